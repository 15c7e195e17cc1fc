"""The machine's limits, against closed forms for sines and the paper's path."""

from __future__ import annotations

import numpy as np
import pytest

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
TIME = np.arange(20_000) * PERIOD
AMPLITUDE, FREQUENCY = 0.4e-3, 2.0
SINE = AMPLITUDE * np.sin(2 * np.pi * FREQUENCY * TIME)
OMEGA = 2 * np.pi * FREQUENCY


def limit(name: str, path: ScanPath, limits: MachineLimits, budget: float = 50e-9):
    evaluated, missing = speed_limits(path, limits, 60.0, budget)
    assert name not in missing
    return next(found for found in evaluated if found.name == name)


def test_derivatives_of_a_sine_are_its_own() -> None:
    velocity, acceleration, jerk = steepest(SINE, PERIOD, content_frequency(SINE, PERIOD))
    assert velocity == pytest.approx(AMPLITUDE * OMEGA, rel=0.02)
    assert acceleration == pytest.approx(AMPLITUDE * OMEGA**2, rel=0.02)
    assert jerk == pytest.approx(AMPLITUDE * OMEGA**3, rel=0.1)


def test_encoder_noise_is_not_taken_for_acceleration() -> None:
    noisy = SINE + np.random.default_rng(1).normal(0, 1e-9, len(SINE))
    _, acceleration, _ = steepest(noisy, PERIOD, content_frequency(noisy, PERIOD))
    assert acceleration == pytest.approx(AMPLITUDE * OMEGA**2, rel=0.05)


def test_content_of_a_sine_is_its_frequency_and_of_a_rest_none() -> None:
    assert content_frequency(SINE, PERIOD) == pytest.approx(FREQUENCY, abs=0.1)
    assert content_frequency(np.full(1000, 0.02), PERIOD) == 0.0


def test_noise_of_the_encoder_is_no_content() -> None:
    noise = np.random.default_rng(2).normal(0, 1e-9, len(SINE))
    assert content_frequency(noise, PERIOD) == 0.0
    # Here the noise holds half of the mean square velocity.
    assert content_frequency(1e-3 * SINE + noise, PERIOD) < 20.0


@pytest.mark.parametrize("lost", [0, 1, 2500])
def test_noise_of_the_encoder_is_no_content_of_a_small_motion_whatever_its_length(lost) -> None:
    """The noise holds more of the mean square velocity than the motion of 1.3 Hz."""
    time = np.arange(60_000 - lost) * PERIOD
    small = 1e-6 * np.sin(2 * np.pi * 1.3 * time)
    for seed in range(10):
        noise = np.random.default_rng(seed).normal(0, 5e-9, len(time))
        assert content_frequency(small + noise, PERIOD) == pytest.approx(1.3, abs=0.1)


@pytest.mark.parametrize("noise", [0.0, 1e-9])
def test_the_feed_over_a_round_part_holds_no_frequency_and_its_swing_does(noise):
    time = np.arange(0, 60, PERIOD)
    radius = 8e-3 - 25e-6 * time
    scatter = noise * np.random.default_rng(5).normal(size=len(time))
    sphere = 0.02 - np.sqrt(0.02**2 - radius**2)
    assert content_frequency(sphere + scatter, PERIOD) == 0.0
    toric = radius**2 * (1 + 0.02 * np.cos(4 * np.pi * time))
    assert content_frequency(toric + scatter, PERIOD) == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize("turns", [1, 2, 4, 32])
def test_of_few_turns_the_content_is_that_of_many(turns):
    """Heights over a circle are a Fourier series: three waves a turn hold 99.9 % of its swing."""
    angle = 2 * np.pi * np.arange(4096) / 4096
    height = PAPER_MIRROR.height(12.7e-3 * np.cos(angle), 12.7e-3 * np.sin(angle))
    swing = np.cumsum(np.abs(np.fft.rfft(height) * np.arange(2049)) ** 2)
    waves = int(np.argmax(swing >= 0.999 * swing[-1]))
    assert waves == 3
    time = np.arange(turns * 2000) * PERIOD  # a turn takes 2 s
    z = Spiral(PAPER_MIRROR, 12.7e-3, 1e-4, 30.0).positions(time).z
    assert content_frequency(z, PERIOD) == pytest.approx(0.5 * waves, abs=0.26)


