"""Levels of acceleration, what they do to a height, and an alarm that does not flutter."""

import numpy as np
import pytest

from omsm_ros.core.ripple.accelerometer import SLIDE, Alarm, MonitorOptions, RunningSpectrum
from omsm_ros.core.streams.blocks import AccelerationBlock
from omsm_ros.errors import ConfigurationError
from omsm_ros.twin.plant import PAPER_DYNAMICS

RATE = 4000.0


def blocks(z, size=400, first=0):
    still = np.zeros(len(z))
    return [
        AccelerationBlock(
            stamp_ns=0, first_sample=first + k, sample_period=1 / RATE,
            x=still[k : k + size], y=0.1 * z[k : k + size], z=z[k : k + size],
        )
        for k in range(0, len(z), size)
    ]  # fmt: skip


def shaken(frequency, acceleration, seconds=3.0):
    time = np.arange(int(seconds * RATE)) / RATE
    return 9.81 + acceleration * np.sin(2 * np.pi * frequency * time)


def fed(z, **options):
    running = RunningSpectrum(MonitorOptions(**options))
    for block in blocks(z):
        running.push(block)
    return running


def test_a_line_has_its_level_in_its_band_and_on_its_axis():
    levels = fed(shaken(680.0, 0.09)).levels()
    assert levels.bands == ((5, 50), (50, 150), (150, 500), (500, 2000))
    assert levels.rms["z"][3] == pytest.approx(0.09 / 2**0.5, rel=1e-3)
    assert levels.rms["y"][3] == pytest.approx(0.009 / 2**0.5, rel=1e-3)
    assert levels.rms["z"][1] < 1e-5
    axis, frequency, amplitude = levels.line
    assert (axis, round(frequency)) == ("z", 680)
    assert amplitude == pytest.approx(0.09, rel=1e-3)


def test_what_the_encoder_does_not_see_moves_the_height_by_its_motion():
    """a/ω²: 5 nm at 680 Hz are 0.0913 m/s²."""
    levels = fed(shaken(680.0, 5e-9 * (2 * np.pi * 680) ** 2)).levels()
    assert levels.height_total == pytest.approx(5e-9 / 2**0.5, rel=0.01)
    assert levels.height[3] == pytest.approx(levels.height_total, rel=1e-3)


@pytest.mark.parametrize("frequency", [30.0, 100.0, 300.0])
def test_what_the_encoder_sees_moves_it_by_what_the_response_lacks(frequency):
    moved = 10e-9
    running = fed(shaken(frequency, moved * (2 * np.pi * frequency) ** 2), mount=SLIDE)
    assert running.levels().height is None
    lacks = abs(1 - PAPER_DYNAMICS.response([frequency])[0])
    levels = running.levels(PAPER_DYNAMICS)
    assert levels.height_total == pytest.approx(moved * lacks / 2**0.5, rel=0.03)


@pytest.mark.parametrize("frequency", [50.0, 150.0, 500.0])
def test_a_line_on_the_edge_of_two_bands_counts_once(frequency):
    """Mains at 50 Hz lies on an edge of the bands that are set by default."""
    levels = fed(shaken(frequency, 10e-9 * (2 * np.pi * frequency) ** 2)).levels()
    assert levels.height_total == pytest.approx(10e-9 / 2**0.5, rel=0.01)
    total = np.sqrt(np.sum(np.square(levels.rms["z"])))
    assert total == pytest.approx(10e-9 * (2 * np.pi * frequency) ** 2 / 2**0.5, rel=1e-3)


def test_what_moves_the_height_most_is_named_apart_from_what_shakes_most():
    """3 nm at 40 Hz along z move it, 1 m/s² along x or at 1900 Hz hardly do."""
    time = np.arange(12_000) / RATE
    slow = 3e-9 * (2 * np.pi * 40) ** 2 * np.sin(2 * np.pi * 40 * time)
    z = slow + 0.05 * np.sin(2 * np.pi * 1900 * time)
    levels = fed(z).levels()
    assert levels.line[:2] == ("z", pytest.approx(1900.0))
    assert levels.height_line == (pytest.approx(40.0), pytest.approx(3e-9, rel=0.01))
    assert fed(z, mount=SLIDE).levels().height_line is None


def test_cut_anyhow_the_levels_are_the_same():
    z = shaken(123.0, 0.02) + np.random.default_rng(1).normal(0, 1e-3, 12_000)
    small, large = (RunningSpectrum(MonitorOptions()) for _ in range(2))
    for block in blocks(z, 37):
        small.push(block)
    for block in blocks(z, 12_000):
        large.push(block)
    assert small.levels() == large.levels()
    assert small.levels().windows == 5


def test_a_gap_or_a_lost_sample_spoils_no_window():
    running = RunningSpectrum(MonitorOptions())
    z = shaken(123.0, 0.02)
    z[100] = np.nan
    for block in blocks(z):
        running.push(block)
    for block in blocks(shaken(123.0, 0.02), first=50_000):
        running.push(block)
    assert (running.lost, running.restarts, running.received) == (1, 1, 24_000)
    assert running.levels().rms["z"][1] == pytest.approx(0.02 / 2**0.5, rel=1e-3)


@pytest.mark.parametrize("seed", range(5))
def test_the_noise_of_the_sensor_is_no_vibration(seed):
    """White noise of 0.5 mm/s² from 5 to 50 Hz would be 90 nm by a/ω²; a line stands out of it."""
    random = np.random.default_rng(seed)
    noise = random.normal(0, 0.5e-3 * np.sqrt(RATE / 2 / 45), int(4 * RATE))
    quiet = fed(noise).levels()
    assert quiet.height_total == 0.0
    f = np.linspace(5, 50, 1000)
    white = np.sqrt(np.trapezoid((0.5e-3) ** 2 / 45 / (2 * np.pi * f) ** 4, f))
    assert white < quiet.height_noise < 4 * white
    line = shaken(30.0, 150e-9 * (2 * np.pi * 30) ** 2, seconds=4.0)
    assert fed(noise + line).levels().height_total == pytest.approx(150e-9 / 2**0.5, rel=0.15)
    fast = shaken(680.0, 20e-9 * (2 * np.pi * 680) ** 2, seconds=4.0)
    levels = fed(noise + fast).levels()
    assert levels.height_total == pytest.approx(20e-9 / 2**0.5, rel=0.05)
    assert levels.height_line[0] == pytest.approx(680, abs=1)


def test_a_slow_sensor_has_fewer_bands():
    levels = fed(shaken(100.0, 0.01), edges=(10.0, 200.0, 1000.0, 9000.0)).levels()
    assert levels.bands == ((10.0, 200.0), (200.0, 1000.0), (1000.0, 2000.0))


def test_before_a_window_is_full_nothing_is_said():
    assert fed(shaken(100.0, 0.01, seconds=0.5)).levels() is None


@pytest.mark.parametrize(
    ("options", "reported"),
    [({"edges": (5.0,)}, "rising"), ({"edges": (5.0, 6.0)}, "16 Hz"), ({"axis": "q"}, "along 'q'")],
)
def test_what_cannot_be_is_refused(options, reported):
    with pytest.raises(ConfigurationError, match=reported):
        MonitorOptions(**options)


def test_an_alarm_has_hysteresis():
    alarm = Alarm(10.0)
    assert [alarm.update(v) for v in (9, 10, 8, None, 7.1, 6.9, 9.9)] == [
        *(False, True, True, True, True, False, False)
    ]
    assert alarm.times == 1
    with pytest.raises(ConfigurationError, match="positive limit"):
        Alarm(0.0)
