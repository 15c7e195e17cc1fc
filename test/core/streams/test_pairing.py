"""Pairs of two streams, whatever the order in which they come."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from omsm_ros.core.streams.blocks import RejectionReason
from omsm_ros.core.streams.pairing import Pairing, SampleRun, StreamInput


def run(
    session: int, first: int, length: int, start_s: float | None = None, bad: int = 0
) -> SampleRun:
    stamp_s = first * 1e-3 if start_s is None else start_s
    reasons = np.zeros(length, np.uint8)
    reasons[:bad] = RejectionReason.INVALID
    values = np.arange(first, first + length, dtype=np.float64)[np.newaxis]
    return SampleRun(session, first, round(stamp_s * 1e9), 1e6, reasons, values)


class Bench:
    """A pairing, its tallies and the pairs found so far."""

    def __init__(self) -> None:
        axes, distance = StreamInput(), StreamInput()
        self.axes, self.distance = axes.tally, distance.tally
        self.pairing = Pairing(axes, distance)
        self.found: list[tuple[int, int, int]] = []

    def push(self, axes: list[SampleRun], distance: list[SampleRun]) -> Bench:
        for r in axes:
            self.pairing.axes.push(r)
        for r in distance:
            self.pairing.distance.push(r)
        return self.join()

    def join(self) -> Bench:
        for a, d in self.pairing.pairs():
            assert len(a) == len(d)
            self.found += [(a.session, d.session, int(count)) for count in a.values[0]]
        return self

    def finish(self) -> dict[str, object]:
        self.pairing.axes.clear()
        self.pairing.distance.clear()
        return {
            "axes": self.axes.snapshot(0),
            "distance": self.distance.snapshot(0),
            "found": self.found,
        }

    def counts(self) -> list[int]:
        return [count for _, _, count in self.found]


def test_equal_blocks_pair_in_full() -> None:
    bench = Bench().push([run(0, 0, 50)], [run(0, 0, 50)])
    assert bench.counts() == list(range(50))
    assert bench.axes.corrected == bench.distance.corrected == 50


def test_a_block_waits_for_its_partner() -> None:
    bench = Bench().push([run(0, 0, 50)], [])
    assert bench.counts() == []
    assert bench.pairing.axes.pending == 50
    assert bench.push([], [run(0, 0, 20)]).counts() == list(range(20))
    assert bench.pairing.axes.pending == 30


def test_what_the_other_stream_has_passed_is_unmatched() -> None:
    bench = Bench().push([run(0, 0, 50)], [run(0, 30, 50)])
    assert bench.counts() == list(range(30, 50))
    assert bench.axes.snapshot(0).counted == {"unmatched": 30}
    assert bench.pairing.distance.pending == 30


def test_a_bad_sample_takes_its_partner_along() -> None:
    bench = Bench().push([run(0, 0, 10)], [run(0, 0, 10, bad=3)])
    assert bench.axes.snapshot(0).counted == {"invalid": 3}
    assert bench.axes.corrected == bench.distance.corrected == 7


def test_sessions_are_linked_by_count_and_time() -> None:
    bench = Bench().push(
        [run(0, 0, 50, 0.0), run(1, 0, 50, 20.0)], [run(0, 0, 50, 0.0), run(1, 0, 50, 20.0)]
    )
    assert bench.found == [(s, s, k) for s in (0, 1) for k in range(50)]


def test_an_early_session_of_one_stream_alone_is_not_mistaken() -> None:
    # The probe ran free for 50 samples before the common trigger reset it.
    bench = Bench().push([run(0, 0, 50, 20.0)], [run(0, 0, 50, 0.0), run(1, 0, 50, 20.0)])
    assert bench.found == [(0, 1, k) for k in range(50)]
    assert bench.distance.snapshot(0).counted == {"unmatched": 50}


def test_leftovers_of_an_old_session_do_not_eat_the_new_one() -> None:
    # Restart within milliseconds; the axes' last samples of the old session were lost.
    bench = Bench().push(
        [run(0, 20_000, 50, 20.0), run(1, 0, 50, 20.11)],
        [run(0, 20_000, 100, 20.0), run(1, 0, 50, 20.11)],
    )
    expected = [(0, 0, 20_000 + k) for k in range(50)] + [(1, 1, k) for k in range(50)]
    assert bench.found == expected
    assert bench.distance.snapshot(0).counted == {"unmatched": 50}


def test_a_stream_that_restarts_alone_finds_no_partner() -> None:
    bench = Bench().push([run(0, 0, 50)], [run(0, 0, 5000)])
    bench.push([run(1, 0, 5000, 5.0)], [run(0, 5000, 5000)])
    # The counts of session 1 have nothing to do with those of the distance's session 0.
    assert {axes for axes, _, _ in bench.found} == {0}


def test_a_false_start_of_one_stream_does_not_cost_the_scan() -> None:
    # The probe counted a moment before its first trigger set it to zero again.
    axes, distance = [run(0, 0, 500, 0.2)], [run(0, 0, 50, 0.1), run(1, 0, 500, 0.2)]
    bench = Bench().push(axes, distance)
    assert [pair for pair in bench.found if pair[1] == 1] == [(0, 1, k) for k in range(50, 500)]


@pytest.mark.parametrize("wrong_s", [-1.6e9, -100.0, 5e8])
@pytest.mark.parametrize("swap", [False, True])
def test_one_block_with_a_wrong_stamp_costs_blocks_and_not_the_scan(
    wrong_s: float, swap: bool
) -> None:
    """After a stamp far ahead the next block starts a session; after an old one it continues."""
    now = 1.7e9
    good = [run(0, k, 100, now + k * 1e-3) for k in range(0, 60_000, 100)]
    fits = [run(0, k, 100, now + k * 1e-3) for k in range(0, 10_000, 100)]
    later = 2 if wrong_s > 0 else 1
    fits += [run(1, 10_000, 100, now + wrong_s)]
    fits += [run(later, k, 100, now + k * 1e-3) for k in range(10_100, 60_000, 100)]
    bench = Bench()
    for a, d in zip(good, fits, strict=True):
        bench.push([d], [a]) if swap else bench.push([a], [d])
    lost = 60_000 - len(bench.found)
    assert 100 <= lost <= 300
    assert bench.counts()[-1] == 59_999
    assert bench.pairing.axes.pending == bench.pairing.distance.pending == 0


@pytest.mark.parametrize("swap", [False, True])
@pytest.mark.parametrize("strays", [1, 100])
def test_a_recording_is_paired_though_blocks_from_nowhere_wait(strays: int, swap: bool) -> None:
    """Played after live samples, of which one stream was left with blocks without partners."""
    waiting = [run(k, 7 * k, 100, 2.1e9 - 5 * k) for k in range(strays)]
    bench = Bench()
    bench.push(waiting, []) if swap else bench.push([], waiting)
    for k in range(0, 10_000, 500):
        bench.push([run(strays, k, 500)], [run(strays, k, 500)])
    assert bench.counts()[-9000:] == list(range(1000, 10_000))
    assert bench.pairing.axes.pending == bench.pairing.distance.pending == 0


def test_leftovers_of_minutes_cost_the_next_motion_nothing() -> None:
    """The probe failed, the axes went on; then both began anew, perhaps with another clock."""
    for restart_s in (110.0, 1000.0):
        bench = Bench()
        bench.push([run(0, 0, 1000)], [run(0, 0, 1000)])
        bench.push([run(0, 1000 + k, 100, 1.0 + k * 1e-3) for k in range(0, 100_000, 100)], [])
        both = [run(1, k, 100, restart_s + k * 1e-3) for k in range(0, 5000, 100)]
        bench.push(both, both)
        assert bench.counts() == [*range(1000), *range(5000)]


def test_a_bounded_queue_gives_the_oldest_up_and_tells_it_from_what_has_no_partner() -> None:
    bench = Bench().push([run(0, 0, 60), run(0, 60, 60)], [])
    bench.pairing.axes.limit(100)
    assert bench.axes.snapshot(0).counted == {"overdue": 20}
    assert bench.push([], [run(0, 0, 60)]).counts() == list(range(20, 60))
    assert bench.distance.snapshot(0).counted == {"overdue": 20}
    assert bench.push([], [run(0, 70, 50)]).counts() == [*range(20, 60), *range(70, 120)]
    assert bench.axes.snapshot(0).counted == {"overdue": 20, "unmatched": 10}


def test_what_was_given_up_in_an_old_session_excuses_nothing_in_a_new_one() -> None:
    bench = Bench().push([run(0, 0, 100, 0.0)], [])
    bench.pairing.axes.limit(0)
    bench.push([run(1, 50, 50, 20.05)], [run(0, 0, 100, 20.0)])
    assert bench.counts() == list(range(50, 100))
    assert bench.distance.snapshot(0).counted == {"unmatched": 50}


def pieces(draw_cuts: list[int], runs: list[SampleRun]) -> list[SampleRun]:
    cut = []
    for r in runs:
        edges = [0, *sorted({c for c in draw_cuts if 0 < c < len(r)}), len(r)]
        cut += [r.part(a, b) for a, b in itertools.pairwise(edges)]
    return cut


AXES = [run(0, 10, 80, 0.01), run(0, 120, 60, 0.12), run(1, 0, 90, 9.0), run(2, 5, 40, 30.0)]
DISTANCE = [run(0, 0, 100, 0.0), run(0, 110, 90, 0.11), run(1, 3, 97, 9.003), run(2, 0, 60, 20.0)]


@settings(max_examples=60)
@given(
    cuts=st.tuples(st.lists(st.integers(1, 99)), st.lists(st.integers(1, 99))),
    turns=st.lists(st.booleans(), min_size=300, max_size=300),
)
def test_outcome_does_not_depend_on_cuts_and_interleaving(
    cuts: tuple[list[int], list[int]], turns: list[bool]
) -> None:
    reference = Bench().push(AXES, DISTANCE).finish()
    axes, distance = pieces(cuts[0], AXES), pieces(cuts[1], DISTANCE)
    bench = Bench()
    for turn in turns:
        if turn and axes:
            bench.push([axes.pop(0)], [])
        elif distance:
            bench.push([], [distance.pop(0)])
    assert bench.push(axes, distance).finish() == reference


@pytest.mark.parametrize("swap", [False, True])
def test_expected_outcome_of_the_mixed_case(swap: bool) -> None:
    bench = Bench()
    if swap:
        bench.push([], DISTANCE).push(AXES, [])
    else:
        bench.push(AXES, []).push([], DISTANCE)
    expected = [(0, 0, k) for k in [*range(10, 90), *range(120, 180)]]
    expected += [(1, 1, k) for k in range(3, 90)]
    assert bench.found == expected


def random_streams(random: np.random.Generator) -> tuple[list[SampleRun], list[SampleRun]]:
    """Some sessions of 5 to 6000 samples, seen by one stream or both, with gaps."""
    streams: tuple[list[SampleRun], list[SampleRun]] = ([], [])
    start, sessions = 0.0, [0, 0]
    for _ in range(random.integers(1, 5)):
        start += random.choice([1.0, 5.0, 30.0])
        length = int(random.integers(5, 60) * random.choice([1, 100]))
        for stream in (0, 1):
            if random.random() < 0.15:
                continue
            edges = np.unique(random.integers(0, length + 1, 6))
            for a, b in itertools.pairwise(edges.tolist()):
                if random.random() < 0.8:
                    streams[stream].append(run(sessions[stream], a, b - a, start + a * 1e-3))
            sessions[stream] += 1
        start += length * 1e-3
    return streams


@pytest.mark.parametrize("seed", range(8))
def test_any_sessions_pair_alike_however_cut_and_interleaved(seed: int) -> None:
    random = np.random.default_rng(seed)
    whole = random_streams(random)
    expected = Bench().push(*whole).finish()
    for _ in range(3):
        axes, distance = (pieces(random.integers(1, 400, 8).tolist(), runs) for runs in whole)
        bench = Bench()
        while axes or distance:
            source = axes if axes and (random.random() < 0.5 or not distance) else distance
            piece = [source.pop(0)]
            bench.push(*((piece, []) if source is axes else ([], piece)))
        assert bench.finish() == expected