@pytest.mark.parametrize("length", [70_002, 290_012, 559_872])  # its steps: a large prime factor
def test_the_content_of_a_long_scan_is_that_of_its_sine_whatever_its_length(length):
    """Four turns and a bit: what is left out at the end is no jump that counts."""
    period = 4.03 / length
    z = 1e-3 * np.sin(2 * np.pi * np.arange(length) * period)
    assert content_frequency(z, period) == pytest.approx(1.0, abs=0.26)


@pytest.mark.parametrize("servo", [50.0, 200.0])
@pytest.mark.parametrize("factor", [1.0, 7.0])
def test_following_error_of_a_sine_is_that_of_the_servo(servo: float, factor: float) -> None:
    lost = abs(1 - 1 / (1 + 1j * FREQUENCY * factor / servo) ** 2)
    found = following_error(SINE, PERIOD, servo, factor)
    assert found == pytest.approx(AMPLITUDE * lost, rel=2e-3)


@pytest.mark.parametrize("factor", [1.0, 7.0])
def test_what_lags_behind_the_encoder_leaves_the_path_too(factor: float) -> None:
    lag, servo = 0.34e-3, 50.0
    structure = TransferFunction(np.ones(1), np.array([1.0, lag]))
    s = 2j * np.pi * FREQUENCY * factor
    lost = abs(1 - 1 / (1 + s / (2 * np.pi * servo)) ** 2 / (1 + s * lag))
    found = following_error(SINE, PERIOD, servo, factor, structure)
    assert found == pytest.approx(AMPLITUDE * lost, rel=2e-3)
    assert found > 1.03 * following_error(SINE, PERIOD, servo, factor)


def test_the_papers_scan_at_1221_rpm_leaves_the_probes_range() -> None:
    """A servo of 200 Hz follows 0.11 mm late there, of 0.05 mm allowed."""
    spiral = Spiral(PAPER_MIRROR, 12.7e-3, feed_per_turn=0.1e-3, spindle_speed=30.0)
    positions = spiral.positions(np.arange(20_000) * PERIOD)
    path = ScanPath(z=positions.z, sample_period=PERIOD, x=positions.x, c=positions.c)
    assert following_error(path.z, PERIOD, 200.0, 1221 / 30) == pytest.approx(113e-6, rel=0.02)
    found = limit("probe range against following error", path, MachineLimits(servo_frequency=200.0))
    assert following_error(path.z, PERIOD, 200.0, found.speed_factor) == pytest.approx(
        50e-6, rel=1e-3
    )
    spindle = limit("spindle speed", path, MachineLimits())
    assert spindle.value == pytest.approx(30.0)
    assert spindle.speed_factor == pytest.approx(4.0)


def test_what_the_readings_span_already_is_not_there_for_following() -> None:
    readings = 50e-6 + 30e-6 * (-1.0) ** np.arange(len(SINE))
    readings[5] = np.nan
    path = ScanPath(z=SINE, sample_period=PERIOD, distance=readings)
    free = ScanPath(z=SINE, sample_period=PERIOD)
    name, limits = "probe range against following error", MachineLimits(servo_frequency=200.0)
    assert limit(name, path, limits).speed_factor < limit(name, free, limits).speed_factor
    assert limit(name, path, limits).value == pytest.approx(30e-6)


def test_readings_that_span_less_show_a_better_servo() -> None:
    name, limits = "probe range against following error", MachineLimits(servo_frequency=50.0)
    late = following_error(SINE, PERIOD, 50.0)
    path = ScanPath(z=SINE, sample_period=PERIOD, distance=0.25 * late * np.sign(SINE))
    found = limit(name, path, limits)
    assert found.value == pytest.approx(0.25 * late, rel=1e-3)
    at_that_speed = 0.25 * following_error(SINE, PERIOD, 50.0, found.speed_factor)
    assert at_that_speed == pytest.approx(50e-6, rel=1e-3)


def test_the_start_of_a_path_is_gathered_from_blocks() -> None:
    start = ScanPathReader(150)
    assert start.path() is None
    ramp = np.arange(100.0)
    for first in (0, 100):
        start.add(
            AxisBlock(
                stamp_ns=0,
                first_sample=first,
                sample_period=PERIOD,
                **dict.fromkeys("xyzbc", first / 100 + ramp * 1e-6),
            )
        )
        start.add(
            DistanceBlock(
                stamp_ns=0,
                first_sample=first,
                sample_period=PERIOD,
                distance=ramp * 1e-9,
                status=(ramp == 7).astype(np.uint8),
            )
        )
    path = start.path()
    assert path is not None
    assert len(path.z) == len(path.c) == len(path.distance) == 150
    assert path.x[149] == pytest.approx(1 + 49e-6)
    assert np.flatnonzero(np.isnan(path.distance)).tolist() == [7, 107]


