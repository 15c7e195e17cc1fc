"""Speed limits of a path: polynomials, units, reversal, any division into blocks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from omsm_ros.core.kinematics.kinematics import PitchCurve, slopes_by_differences
from omsm_ros.core.kinematics.limits import (
    FASTEST,
    MachineLimits,
    following_error,
    highest_factor,
    speed_limits,
)
from omsm_ros.core.kinematics.scan_path import ScanPath, ScanPathReader, content_frequency, steepest
from omsm_ros.core.kinematics.trajectories import Spiral
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.blocks import AxisBlock, DistanceBlock
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.errors import ConfigurationError

PERIOD = 1e-3
TIME = np.arange(8000) * PERIOD
SWING = 0.3e-3 * np.sin(2 * np.pi * 3.0 * TIME) + 20e-6 * np.sin(2 * np.pi * 11.0 * TIME + 1)
DECLARED = MachineLimits(
    z_acceleration=0.5, z_jerk=40.0, point_spacing=80e-6, exposure=1e-3, timing=1e-6
)
SCAN = ScanPath(z=SWING, sample_period=PERIOD, x=np.linspace(8e-3, 7e-3, 8000), c=3.0 * TIME)


def limits_of(path, limits=DECLARED, band=60.0, budget=50e-9):
    return {limit.name: limit for limit in speed_limits(path, limits, band, budget)[0]}


# How steep.


def test_derivatives_of_a_quintic_are_exact():
    """At the middles of all its windows, of eleven samples where the content is high."""
    quintic = np.polynomial.Polynomial([1e-3, -2e-3, 3e-3, 0.02, -0.05, 0.04])
    time = np.arange(200) * 5e-3
    half = 5
    content = 1 / (8 * half * 5e-3) * (1 - 1e-9)
    middles = time[half:-half]
    for found, order in zip(steepest(quintic(time), 5e-3, content), (1, 2, 3), strict=True):
        expected = np.abs(quintic.deriv(order)(middles)).max()
        assert found == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("content", [0.0, 3.0, 60.0])
def test_backwards_upside_down_and_elsewhere_a_path_is_as_steep(content):
    usual = steepest(SWING, PERIOD, content)
    for other in (SWING[::-1], -SWING, SWING + 0.25):
        assert steepest(other, PERIOD, content) == pytest.approx(usual, rel=1e-6)


@pytest.mark.parametrize("factor", [0.5, 4.0])
def test_in_less_time_velocities_grow_by_the_power_of_their_derivative(factor):
    usual = steepest(SWING, PERIOD, 11.0)
    faster = steepest(SWING, PERIOD / factor, 11.0 * factor)
    powers = [factor**k for k in (1, 2, 3)]
    np.testing.assert_allclose(np.divide(faster, usual), powers, rtol=1e-9)
    np.testing.assert_allclose(steepest(7 * SWING, PERIOD, 11.0), 7 * np.array(usual), rtol=1e-9)


def test_a_path_at_rest_or_at_one_speed_has_no_acceleration():
    assert steepest(np.full(500, 0.3), PERIOD, 0.0) == (0.0, 0.0, 0.0)
    velocity, acceleration, _ = steepest(0.02 * TIME, PERIOD, 0.0)
    assert velocity == pytest.approx(0.02)
    assert acceleration < 1e-9


# How fast it changes.


@pytest.mark.parametrize("factor", [0.1, 5.0])
def test_the_content_is_that_of_the_path_in_its_own_time_and_of_any_height(factor):
    usual = content_frequency(SWING, PERIOD)
    assert content_frequency(SWING, PERIOD / factor) == pytest.approx(usual * factor)
    for other in (1e3 * SWING, SWING + 0.5, SWING[::-1]):
        assert content_frequency(other, PERIOD) == pytest.approx(usual, abs=0.2)


@pytest.mark.parametrize(("size", "content"), [(0.3, 40.0), (0.005, 40.0), (0.002, 4.0)])
def test_a_line_counts_where_it_holds_a_thousandth_of_the_mean_square_velocity(size, content):
    """At ten times the frequency: of 0.5 % it has 1/400 of the mean square, of 0.2 % 1/2500."""
    z = np.sin(2 * np.pi * 4.0 * TIME) + size * np.sin(2 * np.pi * 40.0 * TIME)
    assert content_frequency(1e-4 * z, PERIOD) == pytest.approx(content, abs=0.3)


def test_the_content_of_noise_through_a_filter_is_where_its_velocity_is():
    """A band to 20 Hz: of its mean square velocity, which grows as f², 99.9 % lie below it."""
    rng = np.random.default_rng(1)
    band = signal.butter(8, 20.0, fs=1000.0, output="sos")
    z = 1e-6 * signal.sosfiltfilt(band, rng.normal(size=16_000))
    frequency, power = signal.periodogram(np.diff(z), fs=1000.0)
    share = np.cumsum(power) / np.sum(power)
    expected = frequency[np.argmax(share >= 0.999)]
    assert content_frequency(z, PERIOD) == pytest.approx(expected, abs=1.0)


# The limits.


@pytest.mark.parametrize("factor", [0.4, 2.5])
def test_a_path_that_is_run_faster_may_be_run_less_fast_by_as_much(factor):
    """All limits but the spacing, which is of samples, scale with their power of the speed."""
    usual = limits_of(SCAN)
    faster = limits_of(replace(SCAN, sample_period=PERIOD / factor))
    power = {"Z acceleration": 2, "Z jerk": 3, "path within one exposure": 2}
    for name, limit in usual.items():
        if name in ("spacing at the rim", "probe range against following error"):
            continue
        grown = limit.value * factor ** power.get(name, 1)
        assert faster[name].value == pytest.approx(grown, rel=1e-6), name
        assert faster[name].speed_factor == pytest.approx(limit.speed_factor / factor, rel=1e-6)
    name = "probe range against following error"
    assert faster[name].speed_factor * factor == pytest.approx(usual[name].speed_factor, rel=1e-3)
    assert faster["spacing at the rim"].value == usual["spacing at the rim"].value


def test_at_its_own_speed_factor_each_limit_is_just_reached():
    assert len(limits_of(SCAN)) > 5
    for name, limit in limits_of(SCAN).items():
        if name == "spacing at the rim":
            continue
        there = limits_of(replace(SCAN, sample_period=PERIOD / limit.speed_factor))[name]
        assert there.value == pytest.approx(limit.allowed, rel=1e-3), name


def test_what_is_allowed_is_what_was_declared_with_its_unit():
    found = limits_of(SCAN, band=77.0, budget=60e-9)
    expected = {
        "calibrated band": (77.0, "Hz"),
        "motion frequency": (50.0, "Hz"),
        "probe range against following error": (50e-6, "m"),
        "Z acceleration": (0.5, "m/s²"),
        "Z jerk": (40.0, "m/s³"),
        "spindle speed": (120.0, "rpm"),
        "spacing at the rim": (80e-6, "m"),
        "path within one exposure": (30e-9, "m"),
        "timing of the trigger": (30e-9, "m"),
    }
    assert {n: (pytest.approx(v.allowed), v.unit) for n, v in found.items()} == expected


@pytest.mark.parametrize("name", [n for n in MachineLimits.__dataclass_fields__ if n != "x_beyond"])
def test_a_limit_that_nobody_declared_is_missing_and_no_other(name):
    """Range and servo make one limit; what is not declared is not taken for harmless."""
    evaluated, missing = speed_limits(SCAN, replace(DECLARED, **{name: None}), 60.0, 50e-9)
    assert len(missing) == 1
    assert missing[0] in limits_of(SCAN)
    assert {e.name for e in evaluated} == set(limits_of(SCAN)) - set(missing)


@pytest.mark.parametrize("turning", [3.0, -3.0])
def test_the_spindle_turns_as_fast_either_way(turning):
    found = limits_of(replace(SCAN, c=turning * TIME + 50.0))["spindle speed"]
    assert found.value == pytest.approx(3.0 / (2 * np.pi) * 60)


def test_the_spacing_is_the_longest_way_between_neighbours():
    """By the law of cosines between points in the chuck's plane."""
    x = np.array([9e-3, 8.9e-3, 8.7e-3, 8.6e-3] * 10)
    c = np.cumsum(np.tile([0.0, 1e-2, 3e-2, 5e-3], 10))
    path = ScanPath(z=SWING[:40], sample_period=PERIOD, x=x, c=c)
    chord = np.sqrt(x[1:] ** 2 + x[:-1] ** 2 - 2 * x[1:] * x[:-1] * np.cos(np.diff(c)))
    found = limits_of(path)["spacing at the rim"]
    assert found.value == pytest.approx(chord.max(), rel=1e-4)


