"""Backlash of a machine whose servo overshoots: its own columns, not poles that imitate it."""

import numpy as np
import pytest
from scipy import signal

from benchmarks.recorded import record_from_arrays
from benchmarks.step_test import StepTest
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.model_errors.families import backlash_lead, through_backlash, without_noise

PERIOD, FINER = 1e-3, 20
LAG_S = 0.34e-3
HALF_GAP_M = 15e-9


def played(motion, half):
    """The play operator, value by value."""
    state, found = motion[0], []
    for value in motion:
        state = min(max(state, value - half), value + half)
        found.append(state)
    return np.array(found)


@pytest.mark.parametrize("half", [0.05, 0.4, 3.0])
def test_a_gap_is_the_play_operator(half):
    rng = np.random.default_rng(7)
    motion = np.repeat(np.cumsum(rng.normal(size=200)), 2)
    np.testing.assert_allclose(through_backlash(motion, half), played(motion, half), atol=1e-12)


def test_what_is_lost_lies_within_the_gap_and_its_start_is_forgotten_when_crossed():
    motion = np.concatenate([np.linspace(0, 1, 50), np.linspace(1, -1, 100)])
    ahead, start = backlash_lead(motion, [0.5])
    assert (np.min(ahead), np.max(ahead)) == (pytest.approx(-1), pytest.approx(1))
    assert start[0] == 1.0
    assert np.all(start[motion.cumsum() > 15] == 0)


def test_noise_is_no_reversal():
    rng = np.random.default_rng(8)
    still = without_noise(rng.normal(0, 1e-9, 5000), 1e-9)
    assert np.ptp(still) < 5e-9
    np.testing.assert_array_equal(without_noise(np.arange(5.0), 0.0), np.arange(5.0))


def overshooting(seed, half_gap):
    """A 60 Hz servo of 50 % damping, a structure that lags, and a gap behind it."""
    test = StepTest()
    time = np.arange(0, test.duration, PERIOD / FINER)
    omega = 2 * np.pi * 60
    servo = signal.lti([omega**2], [1.0, omega, omega**2])
    _, z, _ = signal.lsim(servo, test.positions(time).z, time)
    _, follows, _ = signal.lsim(signal.lti([1.0], [LAG_S, 1.0]), z, time)
    rng = np.random.default_rng(seed)
    seen = played(follows, half_gap)[::FINER]
    encoder = z[::FINER] + rng.normal(0, 0.3e-9, len(seen))
    return record_from_arrays(PERIOD, encoder, -seen + rng.normal(0, 10e-9, len(seen)))


@pytest.mark.soak
def test_backlash_behind_an_overshooting_servo_is_found_and_bends_no_pole():
    found = identify(overshooting(3, HALF_GAP_M)).calibration
    (model_error,) = found.certificate.model_errors.modelled
    assert model_error.family == "backlash"
    assert model_error.size_m == pytest.approx(HALF_GAP_M, rel=0.1)
    assert found.certificate.structure.poles <= 2
    off = found.dynamics.response(1.0) * (1 + 2j * np.pi * LAG_S) - 1
    # Three nanometres on a tenth of a millimetre.
    assert abs(off) < 30e-6


@pytest.mark.soak
def test_an_overshooting_servo_without_a_gap_shows_none():
    certificate = identify(overshooting(4, 0.0)).calibration.certificate
    assert certificate.model_errors.modelled == ()
    assert certificate.verdict == "accepted"
