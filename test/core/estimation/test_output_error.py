"""Test the fit against motions whose response is known in closed form."""

from dataclasses import replace

import numpy as np
import pytest

from omsm_ros.core.estimation.model_order import fit
from omsm_ros.core.estimation.model_structure import ScaledStructure
from omsm_ros.core.estimation.output_error import CompressedProblem, Problem
from omsm_ros.core.estimation.parallel_sections import close_period
from omsm_ros.core.lti.modes import known_modes
from omsm_ros.core.lti.transfer_function import Structure, TransferFunction

PERIOD = 1e-3
RATE = 2 * np.pi * 50


def smooth_motion(samples=4000):
    """A sum of Gaussian bumps: band-limited to 1e-12 at this rate."""
    time = np.arange(samples) * PERIOD
    centres = np.arange(0.5, 3.5, 0.45)
    signs = np.where(np.arange(len(centres)) % 2, -1, 1)
    return sum(
        1e-5 * sign * np.exp(-(((time - centre) / 6e-3) ** 2))
        for sign, centre in zip(signs, centres, strict=True)
    )


def through(motion, dynamics):
    """By the Fourier series of the periodic motion, exact for bumps far from the ends."""
    spectrum = np.fft.rfft(motion)
    frequency = np.fft.rfftfreq(len(motion), PERIOD)
    return np.fft.irfft(spectrum * dynamics.response(frequency), len(motion))


def problem_of(dynamics, gain=1.0, offset=0.0, noise=0.0, seed=0):
    motion = smooth_motion()
    seen = gain * through(motion, dynamics) + offset
    seen = seen + np.random.default_rng(seed).normal(0, noise or 1e-30, len(motion))
    used = np.ones(len(motion), bool)
    return Problem(motion, seen, used, PERIOD, np.ones((len(motion), 1)), RATE)


def resonance(frequency, damping):
    omega = 2 * np.pi * frequency
    return TransferFunction.from_ascending([1.0], [1.0, 2 * damping / omega, omega**-2])


def start(structure, poles, delay=0.1):
    return ScaledStructure(structure, RATE).nonlinear_of(np.asarray(poles, complex), delay)


def test_a_resonance_is_found_exactly_without_noise():
    truth = resonance(60.0, 0.1)
    structure = Structure(2, 0, False)
    found = fit(problem_of(truth), structure, [start(structure, [-1 + 1j, -1 - 1j])])
    np.testing.assert_allclose(found.dynamics.denominator, truth.denominator, rtol=1e-5)


def test_gain_and_offset_come_apart_from_the_dynamics():
    truth = TransferFunction.from_ascending([1.0, 1e-3], [1.0, 4e-3])
    structure = Structure(1, 1, False)
    found = fit(problem_of(truth, -0.99, 3e-6), structure, [start(structure, [-1.0])])
    assert found.gain == pytest.approx(-0.99, rel=1e-6)
    assert found.background[0] == pytest.approx(3e-6, rel=1e-6)
    np.testing.assert_allclose(found.dynamics.numerator, truth.numerator, rtol=1e-4)


@pytest.mark.parametrize("delay", [0.0002, 0.0007, 0.00123])
def test_a_delay_need_not_be_a_number_of_samples(delay):
    structure = Structure(0, 0, True)
    found = fit(problem_of(TransferFunction([1.0], [1.0], delay)), structure, [np.array([0.1])])
    assert found.dynamics.delay == pytest.approx(delay, rel=1e-6)


def test_a_lost_sample_is_not_compared():
    truth = resonance(40.0, 0.3)
    problem = problem_of(truth)
    lost = np.random.default_rng(2).random(len(problem.used)) < 0.3
    spoiled = replace(problem, output=np.where(lost, 1.0, problem.output), used=~lost)
    structure = Structure(2, 0, False)
    found = fit(spoiled, structure, [start(structure, [-1 + 1j, -1 - 1j])])
    assert found.samples == np.sum(~lost)
    np.testing.assert_allclose(found.dynamics.denominator, truth.denominator, rtol=1e-5)


def test_the_best_of_several_starts_wins():
    structure = Structure(2, 0, False)
    problem = problem_of(resonance(90.0, 0.02))
    poor, good = [-0.01 - 0.1j, -0.01 + 0.1j], [-0.1 + 1.7j, -0.1 - 1.7j]
    both = fit(problem, structure, [start(structure, poor), start(structure, good)])
    assert known_modes(both.dynamics)[0].frequency == pytest.approx(90.0, rel=1e-4)