def test_a_path_without_motion_may_be_run_as_fast_as_is_ever_said():
    still = ScanPath(z=np.full(3000, 1e-3), sample_period=PERIOD)
    assert limits_of(still)
    for limit in limits_of(still).values():
        assert limit.speed_factor == FASTEST


@pytest.mark.parametrize("servo", [20.0, 80.0])
def test_the_following_error_is_that_of_scipys_servo(servo):
    omega = 2 * np.pi * servo
    _, moved, _ = signal.lsim(([1.0], [1 / omega**2, 2 / omega, 1.0]), SWING, TIME)
    settled = np.abs(SWING - moved)[1000:].max()
    assert following_error(SWING, PERIOD, servo) == pytest.approx(settled, rel=2e-3)


def test_a_constant_offset_of_the_path_is_followed():
    usual = following_error(SWING, PERIOD, 50.0)
    assert following_error(SWING + 0.1, PERIOD, 50.0) == pytest.approx(usual, rel=1e-6)
    assert following_error(3 * SWING, PERIOD, 50.0) == pytest.approx(3 * usual, rel=1e-9)


def test_a_delay_behind_the_encoder_costs_its_time_times_the_velocity():
    """The following error of a ramp: 5 ms at 20 mm/s, and two time constants of the servo."""
    ramp, delayed = 0.02 * TIME, TransferFunction(np.ones(1), np.ones(1), 5e-3)
    late = 2 / (2 * np.pi * 50.0)
    assert following_error(ramp, PERIOD, 50.0) == pytest.approx(0.02 * late, rel=1e-6)
    found = following_error(ramp, PERIOD, 50.0, 1.0, delayed)
    assert found == pytest.approx(0.02 * (late + 5e-3), rel=1e-6)


