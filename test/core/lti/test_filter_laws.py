"""Laws of digital filters made of G(s): linear, the same at any time, in any unit, cut anywhere."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from omsm_ros.core.lti.discretisation import DigitalFilter, bilinear, discretise
from omsm_ros.core.lti.recursion import Recursion, past_motion, through
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.twin.plant import PAPER_DYNAMICS

PERIOD = 1e-3
LATE = TransferFunction(PAPER_DYNAMICS.numerator, PAPER_DYNAMICS.denominator, 0.3e-3)
SOFT = TransferFunction.from_ascending([1.0, -2e-4], [1.0, 2e-3, 2e-5, 1e-8])
LAG = TransferFunction(np.ones(1), np.array([1.0, 5e-3]))
ALL = pytest.mark.parametrize("dynamics", [LATE, SOFT, LAG], ids=["late", "soft", "lag"])
NOISE = np.random.default_rng(12).normal(size=(2, 600))


def filtered(dynamics: TransferFunction, samples: FloatArray) -> FloatArray:
    """From rest at zero."""
    return Recursion(discretise(dynamics, PERIOD)).run(np.ascontiguousarray(samples))


@ALL
def test_a_filter_is_linear(dynamics: TransferFunction) -> None:
    one, two = (filtered(dynamics, x) for x in NOISE)
    both = filtered(dynamics, 3.0 * NOISE[0] - 0.7 * NOISE[1])
    np.testing.assert_allclose(both, 3.0 * one - 0.7 * two, atol=1e-12)


@ALL
def test_twice_as_much_is_twice_as_much_to_the_last_bit(dynamics: TransferFunction) -> None:
    for factor in (2.0, -0.25, 2.0**40):
        assert np.array_equal(
            filtered(dynamics, factor * NOISE[0]), factor * filtered(dynamics, NOISE[0])
        )


@ALL
def test_a_filter_is_the_same_at_any_time(dynamics: TransferFunction) -> None:
    later = filtered(dynamics, np.concatenate([np.zeros(7), NOISE[0]]))
    assert not np.any(later[:7])
    assert np.array_equal(later[7:], filtered(dynamics, NOISE[0]))


@ALL
def test_nothing_answers_before_it_is_asked(dynamics: TransferFunction) -> None:
    changed = NOISE[0].copy()
    changed[300:] += 1.0
    same, other = filtered(dynamics, NOISE[0]), filtered(dynamics, changed)
    assert np.array_equal(same[:300], other[:300])
    assert not np.array_equal(same[300:320], other[300:320])


@ALL
def test_a_step_settles_at_the_static_gain(dynamics: TransferFunction) -> None:
    assert filtered(dynamics, np.full(3000, 1.7))[-1] == pytest.approx(1.7, rel=1e-12)


@ALL
@pytest.mark.parametrize("pace", [1e-3, 70.0])
def test_only_time_over_the_sample_period_counts(dynamics: TransferFunction, pace: float) -> None:
    """G in milliseconds instead of seconds, sampled in milliseconds, is the same filter."""
    powers = np.arange(max(len(dynamics.numerator), len(dynamics.denominator)))
    faster = TransferFunction(
        dynamics.numerator * pace ** powers[: len(dynamics.numerator)],
        dynamics.denominator * pace ** powers[: len(dynamics.denominator)],
        dynamics.delay * pace,
    )
    lines = np.array([0.0, 1.0, 40.0, 200.0])
    one = discretise(dynamics, PERIOD).response(lines)
    other = discretise(faster, PERIOD * pace).response(lines / pace)
    np.testing.assert_allclose(other, one, rtol=1e-8)


@ALL
def test_a_gain_passes_through(dynamics: TransferFunction) -> None:
    stronger = TransferFunction(-2.5 * dynamics.numerator, dynamics.denominator, dynamics.delay)
    np.testing.assert_allclose(
        filtered(stronger, NOISE[0]), -2.5 * filtered(dynamics, NOISE[0]), rtol=1e-9, atol=1e-11
    )


@ALL
def test_poles_are_those_of_g_after_one_sample(dynamics: TransferFunction) -> None:
    found = discretise(dynamics, PERIOD).poles
    assert len(dynamics.poles())
    for pole in np.exp(dynamics.poles() * PERIOD):
        assert np.min(np.abs(found - pole)) < 1e-7


@ALL
def test_noise_gain_is_the_mean_square_of_the_response(dynamics: TransferFunction) -> None:
    """Parseval's theorem, over the whole circle."""
    digital = discretise(dynamics, PERIOD)
    lines = np.arange(4096) / 4096 / PERIOD
    expected = np.sqrt(np.mean(np.abs(digital.response(lines)) ** 2))
    assert digital.noise_gain == pytest.approx(expected, rel=1e-6)


@ALL
def test_the_response_is_the_transform_of_the_answer_to_a_pulse(dynamics: TransferFunction) -> None:
    lines = np.array([0.0, 3.0, 77.0, 410.0])
    pulse = filtered(dynamics, np.eye(1, 4000)[0])
    waves = np.exp(-2j * np.pi * np.outer(lines * PERIOD, np.arange(4000)))
    found = discretise(dynamics, PERIOD).response(lines)
    np.testing.assert_allclose(found, waves @ pulse, rtol=1e-8)


