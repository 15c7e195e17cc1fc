import numpy as np
import pytest

from omsm_ros.core.streams.blocks import DistanceBlock
from omsm_ros.core.streams.motion_record import BlockBuffer


def block(first, length=100, stamp_ns=0):
    return DistanceBlock(
        stamp_ns=stamp_ns, first_sample=first, sample_period=1e-3, distance=np.zeros(length)
    )


def filled(capacity, *firsts):
    buffer = BlockBuffer(capacity)
    for first in firsts:
        buffer.add(block(first))
    return buffer


def firsts(buffer, duration=0.0):
    return [kept.first_sample for kept in buffer.recent(duration)]


def test_the_oldest_go_and_are_counted():
    buffer = filled(250, 0, 100, 200, 300)
    assert firsts(buffer) == [200, 300]
    assert (len(buffer), buffer.forgotten) == (200, 200)


def test_one_block_is_always_kept():
    assert firsts(filled(10, 0, 100)) == [100]


def test_a_counter_that_falls_back_begins_a_new_motion():
    buffer = filled(10_000, 0, 100, 200, 0, 100)
    assert firsts(buffer) == [0, 100]
    assert buffer.forgotten == 300


def test_the_last_seconds_are_asked_for():
    buffer = filled(10_000, 0, 100, 200, 300)
    assert firsts(buffer, 0.15) == [200, 300]
    assert firsts(buffer) == [0, 100, 200, 300]
    assert firsts(BlockBuffer(10), 1.0) == []


def test_a_block_that_comes_late_or_again_ends_no_motion():
    """Its stamp is older, as its counter is; what is asked for last is still the end."""
    buffer = BlockBuffer(10_000)
    for first in (0, 100, 300, 400, 100, 200):
        buffer.add(block(first, stamp_ns=first * 1_000_000))
    assert firsts(buffer) == [0, 100, 300, 100, 200, 400]
    assert buffer.forgotten == 0
    assert firsts(buffer, 0.05) == [400]


@pytest.mark.parametrize("stamp_s", [-86_400.0, 0.0, 0.5, 60.0])
def test_one_late_block_wipes_nothing_whatever_its_stamp(stamp_s):
    buffer = BlockBuffer(10_000)
    for first in (300, 400, 0, 500, 600):
        stamp = stamp_s if first == 0 else first * 1e-3
        buffer.add(block(first, stamp_ns=round(stamp * 1e9)))
    assert {300, 400, 500, 600} <= set(firsts(buffer))
    assert len(buffer) + buffer.forgotten == 500


def test_a_motion_that_begins_soon_after_is_a_new_one():
    buffer = BlockBuffer(10_000)
    for first, seconds in ((0, 0.0), (100, 0.1), (0, 0.35), (100, 0.45)):
        buffer.add(block(first, stamp_ns=round(seconds * 1e9)))
    assert firsts(buffer) == [0, 100]


def test_a_recording_of_an_earlier_day_is_a_new_motion():
    buffer = BlockBuffer(10_000)
    for first, seconds in ((0, 1e5), (100, 1e5 + 0.1), (0, 10.0), (100, 10.1)):
        buffer.add(block(first, stamp_ns=round(seconds * 1e9)))
    assert firsts(buffer) == [0, 100]


def test_blocks_of_one_sample_are_joined_and_none_of_them_is_lost():
    buffer = BlockBuffer(3000)
    for first in range(5000):
        if first != 4321:  # a gap stays a gap
            buffer.add(block(first, 1, stamp_ns=first * 1_000_000))
    kept = buffer.recent()
    assert len(kept) < 150
    count = np.concatenate([np.arange(b.first_sample, b.end) for b in kept])
    assert count.tolist() == [n for n in range(count[0], 5000) if n != 4321]
    assert len(count) == len(buffer)
    assert 2500 <= len(buffer) <= 3000
    assert len(buffer) + buffer.forgotten == 4999
    assert all(b.stamp_ns == b.first_sample * 1_000_000 for b in kept)


def test_a_late_block_is_no_new_motion_where_short_ones_are_joined():
    buffer = BlockBuffer(10_000)
    for first in [*range(150), *range(151, 252), 150, *range(252, 400)]:
        buffer.add(block(first, 1, stamp_ns=first * 1_000_000))
    assert buffer.forgotten == 0
    assert sum(map(len, buffer.recent())) == len(buffer) == 400
