"""Comparison of calibrations whose differences and uncertainties are written down, not fitted."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from certified import certified_by
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from omsm_ros.cli.calibration import change_text, repeatability_text
from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.calibration.certificate import Certificate
from omsm_ros.core.calibration.repeatability import (
    Spread,
    common_lines,
    compare_calibrations,
    mahalanobis,
    repeatability,
    response_covariance,
)
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.blocks import FloatArray

LAG, LAG_U, GAIN_U = 3e-4, 2e-6, 4e-6


def late(delay: float = LAG, gain: float = 1.0, **other: object) -> Calibration:
    """A pure delay: its phase alone is uncertain, by ω times the uncertainty of the delay."""
    parts: dict[str, object] = {
        "covariance": np.diag([0.0, LAG_U**2]),
        "certificate": certified_by({"static_gain_uncertainty": GAIN_U}),
        "valid_up_to": 60.0,
    }
    return Calibration(
        dynamics=TransferFunction(np.ones(1), np.ones(1), delay),
        static_gain=gain,
        sample_period=1e-3,
        **(parts | other),  # type: ignore[arg-type]
    )


@pytest.mark.parametrize("sigmas", [0.0, 0.5, 2.0, 6.0])
@pytest.mark.parametrize("gains", [0.0, 1.0, 5.0])
def test_chance_is_that_of_two_independent_differences(sigmas: float, gains: float) -> None:
    """One direction of the response, the delay, and one gain: χ² with two degrees of freedom."""
    delay_u, gain_u = LAG_U * math.sqrt(2), GAIN_U * math.sqrt(2)
    found = compare_calibrations(late(), late(LAG + sigmas * delay_u, 1.0 + gains * gain_u))
    assert found.delay_sigmas == pytest.approx(sigmas, abs=1e-9)
    assert found.static_gain_sigmas == pytest.approx(gains, abs=1e-9)
    expected = stats.chi2.sf(sigmas**2 + gains**2, 2)
    assert found.p_value == pytest.approx(expected, rel=1e-6, abs=0)
    assert found.changed is bool(expected < 1e-3)


def test_the_other_way_round_the_signs_turn() -> None:
    old, new = late(), late(LAG + 9e-6, 1.00001)
    there, back = compare_calibrations(old, new), compare_calibrations(new, old)
    assert back.p_value == pytest.approx(there.p_value, rel=1e-9)
    assert (back.delay, back.phase_at) == pytest.approx((-there.delay, -there.phase_at))
    assert back.static_gain == pytest.approx(-there.static_gain, rel=1e-4)
    # The largest change is at the top of the band that is compared.
    assert there.frequency == common_lines([old, new])[-1]
    assert there.phase_at == pytest.approx(-2 * np.pi * there.frequency * 9e-6)
    assert there.gain_at == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("unit", [1e-3, 4.0, 1e3])
def test_the_unit_of_the_probe_does_not_matter(unit: float) -> None:
    """A gain in µm per volt changes by as many parts, and as many sigmas, as one near 1."""
    reported = {"static_gain_uncertainty": unit * GAIN_U}
    found = compare_calibrations(
        late(gain=unit, certificate=certified_by(reported)),
        late(gain=unit * 1.00001, certificate=certified_by(reported)),
    )
    assert found.static_gain == pytest.approx(1e-5)
    assert found.static_gain_sigmas == pytest.approx(1e-5 / GAIN_U / math.sqrt(2))


def test_a_phase_that_has_turned_round_is_near() -> None:
    """A delay of 0.1 s more: at 10 Hz the phase has turned once, and is the same again."""
    old = late(valid_up_to=30.0, covariance=np.diag([0.0, 1.0]))
    new = replace(old, dynamics=TransferFunction(np.ones(1), np.ones(1), LAG + 0.1))
    found = compare_calibrations(old, new)
    assert abs(found.phase_at) <= np.pi
    lines = common_lines([old, new])
    wrapped = np.angle(np.exp(-2j * np.pi * lines * 0.1))
    assert found.phase_at == pytest.approx(wrapped[lines == found.frequency][0])
    assert found.delay == pytest.approx(0.1)


def test_without_a_stated_uncertainty_nothing_is_known_of_the_gain() -> None:
    silent = [late(gain=g, certificate=Certificate()) for g in (1.0, 1.5)]
    found = compare_calibrations(*silent)
    assert found.static_gain == pytest.approx(0.5)
    assert found.static_gain_sigmas == 0.0
    assert not found.changed
    assert change_text(found).startswith("no significant change")


def test_one_stated_uncertainty_is_enough_to_judge_the_gain() -> None:
    found = compare_calibrations(late(certificate=Certificate()), late(gain=1.0 + 3 * GAIN_U))
    assert found.static_gain_sigmas == pytest.approx(3.0)


def test_a_delay_that_is_known_exactly_changes_beyond_all_sigmas() -> None:
    exact = [late(d, covariance=np.zeros((2, 2))) for d in (LAG, LAG + 1e-9)]
    assert compare_calibrations(*exact).delay_sigmas == float("inf")


def test_undetected_error_in_both_alike_does_not_excuse_a_change() -> None:
    """Ten times the noise is stated besides; repeated tests of one machine do not scatter so."""
    noise = [0.0, 0.0, 0.0, LAG_U**2]
    reported = {"static_gain_uncertainty": GAIN_U, "noise_covariance": noise}
    broad = {"covariance": np.diag([0.0, (10 * LAG_U) ** 2]), "certificate": certified_by(reported)}
    found = compare_calibrations(late(**broad), late(LAG + 6 * LAG_U, **broad))  # type: ignore[arg-type]
    assert found.delay_sigmas == pytest.approx(6 / math.sqrt(2))
    assert found.changed


def test_a_change_is_reported_with_sign_and_sigmas() -> None:
    text = change_text(compare_calibrations(late(), late(LAG - 20e-6, 1.0001)))
    assert text.startswith("changed: lag by -20.0 µs (7.1 sigma), static gain by +100 ppm (17.7")


def test_lines_end_within_the_band_of_the_one_that_knows_least() -> None:
    lines = common_lines([late(), late(valid_up_to=15.0), late(valid_up_to=300.0)])
    assert np.array_equal(lines, common_lines([late(valid_up_to=15.0)] * 2))
    assert np.allclose(np.diff(lines, 2), 0.0, atol=1e-12)
    assert 0 < lines[0] < lines[-1] < 15.0


def test_covariance_of_a_delays_response() -> None:
    lines = np.array([1.0, 5.0, 20.0])
    omega = 2 * np.pi * lines
    expected = np.zeros((6, 6))
    expected[3:, 3:] = np.outer(omega, omega) * LAG_U**2
    np.testing.assert_allclose(response_covariance(late(), lines), expected, atol=1e-25)


regular = st.integers(0, 1000).map(
    lambda seed: np.random.default_rng(seed).normal(size=(4, 12)) + 3 * np.eye(4, 12)
)


@settings(max_examples=30)
@given(mixing=regular, seed=st.integers(0, 100))
def test_chi_square_is_that_of_the_inverse_in_any_units(mixing: FloatArray, seed: int) -> None:
    covariance, random = mixing @ mixing.T / 12, np.random.default_rng(seed)
    off, units = random.normal(size=4), 10.0 ** random.integers(-9, 9, 4)
    found, known = mahalanobis(off * units, covariance * np.outer(units, units))
    plain, _ = mahalanobis(off, covariance)
    assert found == pytest.approx(plain, rel=1e-6)
    if known == 4:
        assert plain == pytest.approx(off @ np.linalg.solve(covariance, off), rel=1e-9)


def test_a_direction_that_is_stated_twice_counts_once() -> None:
    one = np.array([[2.0]])
    twice = np.kron(np.ones((3, 3)), one)
    assert mahalanobis(np.array([4.0]), one) == pytest.approx((8.0, 1))
    assert mahalanobis(np.full(3, 4.0), twice) == pytest.approx((8.0, 1))


def test_order_of_the_quantities_does_not_matter() -> None:
    mixing = np.random.default_rng(1).normal(size=(5, 9))
    covariance, off = mixing @ mixing.T, np.arange(5.0)
    order = np.array([3, 0, 4, 1, 2])
    turned = mahalanobis(off[order], covariance[np.ix_(order, order)])
    assert turned == pytest.approx(mahalanobis(off, covariance))


def test_two_of_a_series_have_no_more_scatter_than_three_say() -> None:
    """One off by a: deviations a/n of the others, χ² = a² (n - 1)/n over the variance."""
    n, off = 5, 4.0
    series = [late()] * (n - 1) + [late(LAG + off * LAG_U)]
    found = repeatability(series)
    assert found.delay == Spread(
        mean=pytest.approx(LAG + off * LAG_U / n),
        deviation=pytest.approx(off * LAG_U / math.sqrt(n)),
        stated=pytest.approx(LAG_U),
    )
    # One direction and one gain, n - 1 degrees of freedom each.
    expected = stats.chi2.sf(off**2 * (n - 1) / n, 2 * (n - 1))
    assert found.p_value == pytest.approx(expected, rel=1e-6, abs=0)
    omega = 2 * np.pi * found.frequency
    assert found.phase_stated == pytest.approx(omega * LAG_U)
    assert found.phase_deviation == pytest.approx(omega * off * LAG_U / math.sqrt(n))
    assert np.max(found.gain_deviation) < 1e-12


def test_order_of_a_series_does_not_matter() -> None:
    series = [late(LAG + k * LAG_U, 1.0 + k**2 * GAIN_U) for k in (0, 2, -1, 1)]
    found, turned = repeatability(series), repeatability(series[::-1])
    assert turned.p_value == pytest.approx(found.p_value, rel=1e-9)
    assert repeatability_text(turned) == repeatability_text(found)


def test_a_gain_that_scatters_alone_is_found() -> None:
    series = [late(gain=1.0 + k * 5 * GAIN_U) for k in (-1, 0, 1, -1, 1)]
    found = repeatability(series)
    assert not found.repeatable
    assert found.delay.ratio == pytest.approx(0.0, abs=1e-9)
    assert found.static_gain.ratio == pytest.approx(5.0)
    assert "scatter more than they state" in repeatability_text(found)
