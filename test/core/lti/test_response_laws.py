"""Laws of continuous responses, of their slow part, and of responses estimated without a model."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial import polynomial
from scipy import signal

from omsm_ros.core.lti.frequency_response import (
    FrequencyResponse,
    frequency_response,
    low_frequency_delay_uncertainty,
    response_band,
    spread_along,
)
from omsm_ros.core.lti.modes import known_modes
from omsm_ros.core.lti.transfer_function import TransferFunction, slow_motion_jacobian, to_control
from omsm_ros.core.ripple.density import aliased_frequency
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import DataError

LINES = np.array([0.0, 0.7, 12.0, 150.0])


def mode(hertz: float, damping: float) -> FloatArray:
    omega = 2 * np.pi * hertz
    return np.array([1.0, 2 * damping / omega, omega**-2])


G = TransferFunction.from_ascending(
    [1.2, -3e-4, 5e-8], polynomial.polymul(mode(80.0, 0.2), [1.0, 1e-3]), 2e-4
)
H = TransferFunction.from_ascending([0.5, 1e-3], mode(25.0, 0.6), 1e-4)


def series(one: TransferFunction, two: TransferFunction) -> TransferFunction:
    return TransferFunction(
        polynomial.polymul(one.numerator, two.numerator),
        polynomial.polymul(one.denominator, two.denominator),
        one.delay + two.delay,
    )


def test_in_series_responses_multiply_and_lags_add() -> None:
    both = series(G, H)
    np.testing.assert_allclose(both.response(LINES), G.response(LINES) * H.response(LINES))
    assert both.low_frequency_delay == pytest.approx(G.low_frequency_delay + H.low_frequency_delay)
    assert both.dc_gain == pytest.approx(G.dc_gain * H.dc_gain)
    for name in ("poles", "zeros"):
        parts = np.concatenate([getattr(G, name)(), getattr(H, name)()])
        np.testing.assert_allclose(
            np.sort_complex(getattr(both, name)()), np.sort_complex(parts), rtol=1e-6
        )


def test_the_gain_at_rest_changes_nothing_but_itself() -> None:
    plain = G.normalised()
    np.testing.assert_allclose(plain.response(LINES) * 1.2, G.response(LINES), rtol=1e-14)
    assert plain.low_frequency_delay == pytest.approx(G.low_frequency_delay)
    assert plain.delay == G.delay
    assert np.array_equal(plain.poles(), G.poles())


def test_backwards_in_frequency_a_real_system_is_conjugate() -> None:
    np.testing.assert_allclose(G.response(-LINES), np.conj(G.response(LINES)), rtol=1e-14)


def test_any_scale_of_both_polynomials_is_one_system() -> None:
    for scale in (7.0, -1e12):
        same = TransferFunction.from_ascending(scale * G.numerator, scale * G.denominator, G.delay)
        assert same.denominator[0] == 1.0
        np.testing.assert_allclose(same.numerator, G.numerator, rtol=1e-14)
        np.testing.assert_allclose(same.denominator, G.denominator, rtol=1e-14)


def test_partial_fractions_add_up_to_the_response() -> None:
    residues, poles, direct = signal.residue(G.numerator[::-1], G.denominator[::-1])
    s = 2j * np.pi * LINES
    total = (residues / (s[:, np.newaxis] - poles)).sum(axis=1) + np.sum(direct)
    np.testing.assert_allclose(total * np.exp(-s * G.delay), G.response(LINES), rtol=1e-8)


def test_zeros_and_poles_are_where_the_response_ends() -> None:
    assert len(G.zeros())
    assert len(G.poles())
    for zero in G.zeros():
        assert abs(G.at(np.array([zero]))[0]) < 1e-9
    with np.errstate(divide="ignore", invalid="ignore"):
        for pole in G.poles():
            assert abs(1 / G.at(np.array([pole * (1 + 1e-13)]))[0]) < 1e-9


def test_modes_are_those_it_was_made_of_slowest_first() -> None:
    found = [(m.frequency, m.damping) for m in known_modes(series(G, H))]
    real = 1 / (2 * np.pi * 1e-3)
    expected = sorted([(25.0, 0.6), (80.0, 0.2), (real, 1.0)])
    assert np.array(found) == pytest.approx(np.array(expected), rel=1e-6)


def test_the_response_has_the_shape_of_its_frequencies() -> None:
    assert G.response(3.0).shape == ()
    assert G.response(np.ones((2, 3))).shape == (2, 3)
    assert G.response([]).shape == (0,)


def test_python_control_multiplies_the_same_way() -> None:
    rational = TransferFunction(G.numerator, G.denominator)
    both = to_control(rational) * to_control(TransferFunction(H.numerator, H.denominator))
    s = 2j * np.pi * 12.0
    expected = (
        rational.at(np.array([s]))[0]
        * TransferFunction(H.numerator, H.denominator).at(np.array([s]))[0]
    )
    assert both(s) == pytest.approx(expected)


def test_a_better_approximant_of_the_delay_is_nearer() -> None:
    hertz = np.array([1000.0])
    missed = [
        abs(to_control(G, order)(2j * np.pi * hertz[0]) - G.response(hertz)[0])
        for order in (1, 2, 4)
    ]
    assert missed[0] > 10 * missed[1] > 100 * missed[2]


# -- slow motion

delays = st.floats(0.0, 1e-3)
small = st.floats(-1e-3, 1e-3)


@settings(max_examples=40)
@given(n=st.tuples(st.floats(0.5, 2), small, small), d=st.tuples(small, small), delay=delays)
def test_slow_motion_by_hand(
    n: tuple[float, float, float], d: tuple[float, float], delay: float
) -> None:
    """L = τ + d1 - n1/n0, k = n2/n0 - n1²/2n0² - d2 + d1²/2, differentiated."""
    (n0, n1, n2), d1 = n, d[0]
    g = TransferFunction(np.array(n), np.array([1.0, *d, 1e-9]), delay)
    expected = [
        [n1 / n0**2, -1 / n0, 0.0, 1.0, 0.0, 0.0, 1.0],
        [-n2 / n0**2 + n1**2 / n0**3, -n1 / n0**2, 1 / n0, d1, -1.0, 0.0, 0.0],
    ]
    found = slow_motion_jacobian(g)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-15)
    assert g.low_frequency_delay == pytest.approx(delay + d1 - n1 / n0, abs=1e-15)


def test_a_pure_delay_has_no_curvature() -> None:
    found = slow_motion_jacobian(TransferFunction(np.array([2.0]), np.ones(1), 1e-3))
    assert np.array_equal(found, [[0.0, 1.0], [0.0, 0.0]])


def test_slow_phase_is_as_uncertain_as_the_lag() -> None:
    """Well below all poles the phase is ω times the lag, and its uncertainty likewise."""
    p = len(G.numerator) + len(G.denominator)
    sizes = np.concatenate([G.numerator, G.denominator[1:], [G.delay]])
    mixing = np.random.default_rng(2).normal(size=(p, p)) * (1e-3 * sizes)[:, np.newaxis]
    covariance = mixing @ mixing.T
    hertz = np.array([0.01])
    band = response_band(G, covariance, hertz)
    lag = low_frequency_delay_uncertainty(G, covariance)
    assert band.phase[0] == pytest.approx(2 * np.pi * 0.01 * lag, rel=1e-4)
    along = slow_motion_jacobian(G)[0]
    assert np.sqrt(along @ covariance @ along) == pytest.approx(lag, rel=1e-9)
    # At 0 Hz the relative gain is as uncertain as the first coefficient.
    expected = np.sqrt(covariance[0, 0]) / G.dc_gain
    assert band.gain[0] == pytest.approx(expected, rel=1e-4)


def test_spread_is_that_of_draws_and_scales_with_both() -> None:
    mixing = np.random.default_rng(3).normal(size=(3, 3))
    covariance, direction = mixing @ mixing.T, np.array([1.0, -2.0, 0.5])
    draws = np.random.default_rng(4).normal(size=(20_000, 3)) @ mixing.T
    found = spread_along(direction, covariance)
    assert found == pytest.approx(np.std(draws @ direction), rel=0.02)
    assert spread_along(-3 * direction, covariance) == pytest.approx(3 * found)
    assert spread_along(direction, 4 * covariance) == pytest.approx(2 * found)
    several = spread_along(np.stack([direction, 0 * direction]), covariance)
    assert several == pytest.approx(np.array([float(found), 0.0]))


# -- responses without a model

MOTION = np.cumsum(np.random.default_rng(5).normal(size=8000))
PERIOD = 1e-3


def estimated(motion: FloatArray, output: FloatArray, segment: int = 500) -> FrequencyResponse:
    return frequency_response(motion, output, PERIOD, segment)


def test_what_only_scales_has_no_uncertainty() -> None:
    found = estimated(MOTION, -0.4 * MOTION + 12.0)
    np.testing.assert_allclose(found.response, -0.4, atol=1e-9)
    np.testing.assert_allclose(found.coherence, 1.0, atol=1e-9)
    assert np.max(found.uncertainty) < 1e-4
    assert found.frequency[[0, -1]] == pytest.approx([0.0, 500.0])
    assert np.diff(found.frequency) == pytest.approx(np.full(250, 2.0))


NOISY = MOTION + np.random.default_rng(6).normal(0, 2.0, len(MOTION))


def test_estimates_are_linear_in_the_output() -> None:
    one, two, both = (estimated(MOTION, y) for y in (NOISY, MOTION**2, NOISY - 3 * MOTION**2))
    np.testing.assert_allclose(both.response, one.response - 3 * two.response, rtol=1e-9)


@pytest.mark.parametrize(("motion", "output"), [(1e-6, 1.0), (1.0, -1e9)])
def test_units_change_neither_coherence_nor_uncertainty(motion: float, output: float) -> None:
    plain, scaled = estimated(MOTION, NOISY), estimated(motion * MOTION, output * NOISY)
    np.testing.assert_allclose(scaled.response, plain.response * output / motion, rtol=1e-9)
    np.testing.assert_allclose(scaled.coherence, plain.coherence, rtol=1e-9)
    np.testing.assert_allclose(scaled.uncertainty, plain.uncertainty, rtol=1e-6)


def test_stand_off_and_home_do_not_matter() -> None:
    plain, moved = estimated(MOTION, NOISY), estimated(MOTION + 100.0, NOISY - 40.0)
    np.testing.assert_allclose(moved.response, plain.response, rtol=1e-6, atol=1e-9)


def test_the_stated_uncertainty_is_the_scatter_over_repetitions() -> None:
    off, stated = [], []
    for seed in range(100, 130):
        noise = np.random.default_rng(seed).normal(0, 0.5, len(MOTION))
        found = estimated(MOTION, MOTION + noise)
        inside = (found.frequency > 5) & (found.frequency < 100)
        off.append((found.response - 1)[inside])
        stated.append(found.uncertainty[inside])
    # Per part, gain or phase; overlapping segments are worth a little less than they count.
    scatter = np.sqrt(np.mean(np.abs(off) ** 2) / 2)
    assert scatter == pytest.approx(np.sqrt(np.mean(np.square(stated))), rel=0.2)


def test_a_segment_longer_than_the_record_is_the_record() -> None:
    found = estimated(MOTION[:300], NOISY[:300], segment=10_000)
    assert len(found.frequency) == 299 // 2 + 1
    assert np.all(np.isfinite(found.response))


# -- folding

rates = st.floats(10.0, 1e5)


@settings(max_examples=50)
@given(share=st.floats(0.0, 40.0), rate=rates)
def test_samples_of_a_wave_are_those_of_its_folded_one(share: float, rate: float) -> None:
    frequency = share * rate
    seen = float(aliased_frequency(frequency, rate))
    assert 0 <= seen <= rate / 2 * (1 + 1e-12)
    k = np.arange(30)
    np.testing.assert_allclose(
        np.cos(2 * np.pi * np.mod(k * share, 1.0)), np.cos(2 * np.pi * k * seen / rate), atol=1e-8
    )
    assert float(aliased_frequency(frequency + 3 * rate, rate)) == pytest.approx(
        seen, abs=1e-6 * rate
    )
    assert float(aliased_frequency(-frequency, rate)) == pytest.approx(seen, abs=1e-9 * rate)


def test_below_half_the_rate_nothing_folds() -> None:
    lines = np.array([[0.0, 10.0], [499.0, 500.0]])
    assert np.array_equal(aliased_frequency(lines, 1000.0), lines)


@pytest.mark.parametrize("rate", [0.0, -1.0, float("nan")])
def test_a_rate_that_is_none_is_named(rate: float) -> None:
    with pytest.raises(DataError, match=f"sample_rate {rate!r} Hz is not positive"):
        aliased_frequency(1.0, rate)
