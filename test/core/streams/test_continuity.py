"""Gaps, repetitions and restarts of a stream by trigger count and stamp."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from omsm_ros.core.streams.blocks import AccelerationBlock, Block
from omsm_ros.core.streams.continuity import Arrival, TriggerCount
from omsm_ros.core.streams.pairing import StreamInput

LEAP = 1_000_000


def block(first: int, stamp_s: float) -> Block:
    return Block(stamp_ns=round(stamp_s * 1e9), first_sample=first, sample_period=1e-3)


@dataclass
class Stream:
    """A sequence fed with blocks of 100 samples."""

    sequence: TriggerCount

    def __call__(self, first: int, stamp_s: float, length: int = 100) -> Arrival:
        return self.sequence.place(block(first, stamp_s), length)


@pytest.fixture
def stream() -> Stream:
    return Stream(TriggerCount())


def test_blocks_in_order_are_one_session(stream: Stream) -> None:
    places = [stream(100 * k, 0.1 * k) for k in range(5)]
    assert places == [Arrival(0, 100 * k, 0, 0) for k in range(5)]


def test_a_gap_is_no_new_session(stream: Stream) -> None:
    stream(0, 0.0)
    assert stream(700, 0.7) == Arrival(0, 700, 0, 0)


def test_a_repeated_block_is_left_out_whole(stream: Stream) -> None:
    stream(0, 0.0)
    stream(100, 0.1)
    assert stream(100, 0.1) == Arrival(0, 100, 100, 0)
    assert stream(0, 0.0) == Arrival(0, 0, 100, 0)
    assert stream(200, 0.2) == Arrival(0, 200, 0, 0)


def test_an_overlap_loses_what_was_seen(stream: Stream) -> None:
    stream(0, 0.0)
    assert stream(60, 0.06) == Arrival(0, 60, 40, 0)
    assert stream(160, 0.16) == Arrival(0, 160, 0, 0)


def test_a_late_block_falls_into_its_gap(stream: Stream) -> None:
    stream(0, 0.0)
    stream(200, 0.2)
    assert stream(100, 0.1) == Arrival(0, 100, 100, 100)


def test_a_late_block_may_be_partly_known(stream: Stream) -> None:
    stream(0, 0.0)
    stream(150, 0.15)
    assert stream(100, 0.1) == Arrival(0, 100, 100, 50)


def test_a_count_that_falls_back_in_later_time_is_a_restart(stream: Stream) -> None:
    stream(5000, 5.0)
    assert stream(0, 5.2) == Arrival(1, 0, 0, 0)
    assert stream(100, 5.3) == Arrival(1, 100, 0, 0)


def test_a_restart_into_the_middle_of_the_newest_block_shows_by_its_time(stream: Stream) -> None:
    stream(0, 0.0)
    assert stream(50, 30.0) == Arrival(1, 50, 0, 0)


def test_time_lapse_is_no_restart(stream: Stream) -> None:
    # Ten times faster than real: the stamps advance by a tenth of the count.
    places = [stream(100 * k, 0.01 * k) for k in range(50)]
    assert {place.session for place in places} == {0}
    assert all(place.skip == 0 for place in places)


@pytest.mark.parametrize("first", [0, 700], ids=["falls back", "goes on"])
def test_time_set_back_far_is_a_new_session(stream: Stream, first: int) -> None:
    stream(500, 60.0)
    assert stream(first, 1.0).session == 1


def test_counts_beyond_32_bits_go_on(stream: Stream) -> None:
    stream(2**32 - 50, 0.0)
    assert stream(2**32 + 50, 0.1) == Arrival(0, 2**32 + 50, 0, 0)


@pytest.mark.parametrize("before", [2**32 - 100, 2**32 - 5_000_000])
def test_a_count_that_falls_to_zero_is_a_restart_wherever_it_was(
    stream: Stream, before: int
) -> None:
    stream(before, 0.0)
    assert stream(0, 0.5) == Arrival(1, 0, 0, 0)


def test_after_an_end_everything_is_new(stream: Stream) -> None:
    stream(0, 0.0)
    stream.sequence.end()
    assert stream(100, 0.1) == Arrival(1, 100, 0, 0)


def test_a_clock_set_back_is_seen_after_messages_that_a_bag_joined() -> None:
    """The last message of a joined block counts, as when messages come singly."""
    parts = np.array([(100 * k, 100_000_000 * k) for k in range(600)])
    for joined in (False, True):
        sequence = TriggerCount()
        if joined:
            sequence.place(replace(block(0, 0.0), parts=parts), 60_000)
        else:
            for first, stamp_ns in parts.tolist():
                sequence.place(block(first, stamp_ns * 1e-9), 100)
        assert sequence.place(block(60_000, 55.0), 100) == Arrival(1, 60_000, 0, 0)


def test_a_single_block_far_ahead_of_its_time_changes_nothing() -> None:
    stream = StreamInput()
    for first in (0, 100, 1_000_200, 200, 300):
        stamp = (first % 1_000_000) * 1_000_000
        block = AccelerationBlock(
            stamp_ns=stamp, first_sample=first, sample_period=1e-3, **dict.fromkeys("xyz", ZEROS)
        )
        arrival = stream.new(block)
        assert (arrival is None) == (first > 1_000_000)
    account = stream.tally.snapshot(0)
    assert (account.missing, account.counted) == (0, {"jumped": 100})


def test_a_counter_that_leaps_is_followed_once_the_next_block_confirms_it() -> None:
    stream, placed = StreamInput(), []
    for i, first in enumerate((0, 100, 1_000_200, 1_000_300, 1_000_400)):
        block = AccelerationBlock(
            stamp_ns=i * 100_000_000, first_sample=first, sample_period=1e-3,
            **dict.fromkeys("xyz", ZEROS),
        )  # fmt: skip
        placed.append(stream.new(block))
    assert [a is not None and a.first for a in placed] == [0, 100, False, 1_000_300, 1_000_400]
    account = stream.tally.snapshot(0)
    assert account.received + account.missing == 1_000_500


@pytest.mark.parametrize("firsts", [
    (0, 100, LEAP, 2 * LEAP, 3 * LEAP, 3 * LEAP + 100),  # only the last one is confirmed
    (0, 100, LEAP, 100, LEAP + 100, LEAP + 200),  # a repeated block comes between
    (0, 100, LEAP, LEAP + 100, LEAP),  # the one that leaps is repeated
    (0, 200, LEAP, 100, LEAP + 100, LEAP + 200),  # a late block comes between
])  # fmt: skip
def test_of_blocks_that_leap_each_sample_counts_once(firsts: tuple[int, ...]) -> None:
    stream, sent = StreamInput(), sorted(set(firsts))
    for first in firsts:
        stream.new(AccelerationBlock(
            stamp_ns=sent.index(first) * 100_000_000, first_sample=first, sample_period=1e-3,
            **dict.fromkeys("xyz", ZEROS),
        ))  # fmt: skip
    account = stream.tally.snapshot(0)
    assert account.missing == sent[-1] + 100 - 100 * len(sent)
    assert account.counted.get("duplicate", 0) == 100 * (len(firsts) - len(sent))


ZEROS = np.zeros(100)
