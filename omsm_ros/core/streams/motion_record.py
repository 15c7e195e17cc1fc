"""Recordings of Z and the probe on one regular grid, and the buffer of the newest motion.

Blocks of one trigger are paired by its counter. If the rates differ there is no common trigger:
then the axis is interpolated by the stamps, on a grid that contains every sample of the probe and
is at least as fine as the sampling of the axis.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any, Generic, TypeAlias, TypeVar

import numpy as np

from omsm_ros.core.streams.axes_at_probe import axes_at_probe
from omsm_ros.core.streams.blocks import (
    SAME_PERIOD,
    AxisBlock,
    Block,
    BoolArray,
    DistanceBlock,
    FloatArray,
    RejectionReason,
    StreamAccount,
    consecutive,
    joined,
)
from omsm_ros.core.streams.continuity import TIME_JUMP_S, is_ahead_of_time
from omsm_ros.core.streams.pairing import STAMP_TOLERANCE_S, Pairing, SampleRun, StreamInput
from omsm_ros.core.streams.trigger_slips import EQUAL_COUNTS, CommonTrigger
from omsm_ros.errors import DataError
from omsm_ros.quantities import SAMPLE_PERIOD
from omsm_ros.units import NANOSECONDS_PER_S

# Five hours at 1 kHz; a larger span of the counter is two recordings or a forged block.
MAX_RECORD_SAMPLES = 20_000_000

B = TypeVar("B", bound=Block)
Probed = TypeVar("Probed", AxisBlock, DistanceBlock)
Values: TypeAlias = Callable[[Any], "tuple[FloatArray, BoolArray]"]


@dataclass(frozen=True, eq=False, kw_only=True)
class MotionRecord:
    """Samples of one regular grid, each array of shape (n,).

    sample_period: of the grid [s]
    z: encoder [m], finite everywhere; interpolated where it was lost, and not ``ok`` there
    distance: probe [m], NaN where it has no reading
    ok: True where both are measured and valid
    reference: second sensor along the same motion [m], NaN where it has no reading, or None
    z_lost: True where z is interpolated, None if it never is
    further: positions of further axes that may move the probe [m], of b and c [rad], by name
    starts: first sample of each recording, where several were joined
    by_stamps: True if the samples were paired by stamps instead of a common trigger
    counts: number of samples by what became of them

    Raises DataError for arrays of different lengths.
    """

    sample_period: float
    z: FloatArray
    distance: FloatArray
    ok: BoolArray
    reference: FloatArray | None = None
    z_lost: BoolArray | None = None
    further: Mapping[str, FloatArray] = field(default_factory=dict)
    starts: tuple[int, ...] = (0,)
    by_stamps: bool = False
    counts: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        arrays = [self.z, self.distance, self.ok, *self.further.values()]
        if self.reference is not None:
            arrays.append(self.reference)
        lengths = sorted({len(a) for a in arrays})
        if len(lengths) != 1:
            raise DataError("streams.record_lengths", lengths=lengths)
        SAMPLE_PERIOD.checked(self.sample_period, DataError, "record: sample_period")

    def __len__(self) -> int:
        return len(self.z)

    def part(self, start: int, stop: int) -> MotionRecord:
        """Return the samples from ``start`` to before ``stop``, as one recording."""
        part = slice(start, stop)
        return replace(
            self,
            z=self.z[part],
            further={name: position[part] for name, position in self.further.items()},
            distance=self.distance[part],
            ok=self.ok[part],
            reference=None if self.reference is None else self.reference[part],
            z_lost=None if self.z_lost is None else self.z_lost[part],
            starts=(0,),
        )


def assemble(
    axes: Sequence[AxisBlock],
    distance: Sequence[DistanceBlock],
    reference: Sequence[DistanceBlock] = (),
    trigger: CommonTrigger = EQUAL_COUNTS,
    by_stamps: bool = False,
    further: Sequence[str] = (),
) -> MotionRecord:
    """Pair the blocks of one recording, in any order, with gaps, repeats and dropouts.

    by_stamps: pair them by their stamps also at equal rates.
    further: axes besides z that the record keeps, of x, y, b, c

    Raises DataError if nothing can be paired, for more than one recording, or if the counters of
    axes and distance slipped against each other.
    """
    if not axes or not distance:
        raise DataError("streams.no_blocks", axes=len(axes), distance=len(distance))
    period = _one_period("axis", axes)
    probe_period = _one_period("distance", distance)
    if abs(probe_period / period - 1) < SAME_PERIOD and not by_stamps:
        return _by_counter(axes, distance, reference, period, trigger, further)
    return _by_stamp(axes, distance, reference, further)


def _one_period(name: str, blocks: Sequence[AxisBlock] | Sequence[DistanceBlock]) -> float:
    periods = sorted({float(block.sample_period) for block in blocks})
    if periods[-1] > periods[0] * (1 + SAME_PERIOD):
        raise DataError("streams.different_periods", stream=name, periods=periods)
    return periods[0]


def _ordered(blocks: Iterable[B]) -> list[B]:
    return sorted(blocks, key=lambda block: (block.stamp_ns, block.first_sample))


def _runs(blocks: Iterable[Block], values: Values, stream: StreamInput) -> Iterator[SampleRun]:
    """Yield the new samples of each block; ``values`` gives channels (a, n) and validity (n,)."""
    for block in _ordered(blocks):
        if (arrival := stream.new(block)) is not None:
            value, ok = values(block)
            reasons = np.where(ok, RejectionReason.NONE, RejectionReason.INVALID).astype(np.uint8)
            yield SampleRun.of(block, arrival, reasons, np.asarray(value, np.float64))


@dataclass(frozen=True, eq=False)
class _Grid:
    """Axes (a, n) on the counts of one session from ``first`` on; NaN where not ``known`` (n,)."""

    runs: list[SampleRun]
    first: int
    positions: FloatArray
    known: BoolArray
    account: StreamAccount

    def __len__(self) -> int:
        return len(self.known)

    @classmethod
    def of(cls, axes: Sequence[AxisBlock], further: Sequence[str]) -> _Grid:
        stream = StreamInput()

        def positions(block: AxisBlock) -> tuple[FloatArray, BoolArray]:
            every = np.array([getattr(block, name) for name in ("z", *further)])
            return every, np.all(np.isfinite(every), axis=0)

        runs = list(_runs(axes, positions, stream))
        sessions = len({run.session for run in runs})
        first, samples = runs[0].first, runs[-1].end - runs[0].first
        if sessions > 1 or samples > MAX_RECORD_SAMPLES:
            raise DataError(
                "streams.record_span", samples=samples, sessions=sessions, most=MAX_RECORD_SAMPLES
            )
        every, known = np.full((1 + len(further), samples), np.nan), np.zeros(samples, np.bool_)
        for run in runs:
            place = slice(run.first - first, run.end - first)
            every[:, place], known[place] = run.values, run.reasons == RejectionReason.NONE
        return cls(runs, first, every, known, stream.tally.snapshot(0))

    def matched(
        self, name: str, blocks: Sequence[DistanceBlock], trigger: CommonTrigger
    ) -> tuple[FloatArray, BoolArray, StreamAccount]:
        """Return readings on the grid (n,), their validity (n,), and the account of the stream.

        Raises DataError if its counter slipped against that of the axes.
        """
        axes, stream = StreamInput(), StreamInput(trigger.counter_offset)
        pairing = Pairing(axes, stream, trigger)
        for run in self.runs:
            axes.stamps.add(run.session, run.first, run.stamp_ns)
            pairing.axes.push(run)
        for run in _runs(blocks, lambda block: (block.distance[np.newaxis], block.ok), stream):
            pairing.distance.push(run)
        seen, ok = np.full(len(self), np.nan), np.zeros(len(self), np.bool_)
        for axis, reading in chain(pairing.pairs(), pairing.end()):
            place = slice(axis.first - self.first, axis.end - self.first)
            usable = reading.reasons == RejectionReason.NONE
            seen[place], ok[place] = np.where(usable, reading.values[0], np.nan), usable
        pairing.distance.clear()
        if pairing.watch.found is not None:
            slip = pairing.watch.found.notice()
            raise DataError("streams.slip_of", stream=name, **slip.values)
        return seen, ok, stream.tally.snapshot(0)


def _by_counter(
    axes: Sequence[AxisBlock],
    distance: Sequence[DistanceBlock],
    reference: Sequence[DistanceBlock],
    period: float,
    trigger: CommonTrigger,
    further: Sequence[str],
) -> MotionRecord:
    grid = _Grid.of(axes, further)
    output, ok, account = grid.matched("distance", distance, trigger)
    lost = account.counted.get("unmatched", 0) + account.counted.get("duplicate", 0)
    if lost + account.counted.get("late", 0) == account.received:
        raise DataError(
            "streams.nothing_in_common",
            first=grid.first,
            last=grid.first + len(grid) - 1,
            distance=distance[0].first_sample,
            tolerance=STAMP_TOLERANCE_S,
        )
    own = replace(trigger, counter_offset=0)
    z, *others = np.zeros_like(grid.positions)
    if len(known := np.flatnonzero(grid.known)):
        z, *others = (np.interp(np.arange(len(grid)), known, row[known]) for row in grid.positions)
    named = zip(further, others, strict=True)
    return MotionRecord(
        sample_period=period,
        z=z,
        # The angle C without its jumps of whole turns.
        further={name: np.asarray(np.unwrap(v)) if name == "c" else v for name, v in named},
        distance=output,
        ok=grid.known & ok,
        reference=grid.matched("reference", reference, own)[0] if reference else None,
        z_lost=None if np.all(grid.known) else ~grid.known,
        counts=_counts(grid, account),
    )


def _counts(grid: _Grid, probe: StreamAccount) -> dict[str, int]:
    lost, axis_lost = probe.counted, grid.account.counted
    on_grid = sum(len(run) for run in grid.runs)
    return {
        "received": probe.received,
        "duplicates": lost.get("duplicate", 0) + lost.get("late", 0),
        "axis_duplicates": axis_lost.get("duplicate", 0) + axis_lost.get("late", 0),
        "missing_axis": len(grid) - on_grid,
        "unmatched": lost.get("unmatched", 0),
        "not_ok": lost.get("invalid", 0),
        "paired": probe.corrected,
    }


def _by_stamp(
    axes: Sequence[AxisBlock],
    distance: Sequence[DistanceBlock],
    reference: Sequence[DistanceBlock],
    further: Sequence[str],
) -> MotionRecord:
    """Interpolate the axis at the samples of the grid, and pair both by counter."""
    axis_period, probe_period = axes[0].sample_period, distance[0].sample_period
    finer = max(int(np.ceil(probe_period / axis_period - SAME_PERIOD)), 1)
    if finer * sum(map(len, distance)) > MAX_RECORD_SAMPLES:
        raise DataError(
            "streams.grid", probe=probe_period, axes=axis_period, most=MAX_RECORD_SAMPLES
        )
    grid = [_refined(block, finer) for block in _ordered(distance)]
    moved = list(axes_at_probe(_ordered(axes), grid))
    second = []
    if reference:
        carried = axes_at_probe([_as_axis(block) for block in _ordered(reference)], grid)
        second = [replace(g, distance=c.z) for g, c in zip(grid, carried, strict=True)]
    period = probe_period / finer
    record = _covered(_by_counter(moved, grid, second, period, EQUAL_COUNTS, further))
    counts = dict(record.counts) | {"received": sum(map(len, distance))}
    counts |= {name: counts[name] // finer for name in ("duplicates", "unmatched")}
    others = counts["duplicates"] + counts["unmatched"] + counts["paired"]
    counts["not_ok"] = counts["received"] - others
    return replace(record, counts=counts, by_stamps=True)


def _refined(block: DistanceBlock, finer: int) -> DistanceBlock:
    """Return the block on a grid that is ``finer`` times as fine, NaN between its readings."""
    values = np.full(len(block) * finer, np.nan)
    values[::finer] = np.where(block.ok, block.distance, np.nan)
    return DistanceBlock(
        stamp_ns=block.stamp_ns,
        first_sample=block.first_sample * finer,
        sample_period=block.sample_period / finer,
        distance=values,
    )


def _as_axis(block: DistanceBlock) -> AxisBlock:
    zero = np.zeros(len(block))
    return AxisBlock(
        stamp_ns=block.stamp_ns,
        first_sample=block.first_sample,
        sample_period=block.sample_period,
        x=zero,
        y=zero,
        z=block.distance,
        b=zero,
        c=zero,
    )


def _covered(record: MotionRecord) -> MotionRecord:
    """Return the record from the first to the last known sample of the axis; or DataError."""
    known = np.ones(len(record), np.bool_) if record.z_lost is None else ~record.z_lost
    places = np.flatnonzero(known)
    if not len(places):
        raise DataError("streams.no_common_time")
    part = record.part(int(places[0]), int(places[-1]) + 1)
    return replace(part, z_lost=None) if np.all(known[places[0] : places[-1]]) else part


# A block needs 2 kB besides its samples, which is much for a short block: that many blocks are
# joined if they have fewer samples than that on average.
_MANY = 100


class BlockBuffer(Generic[Probed]):
    """Blocks of one topic since its trigger counter was last reset, bounded in samples.

    The oldest blocks are dropped when ``capacity`` samples are exceeded; ``forgotten`` counts
    their samples. Short consecutive blocks are joined to save memory.
    """

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._blocks: deque[Probed] = deque()
        self._samples = 0
        self._apart = 0  # number of the newest blocks that are not joined yet
        self.forgotten = 0
        self._doubtful: Probed | None = None

    def add(self, block: Probed) -> None:
        """Append a block; a counter that falls, or leaps ahead of time, begins a new motion.

        The next block has to confirm that; otherwise the one before it is dropped. If the stamp is
        a little older too, the block is a late or repeated one.
        """
        before = self._blocks[-1] if self._blocks else None
        doubtful, self._doubtful = self._doubtful, None
        if doubtful is not None and block.first_sample == doubtful.end:
            self.forget()
            self._append(doubtful)
            self._append(block)
            return
        late_ns = 0 if before is None else before.stamp_ns - block.stamp_ns
        if before is None or (
            block.first_sample >= before.newest[0] and not is_ahead_of_time(before.newest, block)
        ):
            self._append(block)
        elif 0 < late_ns <= TIME_JUMP_S * NANOSECONDS_PER_S:
            self._doubtful = doubtful
            self._append(block, before_newest=block.first_sample < before.first_sample)
            return
        else:
            self._doubtful = block
        self.forgotten += 0 if doubtful is None else len(doubtful)

    def _append(self, block: Probed, *, before_newest: bool = False) -> None:
        self._blocks.insert(len(self._blocks) - before_newest, block)
        self._samples += len(block)
        self._apart += 1
        if self._apart > _MANY:
            self._join()
        while self._samples > self._capacity and len(self._blocks) > 1:
            self._forget(1)

    def _join(self) -> None:
        """Join short blocks except the newest one, before which a late block may be inserted."""
        newest = self._blocks.pop()
        blocks: list[Probed] = [self._blocks.pop() for _ in range(self._apart - 1)][::-1]
        if sum(map(len, blocks)) < _MANY * len(blocks):
            blocks = [joined(run) for run in consecutive(blocks)]
        self._blocks.extend(blocks)
        self._blocks.append(newest)
        self._apart = 1

    def forget(self) -> None:
        """Drop all blocks, because a new motion begins."""
        self._forget(len(self._blocks))

    def _forget(self, blocks: int) -> None:
        for _ in range(blocks):
            samples = len(self._blocks.popleft())
            self._samples -= samples
            self.forgotten += samples
        self._apart = min(self._apart, len(self._blocks))

    def __len__(self) -> int:
        return self._samples

    def recent(self, duration: float = 0.0) -> list[Probed]:
        """Return the blocks of the last ``duration`` seconds of the motion; 0 = all."""
        if not self._blocks or duration == 0:
            return list(self._blocks)
        last = self._blocks[-1]
        first = last.end - duration / last.sample_period
        return [b for b in self._blocks if b.end > first]
