"""Which sample it is: wraps, gaps, restarts, copies and spoilt counters, against plain cases."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from soaked import always

from omsm_ros.instruments.counting import SAMPLE, Counting, Samples, SequenceTracker

FREE = Counting(2**16, timed=False, checked=False, period=1e-3)
TRIGGERED = Counting(2**16, timed=False, checked=False)


def samples(counters: list[int], content: int = 0) -> Samples:
    made = np.zeros(len(counters), SAMPLE)
    made["counter"] = np.array(counters) % 2**16
    made["distance"] = np.array(counters) + content
    return made


def numbers(tracker: SequenceTracker, *portions: Samples, **options: object) -> list[int]:
    found = []
    for portion in portions:
        for run in tracker.split(portion, **options):  # type: ignore[arg-type]
            found += list(range(run.first_sample, run.first_sample + len(run.samples)))
    for run in tracker.settle():
        found.append(run.first_sample)
    return found


def test_a_counter_of_16_bits_goes_on() -> None:
    tracker = SequenceTracker(FREE)
    count = list(range(65_000, 200_000))
    assert numbers(tracker, samples(count)) == count
    assert (tracker.lost, tracker.restarts) == (0, 0)


def test_a_packet_sent_twice_is_counted_and_left_out() -> None:
    tracker = SequenceTracker(FREE)
    packet = samples(list(range(100, 130)))
    assert numbers(tracker, packet, packet, samples([130, 131])) == list(range(100, 132))
    assert (tracker.duplicates, tracker.restarts, tracker.lost) == (30, 0, 0)


def test_a_counter_that_falls_back_with_other_samples_is_a_restart() -> None:
    tracker = SequenceTracker(FREE)
    found = numbers(tracker, samples(list(range(500, 520))), samples(list(range(30)), content=9))
    assert found == [*range(500, 520), *range(30)]
    assert (tracker.restarts, tracker.duplicates) == (1, 0)


@given(st.integers(1, 8), st.integers(0, 2**16 - 1))
def test_a_counter_that_leaps_and_comes_back_is_spoilt(place: int, wrong: int) -> None:
    count = list(range(100, 110))
    spoilt = samples(count)
    spoilt["counter"][place] = wrong
    tracker = SequenceTracker(FREE)
    found = numbers(tracker, spoilt)
    expected = [c for i, c in enumerate(count) if i != place]
    if wrong in count[place - 1 : place + 2]:  # another sample's number, or its own
        assert set(expected) <= {*found, count[place - 1], count[place + 1]}
    else:
        assert found == expected
        assert (tracker.spoilt, tracker.lost, tracker.restarts) == (1, 1, 0)


@pytest.mark.parametrize("bit", [0, 3, 9, 15])
@pytest.mark.parametrize("place", [150, 151, 154])
@pytest.mark.parametrize("timed", [True, False])
def test_a_flipped_bit_of_a_counter_costs_its_own_sample(place: int, bit: int, timed: bool) -> None:
    """The number may become that of the sample before or after."""
    spoilt = samples(list(range(100, 400)))
    spoilt["time"] = np.arange(300) * 1_000_000
    spoilt["counter"][place] ^= 1 << bit
    tracker = SequenceTracker(Counting(2**16, timed=timed, checked=False))
    assert numbers(tracker, spoilt) == [n for n in range(100, 400) if n != 100 + place]
    assert (tracker.restarts, tracker.spoilt, tracker.lost) == (0, 1, 1)


def test_a_leap_is_held_until_the_next_sample_tells() -> None:
    tracker = SequenceTracker(FREE)
    assert numbers(tracker, samples([1, 2])) == [1, 2]
    assert list(tracker.split(samples([9]))) == []
    assert tracker.held == 1
    assert numbers(tracker, samples([10])) == [9, 10]
    assert tracker.lost == 6


@pytest.mark.parametrize(("silence", "lost"), [(0.1, 100), (65.7, 100 + 65_536), (131.2, 131_172)])
def test_whole_turns_in_a_silence_are_found_from_its_length(silence: float, lost: int) -> None:
    tracker = SequenceTracker(FREE)
    numbers(tracker, samples([7]))
    numbers(tracker, samples([108, 109]), elapsed=silence, broken=True)
    assert (tracker.lost, tracker.restarts) == (lost, 0)


@pytest.mark.parametrize(("pause", "lost"), [(0, 0), (65_536, 65_536)])
def test_the_clock_of_the_device_tells_how_long_a_silence_was(pause: int, lost: int) -> None:
    """At 70 kHz the counter turns in 0.94 s, and the host may have slept through the samples."""
    portions = [samples(list(range(100))), samples(list(range(100, 200)))]
    for shift, portion in zip((0, pause), portions, strict=True):
        portion["time"] = (portion["distance"] + shift) / 70_000 * 1e9
    tracker = SequenceTracker(Counting(2**16, timed=True, checked=False, period=1 / 70_000))
    found = numbers(tracker, portions[0]) + numbers(tracker, portions[1], elapsed=5.0, broken=True)
    assert found == [*range(100), *range(100 + lost, 200 + lost)]
    assert (tracker.lost, tracker.restarts) == (lost, 0)


def test_more_samples_than_time_passed_for_are_a_restart() -> None:
    tracker = SequenceTracker(FREE)
    numbers(tracker, samples([100]))
    assert numbers(tracker, samples([5000, 5001]), elapsed=1.0, broken=True) == [5000, 5001]
    assert (tracker.restarts, tracker.lost) == (1, 0)


def test_fewer_samples_than_time_passed_for_are_a_restart() -> None:
    """The counter began again at zero, and has come as far as if it had only lost some."""
    tracker = SequenceTracker(FREE)
    numbers(tracker, samples([1000]))
    assert numbers(tracker, samples([2300, 2301]), elapsed=2.3, broken=True) == [2300, 2301]
    assert (tracker.restarts, tracker.lost) == (1, 0)


def test_a_triggered_counter_at_zero_after_a_silence_is_a_restart() -> None:
    tracker = SequenceTracker(TRIGGERED)
    numbers(tracker, samples([57_391, 57_392]))
    assert numbers(tracker, samples([0, 1]), elapsed=3.0, broken=True) == [0, 1]
    assert (tracker.restarts, tracker.lost) == (1, 0)


@pytest.mark.parametrize("counting", [FREE, TRIGGERED])
def test_samples_that_equal_those_before_a_restart_are_no_copies(counting: Counting) -> None:
    """Nothing is seen, so all samples are alike: only the counter is another after a silence."""
    tracker = SequenceTracker(counting)
    blank = samples(list(range(1000)))
    blank["distance"] = np.nan
    numbers(tracker, blank)
    assert numbers(tracker, blank, elapsed=4.0, broken=True) == list(range(1000))
    assert (tracker.restarts, tracker.duplicates, tracker.lost) == (1, 0, 0)


def test_a_device_known_to_have_been_restarted_counts_from_its_number() -> None:
    tracker = SequenceTracker(FREE)
    numbers(tracker, samples([100, 101]))
    tracker.restart_count()
    assert numbers(tracker, samples([102, 103])) == [102, 103]
    assert (tracker.restarts, tracker.lost) == (1, 0)


def still(count: int, number: int, taken: int = 0) -> Samples:
    """Return samples of one number, 1 ms apart, from the time of sample ``taken`` on."""
    made = samples([number] * count)
    made["time"] = (taken + np.arange(count)) * 1_000_000
    return made


@pytest.mark.parametrize(
    ("modulus", "timed", "period", "number"),
    always(
        (2**16, True, 1e-3, 0), (4, True, 0.0, 0), (4, False, 1e-3, 512),
        of=[
            (*counter, period, number)
            for counter in ((2**16, True), (4, True), (4, False))
            for period in (0.0, 1e-3)
            for number in (0, 512)
        ],
    ),
)  # fmt: skip
def test_a_counter_that_stands_still_is_no_restart(
    modulus: int, timed: bool, period: float, number: int
) -> None:
    tracker = SequenceTracker(Counting(modulus, timed=timed, checked=False, period=period))
    stream = still(8000, number % modulus)
    portions = [stream[i : i + 50] for i in range(0, 8000, 50)]
    assert numbers(tracker, *portions, elapsed=0.05) == [number % modulus]
    assert (tracker.duplicates, tracker.restarts, tracker.lost) == (7999, 0, 0)


def test_a_counter_that_goes_on_after_it_stood_still_goes_on() -> None:
    tracker = SequenceTracker(Counting(2**16, timed=True, checked=False, period=1e-3))
    stood, after = still(500, 7), samples([8, 9])
    after["time"] = np.array([500, 501]) * 1_000_000
    assert numbers(tracker, stood, after) == [7, 8, 9]
    assert (tracker.duplicates, tracker.restarts, tracker.lost) == (499, 0, 0)


def test_a_counter_reset_at_zero_of_a_later_turn_is_a_restart() -> None:
    """The other device of the cell was reset with it, so the turns must not stay."""
    tracker = SequenceTracker(Counting(2**16, timed=True, checked=False))
    count = samples(list(range(2**16 + 1)))
    count["time"] = np.arange(len(count)) * 1_000_000
    again = samples([0, 1, 2])
    again["time"] = (len(count) + np.arange(3)) * 1_000_000
    assert numbers(tracker, count, again) == [*range(2**16 + 1), 0, 1, 2]
    assert (tracker.duplicates, tracker.restarts) == (0, 1)


@pytest.mark.parametrize("period", [0.0, 1e-3])
def test_all_samples_of_a_turn_are_lost_by_the_clock_of_a_free_running_device(
    period: float,
) -> None:
    """A triggered device may have waited as long, and repeats its number."""
    tracker = SequenceTracker(Counting(4, timed=True, period=period))
    before, after = still(1, 2), still(1, 2, taken=4)
    assert numbers(tracker, before, after) == ([2, 6] if period else [2])
    assert (tracker.lost, tracker.duplicates) == ((3, 0) if period else (0, 1))


@pytest.mark.parametrize("silence", [0.01, 0.1])
def test_the_time_between_portions_adds_no_turns_of_a_small_counter(silence: float) -> None:
    tracker = SequenceTracker(Counting(4, timed=False, period=1e-3))
    numbers(tracker, samples([0, 1, 2]))
    made = samples([0, 1], content=4)
    assert numbers(tracker, made, elapsed=silence) == [4, 5]
    assert tracker.lost == 1


@given(st.lists(st.integers(1, 60), min_size=1, max_size=40), st.integers(0, 2**16 - 1), st.data())
def test_any_portions_give_the_same_numbers(
    steps: list[int], start: int, data: st.DataObject
) -> None:
    count = np.cumsum([start, *steps]).tolist()
    cuts = sorted({0, len(count), *data.draw(st.lists(st.integers(0, len(count))))})
    tracker = SequenceTracker(TRIGGERED)
    portions = [samples(count[a:b]) for a, b in itertools.pairwise(cuts)]
    assert numbers(tracker, *portions) == count
    assert tracker.lost == count[-1] - count[0] + 1 - len(count)
