"""Light modes about as slow as the steps follow each other: poles, or in the band, and no lines."""

import numpy as np
import pytest
from late_steps import LAG, LATE, NOISE, PERIOD, TIME, late_record
from scipy import signal
from soaked import soaked

from benchmarks.recorded import record_from_arrays
from benchmarks.step_test import StepTest
from omsm_ros.core.estimation.preparation import prepare
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.identification.model_choice import model_from_start
from omsm_ros.core.identification.model_error_search import search_model_errors
from omsm_ros.core.kinematics.trajectories import s_curve
from omsm_ros.core.lti.frequency_response import response_band
from omsm_ros.core.model_errors.families import MODE, VIBRATION
from omsm_ros.core.model_errors.undetected import alternative_mode_covariance


def ringing(participation, frequency, damping, late=LATE):
    omega = 2 * np.pi * frequency
    mode = signal.cont2discrete(([omega**2], [1, 2 * damping * omega, omega**2]), PERIOD, "foh")
    return participation * (signal.lfilter(mode[0].ravel(), mode[1], late - late[0]) - late)


@pytest.mark.parametrize(("seed", "modelled"), [(2, True), *soaked((1, False))])
def test_a_slow_mode_that_the_steps_keep_ringing_is_in_the_response_or_in_the_band(seed, modelled):
    """By a nanometre it looks like a line, and is tenfold in the response at its frequency."""
    size, frequency, damping = 1e-4, 0.5, 0.05
    calibration = identify(late_record(-ringing(size, frequency, damping), seed)).calibration
    families = {d.family for d in calibration.certificate.model_errors.modelled}
    assert families == ({MODE} if modelled else set())
    lines = np.array([0.5, 1.0, 1.5])
    ratio = 1j * lines / frequency
    mode = 1 / (1 + 2 * damping * ratio + ratio**2)
    truth = np.exp(-2j * np.pi * lines * LAG) * (1 + size * (mode - 1))
    band = response_band(calibration.dynamics, calibration.covariance, lines)
    off = np.abs(np.log(calibration.dynamics.response(lines) / truth))
    assert np.all(off < 3 * np.hypot(band.gain, band.phase))


@pytest.mark.soak
def test_a_mode_between_the_teeth_of_even_steps_is_no_surer_than_which_mode_it_is():
    """Steps every second show 1.7 Hz by its neighbours: several modes fit about as well."""
    size, frequency, damping = 1e-4, 1.7, 0.05
    steps = StepTest(dwell=1.0)
    time = np.arange(round(steps.duration / PERIOD)) * PERIOD
    late = steps.positions(time - LAG).z
    random = np.random.default_rng(1)
    seen = -late - ringing(size, frequency, damping, late) + random.normal(0, NOISE, len(time))
    z = steps.positions(time).z + random.normal(0, 0.3e-9, len(time))
    found = search_model_errors(
        prepare(record_from_arrays(PERIOD, z, seen), "encoder"), model_from_start
    )
    (mode,), (without,) = found.added_poles, found.without
    fitted = found.model.chosen.fit
    lines = np.linspace(1.2, 2.0, 40)
    spread = response_band(
        fitted.dynamics, alternative_mode_covariance(without, mode, fitted), lines
    )
    ratio = 1j * lines / frequency
    truth = np.exp(-2j * np.pi * lines * LAG) * (
        1 + size * (1 / (1 + 2 * damping * ratio + ratio**2) - 1)
    )
    off = np.abs(np.log(fitted.dynamics.response(lines) / truth))
    assert np.max(off) > 2e-4
    assert np.all(off < 3 * np.max(np.hypot(spread.gain, spread.phase)))


def test_a_mode_that_shows_clearly_is_no_other():
    clear = search_model_errors(
        prepare(late_record(-ringing(3e-4, 3.0, 0.05), 1), "encoder"), model_from_start
    )
    (mode,), (without,) = clear.added_poles, clear.without
    fitted = clear.model.chosen.fit
    spread = response_band(
        fitted.dynamics,
        alternative_mode_covariance(without, mode, fitted),
        np.array([0.2, 0.5, 1.0]),
    )
    assert np.max(np.hypot(spread.gain, spread.phase)) < 1e-5


def test_a_slow_line_of_vibration_is_no_mode():
    line = 1.5e-9 * np.sin(2 * np.pi * 0.73 * TIME + 1.0)
    found = search_model_errors(prepare(late_record(line), "encoder"), model_from_start)
    assert {modelled.term.family for modelled in found.nuisance_terms} == {VIBRATION}
    assert not found.added_poles


def test_a_light_mode_that_rings_through_every_rest_is_no_friction():
    """At 12 Hz and 0.5 %, two poles and friction describe it no better than its own."""
    edges, rng, omega = np.random.default_rng(127), np.random.default_rng(50), 2 * np.pi * 12
    starts = 0.4 + 0.52 * np.arange(20) + edges.uniform(0, PERIOD, 20)
    finer = 2.5e-5
    time = np.arange(0, starts[-1] + 0.52, finer)
    height = np.where(np.arange(20) < 10, 10e-6, -10e-6)
    z = s_curve(np.clip((time[:, np.newaxis] - starts) / 20e-3, 0, 1)) @ height
    downs = np.polymul([omega**-2, 0.01 / omega, 1.0], [0.3e-3, 1.0])
    up, down, _ = signal.cont2discrete(([1.0], downs), finer, "foh")
    seen = signal.lfilter(up.ravel(), down, z)[::40]
    rng.uniform(), rng.normal(size=int((starts[-1] + 0.52) / PERIOD))  # a seed that looked so
    noise = rng.normal(0, 10e-9, len(seen))
    calibration = identify(record_from_arrays(PERIOD, z[::40], noise - seen)).calibration
    found = calibration.certificate
    assert found.findings == ()
    lines = np.array([1.0, 6.0, 11.0, 14.0, 20.0])
    band = response_band(calibration.dynamics, calibration.covariance, lines)
    truth = 1 / np.polyval(downs, 2j * np.pi * lines)
    off = np.log(calibration.dynamics.response(lines) / truth)
    assert np.all(np.abs(off.real) < 3 * band.gain)
    assert np.all(np.abs(off.imag) < 3 * band.phase)
