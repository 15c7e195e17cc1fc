"""Stamps, values that need memory, and connection of the generic stream."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from omsm_ros.core.streams.blocks import Status
from omsm_ros.errors import DeviceError
from omsm_ros.instruments.scaling import AxisScaling
from omsm_ros.instruments.six_channel.device import GenericStreamDevice, StreamSettings
from omsm_ros.instruments.six_channel.protocol import StreamScaling, encode_frames

from .scripted_stream import MS, NEVER, Script, assert_consistent, frames_of, run, spans

# Values that need memory.


def test_a_wrapping_encoder_is_unwrapped_across_blocks_and_gaps() -> None:
    turns = AxisScaling(3600 / (2 * np.pi), wrap=3600)
    angle = np.linspace(0.3, 40.0, 300)
    frames = frames_of(np.arange(300))
    frames["counts"][:, 4] = turns.counts(angle)
    kept = np.delete(frames, np.arange(120, 125))
    settings = StreamSettings(block_size=50, pause=NEVER, scaling=StreamScaling(c=turns))
    blocks, _ = run(encode_frames(kept), settings=settings)
    found = np.concatenate([axes.c for axes, _ in blocks])
    expected = np.delete(angle, np.arange(120, 125))
    assert abs(found - expected).max() <= np.pi / 3600 * 1.001


def test_unknown_verdicts_are_counted_and_lost() -> None:
    frames = frames_of(np.arange(4))
    frames["status"] = [0, 9, 1, 200]
    ((_, distance),), device = run(encode_frames(frames))
    assert distance.status.tolist() == [Status.OK, Status.LOST, Status.NO_TARGET, Status.LOST]
    assert device.unknown_status == 2


# Time.


def test_samples_are_stamped_by_their_arrival_not_by_the_read() -> None:
    """The transport knows by the kernel how long the bytes waited for a busy host."""
    script = Script(encode_frames(frames_of(np.arange(10))))
    script.age = 0.25
    device = GenericStreamDevice(script, StreamSettings(block_size=10), lambda: 10**18)
    device.open()
    ((axes, _),) = device.poll(0.0)
    assert axes.stamp_ns == 10**18 - 250 * MS - 9 * MS


@pytest.mark.parametrize(("time_ns", "together"), [(0, 1), (10**18, 20)])
def test_a_time_that_stands_still_is_an_error(time_ns: int, together: int) -> None:
    """A controller whose program does not fill the time in, not one spoilt on the line."""
    frames, now = frames_of(np.arange(2000)), 0.0
    frames["device_time"] = time_ns
    portions = [encode_frames(frames[i : i + together]) for i in range(0, 2000, together)]
    device = GenericStreamDevice(
        Script(*portions), StreamSettings(), lambda: 10**18 + round(now * 1e9)
    )
    device.open()
    found = []
    for _ in portions:
        now += together * 1e-3
        found += device.poll(0.0)
    assert not found
    assert "its time does not increase" in device.trouble
    assert device.statistics.restarts == 0


def test_stamps_are_of_the_first_sample_on_the_host_clock() -> None:
    """Frames that arrive at the instant they are taken: host = device + a known offset."""
    offset = 1_700_000_000_000_000_000
    wire = [encode_frames(frames_of([i])) for i in range(40)]
    arrivals = iter(i * MS + offset for i in range(40))
    device = GenericStreamDevice(
        Script(*wire), StreamSettings(block_size=10, pause=NEVER), lambda: next(arrivals)
    )
    device.open()
    blocks = [pair for _ in wire for pair in device.poll(0.0)]
    assert [axes.stamp_ns - offset for axes, _ in blocks] == [0, 10 * MS, 20 * MS, 30 * MS]


def test_stamps_of_a_restarted_device_are_of_its_new_clock() -> None:
    """Up for a day, then again from zero: host time goes on as if nothing had been."""
    day = 86_400 * 1000 * MS
    before = frames_of(np.arange(10), start_ns=day)
    after = frames_of(np.arange(10), start_ns=0)
    arrivals = iter([9 * MS, 2009 * MS])
    device = GenericStreamDevice(
        Script(encode_frames(before), encode_frames(after)),
        StreamSettings(block_size=10, pause=NEVER),
        lambda: day + next(arrivals),
    )
    device.open()
    blocks = device.poll(0.0) + device.poll(0.0)
    assert [axes.stamp_ns - day for axes, _ in blocks] == [0, 2000 * MS]


@pytest.mark.parametrize(
    ("deviation", "warnings"), [(0.0, 0), (90e-6, 0), (-90e-6, 0), (110e-6, 3), (-0.01, 3)]
)
def test_a_wrong_nominal_period_is_noticed(deviation: float, warnings: int) -> None:
    frames = frames_of(np.arange(330))
    frames["device_time"] = np.rint(np.arange(330) * MS * (1 + deviation))
    _, device = run(encode_frames(frames))
    assert device.statistics.period_warnings == warnings
    assert device.statistics.period_deviation == pytest.approx(deviation, abs=1e-8)
    said = device.trouble or device.caution
    assert ("sample_period" in said) == (warnings > 0)


def test_another_rate_is_seen_in_large_portions_too() -> None:
    """Their times are far from those of the counts, but not because the line damaged them."""
    frames = frames_of(np.arange(4000))
    frames["device_time"] = np.arange(4000) * MS // 2
    edges = [*range(0, 2000, 50), 2000, 2600, 2700, 3500, 4000]
    portions = [encode_frames(frames[a:b]) for a, b in pairwise(edges)]
    found, device = run(*portions)
    assert not found
    assert "2000 Hz" in device.trouble


@pytest.mark.parametrize("together", [1, 7, 300])
@pytest.mark.parametrize(
    ("passed", "missed"), [(3.0, 2), (3.01, 0), (2.5, 0), (30.4, 0), (101.0, 100), (102.0, 0)]
)
def test_whole_periods_of_time_are_missed_triggers(
    together: int, passed: float, missed: int
) -> None:
    """A pause of the trigger has any length, and a longer one than half of ``pause`` is one."""
    frames = frames_of(np.arange(300))
    frames["device_time"][100:] += round((passed - 1) * MS)
    settings = StreamSettings(block_size=10, pause=0.2)
    wire = [encode_frames(frames[i : i + together]) for i in range(0, 300, together)]
    found, device = run(*wire, settings=settings)
    numbers = np.concatenate([axes.first_sample + np.arange(len(axes)) for axes, _ in found])
    counts = np.concatenate([np.rint(axes.x * 1e9).astype(int) for axes, _ in found])
    np.testing.assert_array_equal(numbers, np.arange(300) + missed * (np.arange(300) >= 100))
    np.testing.assert_array_equal(counts, np.arange(300))
    assert (device.statistics.missed, device.statistics.lost) == (missed, 0)


def test_a_damaged_time_is_no_missed_trigger() -> None:
    frames = frames_of(np.arange(300))
    frames["device_time"][100] += 2 * MS
    found, device = run(*(encode_frames(frames[i : i + 1]) for i in range(300)))
    assert sum(len(axes) for axes, _ in found) == 300
    assert device.statistics.missed == 0


@pytest.mark.parametrize("grain", [1000, 10_000])
def test_the_scatter_of_its_times_decides_what_a_device_can_show(grain: int) -> None:
    """At 70 kHz times in steps of 1 µs show a missed trigger, and those of 10 µs do not."""
    frames = frames_of(np.arange(300))
    true = np.arange(300) + 2 * (np.arange(300) >= 100)
    frames["device_time"] = true * 1e9 / 70e3 // grain * grain
    settings = StreamSettings(block_size=10, sample_period=1 / 70e3)
    _, device = run(encode_frames(frames), settings=settings)
    assert device.statistics.missed == (2 if grain == 1000 else 0)


def test_times_of_sending_show_no_missed_trigger() -> None:
    """A device that now and then sends up to three samples late, with the times of sending."""
    random = np.random.default_rng(1)
    frames = frames_of(np.arange(4000))
    late = np.zeros(4000)
    for at in random.integers(40, 3900, 200):
        late[at : at + random.integers(1, 4)] = random.uniform(0.0, 3.0)
    frames["device_time"] = np.rint((np.arange(4000) + late) * MS)
    _, device = run(encode_frames(frames))
    assert device.statistics.missed == 0


# Connection.


def test_the_constructor_touches_nothing() -> None:
    script = Script()
    GenericStreamDevice(script)
    assert script.opened == 0


def test_a_lost_connection_costs_nothing_that_had_arrived() -> None:
    wire = encode_frames(frames_of(np.arange(12)))
    device = GenericStreamDevice(
        Script(wire[: 5 * 63 + 30], DeviceError("gone"), wire[7 * 63 :]),
        StreamSettings(pause=NEVER),
    )
    device.open()
    assert device.poll(0.0) == []
    with pytest.raises(DeviceError, match="gone"):
        device.poll(0.0)
    blocks = device.close()
    device.open()
    device.poll(0.0)
    blocks += device.close()
    assert spans(blocks) == [(0, 5), (7, 5)]
    assert_consistent(blocks, device)
    found = device.statistics
    assert (found.lost, found.gaps, device._decoder.statistics.bad_length) == (2, 1, 1)
