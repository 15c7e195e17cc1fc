import numpy as np

from omsm_ros.core.samples.blocks import DistanceBlock
from omsm_ros.core.samples.motion_buffer import BlockBuffer


def block(first, length=100):
    return DistanceBlock(
        stamp_ns=0, first_sample=first, sample_period=1e-3, distance=np.zeros(length)
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