@pytest.mark.parametrize("tolerance", [1e-3, 1e-6, 1e-9])
def test_a_wrong_start_of_a_lag_is_forgotten_when_it_says(tolerance: float) -> None:
    digital = discretise(LAG, PERIOD)
    right, wrong = Recursion(digital), Recursion(digital)
    wrong.start(np.ones(1))
    settling = digital.settling_samples(tolerance)
    off = np.abs(wrong.run(NOISE[0]) - right.run(NOISE[0]))
    # The state of rest at 1, of which one sample is e^{-T/τ} later.
    assert off[settling] <= tolerance
    assert off[settling - 2 * len(digital.sections) - 2] > tolerance


def test_a_straight_motion_comes_out_late_by_the_lag_from_the_first_sample() -> None:
    index = np.arange(50.0)
    ramp = 1e-3 + 2e-6 * index
    for dynamics in (LATE, SOFT, LAG):
        late = through(discretise(dynamics, PERIOD), ramp)
        expected = ramp - 2e-6 * dynamics.low_frequency_delay / PERIOD
        np.testing.assert_allclose(late, expected, atol=1e-14)


@pytest.mark.parametrize("hertz", [0.5, 5.0, 20.0])
def test_a_sine_comes_out_as_the_response_says(hertz: float) -> None:
    time = PERIOD * np.arange(4000)
    for dynamics in (LATE, SOFT, LAG):
        out = through(discretise(dynamics, PERIOD), np.cos(2 * np.pi * hertz * time))
        gain = dynamics.response(np.array([hertz]))[0]
        expected = np.real(gain * np.exp(2j * np.pi * hertz * time))
        np.testing.assert_allclose(out[2000:], expected[2000:], atol=3e-5)


def test_a_rest_is_kept_to_the_last_digits() -> None:
    """Micrometres of figure ride on a slide that stands at a quarter of a metre."""
    out = through(discretise(LATE, PERIOD), np.full(500, 0.25))
    assert np.max(np.abs(out - 0.25)) < 1e-15


def test_the_rest_of_a_motion_is_where_its_parabola_begins() -> None:
    first = 1e-3 + 3e-6 * np.arange(12.0) - 2e-8 * np.arange(12.0) ** 2
    assert past_motion(first, 0) == pytest.approx([1e-3], rel=1e-9)
    assert past_motion(first, 0)[0] == past_motion(first)[0]


@settings(max_examples=30)
@given(
    coefficients=st.lists(st.floats(-5, 5), min_size=3, max_size=3),
    count=st.integers(3, 20),
    far=st.sampled_from([0.0, 0.3, -2.0]),
)
def test_a_parabola_is_found_wherever_it_lies(
    coefficients: list[float], count: int, far: float
) -> None:
    index, (_, speed, bend) = np.arange(count), coefficients
    first = far + 1e-6 * (coefficients[0] + speed * index + bend * index**2)
    expected = np.array([far, 0.0, 0.0]) + 1e-6 * np.array(coefficients)
    np.testing.assert_allclose(past_motion(first), expected, atol=1e-14)


def test_the_past_of_noise_is_that_of_a_least_squares_parabola() -> None:
    first = NOISE[0][:12]
    expected = np.polynomial.polynomial.polyfit(np.arange(12), first, 2)
    np.testing.assert_allclose(past_motion(first), expected, rtol=1e-9)


def test_a_filter_that_is_started_knows_nothing_of_what_was_before() -> None:
    digital = discretise(SOFT, PERIOD)
    used, new = Recursion(digital), Recursion(digital)
    used.run(1e3 * NOISE[1])
    for recursion in (used, new):
        recursion.start(np.array([0.1, 1e-3, 1e-5]))
    assert np.array_equal(used.run(NOISE[0]), new.run(NOISE[0]))


def test_output_goes_where_it_is_wanted() -> None:
    room = np.full((3, 600), np.nan)
    Recursion(discretise(SOFT, PERIOD)).run(NOISE[0], room[1])
    assert np.array_equal(room[1], filtered(SOFT, NOISE[0]))
    assert np.all(np.isnan(room[[0, 2]]))


@pytest.mark.parametrize("damping", [0.05, 0.7, 1.0])
def test_the_bilinear_filter_is_that_of_scipy(damping: float) -> None:
    omega = 2 * np.pi * 30.0
    g = TransferFunction.from_ascending([1.0, 1e-3], [1.0, 2 * damping / omega, omega**-2])
    b, a = signal.bilinear(g.numerator[::-1], g.denominator[::-1], 1 / PERIOD)
    _, expected = signal.freqz(b, a, 2 * np.pi * np.array([1.0, 30.0, 300.0]) * PERIOD)
    found = bilinear(g, PERIOD).response(np.array([1.0, 30.0, 300.0]))
    np.testing.assert_allclose(found, expected, rtol=1e-8)


def test_sections_in_series_multiply() -> None:
    one, two = discretise(LAG, PERIOD), discretise(SOFT, PERIOD)
    both = DigitalFilter(np.concatenate([one.sections, two.sections]), PERIOD)
    lines = np.array([0.0, 9.0, 150.0])
    np.testing.assert_allclose(
        both.response(lines), one.response(lines) * two.response(lines), rtol=1e-12
    )
    assert len(both.poles) == len(one.poles) + len(two.poles)
