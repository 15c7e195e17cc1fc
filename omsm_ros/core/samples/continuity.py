"""Does a block continue its stream, or what happened in between?

A device counts its triggers; a count that wraps is continued by its driver and never seen
here. The count shows gaps, repetitions and late arrivals; together with the time stamp it
shows a device that has begun to count anew. Stamps may advance more slowly than the count
times the sample period, when a recording is played in time lapse.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field

from omsm_ros.core.samples.blocks import Block
from omsm_ros.units import NANOSECONDS_PER_S

# Messages are not delivered this late; time that falls back further has been set back.
TIME_JUMP_S = 2.0
_GAPS_REMEMBERED = 256


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
        self._gaps: deque[tuple[int, int]] = deque(maxlen=_GAPS_REMEMBERED)

    def place(self, block: Block, length: int) -> Arrival:
        """Place ``block`` of ``length`` samples after what came before."""
        first, missing = block.first_sample, 0
        if self._begins_anew(first, block):
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
            self._newest_first, self._newest_stamp_ns = first, block.stamp_ns
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
            self._gaps = deque(left, maxlen=_GAPS_REMEMBERED)
        return late

    def end(self) -> None:
        """Begin a session with whatever comes next."""
        self._newest_stamp_ns = None

    def _begins_anew(self, first: int, block: Block) -> bool:
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
        self._coming: deque[tuple[int, int, int]] = deque()
        self._current: tuple[int, int, int] | None = None

    def add(self, session: int, count: int, stamp_ns: int) -> None:
        """Append the newest block's session, first count and stamp."""
        self._coming.append((session, count, stamp_ns))

    def extend(self, session: int, offset: int, stamps: Iterable[tuple[int, int]]) -> None:
        """Append first counts, less ``offset``, and stamps of the newest blocks of a session."""
        self._coming.extend((session, first + offset, stamp) for first, stamp in stamps)

    def advance(self, session: int, count: int) -> bool:
        """Go to the block of ``count``; return whether it begins there."""
        while self._coming and self._coming[0][:2] <= (session, count):
            self._current = self._coming.popleft()
            if self._current[:2] == (session, count):
                return True
        return False

    def in_step(
        self, other: StampLine, sessions: tuple[int, int], end: int, tolerance_ns: float
    ) -> list[tuple[int, int, int]]:
        """Go to the last of the next blocks below ``end`` that two lines have in common.

        Return the first count of each, its stamp here, and how much earlier the other's is [ns].
        """
        mine, others = self._coming, other._coming
        one, two = sessions
        taken: list[tuple[int, int, int]] = []
        while mine and others:
            session, count, stamp = mine[0]
            their_session, their_count, their_stamp = others[0]
            if not (their_count == count < end and session == one and their_session == two):
                break
            if abs(stamp - their_stamp) > tolerance_ns:
                break
            self._current, other._current = mine.popleft(), others.popleft()
            taken.append((count, stamp, stamp - their_stamp))
        return taken

    def leaps(self, session: int, count: int, period_ns: float) -> bool:
        """Return whether the block that begins at ``count``, if one does, comes after a pause."""
        expected = self.stamp_of(session, count, period_ns)
        if expected is None or not self._coming or self._coming[0][:2] != (session, count):
            return False
        return self._coming[0][2] - expected >= _PAUSE_NS

    def next_in(self, session: int, end: int) -> int:
        """Return where the next block begins, ``end`` if not before it."""
        if self._coming and self._coming[0][0] == session:
            return min(self._coming[0][1], end)
        return end

    def stamp_of(self, session: int, count: int, period_ns: float) -> float | None:
        """Return the time of the sample ``count`` [ns], None where no block says it."""
        if self._current is None or self._current[0] != session:
            return None
        return self._current[2] + (count - self._current[1]) * period_ns