def test_the_slope_after_elimination_points_downhill():
    structure = Structure(2, 1, True)
    problem = problem_of(resonance(60.0, 0.2), noise=1e-8)
    scaled = ScaledStructure(structure, RATE)
    shape = start(structure, [-1 + 1.5j, -1 - 1.5j])
    gradient, _ = problem.project(scaled, shape).normal()
    assert len(gradient) == len(shape) > 0
    for k in range(len(shape)):
        step = np.zeros_like(shape)
        step[k] = 1e-5
        costs = [
            0.5 * np.sum(problem.project(scaled, shape + sign * step).residual ** 2)
            for sign in (1, -1)
        ]
        assert gradient[k] == pytest.approx((costs[0] - costs[1]) / 2e-5, rel=1e-3, abs=0)


@pytest.mark.parametrize("further", [False, True])
@pytest.mark.parametrize("lines", [0, 1000])
def test_sums_over_lines_are_those_over_the_compared_samples(further, lines):
    """Samples that are not compared have the exact answer; sums of a few lines are close."""
    structure = Structure(2, 1, True)
    problem = problem_of(resonance(60.0, 0.2), noise=1e-8)
    lost = np.random.default_rng(2).random(len(problem.used)) < 0.05
    axis = np.roll(problem.input, 700)[np.newaxis] if further else ()
    problem = replace(problem, used=problem.used & ~lost, further=axis)
    scaled = ScaledStructure(structure, RATE)
    shape = start(structure, [-1 + 1.5j, -1 - 1.5j])
    exact = problem.project(scaled, shape)
    there = problem.evaluated(structure, shape)
    at = CompressedProblem.of(problem, lines).filled(there).project(scaled, shape)
    close = 1e-3 if lines else 1e-7
    np.testing.assert_allclose(at.linear, exact.linear, rtol=close, atol=close)
    assert at.residual @ at.residual == pytest.approx(exact.residual @ exact.residual, rel=close)
    np.testing.assert_allclose(at.normal()[0], exact.normal()[0], rtol=0.1)
    np.testing.assert_allclose(at.normal()[1], exact.normal()[1], rtol=0.3)


@pytest.mark.parametrize("missing", [0.0, 0.2, 0.8])
def test_a_long_record_is_explored_by_fewer_sums_to_the_same_minimum(missing):
    structure = Structure(2, 1, True)
    problem = problem_of(resonance(60.0, 0.2), noise=1e-8)
    lost = np.random.default_rng(2).random(len(problem.used)) < missing
    problem = replace(problem, used=problem.used & ~lost)
    starts = [start(structure, [-1 + 1.5j, -1 - 1.5j])]
    exact = fit(problem, structure, starts)
    near = fit(problem, structure, starts, part=CompressedProblem.of(problem, 1000))
    worse = near.sum_of_squares / exact.sum_of_squares - 1
    assert worse * exact.samples < 1


def test_sensitivity_is_the_derivative_of_the_output():
    structure = Structure(2, 1, True)
    problem = problem_of(resonance(60.0, 0.2), gain=-0.98, noise=1e-8)
    found = fit(problem, structure, [start(structure, [-1 + 1.5j, -1 - 1.5j])])
    columns = problem.sensitivity(found)
    moved = replace(found, nonlinear=found.nonlinear + np.array([1e-6, 0, 0]))
    difference = (problem.modelled(moved) - problem.modelled(found)) / 1e-6
    np.testing.assert_allclose(columns[:, 1], difference, atol=1e-3 * np.ptp(difference))


def test_a_response_bends_by_gain_lag_and_curvature():
    """Against the output of responses that differ by 1, s and s² in front."""
    structure = Structure(2, 1, True)
    problem = problem_of(resonance(60.0, 0.2), noise=1e-8)
    found = fit(problem, structure, [start(structure, [-1 + 1.5j, -1 - 1.5j])])
    columns = problem.low_order_sensitivity(found)
    closed = close_period(problem.input, PERIOD)
    frequency = np.fft.rfftfreq(len(closed), PERIOD)
    moved = np.fft.rfft(closed) * found.dynamics.response(frequency)
    for power in range(3):
        low_order_sensitivity = moved * (2j * np.pi * frequency / RATE) ** power
        expected = np.fft.irfft(low_order_sensitivity, len(closed))[: len(problem.input)]
        np.testing.assert_allclose(columns[:, power], expected, atol=1e-9 * np.ptp(expected))


@pytest.mark.parametrize("poles", [1, 2])
def test_no_fitted_pole_is_faster_than_the_samples_can_show(poles):
    """Poles that an answer at once does not need would go to where a corrector refuses them."""
    problem = problem_of(TransferFunction(np.ones(1), np.ones(1)), noise=1e-12)
    structure = Structure(poles, 0, False)
    found = fit(problem, structure, [start(structure, [-1.0] * poles)])
    rates = np.abs(found.dynamics.poles()) * PERIOD
    assert np.max(rates) < 101  # two that coincide are apart by the root of the rounding
