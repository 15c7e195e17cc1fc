"""Does a block continue its stream, or what happened in between?

A device counts its triggers; a count that wraps is continued by its driver and never seen
here. The count shows gaps, repetitions and late arrivals; together with the time stamp it
shows a device that has begun to count anew. Stamps may advance more slowly than the count
times the sample period, when a recording is played in time lapse.
"""

from __future__ import annotations

from array import array
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from omsm_ros.core.streams.blocks import Block, BoolArray, FloatArray, IntArray
from omsm_ros.units import MILLISECOND_S, NANOSECOND_S, NANOSECONDS_PER_S

# Messages are not delivered this late; time that falls back further has been set back.
TIME_JUMP_S = 2.0
_GAPS_KEPT = 256


@dataclass(frozen=True)
class Arrival:
    """What a block brings.

    session: rises when the count begins anew;  first: count of the block's first sample
    skip: leading samples to leave out, of which ``late`` fill a gap and the others were seen before
    missing: trigger counts left out just before
    """

    session: int
    first: int
    skip: int
    late: int
    missing: int = field(default=0, compare=False)


class TriggerCount:
    """Follows the trigger count of one stream."""

    def __init__(self) -> None:
        self._session = -1
        self._next = 0
        self._newest_first = 0
        self._newest_stamp_ns: int | None = None
        self._gaps: deque[tuple[int, int]] = deque(maxlen=_GAPS_KEPT)

    def place(self, block: Block, length: int) -> Arrival:
        """Place ``block`` of ``length`` samples after what came before."""
        first, missing = block.first_sample, 0
        if self._starts_new_session(first, block):
            self._session += 1
            self._next = first
            self._gaps.clear()
        elif first > self._next:
            self._gaps.append((self._next, first))
            missing = first - self._next
        end = first + length
        skip = min(max(self._next - first, 0), length)
        late = self._filled(first, first + skip) if skip else 0
        if skip < length:
            self._next = end
            self._newest_first, self._newest_stamp_ns = block.newest
        return Arrival(self._session, first, skip, late, missing)

    def _filled(self, first: int, end: int) -> int:
        """Return how many counts of ``first`` to ``end`` had been left out; they are no longer."""
        late, left = 0, []
        for a, b in self._gaps:
            low, high = max(a, first), min(b, end)
            if low < high:
                late += high - low
                left += [part for part in ((a, low), (high, b)) if part[0] < part[1]]
            else:
                left.append((a, b))
        if late:
            self._gaps = deque(left, maxlen=_GAPS_KEPT)
        return late

    def end(self) -> None:
        """Begin a session with whatever comes next."""
        self._newest_stamp_ns = None

    def _starts_new_session(self, first: int, block: Block) -> bool:
        if self._newest_stamp_ns is None:
            return True
        elapsed_ns = block.stamp_ns - self._newest_stamp_ns
        tolerance_ns = TIME_JUMP_S * NANOSECONDS_PER_S
        if elapsed_ns < -tolerance_ns:
            return True
        if first >= self._next:
            return False
        if first <= self._newest_first:
            return elapsed_ns > 0
        # An overlapping block is due between the newest block and the next one.
        due_ns = (first - self._newest_first) * block.sample_period * NANOSECONDS_PER_S
        return elapsed_ns > due_ns + tolerance_ns


# Stamps that leap so far ahead are of a motion after a pause; half of what settles pairs live [ns].
_PAUSE_NS = 0.5e9


