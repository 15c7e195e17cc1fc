"""Residual after the correction: closed forms for sines, and laws of scale."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from certified import certified_by
from hypothesis import given, settings
from hypothesis import strategies as st

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.correction.predict import (
    dynamic_error,
    largest_residual,
    predict_error,
    residual_variances,
    running_mean,
)
from omsm_ros.core.correction.source_kinds import components, fading, random_walk, smooth
from omsm_ros.core.kinematics.limits import MachineLimits
from omsm_ros.core.kinematics.scan_path import ScanPath
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.blocks import FloatArray

PERIOD, COUNT = 1e-3, 6000
TIME = PERIOD * np.arange(COUNT)
AMPLITUDE, LAG, LAG_U = 0.2e-3, 3e-4, 2e-6
G = TransferFunction(np.ones(1), np.array([1.0, LAG]))
TRUSTED = 40.0


def calibration(**parts: object) -> Calibration:
    """Uncertain of its pole alone: H(z) varies by the rate of z, through G²."""
    stated: dict[str, object] = {
        "covariance": np.diag([0.0, LAG_U**2, 0.0]),
        "certificate": certified_by({}),
    }
    return Calibration(
        dynamics=G,
        static_gain=1.0,
        sample_period=PERIOD,
        valid_up_to=TRUSTED,
        **(stated | parts),  # type: ignore[arg-type]
    )


EXACT = calibration(covariance=np.zeros((3, 3)))


def sine(hertz: float) -> FloatArray:
    return np.asarray(AMPLITUDE * np.sin(2 * np.pi * hertz * TIME))


def left(known: Calibration, z: FloatArray) -> FloatArray:
    """Variance of the residual away from the record's ends [m²]."""
    variance = sum(residual_variances(known, PERIOD, z))
    return np.asarray(variance)[1000:-1000]


@pytest.mark.parametrize("hertz", [1.0, 6.0, 20.0])
def test_within_the_band_only_the_covariance_is_left(hertz: float) -> None:
    omega = 2 * np.pi * hertz
    passed = abs(G.response(np.array([hertz]))[0]) ** 2
    rms = AMPLITUDE * omega * LAG_U * passed / np.sqrt(2)
    assert np.sqrt(np.mean(left(calibration(), sine(hertz)))) == pytest.approx(rms, rel=0.01)
    # The filter of the band passes a millionth of the motion, of which 1 - G is left.
    missed = abs(1 - G.response(np.array([hertz]))[0])
    assert np.sqrt(np.max(left(EXACT, sine(hertz)))) < 1e-4 * missed * AMPLITUDE


@pytest.mark.parametrize("hertz", [45.0, 60.0])
def test_beyond_the_band_all_of_the_error_is_left(hertz: float) -> None:
    missed = abs(1 - G.response(np.array([hertz]))[0])
    expected = AMPLITUDE * missed / np.sqrt(2)
    assert np.sqrt(left(EXACT, sine(hertz))) == pytest.approx(expected, rel=0.01)


def test_a_response_that_is_trusted_everywhere_leaves_nothing_beyond() -> None:
    everywhere = replace(EXACT, valid_up_to=0.5 / PERIOD)
    assert not np.any(left(everywhere, sine(200.0)))


@pytest.mark.parametrize("factor", [0.1, -3.0])
def test_the_residual_is_in_proportion_to_the_motion(factor: float) -> None:
    z = sine(3.0) + 0.1 * sine(90.0)
    plain, larger = (residual_variances(calibration(), PERIOD, x) for x in (z, factor * z))
    assert np.size(plain) > 0
    for one, other in zip(plain, larger, strict=True):
        np.testing.assert_allclose(other, factor**2 * one, rtol=1e-6, atol=1e-24)


def test_where_the_slide_stands_does_not_matter() -> None:
    z = sine(3.0) + 0.1 * sine(90.0)
    near, far = (residual_variances(calibration(), PERIOD, x)[0] for x in (z, z + 0.25))
    np.testing.assert_allclose(far, near, rtol=1e-3, atol=1e-22)


def test_what_does_not_follow_linearly_is_left_at_rest_too() -> None:
    backlash = replace(EXACT, certificate=certified_by({"motion_error_m": 7e-9}))
    assert largest_residual(backlash, PERIOD, np.zeros(COUNT)) == pytest.approx(7e-9)
    assert largest_residual(EXACT, PERIOD, np.zeros(COUNT)) == 0.0


def test_noise_and_undetected_error_are_kept_separate() -> None:
    """A quarter of the variance is noise, three quarters are undetected model error."""
    noise = np.diag([0.0, LAG_U**2 / 4, 0.0])
    reported = calibration(
        certificate=certified_by({"noise_covariance": [float(v) for v in noise.ravel()]})
    )
    known, undetected = residual_variances(reported, PERIOD, sine(5.0))
    np.testing.assert_allclose(undetected[1000:-1000], 3 * known[1000:-1000], rtol=1e-3, atol=1e-24)
    both = residual_variances(calibration(), PERIOD, sine(5.0))
    np.testing.assert_allclose(known + undetected, both[0] + both[1], rtol=1e-6, atol=1e-24)
    assert not np.any(both[1])


