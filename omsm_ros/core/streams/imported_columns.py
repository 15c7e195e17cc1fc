"""Columns of another program's recording, made into blocks of this one's."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from omsm_ros.core.streams.blocks import (
    AxisBlock,
    DistanceBlock,
    FloatArray,
    IntArray,
    Status,
    empty_parts,
)
from omsm_ros.errors import DataError
from omsm_ros.quantities import COUNTER, INTENSITY_READING, SAMPLE_PERIOD, STAMP, TIME
from omsm_ros.units import (
    DATE,
    NANOSECONDS_PER_S,
    SINCE_1970,
    check_share,
    check_turns,
    contradicts_unit,
)

AXES = ("x", "y", "z", "b", "c")
PROBE = ("distance", "intensity")
COUNTING = ("trigger", "time")
CHANNELS = (*AXES, *PROBE, *COUNTING)

# 0.4 MB of axes in a message.
_BLOCK_SAMPLES = 10_000
_NOT_RISING = (
    "import the parts before and after it one by one, or, if time is written too coarsely, leave "
    "it out and state sample_period"
)
# A time that is off by more lies nearer to no sample than to its neighbour.
_MOST_JITTER = 0.25
# The years 2000 and 2100, of stamps that a set clock gave [s since 1970].
_STAMPED_S = (946_684_800.0, 4_102_444_800.0)
# Rows off the grid by that much, of which more than one in a hundred is no single slip.
_MOST_UNEVEN = 0.01
# Clocks of two devices differ by less than 0.1 %; a period written wrongly by more.
MOST_PERIOD_ERROR = 1e-3


@dataclass(frozen=True, slots=True)
class Column:
    """Where a channel comes from.

    name: of the column in the file; empty for a channel that stood still
    factor: SI value of one unit of it, with the sign that makes it ours
    constant: its value [SI] where it has no column;  unit: as the map names it
    """

    name: str
    factor: float = 1.0
    constant: float = 0.0
    unit: str = ""

    def contradicts(self, stated: str, channel: str) -> bool:
        """Return whether ``stated``, a file's own word on the unit, means another one."""
        return contradicts_unit(stated, self.unit, channel)


@dataclass(frozen=True, slots=True)
class ColumnMap:
    """How the columns of a foreign recording become channels.

    columns: channel → its column;  sample_period: [s], None = from the column ``time``
    start: time of sample 0 [s, Unix];  invalid: readings [SI of no unit, as they stand in the
    file] of the probe that mean "no reading"
    """

    columns: Mapping[str, Column]
    sample_period: float | None = None
    start: float = 0.0
    invalid: tuple[float, ...] = field(default=())

    def __post_init__(self) -> None:
        unknown = sorted(set(self.columns) - set(CHANNELS))
        if unknown:
            raise DataError(f"channel {unknown[0]!r} is unknown, expected one of {list(CHANNELS)}")
        if self.sample_period is None and "time" not in self.columns:
            raise DataError("neither sample_period nor a column of time; give one of them")
        if self.sample_period is not None:
            SAMPLE_PERIOD.checked(self.sample_period, DataError, "sample_period")
        TIME.checked(self.start, DataError, "start")  # else it has no number of nanoseconds
        STAMP.checked(round(self.start * NANOSECONDS_PER_S), DataError, "start")
        if self.start and self.dated:
            raise DataError(
                f"start is {self.start:g} s, but the column of time holds dates; leave start out"
            )
        if not {"z", "distance"} & set(self.columns):
            raise DataError("neither z nor distance has a column; write one of them into the map")
        lacking = [a for a in AXES if a not in self.columns]
        read = [a for a in AXES if self.has(a)]
        if lacking and (read or "z" in self.columns):
            raise DataError(
                f"no column for {', '.join(lacking)}, which {(read or ['z'])[-1]} needs beside it; "
                "where one stood "
                f"still, write {', '.join(f'{axis}: {{constant: 0}}' for axis in lacking)}"
            )

    @property
    def dated(self) -> bool:
        """Return whether the column of time holds instants since 1970."""
        return "time" in self.columns and self.columns["time"].unit in (DATE, *SINCE_1970)

    def names(self, channels: tuple[str, ...]) -> list[str]:
        """Return the columns of the file that ``channels`` need, without those that stand still."""
        return [self.columns[c].name for c in channels if c in self.columns and self.has(c)]

    def has(self, channel: str) -> bool:
        """Return whether ``channel`` is read from a column."""
        return channel in self.columns and self.columns[channel].name != ""


