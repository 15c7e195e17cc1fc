"""Test initial-condition responses: their form, and when they are significant."""

from dataclasses import replace

import numpy as np
import pytest

from omsm_ros.core.estimation.model_order import fit
from omsm_ros.core.estimation.model_structure import ScaledStructure
from omsm_ros.core.estimation.output_error import Problem
from omsm_ros.core.identification.model_choice import has_initial_response
from omsm_ros.core.lti.modes import known_modes
from omsm_ros.core.lti.transfer_function import Structure, TransferFunction

PERIOD, RATE, SAMPLES, SKIPPED = 1e-3, 2 * np.pi * 50, 4000, 50
TIME = np.arange(SAMPLES) * PERIOD
OMEGA, DAMPING = 2 * np.pi * 60, 0.02
TRUTH = TransferFunction.from_ascending([1.0], [1.0, 2 * DAMPING / OMEGA, OMEGA**-2])
MODE = Structure(2, 0, False)
NOISE = 10e-9


def bumps():
    """Return a band-limited motion that is stationary at both ends."""
    centres = np.arange(0.6, 3.3, 0.3)
    return sum(1e-5 * np.exp(-(((TIME - centre) / 6e-3) ** 2)) for centre in centres)


def ringing(amplitude):
    """Return the initial-condition response of the mode, in closed form."""
    turning = OMEGA * np.sqrt(1 - DAMPING**2)
    return amplitude * np.exp(-DAMPING * OMEGA * TIME) * np.cos(turning * TIME + 0.7)


def problem(amplitude, seed=1):
    motion = bumps()
    spectrum = np.fft.rfft(motion) * TRUTH.response(np.fft.rfftfreq(SAMPLES, PERIOD))
    seen = np.fft.irfft(spectrum, SAMPLES) + ringing(amplitude)
    seen = seen + np.random.default_rng(seed).normal(0, NOISE, SAMPLES)
    used = np.arange(SAMPLES) >= SKIPPED
    return Problem(motion, seen, used, PERIOD, np.ones((SAMPLES, 1)), RATE)


def fitted(of):
    start = ScaledStructure(MODE, RATE).nonlinear_of(TRUTH.poles() / RATE, 0.0)
    return fit(of, MODE, [start])


def test_free_decays_are_those_of_the_differential_equation():
    whole = replace(problem(0.0), fits_initial_condition=True)
    columns = whole.initial_condition_response(fitted(problem(0.0)))[SKIPPED:]
    expected = ringing(1.0)[SKIPPED:]
    columns = columns / np.linalg.norm(columns, axis=0)
    left = expected - columns @ np.linalg.lstsq(columns, expected, rcond=None)[0]
    # The mode of the columns is the fitted one, which noise keeps from the true one.
    assert np.linalg.norm(left) < 2e-3 * np.linalg.norm(expected)


@pytest.mark.parametrize("amplitude", [0.0, 100e-9, 3e-6])
def test_ringing_is_seen_where_it_is(amplitude):
    of = problem(amplitude)
    assert has_initial_response(of, fitted(of)) is (amplitude > 0)


def test_a_record_that_starts_moving_is_not_asked():
    """The motion before is unknown; it would bias a fit before it becomes significant."""
    of = problem(0.0)
    assert has_initial_response(of, fitted(of), at_rest=False)


def test_a_chance_is_rarely_taken_for_ringing():
    assert not any(
        has_initial_response(of, fitted(of)) for of in (problem(0.0, s) for s in range(40))
    )


def test_with_free_decays_only_noise_is_left():
    of = problem(3e-6)
    without, found = fitted(of), fitted(replace(of, fits_initial_condition=True))
    (mode,) = known_modes(found.dynamics)
    assert mode.damping == pytest.approx(DAMPING, rel=1e-3)
    assert found.gain == pytest.approx(1.0, abs=1e-4)
    assert found.rms == pytest.approx(NOISE, rel=0.05)
    assert without.rms > 2 * NOISE


def test_decays_count_as_parameters():
    of = problem(0.0)
    assert fitted(of).size == MODE.size
    assert fitted(replace(of, fits_initial_condition=True)).size == MODE.size + MODE.poles


def test_sensitivity_includes_the_decays():
    """Against differences of the output, at fixed linear parameters."""
    of = replace(problem(3e-6), fits_initial_condition=True)
    found = fitted(of)
    columns = of.sensitivity(found)
    for k in range(MODE.poles):
        step = np.zeros(MODE.poles)
        step[k] = 1e-6
        up, down = (
            of.modelled(replace(found, nonlinear=found.nonlinear + sign * step)) for sign in (1, -1)
        )
        difference = ((up - down) / 2e-6)[of.used]
        np.testing.assert_allclose(columns[:, k], difference, atol=1e-5 * np.max(difference))
    assert columns.shape[1] == MODE.size + 1 + MODE.poles + 1


def test_fast_poles_are_over_before_the_first_sample_that_counts():
    """Then nothing is looked for, whatever the residual holds."""
    fast = Structure(1, 0, False)
    of = problem(3e-6)
    found = fit(
        of, fast, [ScaledStructure(fast, RATE).nonlinear_of(np.array([-4000 / RATE + 0j]), 0.0)]
    )
    quick = replace(
        found,
        nonlinear=ScaledStructure(fast, RATE).nonlinear_of(np.array([-4000 / RATE + 0j]), 0.0),
    )
    assert not has_initial_response(of, quick)
