"""Continuity of a stream: gaps, repetitions, late blocks and restarts of its trigger count.

The count shows gaps, repetitions and late arrivals; with the time stamp it shows a device that
counts from the start again. A counter that wraps is unwrapped by its driver. In a recording that
is played in time lapse, stamps advance more slowly than the count times the sample period.
"""

from collections import deque
from dataclasses import dataclass, field

from omsm_ros.core.streams.blocks import Block
from omsm_ros.units import NANOSECONDS_PER_S

# No message is delivered this late; a stamp that is older was made by a clock that was set back.
TIME_JUMP_S = 2.0
# The newest gaps, into which late blocks are sorted; it bounds memory.
_MOST_GAPS = 256


@dataclass(frozen=True)
class Arrival:
    """The place of a block in its stream.

    session: number of the run of the counter;  first: count of the block's first sample
    skip: leading samples to leave out: ``late`` ones fill a gap, the others are duplicates
    missing: trigger counts that were skipped just before the block
    jumped: samples left out, since the count is far ahead of the time until a block confirms it
    """

    session: int
    first: int
    skip: int
    late: int
    missing: int = field(default=0, compare=False)
    jumped: int = field(default=0, compare=False)


def is_ahead_of_time(before: tuple[int, int], block: Block) -> bool:
    """Return whether the count of ``block`` is far ahead of its time.

    before: first count and stamp [ns] of the block before it
    """
    due_ns = (block.first_sample - before[0]) * block.sample_period * NANOSECONDS_PER_S
    return due_ns > block.stamp_ns - before[1] + TIME_JUMP_S * NANOSECONDS_PER_S


class TriggerCount:
    """Follows the trigger count of one stream."""

    def __init__(self) -> None:
        self._session = -1
        self._next = 0
        self._newest_first = 0
        self._newest_stamp_ns: int | None = None
        self._gaps: deque[tuple[int, int]] = deque(maxlen=_MOST_GAPS)
        # Count, stamp and end of the blocks that are ahead.
        self._jumped: deque[tuple[int, int, int]] = deque(maxlen=_MOST_GAPS)

    def place(self, block: Block, length: int) -> Arrival:
        """Place ``block`` of ``length`` samples after what came before."""
        first, missing = block.first_sample, 0
        if self._starts_new_session(first, block):
            self._session += 1
            self._next = first
            self._gaps.clear()
        elif first > self._next:
            if self._leaps(block):
                self._jumped.append((first, block.stamp_ns, first + length))
                return Arrival(self._session, first, length, 0, jumped=length)
            self._gaps.append((self._next, first))
            came = sum(self._filled(begin, end) for begin, _, end in self._jumped)
            missing = first - self._next - came
        skip = min(max(self._next - first, 0), length)
        late = self._filled(first, first + skip) if skip else 0
        if skip < length:
            self._jumped.clear()
            self._next = first + length
            self._newest_first, self._newest_stamp_ns = block.newest
        return Arrival(self._session, first, skip, late, missing)

    def _leaps(self, block: Block) -> bool:
        """Return whether the count is ahead of the time, and of the last block that was ahead."""
        assert self._newest_stamp_ns is not None  # of a session that has begun
        ahead = is_ahead_of_time((self._newest_first, self._newest_stamp_ns), block)
        if not self._jumped or block.first_sample <= self._jumped[-1][0]:
            return ahead
        return ahead and is_ahead_of_time(self._jumped[-1][:2], block)

    def _filled(self, first: int, end: int) -> int:
        """Remove the counts ``first`` to ``end`` from the gaps; return how many there were."""
        late, left = 0, []
        for a, b in self._gaps:
            low, high = max(a, first), min(b, end)
            if low < high:
                late += high - low
                left += [part for part in ((a, low), (high, b)) if part[0] < part[1]]
            else:
                left.append((a, b))
        if late:
            self._gaps = deque(left, maxlen=_MOST_GAPS)
        return late

    def end(self) -> None:
        """Begin a new session with the next block."""
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
        # A block that overlaps the newest one is due before the block that follows that one.
        due_ns = (first - self._newest_first) * block.sample_period * NANOSECONDS_PER_S
        return elapsed_ns > due_ns + tolerance_ns
