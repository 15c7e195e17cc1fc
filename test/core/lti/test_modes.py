"""Modes against their own sum, partial fractions, and coefficients drawn at random."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy import signal

from omsm_ros.core.lti.modes import KnownMode, known_modes, modal_remainder, modal_sum, mode_entries
from omsm_ros.core.lti.transfer_function import TransferFunction

multiply, add = np.polynomial.polynomial.polymul, np.polynomial.polynomial.polyadd
PAIR_HZ, DAMPING, REAL_HZ = 120.0, 0.2, 900.0


def _mode(residue: float, frequency: float, damping: float) -> KnownMode:
    return KnownMode(frequency, 0.0, damping, 0.0, residue, 0.0)


TERMS = (_mode(2e4, 40.0, 0.03), _mode(-5e5, 150.0, 0.02))


def section(term):
    omega = 2 * np.pi * term.frequency
    return np.array([omega**2, 2 * term.damping * omega, 1.0])


def of_terms(terms, delay=0.0):
    """Eq. 8 over a common denominator."""
    numerator, denominator = np.zeros(1), np.ones(1)
    for term in terms:
        numerator = add(multiply(numerator, section(term)), term.residue * denominator)
        denominator = multiply(denominator, section(term))
    return TransferFunction.from_ascending(numerator, denominator, delay)


def exact(dynamics):
    """Its modes without uncertainty."""
    size = len(dynamics.numerator) + len(dynamics.denominator)
    return known_modes(dynamics, np.zeros((size, size)))


@pytest.fixture(scope="module")
def identified():
    """A pair and a real pole, and coefficients correlated as those of a fit, nearly exact."""
    omega, rate = 2 * np.pi * PAIR_HZ, 2 * np.pi * REAL_HZ
    denominator = multiply([1.0, 2 * DAMPING / omega, 1 / omega**2], [1.0, 1 / rate])
    dynamics = TransferFunction([1.0, 1e-4], denominator, 1e-4)
    coefficients = np.array([*dynamics.numerator, *denominator[1:], 1e-4])
    random = np.random.default_rng(3)
    root = 1e-3 * coefficients[:, np.newaxis] * random.normal(size=(6, 6))
    return dynamics, coefficients, root @ root.T


def drawn(identified, count):
    dynamics, coefficients, covariance = identified
    random = np.random.default_rng(4)
    zeros = len(dynamics.numerator)
    for row in random.multivariate_normal(coefficients, covariance, size=count, tol=1e-6):
        yield TransferFunction(row[:zeros], np.r_[1.0, row[zeros:-1]], row[-1])


def test_values_are_those_of_the_transfer_function(identified):
    dynamics, _, covariance = identified
    pair, real = known_modes(dynamics, covariance)
    assert (pair.frequency, pair.damping) == pytest.approx((PAIR_HZ, DAMPING))
    assert (real.frequency, real.damping) == pytest.approx((REAL_HZ, 1.0))


def test_the_residue_is_that_of_partial_fractions(identified):
    dynamics, _, covariance = identified
    residues, poles, _ = signal.residue(dynamics.numerator[::-1], dynamics.denominator[::-1])
    upper = np.argmax(poles.imag)
    pair, real = known_modes(dynamics, covariance)
    assert pair.residue == pytest.approx(-2 * np.real(residues[upper] * np.conj(poles[upper])))
    assert real.residue is None


def test_uncertainties_are_the_scatter_of_drawn_coefficients(identified):
    dynamics, _, covariance = identified
    every = [exact(one) for one in drawn(identified, 2000)]
    known = known_modes(dynamics, covariance)
    # The scatter of 2000 is known to 1.6 %.
    for index, name in ((0, "frequency"), (1, "frequency"), (0, "damping"), (0, "residue")):
        scatter = np.std([getattr(modes[index], name) for modes in every])
        assert getattr(known[index], f"{name}_uncertainty") == pytest.approx(scatter, rel=0.05)
    assert known[1].damping_uncertainty == 0.0
    assert known[1].residue_uncertainty is None


@pytest.mark.parametrize("place", range(6))
def test_the_residue_follows_each_coefficient_as_finite_differences_do(identified, place):
    dynamics, coefficients, _ = identified
    alone = np.zeros((6, 6))
    alone[place, place] = coefficients[place] ** 2
    step = np.zeros(6)
    step[place] = 1e-5 * coefficients[place]
    low, high = (
        exact(TransferFunction.from_ascending(row[:2], np.r_[1.0, row[2:5]], row[5]))[0].residue
        for row in (coefficients - step, coefficients + step)
    )
    stated = known_modes(dynamics, alone)[0].residue_uncertainty
    assert stated == pytest.approx(abs(high - low) / 2e-5, rel=1e-5, abs=1e-3)


def test_a_modal_sum_has_its_terms_as_modes():
    dynamics = of_terms(TERMS)
    for given, mode in zip(TERMS, exact(dynamics), strict=True):
        assert mode.frequency == pytest.approx(given.frequency)
        assert mode.damping == pytest.approx(given.damping)
        assert mode.residue * dynamics.dc_gain == pytest.approx(given.residue, rel=1e-6)
    assert modal_remainder(dynamics, 200.0) < 1e-6


def test_a_modal_sum_is_the_sum_of_its_terms():
    frequency = np.array([1.0, 39.0, 151.0])
    expected = of_terms(TERMS).response(frequency)
    np.testing.assert_allclose(modal_sum(TERMS, frequency), expected)
    np.testing.assert_array_equal(modal_sum((), frequency), 0)


def test_the_scale_of_the_response_does_not_count(identified):
    """A static gain left in G, or taken out of it, is not of the modes."""
    dynamics, _, covariance = identified
    scale = np.array([2.0, 2.0, 1.0, 1.0, 1.0, 1.0])
    doubled = TransferFunction(2 * dynamics.numerator, dynamics.denominator, dynamics.delay)
    (once, _), (twice, _) = (
        known_modes(dynamics, covariance),
        known_modes(doubled, covariance * np.outer(scale, scale)),
    )
    assert twice.residue == pytest.approx(once.residue)
    assert twice.residue_uncertainty == pytest.approx(once.residue_uncertainty)


def test_what_the_terms_leave_is_the_real_pole():
    """One pair and one real pole, parallel: the real pole's share of G(0) is left at 0 Hz."""
    term, rate, share = _mode(1.0, 40.0, 0.1), 2 * np.pi * 300.0, 0.1
    omega = 2 * np.pi * term.frequency
    pair = _mode((1 - share) * omega**2, term.frequency, term.damping)
    numerator = add(multiply([pair.residue], [1.0, 1 / rate]), share * section(term))
    both = TransferFunction.from_ascending(
        numerator, multiply(section(term), [1.0, 1 / rate]), delay=1e-3
    )
    greatest = np.max(np.abs(both.response(np.linspace(0.0, 100.0, 4000))))
    assert modal_remainder(both, 100.0) == pytest.approx(share / greatest, rel=1e-3)
    assert modal_remainder(TransferFunction([1.0], [1.0, 1e-3]), 100.0) is None


