"""Discretisation against the continuous response and the exact solution of the ODE."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial import polynomial
from scipy import signal

from omsm_ros.core.lti.discretisation import bilinear, discretise
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.errors import ConfigurationError, DataError
from omsm_ros.twin.plant import PAPER_EQ_12

PAPER = PAPER_EQ_12.normalised()
BAND = np.array([0.1, 0.5, 1.5, 6.0, 15.0])


def second_order(frequency: float, damping: float, delay: float = 0.0) -> TransferFunction:
    omega = 2 * np.pi * frequency
    return TransferFunction.from_ascending([1.0], [1.0, 2 * damping / omega, 1 / omega**2], delay)


@pytest.mark.parametrize(
    ("period", "order"), [(1e-3, 5), *((1 / 70e3, order) for order in (1, 2, 3, 5, 7))]
)
def test_dc_gain_is_that_of_the_continuous_system(period: float, order: int) -> None:
    assert abs(discretise(PAPER, period, order).response(np.zeros(1))[0] - 1) < 1e-12


def test_static_gain_as_printed_is_kept() -> None:
    at_rest = discretise(PAPER_EQ_12, 1e-3).response(np.zeros(1))[0]
    assert at_rest == pytest.approx(1.26 / 1.27, abs=1e-14)


@pytest.mark.parametrize("delay", [0.0, 0.34e-3, 1e-3, 2.7e-3, 5e-3])
def test_band_of_a_scan_is_followed_to_a_part_in_a_hundred_thousand(delay: float) -> None:
    dynamics = TransferFunction(PAPER.numerator, PAPER.denominator, delay)
    error = abs(discretise(dynamics, 1e-3).response(BAND) - dynamics.response(BAND))
    assert np.all(error < 1e-5)
    # 1.5 Hz is the paper's highest path harmonic: on 0.6 mm it is to stay below 1 pm.
    assert error[2] * 0.6e-3 < 1e-12


def test_error_falls_with_the_order_of_the_interpolation() -> None:
    errors = [
        abs(discretise(PAPER, 1e-3, order).response(BAND[-1:]) - PAPER.response(BAND[-1:]))[0]
        for order in (1, 2, 3, 5)
    ]
    assert all(later < 0.1 * earlier for earlier, later in itertools.pairwise(errors))


def test_first_order_hold_of_scipy_is_the_polynomial_of_order_one() -> None:
    dynamics = second_order(30.0, 0.2)
    system = signal.StateSpace(
        signal.TransferFunction(dynamics.numerator[::-1], dynamics.denominator[::-1])
    ).to_discrete(1e-3, method="foh")
    frequency = np.array([0.0, 3.0, 80.0, 250.0, 450.0])
    peer = system.freqresp(2 * np.pi * frequency * 1e-3)[1]
    ours = discretise(dynamics, 1e-3, order=1).response(frequency)
    assert np.allclose(ours, peer, rtol=1e-9)


def test_a_parabola_is_integrated_exactly() -> None:
    # u = t²: the forced response of a stable G is n0 t² + 2 n1' t + … with G's Taylor series.
    dynamics = second_order(40.0, 0.3)
    digital = discretise(dynamics, 1e-3, order=2)
    time = np.arange(4000) * 1e-3
    d1, d2 = dynamics.denominator[1:]
    expected = time**2 - 2 * d1 * time + 2 * (d1**2 - d2)
    late = signal.sosfilt(digital.sections, time**2)[3000:]
    assert np.allclose(late, expected[3000:], rtol=0, atol=1e-11)


def test_a_pole_far_above_nyquist_does_not_ring() -> None:
    fast = discretise(PAPER, 1e-3)
    ringing = bilinear(PAPER, 1e-3)
    assert fast.settling_samples(1e-6) < 25
    assert ringing.settling_samples(1e-6) > 150
    assert max(abs(fast.poles)) < np.exp(-0.96)


def test_repeated_poles_are_no_special_case() -> None:
    critical = second_order(50.0, 1.0)
    error = abs(discretise(critical, 1e-3).response(BAND) - critical.response(BAND))
    assert np.all(error < 1e-5)


def test_slow_poles_at_a_fast_rate_keep_their_digits() -> None:
    slow = TransferFunction(
        np.array([1.0, 1e-3]),
        polynomial.polymul(second_order(50, 0.1).denominator, second_order(50, 1.0).denominator),
    )
    error = abs(discretise(slow, 1 / 70e3).response(BAND) - slow.response(BAND))
    assert np.all(error < 1e-9)


def test_a_pure_delay_of_whole_samples_is_exact() -> None:
    late = discretise(TransferFunction(np.ones(1), np.ones(1), 7e-3), 1e-3)
    pulse = np.zeros(12)
    pulse[0] = 1.0
    assert np.allclose(signal.sosfilt(late.sections, pulse), np.roll(pulse, 7), atol=1e-12)


def test_a_gain_alone_has_no_memory() -> None:
    digital = discretise(TransferFunction(np.array([0.5]), np.ones(1)), 1e-3)
    assert np.array_equal(signal.sosfilt(digital.sections, [1.0, 2.0, 4.0]), [0.5, 1.0, 2.0])


def test_noise_gain_is_that_of_filtered_noise() -> None:
    digital = discretise(PAPER, 1e-3)
    noise = np.random.default_rng(2).normal(size=200_000)
    spread = np.std(signal.sosfilt(digital.sections, noise))
    assert digital.noise_gain == pytest.approx(spread, rel=0.01)


def test_settling_time_is_that_of_the_slowest_pole() -> None:
    digital = discretise(second_order(5.0, 0.1), 1e-3)
    decay = 2 * np.pi * 5.0 * 0.1 * 1e-3
    assert digital.settling_samples(1e-6) == pytest.approx(np.log(1e6) / decay, abs=10)


def test_bilinear_follows_its_own_warped_frequency() -> None:
    dynamics = second_order(40.0, 0.3)
    warped = np.tan(np.pi * BAND * 1e-3) / (np.pi * 1e-3)
    ours = bilinear(dynamics, 1e-3).response(BAND)
    assert np.allclose(ours, dynamics.response(warped), rtol=1e-10)


@pytest.mark.parametrize("power", [1, 2, 3])
@pytest.mark.parametrize("period", [1e-3, 1 / 70e3])
def test_a_derivative_is_one_at_low_frequency_too(power: int, period: float) -> None:
    numerator = np.zeros(power + 1)
    numerator[power] = 1e-3**power
    rate = TransferFunction(numerator, PAPER.denominator)
    error = abs(discretise(rate, period, order=5).response(BAND) / rate.response(BAND) - 1)
    assert np.all(error < 3e-3)


@pytest.mark.parametrize("order", [0, 8, -1])
def test_an_order_out_of_range_is_named(order: int) -> None:
    with pytest.raises(ConfigurationError, match=rf"order {order}, expected 1 to 7"):
        discretise(PAPER, 1e-3, order)


@pytest.mark.parametrize("period", [0.0, -1e-3, np.nan, np.inf])
def test_an_impossible_period_is_named(period: float) -> None:
    with pytest.raises(ConfigurationError, match="sample_period"):
        discretise(PAPER, period)


modes = st.tuples(st.floats(5.0, 200.0), st.floats(0.02, 1.0))


@settings(max_examples=60)
@given(
    poles=st.lists(modes, min_size=1, max_size=3),
    zeros=st.lists(modes, max_size=1),
    lag=st.sampled_from([None, 3.0, 40.0, 4000.0]),
    delay=st.sampled_from([0.0, 0.34e-3, 4e-3]),
    period=st.sampled_from([1e-3, 1e-4, 1 / 70e3]),
)
def test_any_resonances_below_nyquist_are_followed(
    poles: list[tuple[float, float]],
    zeros: list[tuple[float, float]],
    lag: float | None,
    delay: float,
    period: float,
) -> None:
    numerator, denominator = np.ones(1), np.ones(1)
    for mode in poles:
        denominator = polynomial.polymul(denominator, second_order(*mode).denominator)
    for mode in zeros:
        numerator = polynomial.polymul(numerator, second_order(*mode).denominator)
    if lag is not None:
        denominator = polynomial.polymul(denominator, [1.0, 1 / (2 * np.pi * lag)])
    dynamics = TransferFunction(numerator, denominator, delay)
    digital = discretise(dynamics, period)
    error = abs(digital.response(BAND[:3]) - dynamics.response(BAND[:3]))
    assert np.all(error < 1e-6 * np.maximum(abs(dynamics.response(BAND[:3])), 1.0))
    assert np.max(abs(digital.poles)) < 1


def test_a_resonance_that_folds_to_slow_motion_is_refused() -> None:
    # A sharp and strong mode close to the sample rate looks like slow motion itself.
    sharp = second_order(998.4, 1e-3).denominator
    strong = TransferFunction(second_order(5.0, 1.0).denominator, sharp)
    with pytest.raises(DataError, match=r"0\.001 s.*off by more than 1%"):
        discretise(strong, 1e-3)


def test_a_late_differentiator_keeps_its_gain():
    """With G(0) = 0 the gain is matched at slow motion, including the delay."""
    late = TransferFunction([0.0, 1.0], [1.0, 1e-2], 5.3e-3)
    frequency = np.array([0.5, 1.0, 3.0])
    found = discretise(late, 1e-3).response(frequency)
    np.testing.assert_allclose(found, late.response(frequency), rtol=1e-3)
