"""Test response, band and range of a sampled model against second methods."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from omsm_ros.core.estimation.sampled_fit import FIRST_ORDER, ZERO_ORDER, zero_order_hold_equivalent
from omsm_ros.core.estimation.sampled_model import (
    BAND_LIMITED,
    Discrete,
    SampledModel,
    free_run,
    stationary_output,
)
from omsm_ros.core.identification.sampled_identification import (
    identify_samples,
    sampled_certificate,
    widest_valid_range,
)
from omsm_ros.core.lti.frequency_response import Band, ResponseLimits
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import IdentificationError

PERIOD = 0.02
LINES = np.array([0.0, 0.3, 2.0, 11.0, 24.0])
POLE = 0.8


def discrete(
    numerator: list[float], denominator: list[float], delay: int = 0, size: float = 0.0
) -> Discrete:
    p = len(numerator) + len(denominator) - 1
    mixing = np.random.default_rng(p).normal(size=(p, p)) * size
    return Discrete(
        numerator=np.array(numerator),
        denominator=np.array(denominator),
        delay=delay,
        covariance=mixing @ mixing.T,
    )


MODE = discrete([0.1, 0.3, -0.05], [1.0, -1.5, 0.7], 2, size=1e-4)


@pytest.mark.parametrize("model", [MODE, discrete([2.0], [1.0]), discrete([0.0, 1.0], [1.0, -0.9])])
def test_the_response_is_that_of_scipy(model: Discrete) -> None:
    late = np.concatenate([np.zeros(model.delay), model.numerator])
    _, expected = signal.freqz(late, model.denominator, 2 * np.pi * LINES * PERIOD)
    np.testing.assert_allclose(model.response(LINES, PERIOD), expected, rtol=1e-12)


def test_the_response_is_the_transform_of_the_impulse_response() -> None:
    pulse = np.eye(1, 400)[0]
    out = np.roll(signal.lfilter(MODE.numerator, MODE.denominator, pulse), MODE.delay)
    waves = np.exp(-2j * np.pi * np.outer(LINES * PERIOD, np.arange(400)))
    np.testing.assert_allclose(MODE.response(LINES, PERIOD), waves @ out, rtol=1e-9)


def test_only_frequency_times_period_counts() -> None:
    np.testing.assert_allclose(MODE.response(LINES, PERIOD), MODE.response(LINES / 50, 1.0))


def test_the_band_is_the_scatter_of_drawn_coefficients() -> None:
    band = MODE.band(LINES, PERIOD)
    random = np.random.default_rng(5)
    centre = np.concatenate([MODE.numerator, MODE.denominator[1:]])
    draws = random.multivariate_normal(centre, MODE.covariance, 4000)
    drawn = [
        replace(MODE, numerator=d[:3], denominator=np.append(1.0, d[3:])).response(LINES, PERIOD)
        for d in draws
    ]
    ratio = np.log(np.array(drawn) / MODE.response(LINES, PERIOD))
    # A standard deviation of 4000 is known to 1.1 %.
    assert band.gain == pytest.approx(np.std(ratio.real, axis=0), rel=0.05)
    assert band.phase[1:] == pytest.approx(np.std(ratio.imag[:, 1:], axis=0), rel=0.05)
    assert band.phase[0] == pytest.approx(0.0, abs=1e-12)


def test_of_a_gain_the_band_is_its_relative_uncertainty() -> None:
    gain = replace(discrete([-4.0], [1.0]), covariance=np.array([[0.01]]))
    band = gain.band(LINES, PERIOD)
    assert band.gain == pytest.approx(np.full(5, 0.025))
    assert np.max(band.phase) < 1e-12
    # A delay of whole samples is known exactly.
    late = replace(gain, delay=7).band(LINES, PERIOD)
    assert np.array_equal(late.gain, band.gain)


def test_a_pole_alone_by_hand() -> None:
    """ln(1/(1 + a q)): its derivative by a is -q/(1 + a q)."""
    lag = replace(discrete([1.0], [1.0, -POLE]), covariance=np.diag([0.0, 1e-6]))
    q = np.exp(-2j * np.pi * LINES * PERIOD)
    by_pole = -q / (1 - POLE * q)
    band = lag.band(LINES, PERIOD)
    assert band.gain == pytest.approx(1e-3 * np.abs(by_pole.real))
    assert band.phase == pytest.approx(1e-3 * np.abs(by_pole.imag), abs=1e-15)


@pytest.mark.parametrize("gain", [1.0, -3.0])
def test_a_lag_behind_a_zero_order_hold_by_hand(gain: float) -> None:
    """x[k+1] = p x[k] + (1 - p) g u[k], p = exp(-T/τ)."""
    numerator = np.array([0.0, gain * (1 - POLE)])
    found = zero_order_hold_equivalent(numerator, np.array([1.0, -POLE]), PERIOD, ZERO_ORDER)
    assert found is not None
    assert found.denominator == pytest.approx([1.0, -PERIOD / np.log(POLE)])
    assert found.numerator[0] == pytest.approx(gain)
    assert np.all(np.abs(found.numerator[1:]) < 1e-12)


def test_a_lag_behind_a_first_order_hold_by_hand() -> None:
    """Through a straight line u = t a lag answers t - τ + τ exp(-t/τ), exactly at the samples."""
    tau = -PERIOD / np.log(POLE)
    b0 = 1 - tau / PERIOD * (1 - POLE)
    b1 = tau / PERIOD * (1 - POLE) - POLE
    found = zero_order_hold_equivalent(
        np.array([b0, b1]), np.array([1.0, -POLE]), PERIOD, FIRST_ORDER
    )
    assert found is not None
    lag = TransferFunction(np.ones(1), np.array([1.0, tau]))
    np.testing.assert_allclose(found.response(LINES), lag.response(LINES), rtol=1e-9)


poles = st.tuples(st.floats(0.3, 20.0), st.floats(0.1, 0.9))


@settings(max_examples=25)
@given(modes=st.lists(poles, min_size=1, max_size=2), hold=st.sampled_from(["zoh", "foh"]))
def test_any_modes_come_back_through_either_hold(
    modes: list[tuple[float, float]], hold: str
) -> None:
    down = np.ones(1)
    for k, (hertz, damping) in enumerate(modes):
        omega = 2 * np.pi * (hertz + 0.37 * k)
        down = np.polymul([omega**-2, 2 * damping / omega, 1.0], down)
    up, sampled, _ = signal.cont2discrete(([0.01, 1.0], down), PERIOD, hold)
    name = ZERO_ORDER if hold == "zoh" else FIRST_ORDER
    found = zero_order_hold_equivalent(np.ravel(up), sampled, PERIOD, name)
    assert found is not None
    truth = TransferFunction.from_ascending([1.0, 0.01], down[::-1])
    np.testing.assert_allclose(found.response(LINES[:4]), truth.response(LINES[:4]), rtol=1e-4)


def test_a_numerator_longer_than_the_denominator_has_no_equivalent() -> None:
    assert (
        zero_order_hold_equivalent(np.ones(3), np.array([1.0, -POLE]), PERIOD, ZERO_ORDER) is None
    )


def test_the_scale_of_both_polynomials_does_not_matter() -> None:
    b, a = np.array([0.0, 0.3, 0.1]), np.array([1.0, -1.2, 0.5])
    plain, scaled = (
        zero_order_hold_equivalent(f * b, f * a, PERIOD, ZERO_ORDER) for f in (1.0, -2.5)
    )
    assert plain is not None
    assert scaled is not None
    np.testing.assert_allclose(scaled.response(LINES), plain.response(LINES), rtol=1e-12)


# -- the range in which a model is trusted

GRID = np.geomspace(0.1, 100.0, 31)
LIMITS = ResponseLimits(gain=0.1, phase=0.1)


def band(gain: FloatArray | float, phase: FloatArray | float = 0.0) -> Band:
    return Band(GRID, np.broadcast_to(gain, GRID.shape), np.broadcast_to(phase, GRID.shape))


def test_all_of_a_band_within_the_limits_is_the_range() -> None:
    assert widest_valid_range(band(0.01, 0.01), LIMITS) == (GRID[0], GRID[-1])
    assert widest_valid_range(band(0.2), LIMITS) == (GRID[0], GRID[0])
    assert widest_valid_range(band(0.0, 0.2), LIMITS) == (GRID[0], GRID[0])


@settings(max_examples=40)
@given(inside=st.lists(st.booleans(), min_size=31, max_size=31), by=st.sampled_from("gps"))
def test_the_range_is_the_widest_run_however_it_ends(inside: list[bool], by: str) -> None:
    size = np.where(inside, 0.01, 0.2)
    found = widest_valid_range(
        band(size if by == "g" else 0.0, size if by == "p" else 0.0),
        LIMITS,
        np.array(inside) if by == "s" else None,
    )
    runs = [(GRID[i], GRID[j]) for i in range(31) for j in range(i, 31) if all(inside[i : j + 1])]
    widest = max((high / low for low, high in runs), default=1.0)
    assert found[1] / found[0] == pytest.approx(widest)
    assert found in runs or not runs


def test_half_a_width_of_95_percent_is_what_counts() -> None:
    just = 0.1 / 1.96
    assert widest_valid_range(band(0.999 * just), LIMITS)[1] == GRID[-1]
    assert widest_valid_range(band(1.001 * just), LIMITS)[1] == GRID[0]


def certificate(**changes: object) -> dict[str, object]:
    stated: dict[str, object] = {
        "order": 2, "free_order": 2, "widened": 1.0, "valid": (0.1, 8.0), "limits": LIMITS,
        "entries": {"predicted": 0.99, "independence_p": 0.3, "samples": {"compared": 900}},
    }  # fmt: skip
    return sampled_certificate(**(stated | changes))  # type: ignore[arg-type]


def test_a_model_that_predicts_is_accepted_with_its_range() -> None:
    found = certificate()
    assert found["verdict"] == "accepted from 0.100 Hz to 8.00 Hz"
    assert (found["reasons"], found["warnings"]) == ([], [])
    assert found["predicted"] == 0.99
    assert list(found)[-3:] == ["warnings", "reasons", "verdict"]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"entries": {"predicted": 0.2}}, "describes only what it was fitted to"),
        ({"entries": {"predicted": -3.0}}, "describes only what it was fitted to"),
        ({"valid": (0.1, 0.1)}, "known nowhere to 10 % of gain"),
    ],
)
def test_a_model_that_does_not_is_rejected_with_its_reason(
    changes: dict[str, object], said: str
) -> None:
    found = certificate(**changes)
    assert found["verdict"] == "rejected"
    (reason,) = found["reasons"]  # type: ignore[misc]
    assert said in reason


def test_doubts_that_reject_nothing_are_warnings() -> None:
    follows = certificate(entries={"predicted": 0.9, "independence_p": 1e-9})
    asked = certificate(order=1, widened=3.0)
    for found, said in ((follows, "follows the input"), (asked, "2 would have been chosen")):
        (warning,) = found["warnings"]  # type: ignore[misc]
        assert said in warning
        assert str(found["verdict"]).startswith("accepted")


# -- a model running freely

U = 4.0 + np.repeat(np.random.default_rng(6).choice([-1.0, 1.0], 120), 5)
HELD = SampledModel(
    hold=ZERO_ORDER, sample_period=PERIOD, discrete=MODE, continuous=None, covariance=None,
    valid_from=0.1, valid_up_to=10.0, working_point=(4.0, 30.0),
)  # fmt: skip


def answered(u: FloatArray = U) -> FloatArray:
    late = np.concatenate([np.zeros(MODE.delay), u - 4.0])[: len(u)]
    return np.asarray(30.0 + signal.lfilter(MODE.numerator, MODE.denominator, late))


Y = answered()
NOISY = Y + np.random.default_rng(7).normal(0, 0.01, len(Y))


def test_a_constant_on_either_column_is_taken_up() -> None:
    """That of the output by the constant that is fitted, that of the input by its gain times it."""
    plain = free_run(HELD, U, NOISY)
    for run in (free_run(HELD, U, NOISY + 7.0), free_run(HELD, U - 2.0, NOISY)):
        np.testing.assert_allclose(run.residual, plain.residual, atol=1e-9)
        assert run.explained == pytest.approx(plain.explained, rel=1e-9)


def test_a_free_run_is_linear() -> None:
    still = replace(HELD, working_point=(0.0, 0.0))
    one, both = free_run(still, U, NOISY), free_run(still, 3.0 * U, 3.0 * NOISY)
    np.testing.assert_allclose(both.output, 3.0 * one.output, rtol=1e-9)
    assert both.rms == pytest.approx(3.0 * one.rms)
    assert both.explained == pytest.approx(one.explained)


def test_the_true_model_leaves_the_noise_and_explains_the_rest() -> None:
    run = free_run(HELD, U, NOISY)
    # Two poles, two samples of delay and a constant are fitted of 600.
    assert run.rms == pytest.approx(0.01 * np.sqrt(1 - 5 / 600), rel=0.08)
    assert run.explained == pytest.approx(1 - run.rms**2 / np.var(NOISY))
    assert free_run(HELD, U, Y).rms < 1e-12


def test_where_it_was_cut_does_not_matter_once_it_has_settled() -> None:
    whole, cut = free_run(HELD, U, Y), free_run(HELD, U[77:], Y[77:])
    np.testing.assert_allclose(cut.output, whole.output[77:], atol=1e-9)


def test_columns_of_different_length_are_refused() -> None:
    with pytest.raises(IdentificationError, match="input of 599 samples, output of 600"):
        free_run(HELD, U[1:], Y)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_an_input_of_which_values_are_missing_is_refused(value: float) -> None:
    """Not run on to an output of nothing."""
    holed = np.where(np.isin(np.arange(len(U)), [50, 51]), value, U)
    for run in (
        lambda: free_run(HELD, holed, Y),
        lambda: identify_samples(holed, Y, PERIOD),
        lambda: identify_samples(holed, Y, PERIOD, hold=BAND_LIMITED),
    ):
        with pytest.raises(IdentificationError, match="input has 2 values that are not finite"):
            run()


def test_the_resting_output_is_that_of_the_mean_input() -> None:
    used = np.ones(len(U), np.bool_)
    gain = np.sum(MODE.numerator) / np.sum(MODE.denominator)
    expected = 30.0 + gain * (np.mean(U) - 4.0)
    assert stationary_output(MODE, U, Y, used) == pytest.approx(expected, abs=1e-9)
    spoiled = np.where(np.arange(len(U)) % 50 == 7, 1e3, Y)
    assert stationary_output(MODE, U, spoiled, spoiled < 1e2) == pytest.approx(expected, abs=1e-9)


def test_a_band_limited_model_runs_by_its_continuous_half() -> None:
    lag = TransferFunction(np.array([2.0]), np.array([1.0, 0.1]))
    model = replace(
        HELD, hold=BAND_LIMITED, discrete=None, continuous=lag, covariance=np.zeros((3, 3))
    )
    time, omega = PERIOD * np.arange(2000), 2 * np.pi * 0.4
    run = free_run(model, 4.0 + np.sin(omega * time), 30.0 + np.sin(omega * time))
    gain = lag.response(np.array([0.4]))[0]
    settled = np.imag(gain * np.exp(1j * omega * time))[500:]
    assert np.ptp(run.output[500:] - settled) < 1e-3 * np.ptp(settled)