def test_without_poles_there_are_no_modes(true_calibration):
    assert exact(TransferFunction([1.0], [1.0], 1e-4)) == ()
    known = known_modes(true_calibration.dynamics, true_calibration.covariance)
    assert len(known) == sum(pole.imag >= 0 for pole in true_calibration.dynamics.poles())
    assert {mode.frequency_uncertainty for mode in known} == {0.0}


def test_entries_are_json_with_units(identified):
    dynamics, _, covariance = identified
    entries = mode_entries(dynamics, covariance)
    assert json.loads(json.dumps(entries, allow_nan=False)) == entries
    pair, real = known_modes(dynamics, covariance)
    assert entries[0]["frequency_hz"] == pair.frequency
    assert entries[0]["residue_uncertainty_per_s2"] == pair.residue_uncertainty
    assert entries[1]["frequency_uncertainty_hz"] == real.frequency_uncertainty
    assert entries[1]["residue_per_s2"] is None


def test_of_poles_that_coincide_nothing_is_known():
    double = TransferFunction([1.0], [1.0, 2e-3, 1e-6])
    entries = mode_entries(double, 1e-12 * np.eye(4))
    assert len(entries) == 2
    for mode, entry in zip(known_modes(double, 1e-12 * np.eye(4)), entries, strict=True):
        assert mode.frequency_uncertainty == np.inf
        assert entry["frequency_uncertainty_hz"] is None