def test_the_largest_is_where_the_motion_is_fastest() -> None:
    """The whole covariance contributes: rate times lag, through G²."""
    z = sine(5.0) * (1.5 + 0.5 * np.tanh((TIME - 3.0) / 0.3))
    noise = [float(v) for v in np.diag([0.0, LAG_U**2 / 4, 0.0]).ravel()]
    expected = 2 * AMPLITUDE * 2 * np.pi * 5.0 * LAG_U * abs(G.response(np.array([5.0]))[0]) ** 2
    for known in (
        calibration(),
        calibration(certificate=certified_by({"noise_covariance": noise})),
    ):
        assert largest_residual(known, PERIOD, z) == pytest.approx(expected, rel=0.02)


def test_the_same_path_in_a_tenth_of_the_time_is_ten_times_as_uncertain() -> None:
    """Where all poles are far above the motion, its residual is the rate times the lag's."""
    slow, fast = (largest_residual(calibration(), p, sine(0.5)) for p in (PERIOD, PERIOD / 10))
    assert fast == pytest.approx(10 * slow, rel=0.01)


@settings(max_examples=40)
@given(
    values=st.lists(st.floats(0, 1e3), min_size=1, max_size=30).map(np.array),
    width=st.integers(-2, 40),
)
def test_a_running_mean_by_a_plain_loop(values: FloatArray, width: int) -> None:
    found = running_mean(values, width)
    size = min(max(width, 1), len(values))
    means = [np.mean(values[k : k + size]) for k in range(len(values) - size + 1)]
    before = size // 2
    expected = [means[min(max(k - before, 0), len(means) - 1)] for k in range(len(values))]
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("hertz", [1.0, 7.0, 60.0])
def test_the_error_of_a_sine_is_that_of_the_response(hertz: float) -> None:
    missed = abs(1 - G.response(np.array([hertz]))[0])
    error = dynamic_error(G, sine(hertz), PERIOD)
    assert np.max(np.abs(error)) == pytest.approx(AMPLITUDE * missed, rel=2e-3)
    turned = dynamic_error(G, -2 * sine(hertz), PERIOD)
    np.testing.assert_allclose(turned, -2 * error, atol=1e-15)


FREE = MachineLimits(
    servo_frequency=None, probe_range=None, spindle_speed_rpm=None, motion_frequency=None
)


def test_twice_the_motion_and_twice_the_budget_are_one_question() -> None:
    one, two = (
        predict_error(
            calibration(), ScanPath(z=k * sine(0.5), sample_period=PERIOD), k * 20e-9, FREE
        )
        for k in (1.0, 2.0)
    )
    for name in ("peak_to_valley", "rms", "residual"):
        assert getattr(two, name) == pytest.approx(2 * getattr(one, name), rel=1e-6)
    assert two.speed_factor == pytest.approx(one.speed_factor, rel=1e-2)
    assert two.outside_band_fraction == pytest.approx(one.outside_band_fraction, abs=1e-9)
    assert two.safe is one.safe is True
    # The residual grows as the speed does: it takes all of the budget, k = 2, there.
    assert one.speed_factor == pytest.approx(10e-9 / one.residual, rel=0.05)


# -- curves of which only size and smoothness are known

KERNELS = {"walk": random_walk, "fading": fading(3.0), "smooth": smooth(2.0)}


@pytest.mark.parametrize("kernel", KERNELS.values(), ids=KERNELS)
def test_components_are_those_of_their_places_in_any_order(kernel: object) -> None:
    where = np.random.default_rng(4).uniform(0.0, 9.0, 300)
    where[:2] = 0.0, 9.0
    order = np.random.default_rng(5).permutation(300)
    found, mixed = components(kernel, where), components(kernel, where[order])  # type: ignore[arg-type]
    np.testing.assert_allclose(mixed, found[:, order], atol=1e-12)
    # Together they are the covariance, but for what is left out and lies between the nodes.
    expected = kernel(where[:, np.newaxis], where)  # type: ignore[operator]
    np.testing.assert_allclose(found.T @ found, expected, atol=0.05 * np.max(expected))


def test_a_curve_over_another_length_is_the_same_curve() -> None:
    where = np.linspace(0.0, 1.0, 50)
    for kind in (fading, smooth):
        one, other = components(kind(0.3), where), components(kind(0.3e-3), 1e-3 * where)
        np.testing.assert_allclose(np.abs(other), np.abs(one), atol=1e-9)


def test_a_smoother_curve_has_fewer_components() -> None:
    where = np.linspace(0.0, 1.0, 50)
    counts = [len(components(smooth(length), where)) for length in (0.05, 0.2, 1.0)]
    assert counts == sorted(counts, reverse=True)
    assert counts[0] > 3 * counts[-1]