@given(st.floats(0.02, 90.0), st.floats(0.5, 4.0))
@settings(max_examples=30)
def test_the_highest_factor_is_allowed_and_one_a_little_higher_is_not(factor, power):
    def value(k):
        return (k / factor) ** power

    found = highest_factor(value, 1.0)
    assert value(found) <= 1.0
    assert value(found * (1 + 3e-4)) > 1.0


# Blocks.


@given(st.lists(st.integers(1, 60), min_size=1, max_size=12), st.integers(1, 400))
@settings(max_examples=30)
def test_a_path_does_not_know_how_it_was_cut_into_blocks(lengths, most):
    total = sum(lengths)
    start, first = ScanPathReader(most), 0
    for length in lengths:
        part = slice(first, first + length)
        channels = {n: SWING[part] + k for k, n in enumerate("xyzbc")}
        stamps = {"stamp_ns": first * 10**6, "first_sample": first, "sample_period": PERIOD}
        start.add(AxisBlock(**stamps, **channels))
        start.add(DistanceBlock(**stamps, distance=SWING[part] * 0.1))
        first += length
    found, kept = start.path(), min(most, total)
    np.testing.assert_array_equal(found.x, SWING[:kept])
    np.testing.assert_array_equal(found.z, SWING[:kept] + 2)
    np.testing.assert_array_equal(found.c, SWING[:kept] + 4)
    np.testing.assert_array_equal(found.distance, SWING[:kept] * 0.1)
    assert (found.left_out is None) == (kept == total)


def test_without_readings_a_path_has_no_distance():
    start = ScanPathReader(100)
    zero = dict.fromkeys("xyzbc", np.zeros(5))
    start.add(AxisBlock(stamp_ns=0, first_sample=0, sample_period=PERIOD, **zero))
    assert start.path().distance is None


# Slopes and pitch.


def test_differences_of_a_quadratic_are_its_slopes():
    class Bowl:
        def height(self, x, y):
            return 3.0 * x**2 - 2.0 * x * y + 0.5 * y**2 + 0.1 * x

    x, y = np.random.default_rng(3).uniform(-1e-2, 1e-2, (2, 50))
    along_x, along_y = slopes_by_differences(Bowl(), x, y)
    np.testing.assert_allclose(along_x, 6 * x - 2 * y + 0.1, atol=1e-11)
    np.testing.assert_allclose(along_y, y - 2 * x, atol=1e-11)


def test_differences_of_a_mirror_are_closer_the_shorter_the_step():
    x, y = np.random.default_rng(4).uniform(-1e-2, 1e-2, (2, 50))
    true = PAPER_MIRROR.gradient(x, y)[0]
    broad, half = (
        np.abs(slopes_by_differences(PAPER_MIRROR, x, y, s)[0] - true).max() for s in (2e-3, 1e-3)
    )
    assert broad / half == pytest.approx(4, rel=0.05)


def test_a_pitch_is_straight_between_its_places_and_grows_with_the_arm():
    curve = PitchCurve(np.array([-1e-3, 0.0, 4e-3]), np.array([2e-6, 0.0, -8e-6]))
    z = np.array([-0.5e-3, 1e-3, 3e-3])
    np.testing.assert_allclose(curve.over(0.1, z), [1e-7, -2e-7, -6e-7])
    np.testing.assert_allclose(curve.over(-0.3, z), -3 * curve.over(0.1, z))


def test_places_of_a_pitch_that_are_no_numbers_in_order_are_refused():
    with pytest.raises(ConfigurationError, match="sort them, each once, two or more"):
        PitchCurve(np.array([0.0, 2.0, 1.0]), np.zeros(3))


def test_the_papers_scan_faster_by_a_factor_is_that_of_a_faster_spindle():
    """Two ways to the same: half the period, or twice the speed."""
    slow, fast = (Spiral(PAPER_MIRROR, 12.7e-3, 1e-4, v).positions(TIME[:4000]) for v in (30, 60))
    one = ScanPath(z=slow.z, sample_period=PERIOD / 2, x=slow.x, c=slow.c)
    other = ScanPath(z=fast.z, sample_period=PERIOD, x=fast.x, c=fast.c)
    for name in ("Z acceleration", "spindle speed", "motion frequency"):
        found, expected = limits_of(one)[name], limits_of(other)[name]
        assert found.value == pytest.approx(expected.value, rel=0.05)
