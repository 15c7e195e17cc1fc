"""The filter over the axes: runs, interruptions, and what it delays."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from soaked import always

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.correction.motion_filter import (
    SETTLED,
    MotionFilter,
    MotionFilters,
    forgetting_samples,
)
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.blocks import RejectionReason
from omsm_ros.core.streams.pairing import SampleRun
from omsm_ros.twin.plant import Plant

G = Plant().dynamics
CALIBRATION = Calibration(
    dynamics=G, static_gain=1.0, sample_period=1e-3, valid_up_to=100.0, covariance=np.zeros((7, 7))
)
X, Y, B, C, ERROR, MOVED, RATE, SENSITIVITIES = range(8)
SPEED = np.array([2e-3, -1e-3, 3e-3, 0.01, 3.0])


def uniform(first: int, length: int, session: int = 0) -> SampleRun:
    """Axes x, y, z, b, c, each at a constant speed."""
    time = (first + np.arange(length)) * 1e-3
    values = SPEED[:, np.newaxis] * time
    return SampleRun(session, first, 0, 1e6, np.zeros(length, np.uint8), values)


def new(**lags: float) -> MotionFilter:
    return MotionFilter(MotionFilters.of(CALIBRATION, 1e-3, **lags))


def settling() -> int:
    return MotionFilters.of(CALIBRATION, 1e-3).settling_samples()


def test_a_uniform_motion_comes_out_late_by_the_lag_from_the_first_sample() -> None:
    (run,) = new().push(uniform(0, 200))
    lag = SPEED[2] * G.low_frequency_delay
    # The settling samples too: uniform motion is what the start assumes.
    assert np.allclose(run.values[ERROR], lag, rtol=1e-6)
    assert np.array_equal(run.reasons[: settling()], np.full(settling(), RejectionReason.SETTLING))
    assert not run.reasons[settling() :].any()


def test_axes_pass_unless_the_lag_is_latency() -> None:
    (run,) = new().push(uniform(0, 100))
    assert np.array_equal(run.values[[X, Y, B, C]], uniform(0, 100).values[[0, 1, 3, 4]])
    (late,) = new(probe_latency=0.4e-3).push(uniform(0, 100))
    shift = SPEED[[0, 1, 3, 4]] * 0.4e-3
    delayed = run.values[[X, Y, B, C]] - shift[:, np.newaxis]
    assert np.allclose(late.values[[X, Y, B, C]], delayed, rtol=0, atol=1e-12)


@pytest.mark.parametrize("length", always(7, 400, of=[1, 2, 7, 50, 400]))
@pytest.mark.parametrize("least", [0.0, -np.pi])
@pytest.mark.parametrize("speed", [300.0, -300.0, 2 * np.pi * 1000])
def test_a_spindle_that_begins_anew_on_every_turn_is_delayed_alike(
    length: int, least: float, speed: float
) -> None:
    """Also one that makes a whole turn from sample to sample, where nothing begins anew."""
    once = speed > 1000
    counting, anew = new(probe_latency=0.4e-3), new(probe_latency=0.4e-3)
    both: list[list[SampleRun]] = [[], []]
    for first in range(0, 400, length):
        run = uniform(first + 10, length)
        turned = replace(run, values=run.values.copy())
        turned.values[4] *= speed / SPEED[4]
        wrapped = replace(turned, values=turned.values.copy())
        if not once:
            wrapped.values[4] = (turned.values[4] - least) % (2 * np.pi) + least
        both[0] += counting.push(turned)
        both[1] += anew.push(wrapped)
    expected, found = (np.concatenate([r.values[C] for r in runs]) for runs in both)
    # The direction of rotation is unknown in the first samples.
    settled = slice(settling(), None)
    assert np.allclose(np.exp(1j * found)[settled], np.exp(1j * expected)[settled], atol=1e-9)
    lag = speed * (10 + np.arange(len(expected))) * 1e-3 - expected
    assert np.allclose(lag, speed * 0.4e-3, rtol=0, atol=1e-7)


def test_the_rate_is_the_speed() -> None:
    (run,) = new().push(uniform(0, 100))
    assert np.allclose(run.values[RATE], SPEED[2], rtol=1e-6)
    assert len(run.values) == SENSITIVITIES


def test_too_few_samples_wait_and_are_settling_at_the_end() -> None:
    motion = new()
    assert motion.push(uniform(0, 5)) == []
    assert motion.pending == 5
    (run,) = motion.end()
    assert motion.pending == 0
    assert np.all(run.reasons == RejectionReason.SETTLING)


@pytest.mark.parametrize(
    ("first", "session"), [(101, 0), (100, 1)], ids=["a gap", "another session"]
)
def test_an_interruption_settles_again(first: int, session: int) -> None:
    motion = new()
    motion.push(uniform(0, 100))
    (run,) = motion.push(uniform(first, 100, session))
    assert np.count_nonzero(run.reasons == RejectionReason.SETTLING) == settling()


def test_an_axis_that_is_no_number_splits_the_run() -> None:
    broken = uniform(0, 300)
    broken.values[4, 100:103] = np.nan
    runs = new().push(broken)
    assert [(r.first, len(r)) for r in runs] == [(0, 100), (100, 3), (103, 197)]
    assert np.all(runs[1].reasons == RejectionReason.INVALID)
    assert np.count_nonzero(runs[2].reasons == RejectionReason.SETTLING) == settling()
    assert np.all(np.isfinite(runs[2].values))


def test_settling_covers_the_lateral_delay_too() -> None:
    filters = MotionFilters.of(CALIBRATION, 1e-3, probe_latency=80e-3)
    assert filters.settling_samples() > 80


def test_however_the_stream_is_cut_the_same_samples_settle() -> None:
    whole = uniform(0, 300)
    (at_once,) = new(probe_latency=0.4e-3).push(whole)
    cut = new(probe_latency=0.4e-3)
    bounds = [0, 5, 13, 14, 40, 41, 60, 200, 300]
    runs = [run for a, b in pairwise(bounds) for run in cut.push(whole.part(a, b))]
    assert np.array_equal(np.concatenate([run.reasons for run in runs]), at_once.reasons)
    assert np.array_equal(np.concatenate([run.values for run in runs], axis=1), at_once.values)


def test_variance_of_the_dynamics_is_that_of_the_lag_at_constant_speed() -> None:
    """An uncertain delay, and an uncertain time constant: v² (σ_τ² + σ_d²)."""
    covariance = np.zeros((7, 7))
    covariance[3, 3], covariance[6, 6] = (2e-6) ** 2, (3e-6) ** 2
    uncertain = replace(CALIBRATION, covariance=covariance)
    (run,) = MotionFilter(MotionFilters.of(uncertain, 1e-3)).push(uniform(0, 200))
    expected = SPEED[2] ** 2 * ((2e-6) ** 2 + (3e-6) ** 2)
    found = np.sum(run.values[SENSITIVITIES:] ** 2, axis=0)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_a_run_just_long_enough_to_start_on_is_filtered() -> None:
    """One sample fewer waits for more; that many come out at once."""
    enough = next(n for n in range(1, 100) if new().push(uniform(0, n)))
    motion = new()
    assert motion.push(uniform(0, enough - 1)) == []
    assert sum(len(run) for run in motion.push(uniform(enough - 1, 1))) == enough
    assert motion.pending == 0


def test_a_slow_pole_of_small_share_is_forgotten_before_its_decay_ends():
    """A relaxation of 0.01 % with 2 s next to a pole of 1 ms settles soon."""
    size, slow, fast = 1e-4, 2.0, 1e-3
    dynamics = TransferFunction.from_ascending(
        [1.0, slow * (1 - size)], [1.0, slow + fast, slow * fast]
    )
    expected = slow * np.log(2 * size / SETTLED) / 1e-3
    assert forgetting_samples(dynamics, 1e-3) == pytest.approx(expected, rel=0.01)
    known = replace(CALIBRATION, dynamics=dynamics, covariance=np.zeros((5, 5)))
    shares = MotionFilters.of(known, 1e-3)
    assert shares.settling_samples() < 0.5 * shares.height.settling_samples(SETTLED)


def test_of_fast_poles_alone_a_start_is_forgotten_as_ever():
    filters = MotionFilters.of(CALIBRATION, 1e-3)
    assert filters.settling_samples() <= filters.height.settling_samples(SETTLED)