def share_trigger(starts: Sequence[float], periods: Sequence[float]) -> bool:
    """Return whether streams that begin at ``starts`` [s] share one trigger, by their times.

    They do if their ``periods`` [s] agree to 0.1 %, and their samples fall on one grid.
    """
    period, first = periods[0], min(starts)
    alike = all(abs(other / period - 1) < MOST_PERIOD_ERROR for other in periods)
    places = [(start - first) / period for start in starts]
    return alike and all(abs(place - round(place)) <= _MOST_JITTER for place in places)


def check_epoch(first: float, time: Column, start: float) -> None:
    """Raise DataError where the column ``time`` begins at ``first`` [s], another unit's instant.

    start: as the map states it [s, Unix]; with it, times since 1970 may be in any unit of time
    """
    raw = first / time.factor
    low, high = _STAMPED_S
    fitting = [unit for unit, factor in SINCE_1970.items() if low <= raw * factor <= high]
    if not fitting or time.unit in (*fitting, DATE):
        return
    if time.unit in SINCE_1970:
        raise DataError(
            f"time begins at {raw:.13g}, no instant in {time.unit}; write unit: {fitting[0]}"
        )
    if SINCE_1970[fitting[0]] == abs(time.factor) and not start:
        raise DataError(
            f"time begins at {raw:.13g} {time.unit}, which looks like a date; write unit: "
            f"{fitting[0]} where it counts from 1970, or else the start"
        )


def period_of(times: FloatArray, stated: float | None) -> float:
    """Return the sample period [s] that ``times`` (n,) [s] have, or ``stated`` where they agree.

    Raises DataError where time does not rise, or the two differ by more than 0.1 %.
    """
    TIME.checked_all(times, DataError, "time")
    if len(times) < 2:
        raise DataError(f"{len(times)} rows of time, expected at least 2; record more")
    steps = np.diff(times)
    if not np.all(steps > 0):
        row = int(np.argmax(steps <= 0)) + 1
        raise DataError(
            f"time does not rise from {times[row - 1]:.15g} s to {times[row]:.15g} s at row {row}; "
            f"{_NOT_RISING}"
        )
    found = float(np.median(steps))
    whole = np.maximum(np.round(steps / found), 1.0)
    uneven = float(np.mean(np.abs(steps / found - whole) > _MOST_JITTER))
    found = float((times[-1] - times[0]) / np.sum(whole))
    if stated is None:
        return float(SAMPLE_PERIOD.checked(found, DataError, "sample period of the column time"))
    if abs(found / stated - 1) > MOST_PERIOD_ERROR:
        if uneven > _MOST_UNEVEN:
            raise DataError(
                f"{100 * uneven:.0f} % of the times lie off an even grid; where"
                " only the stamping is uneven, leave time out and state sample_period"
            )
        raise DataError(
            f"sample_period is {stated:g} s, but the column of time says {found:.6g} s; "
            "correct the one that is wrong, or its unit"
        )
    return stated


def counter_of_times(
    times: FloatArray, period: float, before: tuple[float, int] | None
) -> IntArray:
    """Return the trigger number (n,) of each time [s]; a gap in time is a gap in the count.

    before: time [s] and trigger number of the row before these, None where these are the first.
    Counted from neighbour to neighbour, for clocks drift and a period is known to some digits
    only. Raises DataError where a time falls, or lies between two samples.
    """
    TIME.checked_all(times, DataError, "time")
    time, number = before if before is not None else (times[0] - period, -1)
    steps = np.diff(times, prepend=time) / period
    whole = np.round(steps)
    off = np.abs(steps - whole)
    if np.max(off, initial=0.0) > _MOST_JITTER:
        row = int(np.argmax(off))
        raise DataError(
            f"time {times[row]:.15g} s comes {steps[row]:.3g} periods of {period:g} s after the "
            "row before; give a column of trigger numbers, or samples taken evenly; or, where only "
            "the stamping is uneven, leave time out and state sample_period"
        )
    if np.min(whole, initial=1.0) < 1:
        row = int(np.argmin(whole))
        raise DataError(f"time {times[row]:.15g} s does not rise; {_NOT_RISING}")
    return np.asarray(number + np.cumsum(whole).astype(np.int64))