class StampLine:
    """Stamps of one stream's blocks, in the order of sessions and counts."""

    def __init__(self) -> None:
        # A row each, those before ``_head`` are done with: a bag brings thousands at once.
        self._sessions, self._counts, self._stamps = array("q"), array("q"), array("q")
        self._head = 0
        self._current: tuple[int, int, int] | None = None

    def add(self, session: int, count: int, stamp_ns: int) -> None:
        """Append the newest block's session, first count and stamp."""
        self._clear()
        self._sessions.append(session)
        self._counts.append(count)
        self._stamps.append(stamp_ns)

    def extend(self, session: int, counts: IntArray, stamps: IntArray) -> None:
        """Append first counts and stamps of the newest blocks of a session, each (n,)."""
        self._clear()
        self._sessions.extend(array("q", [session]) * len(counts))
        self._counts.frombytes(np.ascontiguousarray(counts, np.int64).tobytes())
        self._stamps.frombytes(np.ascontiguousarray(stamps, np.int64).tobytes())

    def _clear(self) -> None:
        for column in (self._sessions, self._counts, self._stamps):
            del column[: self._head]
        self._head = 0

    def __len__(self) -> int:
        """Blocks to come."""
        return len(self._counts) - self._head

    def advance(self, session: int, count: int) -> bool:
        """Go to the block of ``count``; return whether it begins there."""
        before = self._head
        while self._head < len(self._counts) and self._next() <= (session, count):
            self._head += 1
        if self._head == before:
            return False
        self._current = self._row(self._head - 1)
        return self._current[:2] == (session, count)

    def skip(self, blocks: int) -> None:
        """Go on by so many blocks."""
        if blocks:
            self._head += blocks
            self._current = self._row(self._head - 1)

    def coming(self, session: int, end: int) -> tuple[IntArray, IntArray] | None:
        """Return first counts below ``end`` and stamps of a session's next blocks, each (1 + n,).

        The block that has begun leads; None where the session has none.
        """
        if self._current is None or self._current[0] != session:
            return None
        until = bisect_right(self._sessions, session, self._head)
        place = slice(self._head, bisect_left(self._counts, end, self._head, until))
        _, count, stamp = self._current
        counts, stamps = self._counts[place], self._stamps[place]
        return np.concatenate([[count], counts]), np.concatenate([[stamp], stamps])

    def follows_gap(self, session: int, count: int, period_ns: float) -> bool:
        """Return whether the block that begins at ``count``, if one does, comes after a pause."""
        if self._current is None or not len(self) or self._next() != (session, count):
            return False
        begun, before, stamp = self._current
        ahead = self._stamps[self._head] - stamp - (count - before) * period_ns
        return begun == session and ahead >= _PAUSE_NS

    def next_in(self, session: int, end: int) -> int:
        """Return where the next block begins, ``end`` if not before it."""
        if len(self) and self._sessions[self._head] == session:
            return min(self._counts[self._head], end)
        return end

    def stamp_of(self, session: int, count: int, period_ns: float) -> float | None:
        """Return the time of the sample ``count`` [ns], None where no block says it."""
        if self._current is None or self._current[0] != session:
            return None
        return self._current[2] + (count - self._current[1]) * period_ns

    def stamp_difference(
        self, other: StampLine, sessions: tuple[int, int], period_ns: float
    ) -> float | None:
        """Return by how much later a count is stamped here than there [ns], None where unknown.

        Of the blocks that have begun, whose counts both have; exact, as stamps of today are not in
        floating point.
        """
        here, there = self._current, other._current
        if here is None or there is None or (here[0], there[0]) != sessions:
            return None
        return here[2] - there[2] + (there[1] - here[1]) * period_ns

    def _next(self) -> tuple[int, int]:
        return self._sessions[self._head], self._counts[self._head]

    def _row(self, at: int) -> tuple[int, int, int]:
        return self._sessions[at], self._counts[at], self._stamps[at]


def upcoming_stamps(
    lines: Sequence[StampLine], sessions: tuple[int, int], end: int, period_ns: float
) -> tuple[FloatArray, BoolArray] | None:
    """Return what the next blocks of two streams say where one begins, as :class:`StampHistory` has
    it, (n, 5), and whether one comes after a pause, (n,); None where a stream has no stamp yet.

    Counts below ``end``. The same as :class:`StampLine` tells one by one, to the last bit.
    """
    one, other = (line.coming(s, end) for line, s in zip(lines, sessions, strict=True))
    if one is None or other is None:
        return None
    counts = np.union1d(one[0][1:], other[0][1:])
    (first, stamp, leap), (other_first, other_stamp, other_leap) = (
        _at(counts, *blocks, period_ns) for blocks in (one, other)
    )
    skew = stamp - other_stamp + (other_first - first) * period_ns
    time = stamp + (counts - first) * period_ns
    columns = [counts, skew, first == counts, other_first == counts, time]
    return np.stack(columns, axis=1, dtype=np.float64), leap | other_leap