def test_powers_of_the_speed() -> None:
    path = ScanPath(z=SINE, sample_period=PERIOD)
    declared = MachineLimits(
        z_acceleration=4 * AMPLITUDE * OMEGA**2,
        z_jerk=8 * AMPLITUDE * OMEGA**3,
        exposure=1e-3,
        timing=1e-6,
    )
    assert limit("Z acceleration", path, declared).speed_factor == pytest.approx(2.0, rel=0.02)
    assert limit("Z jerk", path, declared).speed_factor == pytest.approx(2.0, rel=0.05)
    late = limit("timing of the trigger", path, declared)
    assert late.value == pytest.approx(1e-6 * AMPLITUDE * OMEGA, rel=0.02)
    assert late.speed_factor == pytest.approx(25e-9 / late.value)


def test_path_within_one_exposure_is_the_loss_of_a_boxcar() -> None:
    """The mean of a sine over τ is less than the sine by ω²τ²/24."""
    tau = 2e-3
    path = ScanPath(z=SINE, sample_period=PERIOD)
    found = limit("path within one exposure", path, MachineLimits(exposure=tau))
    lost = AMPLITUDE * (1 - np.sinc(FREQUENCY * tau))
    assert found.value == pytest.approx(lost, rel=0.02)
    # Half of the budget of 50 nm, k = 2, is the standard error; the loss grows with the square.
    assert found.speed_factor == pytest.approx(np.sqrt(25e-9 / lost), rel=0.02)


def test_spacing_at_the_rim() -> None:
    x, c = np.full(1000, 12.7e-3), 2 * np.pi * 0.5 * np.arange(1000) * PERIOD
    path = ScanPath(z=np.zeros(1000), sample_period=PERIOD, x=x, c=c)
    found = limit("spacing at the rim", path, MachineLimits(point_spacing=80e-6))
    assert found.value == pytest.approx(39.9e-6, rel=1e-3)
    assert found.speed_factor == pytest.approx(80 / 39.9, rel=1e-2)


def test_what_is_not_declared_or_not_known_is_named() -> None:
    _, missing = speed_limits(ScanPath(z=SINE, sample_period=PERIOD), MachineLimits(), 60.0, 50e-9)
    assert set(missing) == {
        "Z acceleration",
        "Z jerk",
        "spindle speed",
        "spacing at the rim",
        "path within one exposure",
        "timing of the trigger",
    }


def test_highest_factor_of_a_line() -> None:
    assert highest_factor(lambda k: 2 * k, 6.0) == pytest.approx(3.0, rel=1e-3)
    assert highest_factor(lambda k: 0.0, 1.0) == FASTEST
    assert highest_factor(lambda k: 1.0, 0.5) == 0.0


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_a_senseless_limit_is_named(value: float) -> None:
    with pytest.raises(ConfigurationError, match="z_jerk"):
        MachineLimits(z_jerk=value)


@pytest.mark.parametrize(
    ("power", "factor"),
    [(0.3, 0.011), (6.0, 0.011), (2.0, 0.2), (1.0, 1.0), (0.3, 99.0), (6.0, 99.0)],
)
def test_highest_factor_of_a_power_takes_few_values(power: float, factor: float) -> None:
    asked: list[float] = []

    def value(k: float) -> float:
        asked.append(k)
        return 5.0 * (k / factor) ** power

    found = highest_factor(value, 5.0)
    assert factor * (1 - 1e-3) < found <= factor * (1 + 1e-9)
    assert len(asked) < 10


@pytest.mark.parametrize("factor", [0.2, 7.0])
def test_highest_factor_asks_only_on_the_side_of_what_is_known(factor: float) -> None:
    asked: list[float] = []

    def value(k: float) -> float:
        asked.append(k)
        return k / factor

    assert highest_factor(value, 1.0, now=1 / factor) == pytest.approx(factor, rel=1e-3)
    assert all((k > 1) == (factor > 1) for k in asked)


def test_highest_factor_of_a_bend_and_of_a_jump() -> None:
    # Noise at low speed, a resonance at high: the line is broken twice.
    found = highest_factor(lambda k: 1.0 + k**2 + 1e-3 * k**6, 30.0)
    assert 1.0 + found**2 + 1e-3 * found**6 == pytest.approx(30.0, rel=1e-3)
    jump = highest_factor(lambda k: 0.0 if k < 7.0 else 9.0, 1.0)
    assert 7.0 * (1 - 1e-3) < jump < 7.0
