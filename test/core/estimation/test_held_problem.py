"""Test fits to a held input: exact in z, stable, with derivatives against differences."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from omsm_ros.core.estimation.model_structure import Structure
from omsm_ros.core.estimation.output_error import fit
from omsm_ros.core.estimation.sampled_fit import (
    ScaledDiscreteStructure,
    ZeroOrderHoldProblem,
    coefficients,
)

PERIOD, SAMPLES = 0.1, 300
POLES = np.array([0.9 * np.exp(0.4j), 0.9 * np.exp(-0.4j), 0.7])
A = np.poly(POLES).real
B = np.array([0.1, 0.5, -0.2, 0.05])
STRUCTURE = Structure(3, 3, False)
SCALED = ScaledDiscreteStructure(STRUCTURE, 0.5 / PERIOD)


def problem(noise=0.0, seed=1, start=(0.3, -1.0, 2.0)):
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([-1.0, 1.0], SAMPLES // 4), 4)
    y, _ = signal.lfilter(B, A, u, zi=np.array(start))
    y = y + rng.normal(0.0, noise, SAMPLES) if noise else y
    return ZeroOrderHoldProblem(
        u - u.mean(), y, np.ones(SAMPLES, bool), PERIOD, np.ones((SAMPLES, 1)), 0.5 / PERIOD
    )


def test_the_denominator_is_that_of_the_poles():
    nonlinear = SCALED.of_discrete(POLES)
    whole = np.ones(1)
    for factor in SCALED.polynomials(nonlinear):
        whole = np.polynomial.polynomial.polymul(whole, factor)
    np.testing.assert_allclose(whole / whole[0], A, atol=1e-5)
    q = np.exp(-1j * np.array([0.1, 1.0, 3.0]))
    lag = SCALED.lag(nonlinear, q)
    expected = 1 / np.polynomial.polynomial.polyval(q, whole)
    np.testing.assert_allclose(lag, expected, rtol=1e-9)


def test_unstable_poles_are_reflected():
    nonlinear = SCALED.of_discrete(np.array([1 / 0.7, 1.1j, -1.1j]))
    whole = np.ones(1)
    for factor in SCALED.polynomials(nonlinear):
        whole = np.polynomial.polynomial.polymul(whole, factor)
    found = np.roots(whole)
    assert np.max(np.abs(found)) < 1
    assert np.min(np.abs(found - 0.7)) < 1e-5


def test_any_parameters_are_stable():
    rng = np.random.default_rng(3)
    for _ in range(100):
        for factor in SCALED.polynomials(rng.uniform(-5, 5, 3)):
            assert np.all(np.abs(np.roots(factor)) < 1)


def test_without_noise_the_coefficients_are_exact_from_any_initial_state():
    of = problem()
    found = fit(of, STRUCTURE, [SCALED.of_discrete(0.9 * POLES)])
    numerator, denominator, _ = coefficients(found)
    np.testing.assert_allclose(numerator, B, atol=1e-5)
    np.testing.assert_allclose(denominator, A, atol=1e-5)
    np.testing.assert_allclose(of.free_run(found), of.output, atol=1e-5)


def test_the_derivatives_of_the_coefficients_are_those_of_differences():
    found = fit(problem(0.01), STRUCTURE, [SCALED.of_discrete(POLES)])
    _, _, jacobian = coefficients(found)
    for column in range(7):
        step = 1e-6
        moved = []
        for sign in (1, -1):
            driven, nonlinear = found.driven.copy(), found.nonlinear.copy()
            if column < 4:
                driven[column] += sign * step
            else:
                nonlinear[column - 4] += sign * step
            b, a, _ = coefficients(replace(found, driven=driven, nonlinear=nonlinear))
            moved.append(np.concatenate([b, a[1:]]))
        difference = (moved[0] - moved[1]) / (2 * step)
        np.testing.assert_allclose(jacobian[:, column], difference, atol=1e-6)


def test_the_columns_are_the_derivatives_of_the_output():
    of = problem(0.01)
    found = fit(of, STRUCTURE, [SCALED.of_discrete(POLES)])
    columns = of.columns(found)
    for k in range(3):
        step = np.eye(3)[k] * 1e-6
        up, down = (
            of.modelled(replace(found, nonlinear=found.nonlinear + sign * step)) for sign in (1, -1)
        )
        np.testing.assert_allclose(columns[:, 4 + k], (up - down) / 2e-6, atol=1e-5)


def test_twenty_poles_stay_finite():
    """Powers of w up to the twentieth would overflow at half the sampling rate."""
    structure = Structure(20, 20, False)
    scaled = ScaledDiscreteStructure(structure, 0.5 / PERIOD)
    poles = 0.95 * np.exp(1j * np.linspace(0.2, 3.0, 10))
    of = problem(0.01)
    at = of.project(scaled, scaled.of_discrete(np.concatenate([poles, poles.conj()])))
    assert np.all(np.isfinite(at.residual))
    assert np.all(np.isfinite(at.jacobian))


def test_a_run_after_a_gap_ignores_held_out_samples():
    of = problem(0.01)
    used = np.arange(SAMPLES) < 200
    spoiled = replace(of, output=np.where(used, of.output, 1e6), used=used)
    found = fit(spoiled, STRUCTURE, [SCALED.of_discrete(POLES)])
    assert np.std((spoiled.free_run(found) - of.output)[~used]) == pytest.approx(0.01, rel=0.4)
