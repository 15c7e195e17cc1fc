"""Faults found in recordings with known faults."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from soaked import soaked

from omsm_ros.core.streams.blocks import AxisBlock, Block, DistanceBlock, Status
from omsm_ros.core.streams.stream_faults import StreamWatch, counter_skew, skew_fault

PERIOD = 1e-3
EPOCH = 1_763_000_000_000_000_000


def axes(first: int, samples: int = 100, offset_ns: int = 0) -> AxisBlock:
    zeros = {name: np.zeros(samples) for name in "xyzbc"}
    stamp = EPOCH + first * 1_000_000 + offset_ns
    return AxisBlock(stamp_ns=stamp, first_sample=first, sample_period=PERIOD, **zeros)


def distance(first: int, samples: int = 100, counter: int = 0) -> DistanceBlock:
    stamp = EPOCH + first * 1_000_000
    return DistanceBlock(
        stamp_ns=stamp,
        first_sample=first + counter,
        sample_period=PERIOD,
        distance=np.zeros(samples),
    )


def watched(*blocks: Block) -> StreamWatch:
    watch = StreamWatch()
    for block in blocks:
        watch.add(block)
    return watch


def faults(*blocks: Block) -> list[str]:
    return list(map(str, watched(*blocks).faults("axes")))


def test_nothing_is_said_of_a_good_stream() -> None:
    assert faults(*(axes(first) for first in range(0, 1000, 100))) == []


def test_missing_trigger_numbers_are_counted_and_named() -> None:
    watch = watched(axes(0), axes(150), axes(250), axes(400), axes(1000), axes(2000))
    assert (watch.missing, watch.places) == (50 + 50 + 500 + 900, 4)
    (said,) = map(str, watch.faults("axes"))
    assert "1500 trigger numbers are missing" in said
    assert "100 to 149, 350 to 399, 500 to 999 and 1 more" in said


def test_what_comes_late_into_a_gap_was_not_missing() -> None:
    assert watched(axes(0), axes(200), axes(100)).missing == 0


def test_a_restart_and_a_repetition_are_distinguished() -> None:
    later = replace(axes(0), stamp_ns=EPOCH + 3_600 * 10**9)
    assert "began anew 1 times" in faults(axes(0), axes(100), later)[0]
    assert "100 samples repeat" in faults(axes(0), axes(100), axes(100))[0]


def test_another_period_and_a_probe_that_sees_nothing() -> None:
    other = replace(axes(100), sample_period=2e-3)
    assert "sample periods from 0.001 s to 0.002 s" in faults(axes(0), other)[0]
    blind = replace(distance(0), status=np.full(100, Status.NO_TARGET, np.uint8))
    assert "none of 100 readings is valid" in faults(blind)[0]


def test_a_probe_that_never_changes_is_named_with_what_it_says() -> None:
    still = [replace(distance(first), distance=np.full(100, 12.3e-6)) for first in (0, 100)]
    (said,) = faults(*still)
    assert "all 200 valid readings are 12.3 µm" in said
    moved = replace(still[1], distance=np.append(np.full(99, 12.3e-6), 12.300001e-6))
    assert faults(still[0], moved) == []
    lost = replace(
        still[0], status=np.append(np.full(99, Status.NO_TARGET), Status.OK).astype("u1")
    )
    assert faults(lost) == []


def readings(values: np.ndarray, size: int = 100) -> list[DistanceBlock]:
    parts = np.split(values, range(size, len(values), size))
    return [replace(distance(k * size, len(part)), distance=part) for k, part in enumerate(parts)]


def scattered(samples: int, step: float = 1e-9) -> np.ndarray:
    noise = np.random.default_rng(8).normal(0.0, 10e-9, samples)
    return np.round(noise / step) * step


@pytest.mark.parametrize("step", [1e-15, 1e-9, 20e-9])
@pytest.mark.parametrize("size", [7, 100, 10_000, *soaked(1)])
def test_readings_that_scatter_are_no_fault(step: float, size: int) -> None:
    assert faults(*readings(scattered(4000, step), size)) == []


@pytest.mark.parametrize("size", [1, 7, 100, 10_000])
def test_a_reading_that_is_held_is_named_with_how_long(size: int) -> None:
    values = scattered(4000)
    values[1234:1789] = 55.5e-9
    (said,) = faults(*readings(values, size))
    assert "555 readings in succession are 55.5 nm" in said


@pytest.mark.parametrize(("sign", "word"), [(1, "greatest"), (-1, "least")])
def test_a_clipped_probe_and_a_number_for_no_reading_pile_up(sign: int, word: str) -> None:
    clipped = sign * np.minimum(scattered(4000, 1e-12), 10e-9)
    times = int(np.sum(clipped == sign * 10e-9))
    (said,) = faults(*readings(clipped))
    assert f"{times} of 4000 readings are the {word}" in said
    values = scattered(4000)
    values[::40] = sign * 9999e-6
    (said,) = faults(*readings(values))
    assert f"100 of 4000 readings are the {word}, {'-' * (sign < 0)}10.0 mm" in said


def test_plateaus_of_coarse_readings_are_no_fault() -> None:
    plateaus = np.repeat([0.0, 1e-6, 0.0, 1e-6, 2e-6, 1e-6], 500)
    assert faults(*readings(plateaus)) == []


@pytest.mark.parametrize(
    ("factor", "lapse", "said"), [(1, 1, 0), (1.01, 1, 1), (2, 1, 1), (0.05, 20, 0)]
)
def test_stamps_that_contradict_the_period_are_named(factor, lapse, said) -> None:
    blocks = [
        replace(axes(first), stamp_ns=EPOCH + round(first * factor * 1e6))
        for first in range(0, 5000, 100)
    ]
    found = list(watched(*blocks).period_fault("axes", lapse))
    assert len(found) == said
    assert all("sample period of 0.001 s" in str(fault) for fault in found)


def test_messages_that_were_joined_tell_their_stamps() -> None:
    parts = np.array([(first, EPOCH + 2_000_000 * first) for first in range(0, 5000, 100)])
    joined = replace(axes(0, 5000), parts=parts)
    (said,) = map(str, watched(joined).period_fault("axes"))
    assert "by their stamps it is 0.002 s" in said


@pytest.mark.parametrize("samples", [1, -1, 10, 100, 400])
def test_a_counter_that_is_off_is_found_by_the_stamps(samples: int) -> None:
    one = watched(*(axes(first) for first in range(0, 5000, 100)))
    other = watched(*(distance(first, counter=samples) for first in range(100, 5000, 100)))
    skew = counter_skew(one, other)
    assert skew == pytest.approx(samples * PERIOD, abs=1e-9)
    (said,) = map(str, skew_fault(skew, PERIOD))
    assert f"{samples} samples" in said


def test_scattered_stamps_of_two_clocks_are_no_fault() -> None:
    random = np.random.default_rng(2)
    one = watched(*(axes(f, offset_ns=int(random.normal(0, 2e5))) for f in range(0, 20_000, 100)))
    other = watched(*(distance(first) for first in range(0, 20_000, 100)))
    assert list(skew_fault(counter_skew(one, other), PERIOD)) == []


def test_blocks_of_other_lengths_and_a_recording_in_time_lapse() -> None:
    """Twenty times faster than real: stamps advance by a twentieth of the period."""

    def lapsed(block: Block) -> Block:
        return replace(block, stamp_ns=EPOCH + (block.stamp_ns - EPOCH) // 20)

    one = watched(*(lapsed(axes(first, 70)) for first in range(0, 7000, 70)))
    other = watched(*(lapsed(distance(first)) for first in range(0, 7000, 100)))
    assert counter_skew(one, other) == pytest.approx(0.0, abs=1e-6)


def test_one_block_each_and_none_in_common() -> None:
    assert counter_skew(watched(axes(0)), watched(distance(0, counter=5))) == pytest.approx(5e-3)
    assert counter_skew(watched(axes(0)), StreamWatch()) is None
    assert list(skew_fault(None, PERIOD)) == []


def test_places_where_an_axis_was_lost_are_counted_once_each() -> None:
    block = axes(0)
    z, c = block.z.copy(), block.c.copy()
    z[[3, 7]], c[[7, 50]] = np.nan, np.nan
    assert watched(replace(block, z=z, c=c), axes(100)).invalid == 3


TIME = np.arange(6000) * PERIOD


def moving(size: int = 100, **axis: np.ndarray) -> StreamWatch:
    """A spiral with Z to and fro, one of its axes as given."""
    whole = {"x": 5e-3 - 5e-5 * TIME, "z": 1e-5 * np.sin(2 * TIME), "c": np.pi * TIME, **axis}
    blocks = []
    for first in range(0, len(TIME), size):
        part = {name: values[first : first + size] for name, values in whole.items()}
        blocks.append(replace(axes(first, len(part["x"])), **part))
    return watched(*blocks)


@pytest.mark.parametrize("size", [100, 6000, *soaked(1)])
def test_an_axis_that_stands_still_between_steps_is_named(size: int) -> None:
    held = np.arange(6000) // 10 * 10
    assert list(moving(size).step_faults()) == []
    (said,) = map(str, moving(size, z=np.round(1e-5 * np.sin(2 * TIME), 7)).step_faults())
    assert "Z moves in steps of 100 nm" in said
    assert "height error of 28.9 nm" in said
    (said,) = map(str, moving(size, c=np.pi * TIME[held]).step_faults())
    assert "C moves in steps of 31.4 mrad" in said
    assert f"error of {5e3 * 10 * np.pi * PERIOD / np.sqrt(12):.1f} µm" in said
    (said,) = map(str, moving(size, x=5e-3 - 5e-5 * TIME[held // 200 * 200]).step_faults())
    assert "X moves in steps of 10.0 µm" in said


def test_steps_that_are_stated_or_harmless_are_no_fault() -> None:
    coarse = moving(z=np.round(1e-5 * np.sin(2 * TIME), 7))
    assert list(coarse.step_faults(resolution=1e-7)) == []
    held = np.pi * TIME[np.arange(6000) // 10 * 10]
    assert list(moving(c=held).step_faults(lateral=50e-6)) == []
    fine = np.round(1e-5 * np.sin(2 * TIME), 8)
    rests = np.where(TIME < 4.0, 0.0, 1e-5 * np.sin(2 * TIME))
    for z in (fine, rests, np.where(np.arange(6000) % 7 == 3, np.nan, rests)):
        assert list(moving(z=z).step_faults()) == []
