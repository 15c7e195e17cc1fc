"""Pairing of the samples of two streams by their trigger counts.

Both streams are queues in the order of sessions and trigger counts. Their heads are compared:
equal counts of linked sessions make pairs, and a head that the other stream has passed has no
partner. A decision depends on the two heads only, so that it does not matter how the streams were
interleaved or cut.

Each stream numbers its own sessions. The first pair of equal count *and* equal time links a
session of one stream to a session of the other. Pairs whose counters have slipped against each
other by their stamps are refused.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.streams.blocks import Block, FloatArray, RejectionReason, Tally
from omsm_ros.core.streams.continuity import Arrival, TriggerCount
from omsm_ros.core.streams.stamps import StampLine
from omsm_ros.core.streams.trigger_slips import EQUAL_COUNTS, CommonTrigger, TriggerSlipDetector
from omsm_ros.units import NANOSECONDS_PER_S

# Two drivers stamp the same trigger with a common clock; scheduling delays them by less.
STAMP_TOLERANCE_S = 0.5
# The search for runs of the other stream's time ends after this number of misses in a row.
_MISSES = 8


@dataclass(frozen=True, slots=True, eq=False)
class SampleRun:
    """Consecutive samples of one stream.

    session, first: session and count of the first sample
    stamp_ns, period_ns: its time, and the time between samples [ns]
    reasons: Reason why a sample gives no point, (n,);  values: channels, (channels, n)
    """

    session: int
    first: int
    stamp_ns: int
    period_ns: float
    reasons: NDArray[np.uint8]
    values: FloatArray

    @classmethod
    def of(
        cls, block: Block, arrival: Arrival, reasons: NDArray[np.uint8], values: FloatArray
    ) -> SampleRun:
        """Return the new samples of ``block``, all of which have ``reasons`` and ``values``."""
        begin = arrival.session, arrival.first, block.stamp_ns, _period_ns(block)
        whole = cls(*begin, reasons, values)
        return whole.part(arrival.skip, len(whole)) if arrival.skip else whole

    def __len__(self) -> int:
        return len(self.reasons)

    @property
    def end(self) -> int:
        """The count after the last sample."""
        return self.first + len(self)

    def stamp_of(self, count: int) -> float:
        """Return the time of the sample ``count`` [ns]."""
        return self.stamp_ns + (count - self.first) * self.period_ns

    def part(self, start: int, stop: int) -> SampleRun:
        """Return the samples from index ``start`` up to ``stop``."""
        return replace(
            self,
            first=self.first + start,
            stamp_ns=self.stamp_ns + round(start * self.period_ns),
            reasons=self.reasons[start:stop],
            values=self.values[:, start:stop],
        )


class StreamInput:
    """Input of one stream: places its blocks, counts their samples and keeps their stamps.

    offset: added to the trigger counts
    """

    def __init__(self, offset: int = 0) -> None:
        self.tally = Tally()
        self.stamps = StampLine()
        self._offset = offset
        self._count = TriggerCount()

    def new(self, block: Block, parts: Sequence[Block] = ()) -> Arrival | None:
        """Return the place of ``block``, counting its samples; None if none of them is new.

        parts: the blocks it was joined from, each with its stamp
        """
        arrival = self._count.place(block, len(block))
        self.tally.received += len(block)
        self.tally.missing = max(self.tally.missing + arrival.missing - arrival.late, 0)
        self.tally.count(RejectionReason.LATE, arrival.late)
        repeated = arrival.skip - arrival.late - arrival.jumped
        self.tally.count(RejectionReason.DUPLICATE, repeated)
        self.tally.count(RejectionReason.JUMPED, arrival.jumped)
        if arrival.skip == len(block):
            return None
        arrival = replace(arrival, first=arrival.first + self._offset)
        for part in parts or (block,):
            self._note(part, arrival)
        return arrival

    def _note(self, block: Block, arrival: Arrival) -> None:
        """Keep the stamps of the new samples of ``block``."""
        begins, period_ns = arrival.first + arrival.skip, _period_ns(block)
        rows = block.stamps.tolist()
        ends = [*(first for first, _ in rows[1:]), block.end]
        for (first, stamp), end in zip(rows, ends, strict=True):
            if end + self._offset > begins:
                late = max(begins - first - self._offset, 0)
                count, stamp = first + late + self._offset, stamp + round(late * period_ns)
                self.stamps.add(arrival.session, count, stamp)

    def end(self) -> None:
        """Begin a new session with the next block."""
        self._count.end()


class RunQueue:
    """Runs of one stream that wait for a partner.

    pending: samples without a partner;  held: samples in pairs that are not settled yet
    given_up: the newest samples that waited too long
    stamps: of the blocks in which they came
    """

    def __init__(self, tally: Tally, stamps: StampLine) -> None:
        self.stamps = stamps
        self.pending = self.held = 0
        self.given_up: SampleRun | None = None
        self._runs: deque[SampleRun] = deque()
        self._tally = tally

    @property
    def head(self) -> SampleRun | None:
        """The oldest run."""
        return self._runs[0] if self._runs else None

    def push(self, run: SampleRun) -> None:
        """Append the newest run."""
        self._runs.append(run)
        self.pending += len(run)

    def drop(self, samples: int, reason: RejectionReason = RejectionReason.UNMATCHED) -> SampleRun:
        """Remove the oldest ``samples`` of the head, counting them under ``reason``."""
        run = self._cut(samples)
        self.stamps.advance(run.session, run.end - 1)
        self._tally.count_each(np.where(run.reasons, run.reasons, np.uint8(reason)))
        return run

    def hold(self, samples: int) -> SampleRun:
        """Remove the oldest ``samples`` of the head, which have partners; then settle them."""
        self.held += samples
        return self._cut(samples)

    def settle(self, run: SampleRun, partner_reasons: NDArray[np.uint8] | np.uint8) -> None:
        """Count a run that was held; its partners have the reasons ``partner_reasons`` (n,)."""
        self.held -= len(run)
        self._tally.count_each(np.where(run.reasons, run.reasons, partner_reasons))

    def limit(self, samples: int) -> None:
        """Drop the oldest as overdue until no more than ``samples`` wait."""
        while self.pending > samples:
            excess = min(self.pending - samples, len(self._runs[0]))
            self.given_up = self.drop(excess, RejectionReason.OVERDUE)

    def clear(self, runs: int | None = None) -> None:
        """Drop the oldest ``runs`` as unmatched, None: all that wait."""
        for _ in range(len(self._runs) if runs is None else runs):
            self.drop(len(self._runs[0]))

    def misplaced_runs(self, other: SampleRun) -> int:
        """Return the number of runs before the one at the time of ``other``; 0 if none is."""
        first = misses = 0
        for place in range(len(self._runs) - 1, 0, -1):
            misses = misses + 1 if _apart(self._runs[place], other) else 0
            if misses == _MISSES:
                break
            first = first if misses else place
        return first

    def _cut(self, samples: int) -> SampleRun:
        run = self._runs[0]
        self.pending -= samples
        if samples == len(run):
            return self._runs.popleft()
        self._runs[0] = run.part(samples, len(run))
        return run.part(0, samples)


class Pairing:
    """Pairs the samples of two queues.

    stamp_skew: time of the axes minus time of the distance at the newest common count [s]
    """

    def __init__(
        self, axes: StreamInput, distance: StreamInput, trigger: CommonTrigger = EQUAL_COUNTS
    ) -> None:
        self.axes = RunQueue(axes.tally, axes.stamps)
        self.distance = RunQueue(distance.tally, distance.stamps)
        self.stamp_skew: float | None = None
        self.watch = TriggerSlipDetector(axes.stamps, distance.stamps, trigger)
        # Sessions of axes and distance that count the same triggers.
        self._link = (-1, -1)
        self._held: deque[tuple[SampleRun, SampleRun]] = deque()

    def pairs(self) -> Iterator[tuple[SampleRun, SampleRun]]:
        """Yield settled runs of axes and distance, of equal counts and length."""
        while (a := self.axes.head) is not None and (d := self.distance.head) is not None:
            order, linked = self._order(a, d), self._linked(a, d)
            if order == 0:
                yield from self._joined(a, d)
                continue
            queue, run, others, other = self.axes, a, self.distance, d
            if order > 0:
                queue, run, others, other = others, other, queue, run
            if not linked and _apart(a, d):
                if self._drop_misplaced(a, d):
                    continue
                self.watch.apart(a.stamp_of(d.first) - d.stamp_ns, len(run), run.period_ns)
            samples = min(other.first - run.first, len(run)) if linked else len(run)
            queue.drop(samples, _missing(run, others))

    def end(self) -> Iterator[tuple[SampleRun, SampleRun]]:
        """Settle the pairs that still wait by the stamps there are, and yield them."""
        if self._held:
            yield from self._settle(self._held[-1][0].end, self.watch.end())

    def _joined(self, a: SampleRun, d: SampleRun) -> Iterator[tuple[SampleRun, SampleRun]]:
        """Pair two heads of equal count, and yield the pairs that are settled by their stamps."""
        self.stamp_skew = (a.stamp_ns - d.stamp_ns) / NANOSECONDS_PER_S
        sessions, first, samples = (a.session, d.session), a.first, min(len(a), len(d))
        if sessions != self.watch.sessions:
            yield from self.end()
        self._held.append((self.axes.hold(samples), self.distance.hold(samples)))
        verdicts = self.watch.settled(sessions, first, first + samples, a.period_ns)
        # Successive pairs with the same verdict are yielded as one run.
        for slipped, alike in groupby(verdicts, key=itemgetter(1)):
            yield from self._settle(max(until for until, _ in alike), slipped)

    def _settle(self, until: int, slipped: bool) -> Iterator[tuple[SampleRun, SampleRun]]:
        """Settle the pairs before the count ``until``; yield them unless they slipped."""
        while self._held and (first := self._held[0][0].first) < until:
            a, d = self._held.popleft()
            if until < a.end:
                stop = until - first
                self._held.appendleft((a.part(stop, len(a)), d.part(stop, len(d))))
                a, d = a.part(0, stop), d.part(0, stop)
            refused = np.uint8(RejectionReason.SLIPPED)
            self.axes.settle(a, refused if slipped else d.reasons)
            self.distance.settle(d, refused if slipped else a.reasons)
            if not slipped:
                yield a, d

    def _drop_misplaced(self, a: SampleRun, d: SampleRun) -> bool:
        """Drop heads of a wrong time if later runs of that stream fit the other; return if so.

        A single wrong stamp shows only by the blocks that follow. Without this its head would be
        taken for an older session, and the other stream would be dropped from then on.
        """
        axes, distance = self.axes.misplaced_runs(d), self.distance.misplaced_runs(a)
        if bool(axes) == bool(distance):
            return False
        self.axes.clear(axes)
        self.distance.clear(distance)
        return True

    def _linked(self, a: SampleRun, d: SampleRun) -> bool:
        return (a.session, d.session) == self._link

    def _order(self, a: SampleRun, d: SampleRun) -> int:
        """Return -1 if the head of the axes has no partner, 1 for the distance, 0 for a pair."""
        if not self._linked(a, d):
            if _apart(a, d):
                if a.session == self._link[0]:
                    return -1
                if d.session == self._link[1]:
                    return 1
                return -1 if a.stamp_ns <= d.stamp_ns else 1
            if max(a.first, d.first) < min(a.end, d.end):
                self._link = (a.session, d.session)
        return (a.first > d.first) - (a.first < d.first)


def _apart(a: SampleRun, d: SampleRun) -> bool:
    count = max(a.first, d.first)
    return abs(a.stamp_of(count) - d.stamp_of(count)) > STAMP_TOLERANCE_S * NANOSECONDS_PER_S


def _missing(run: SampleRun, other: RunQueue) -> RejectionReason:
    lost = other.given_up
    overdue = lost is not None and run.first < lost.end and not _apart(run, lost)
    return RejectionReason.OVERDUE if overdue else RejectionReason.UNMATCHED


def _period_ns(block: Block) -> float:
    return block.sample_period * NANOSECONDS_PER_S