def _at(
    counts: IntArray, firsts: IntArray, stamps: IntArray, period_ns: float
) -> tuple[IntArray, IntArray, BoolArray]:
    """Return first count and stamp of the blocks that hold ``counts`` (n,), and which leap."""
    ahead = np.diff(stamps) - np.diff(firsts) * period_ns
    leap = np.concatenate([[False], ahead >= _PAUSE_NS])
    block = np.searchsorted(firsts, counts, "right") - 1
    return firsts[block], stamps[block], (firsts[block] == counts) & leap[block]


# Stamps that advance faster or slower than the counts by this factor are of a time lapse, or none:
# a second of theirs is not one of the samples. A slip of a third of the span is still judged.
_TIME_LAPSE = 1.5


class StampHistory:
    """What the stamps of two streams said at the last counts at which a block began.

    rows: count, by how much later the first stream is stamped [ns], whether a block of the first
        and whether one of the second begins there, time of the first [ns]; (n, 5), most at most
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._room, self._held = np.empty((2 * most, 5)), 0

    @property
    def rows(self) -> FloatArray:
        """Those held, in their order."""
        return self._room[max(self._held - self._most, 0) : self._held]

    def add(self, rows: FloatArray) -> None:
        """Append rows, (n, 5)."""
        rows = rows[-self._most :]
        if self._held + len(rows) > len(self._room):
            kept = self.rows.copy()
            self._held = len(kept)
            self._room[: self._held] = kept
        self._room[self._held : self._held + len(rows)] = rows
        self._held += len(rows)

    def after(self, count: float) -> FloatArray:
        """Return the rows beyond a count."""
        return self.rows[np.searchsorted(self.rows[:, 0], count, "right") :]

    def recent(self, first: float, since: float, least: int) -> FloatArray | None:
        """Return the rows from the count ``since``, or so many that ``least`` are of each stream.

        first: none before this count;  None if that leaves too few
        """
        rows = self.rows[np.searchsorted(self.rows[:, 0], first) :]
        starts = [np.flatnonzero(rows[:, column]) for column in (2, 3)]
        if min(map(len, starts)) < least:
            return None
        begin = int(np.searchsorted(rows[:, 0], since))
        return rows[min(begin, *(int(s[-least]) for s in starts)) :]

    def stamps_follow_counts(self, period_ns: float) -> bool:
        """Return whether stamps advance about as the counts do."""
        (first, *_, began), (last, *_, ended) = self.rows[0], self.rows[-1]
        elapsed, passed = (last - first) * period_ns, ended - began
        return bool(elapsed < _TIME_LAPSE * passed and passed < _TIME_LAPSE * elapsed)


# How fast does a node keep up? Latency of its blocks and its share of a processor.


class LoadMeter:
    """Latencies of the last ``window`` blocks, and processor time between two reports.

    All times come from the caller; this only counts.
    """

    def __init__(self, window: int = 10_000) -> None:
        self._latencies = np.zeros(window, np.int64)  # of the newest, in a ring [ns]
        self._blocks = 0
        self._cpu = self._wall = 0.0
        self._worst_ns = 0

    def block(self, arrived_ns: int, done_ns: int) -> None:
        """Note the block that arrived at ``arrived_ns`` and was done at ``done_ns`` [ns]."""
        self._latencies[self._blocks % len(self._latencies)] = done_ns - arrived_ns
        self._blocks += 1
        self._worst_ns = max(self._worst_ns, done_ns - arrived_ns)

    def worst_ms(self) -> float:
        """Return the greatest latency since the last call [ms]."""
        worst, self._worst_ns = self._worst_ns, 0
        return worst * NANOSECOND_S / MILLISECOND_S

    def report(self, cpu: float, wall: float) -> dict[str, float]:
        """Return median, 99 % point and maximum latency [ms]; share of a core since last called.

        cpu, wall: processor time used so far, and any steady clock [s]
        """
        share = (cpu - self._cpu) / (wall - self._wall) if wall > self._wall else 0.0
        self._cpu, self._wall = cpu, wall
        found = {"cpu_share": round(share, 4)}
        if self._blocks:
            points = np.percentile(self._latencies[: self._blocks], (50, 99, 100))
            scaled = points * NANOSECOND_S / MILLISECOND_S
            names = ("latency_median_ms", "latency_p99_ms", "latency_max_ms")
            found |= {
                name: round(float(value), 3) for name, value in zip(names, scaled, strict=True)
            }
        return found