def counter_of_triggers(values: FloatArray, before: int) -> IntArray:
    """Return the trigger number (n,) of each row; DataError unless whole and rising."""
    if not np.all(np.isfinite(values)) or np.any(values != np.round(values)):
        bad = int(np.argmax(~np.isfinite(values) | (values != np.round(values))))
        last = before if bad == 0 else values[bad - 1]
        raise DataError(
            f"trigger is {values[bad]:.15g} in the row after {last:.15g}, expected whole numbers; "
            "correct that row, or delete it"
        )
    COUNTER.checked_all(values, DataError, "trigger")
    counter = values.astype(np.int64)
    steps = np.diff(counter, prepend=before)
    if not np.all(steps > 0):
        row = int(np.argmax(steps <= 0))
        raise DataError(
            f"trigger {counter[row] - steps[row]} is followed by {counter[row]}; "
            "delete the row that repeats or comes late, or import what lies before and after it "
            "one by one"
        )
    return counter


@dataclass(frozen=True, slots=True)
class TableRows:
    """Where some rows stand in their recording.

    counter: trigger number of each (n,);  elapsed: time of each (n,) [s] after ``start`` [s, Unix]
    period: from trigger to trigger [s]
    """

    counter: IntArray
    elapsed: FloatArray
    period: float
    start: float

    def parts(self) -> Iterator[tuple[slice, int, int]]:
        """Yield runs of consecutive numbers, no longer than a block: rows, stamp [ns], number."""
        edges = [0, *(np.flatnonzero(np.diff(self.counter) != 1) + 1).tolist(), len(self.counter)]
        # Apart, for a float of seconds since 1970 ends at a quarter of a microsecond.
        whole, fraction = divmod(self.start, 1.0)
        for begin, end in pairwise(edges):
            for low in range(begin, end, _BLOCK_SAMPLES):
                elapsed = round((fraction + float(self.elapsed[low])) * NANOSECONDS_PER_S)
                stamp_ns = int(whole) * NANOSECONDS_PER_S + elapsed
                yield slice(low, min(low + _BLOCK_SAMPLES, end)), stamp_ns, int(self.counter[low])


def axis_blocks(
    table: Mapping[str, FloatArray], mapped: ColumnMap, rows: TableRows
) -> Iterator[AxisBlock]:
    """Yield the axes of ``rows`` of ``table`` (column name → (n,)), cut at gaps of their count."""
    for axis in ("b", "c"):
        if mapped.has(axis):
            check_turns(table[mapped.columns[axis].name], mapped.columns[axis].unit, axis)
    channels = {c: _channel(table, mapped.columns[c], len(rows.counter)) for c in AXES}
    for part, stamp_ns, first in rows.parts():
        yield AxisBlock(
            stamp_ns=stamp_ns,
            first_sample=first,
            sample_period=rows.period,
            parts=empty_parts(),
            **{c: values[part] for c, values in channels.items()},
        )


def distance_blocks(
    table: Mapping[str, FloatArray], mapped: ColumnMap, rows: TableRows
) -> Iterator[DistanceBlock]:
    """Yield the probe's readings of ``rows``; NaN and ``invalid`` ones as no target."""
    count = len(rows.counter)
    column = mapped.columns["distance"]
    raw = table[column.name] if column.name else np.full(count, column.constant)
    distance = _channel(table, column, count)
    lost = ~np.isfinite(distance) | np.isin(raw, np.asarray(mapped.invalid))
    distance = np.where(lost, np.nan, distance)
    status = np.where(lost, Status.NO_TARGET, Status.OK).astype(np.uint8)
    intensity = np.empty(0, np.float32)
    if mapped.has("intensity"):
        read = _channel(table, mapped.columns["intensity"], count)
        check_share(read, mapped.columns["intensity"].unit)
        intensity = INTENSITY_READING.nan_if_implausible(read).astype(np.float32)
    for part, stamp_ns, first in rows.parts():
        yield DistanceBlock(
            stamp_ns=stamp_ns,
            first_sample=first,
            sample_period=rows.period,
            distance=distance[part],
            intensity=intensity[part] if len(intensity) else intensity,
            status=status[part],
        )


def _channel(table: Mapping[str, FloatArray], column: Column, rows: int) -> FloatArray:
    if not column.name:
        return np.full(rows, column.constant)
    with np.errstate(invalid="ignore", over="ignore"):  # what is no number is told by who reads it
        return np.asarray(table[column.name] * column.factor)
