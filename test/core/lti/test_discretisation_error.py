"""The error of the discretisation against closed forms and the twin."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from omsm_ros.core.kinematics.trajectories import Spiral
from omsm_ros.core.lti.discretisation import (
    bilinear,
    checked_motion,
    discretisation_error,
    discretise,
    velocity_spectrum,
)
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.errors import DataError
from omsm_ros.twin.plant import PAPER_EQ_12

PAPER = PAPER_EQ_12.normalised()
TIME = np.arange(20_000) * 1e-3
SPIRAL = Spiral(PAPER_MIRROR, start_radius=12.7e-3, feed_per_turn=0.5e-3, spindle_speed=30.0)


def spiral_motion() -> np.ndarray:
    return SPIRAL.positions(np.arange(50_000) * 1e-3).z


def test_half_the_spectrums_power_is_the_mean_square_velocity() -> None:
    z = 1e-3 * np.sin(2 * np.pi * 3.0 * TIME) + 2e-4 * np.cos(2 * np.pi * 7.0 * TIME)
    _, velocity = velocity_spectrum(z, 1e-3)
    expected = 0.5 * ((2 * np.pi * 3e-3) ** 2 + (2 * np.pi * 7 * 2e-4) ** 2)
    assert np.sum(abs(velocity) ** 2) / 2 == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("faded", [False, True])
@pytest.mark.parametrize("samples", [4001, 4096, 10_008])
def test_the_spectrum_is_that_of_scipys_windows_by_its_power(samples: int, faded: bool) -> None:
    z = np.cumsum(np.random.default_rng(3).normal(size=samples)) * 1e-9
    window = signal.get_window(("tukey", 0.2) if faded else "blackmanharris", samples - 1)
    lines, velocity = velocity_spectrum(z, 1e-3, faded)
    # Parseval, with the difference quotient in place of the derivative.
    quotient = np.diff(z) / 1e-3 * window
    flat = abs(velocity * np.sinc(1e-3 * lines)) ** 2 / 2
    assert np.sum(flat) == pytest.approx(np.sum(quotient**2) / np.sum(window**2), rel=1e-9, abs=0)


@pytest.mark.parametrize("order", [1, 3])
def test_error_on_a_sine_is_that_of_the_response(order: int) -> None:
    frequency, amplitude = np.array([12.0]), 1e-3
    digital = discretise(PAPER, 1e-3, order)
    z = amplitude * np.sin(2 * np.pi * frequency[0] * TIME)
    rms, peak_to_valley = discretisation_error(PAPER, digital, z, up_to=50.0)
    magnitude = amplitude * abs(digital.response(frequency) - PAPER.response(frequency))[0]
    assert rms == pytest.approx(magnitude / np.sqrt(2), rel=0.01)
    assert peak_to_valley == pytest.approx(2 * magnitude, rel=0.02)


def test_error_over_time_is_that_of_the_filter() -> None:
    # A second method: the first-order filter against one of order 7, sample by sample.
    z = spiral_motion()
    coarse, fine = discretise(PAPER, 1e-3, 1), discretise(PAPER, 1e-3, 7)
    difference = signal.sosfilt(coarse.sections, z) - signal.sosfilt(fine.sections, z)
    rms, peak_to_valley = discretisation_error(PAPER, coarse, z, up_to=100.0)
    assert rms == pytest.approx(np.std(difference[5000:-5000]), rel=0.2)
    assert peak_to_valley == pytest.approx(np.ptp(difference[5000:-5000]), rel=0.05)


def test_the_papers_path_costs_no_tenth_of_a_nanometre() -> None:
    filters = discretise(PAPER, 1e-3, 3), bilinear(PAPER, 1e-3), discretise(PAPER, 1e-3, 1)
    z = spiral_motion()
    third, trapezoid, first = (discretisation_error(PAPER, f, z, up_to=100.0)[1] for f in filters)
    assert third < 1e-12
    assert trapezoid < 0.1e-9
    assert first > 1e-9


@pytest.mark.parametrize(
    ("motion", "text"),
    [
        (np.zeros(10), r"shape \(10,\)"),
        (np.zeros((100, 2)), r"shape \(100, 2\)"),
        (np.r_[np.zeros(99), np.nan], "1 values that are not finite"),
    ],
)
def test_a_motion_that_cannot_be_judged_is_named(motion: np.ndarray, text: str) -> None:
    with pytest.raises(DataError, match=text):
        checked_motion(motion)


@pytest.mark.parametrize("faded", [False, True])
def test_a_steady_drift_is_its_own_velocity(faded: bool) -> None:
    _, velocity = velocity_spectrum(3e-6 * TIME + 0.2, 1e-3, faded)
    assert np.sqrt(np.sum(abs(velocity) ** 2) / 2) == pytest.approx(3e-6, rel=1e-6)


@pytest.mark.parametrize("faded", [False, True])
def test_where_it_is_and_how_long_a_sample_takes_only_scale_the_spectrum(faded: bool) -> None:
    z = np.cumsum(np.random.default_rng(8).normal(size=3000)) * 1e-9
    lines, plain = velocity_spectrum(z, 1e-3, faded)
    np.testing.assert_allclose(velocity_spectrum(z + 0.5, 1e-3, faded)[1], plain, atol=1e-12)
    np.testing.assert_allclose(velocity_spectrum(-2 * z, 1e-3, faded)[1], -2 * plain, rtol=1e-9)
    slower, spectrum = velocity_spectrum(z, 1e-2, faded)
    np.testing.assert_allclose(slower, lines / 10)
    np.testing.assert_allclose(spectrum, plain / 10, rtol=1e-9)
    # Backwards in time all lines are as strong.
    turned = velocity_spectrum(z[::-1], 1e-3, faded)[1]
    assert np.sum(abs(turned) ** 2) == pytest.approx(np.sum(abs(plain) ** 2), rel=0.02, abs=0)


def test_the_error_is_in_proportion_to_the_motion_and_knows_no_home() -> None:
    digital = discretise(PAPER, 1e-3, 1)
    z = 1e-3 * np.sin(2 * np.pi * 4.0 * TIME) + 1e-4 * np.sin(2 * np.pi * 9.0 * TIME)
    plain = discretisation_error(PAPER, digital, z, up_to=50.0)
    assert discretisation_error(PAPER, digital, -3 * z, up_to=50.0) == pytest.approx(
        tuple(3 * size for size in plain), rel=1e-9, abs=0
    )
    moved = discretisation_error(PAPER, digital, z + 0.3, up_to=50.0)
    assert moved == pytest.approx(plain, rel=1e-4, abs=0)


def test_above_the_band_no_error_is_claimed() -> None:
    digital = discretise(PAPER, 1e-3, 1)
    low, high = (a * np.sin(2 * np.pi * f * TIME) for a, f in ((1e-3, 4.0), (1e-5, 40.0)))
    alone = discretisation_error(PAPER, digital, low, up_to=20.0)
    both = discretisation_error(PAPER, digital, low + high, up_to=20.0)
    assert both[0] == pytest.approx(alone[0], rel=0.02, abs=0)
    broad, fast = (discretisation_error(PAPER, digital, z, up_to=60.0) for z in (low + high, high))
    assert broad[0] == pytest.approx(np.hypot(alone[0], fast[0]), rel=0.02, abs=0)
    assert fast[0] > 0.5 * alone[0]


def test_errors_of_two_lines_add_in_squares() -> None:
    digital = discretise(PAPER, 1e-3, 2)
    parts = [1e-3 * np.sin(2 * np.pi * f * TIME) for f in (6.0, 17.0)]
    one, two, both = (
        discretisation_error(PAPER, digital, z, up_to=50.0)[0] for z in (*parts, sum(parts))
    )
    assert both == pytest.approx(np.hypot(one, two), rel=1e-2, abs=0)


def test_a_response_that_is_a_gain_costs_nothing() -> None:
    gain = TransferFunction(np.array([0.9]), np.ones(1))
    z = 1e-3 * np.sin(2 * np.pi * 4.0 * TIME)
    rms, peak_to_valley = discretisation_error(gain, discretise(gain, 1e-3), z, up_to=50.0)
    assert max(rms, peak_to_valley) < 1e-18


def test_the_shortest_motion_that_is_judged() -> None:
    assert len(checked_motion(np.zeros(64))) == 64
    assert checked_motion(np.arange(64)).dtype == np.float64
    with pytest.raises(DataError, match=r"shape \(63,\), expected 64 samples"):
        checked_motion(np.zeros(63))
