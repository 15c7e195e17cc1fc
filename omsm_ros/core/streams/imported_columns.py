"""Conversion of the columns of another program's recording to blocks.

A number outside the plausible range, a time that falls and a unit that contradicts the data raise
DataError instead of being interpreted.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from omsm_ros.core.streams.blocks import AxisBlock, DistanceBlock, FloatArray, IntArray, Status
from omsm_ros.errors import DataError
from omsm_ros.quantities import COUNTER, INTENSITY_READING, SAMPLE_PERIOD, STAMP, TIME
from omsm_ros.units import DATE, NANOSECONDS_PER_S, SINCE_1970

AXES = ("x", "y", "z", "b", "c")
PROBE = ("distance", "intensity")
COUNTING = ("trigger", "time")
CHANNELS = (*AXES, *PROBE, *COUNTING)

# A block of this length has 0.4 MB of axes.
_BLOCK_SAMPLES = 10_000
# Deviation of a time from the grid of samples, in periods, at which its sample is not certain.
_MOST_JITTER = 0.25
# The years 2000 and 2100: the range of a clock that was set [s since 1970].
_STAMPED_S = (946_684_800.0, 4_102_444_800.0)
# Share of rows off the grid above which the stamping is uneven, not a single row.
_MOST_UNEVEN = 0.01
# Clocks of two devices differ by less than 0.1 %; a wrong sample period is off by more.
MOST_PERIOD_ERROR = 1e-3
# One turn in each unit of an angle.
_TURNS = {"deg": 360.0, "rad": 2 * np.pi, "mrad": 2000 * np.pi, "turn": 1.0}
# Share of a turn by which a wrapped angle falls back at least: its last reading is one step short.
_NEARLY_ONE = 0.9


@dataclass(frozen=True, slots=True)
class Column:
    """The source of a channel.

    name: of the column in the file; empty for a channel that is constant
    factor: SI value of one unit, with the sign of the channel
    constant: value [SI] without a column;  unit: as the column map names it
    """

    name: str
    factor: float = 1.0
    constant: float = 0.0
    unit: str = ""


@dataclass(frozen=True, slots=True)
class ColumnMap:
    """Assignment of the columns of a foreign recording to channels.

    columns: channel → its column;  sample_period: [s], None = from the column ``time``
    start: time of sample 0 [s since 1970]
    invalid: numbers in the file, without conversion, that mean "no reading" of the probe
    """

    columns: Mapping[str, Column]
    sample_period: float | None = None
    start: float = 0.0
    invalid: tuple[float, ...] = field(default=())

    def __post_init__(self) -> None:
        unknown = sorted(set(self.columns) - set(CHANNELS))
        if unknown:
            raise DataError("streams.channel", channel=unknown[0], known=CHANNELS)
        if self.sample_period is None and "time" not in self.columns:
            raise DataError("streams.no_time")
        if self.sample_period is not None:
            SAMPLE_PERIOD.checked(self.sample_period, DataError, "sample_period")
        TIME.checked(self.start, DataError, "start")  # before it is converted to nanoseconds
        STAMP.checked(round(self.start * NANOSECONDS_PER_S), DataError, "start")
        if self.start and self.dated:
            raise DataError("streams.start_and_dates", start=self.start)
        if not {"z", "distance"} & set(self.columns):
            raise DataError("streams.no_z_or_distance")
        lacking = [a for a in AXES if a not in self.columns]
        read = [a for a in AXES if self.has(a)]
        if lacking and (read or "z" in self.columns):
            constants = [f"{axis}: {{constant: 0}}" for axis in lacking]
            given = (read or ["z"])[-1]
            raise DataError("streams.axes", lacking=lacking, given=given, constants=constants)

    @property
    def dated(self) -> bool:
        """True if the column of time holds instants since 1970."""
        return "time" in self.columns and self.columns["time"].unit in (DATE, *SINCE_1970)

    def names(self, channels: tuple[str, ...]) -> list[str]:
        """Return the columns of the file that ``channels`` need, without constant ones."""
        return [self.columns[c].name for c in channels if c in self.columns and self.has(c)]

    def has(self, channel: str) -> bool:
        """Return whether ``channel`` is read from a column."""
        return channel in self.columns and self.columns[channel].name != ""


def share_trigger(starts: Sequence[float], periods: Sequence[float]) -> bool:
    """Return whether streams that begin at ``starts`` [s] have samples on one grid of times.

    Their ``periods`` [s] must agree to 0.1 %.
    """
    period, first = periods[0], min(starts)
    alike = all(abs(other / period - 1) < MOST_PERIOD_ERROR for other in periods)
    places = [(start - first) / period for start in starts]
    return alike and all(abs(place - round(place)) <= _MOST_JITTER for place in places)


def check_epoch(first: float, time: Column, start: float) -> None:
    """Raise DataError if the first time is an instant since 1970 in another unit than stated.

    first: of the column ``time`` [s];  start: as the map states it [s since 1970]; with it, times
        since 1970 may be in any unit of time
    """
    raw = first / time.factor
    low, high = _STAMPED_S
    fitting = [unit for unit, factor in SINCE_1970.items() if low <= raw * factor <= high]
    if not fitting or time.unit in (*fitting, DATE):
        return
    if time.unit in SINCE_1970:
        raise DataError("streams.epoch_unit", first=raw, unit=time.unit, fitting=fitting[0])
    if SINCE_1970[fitting[0]] == abs(time.factor) and not start:
        raise DataError("streams.epoch", first=raw, unit=time.unit, fitting=fitting[0])


def period_of(times: FloatArray, stated: float | None) -> float:
    """Return the sample period [s] of ``times`` (n,) [s]; ``stated`` if one is given.

    Raises DataError where time does not rise, or the two differ by more than 0.1 %.
    """
    TIME.checked_all(times, DataError, "time")
    if len(times) < 2:
        raise DataError("streams.few_times", rows=len(times))
    steps = np.diff(times)
    if not np.all(steps > 0):
        row = int(np.argmax(steps <= 0)) + 1
        raise DataError(
            "streams.time_falls", before=float(times[row - 1]), time=float(times[row]), row=row
        )
    found = float(np.median(steps))
    whole = np.maximum(np.round(steps / found), 1.0)
    uneven = float(np.mean(np.abs(steps / found - whole) > _MOST_JITTER))
    found = float((times[-1] - times[0]) / np.sum(whole))
    if stated is None:
        return float(SAMPLE_PERIOD.checked(found, DataError, "sample period of the column time"))
    if abs(found / stated - 1) > MOST_PERIOD_ERROR:
        if uneven > _MOST_UNEVEN:
            raise DataError("streams.uneven_times", share=uneven)
        raise DataError("streams.period_of_times", stated=stated, found=found)
    return stated


def counter_of_times(
    times: FloatArray, period: float, before: tuple[float, int] | None
) -> IntArray:
    """Return the trigger count (n,) of each time [s]; a gap in time is a gap in the count.

    before: time [s] and trigger count of the row before these, None for the first rows
    The count advances from row to row, because clocks drift and the period has few digits. Raises
    DataError where a time falls, or lies between two samples.
    """
    TIME.checked_all(times, DataError, "time")
    time, number = before if before is not None else (times[0] - period, -1)
    steps = np.diff(times, prepend=time) / period
    whole = np.round(steps)
    off = np.abs(steps - whole)
    if np.max(off, initial=0.0) > _MOST_JITTER:
        row = int(np.argmax(off))
        raise DataError(
            "streams.off_grid", time=float(times[row]), periods=float(steps[row]), period=period
        )
    if np.min(whole, initial=1.0) < 1:
        row = int(np.argmin(whole))
        raise DataError("streams.time_repeats", time=float(times[row]))
    return np.asarray(number + np.cumsum(whole).astype(np.int64))


def counter_of_triggers(values: FloatArray, before: int) -> IntArray:
    """Return the trigger count (n,) of each row; raise DataError unless whole and rising."""
    whole = np.isfinite(values) & (values == np.round(values))
    if not np.all(whole):
        bad = int(np.argmin(whole))
        last = before if bad == 0 else values[bad - 1]
        raise DataError("streams.trigger", value=float(values[bad]), before=float(last))
    COUNTER.checked_all(values, DataError, "trigger")
    counter = values.astype(np.int64)
    steps = np.diff(counter, prepend=before)
    if not np.all(steps > 0):
        row = int(np.argmax(steps <= 0))
        raise DataError(
            "streams.trigger_falls", before=int(counter[row] - steps[row]), value=int(counter[row])
        )
    return counter


@dataclass(frozen=True, slots=True)
class TableRows:
    """Counts and times of some rows of a recording.

    counter: trigger count (n,);  elapsed: time (n,) [s] after ``start`` [s since 1970]
    period: from trigger to trigger [s]
    """

    counter: IntArray
    elapsed: FloatArray
    period: float
    start: float

    def parts(self) -> Iterator[tuple[slice, int, int]]:
        """Yield rows, stamp [ns] and count of each run of consecutive counts, at most a block."""
        edges = [0, *(np.flatnonzero(np.diff(self.counter) != 1) + 1).tolist(), len(self.counter)]
        # Split, because a float of seconds since 1970 resolves a quarter of a microsecond.
        whole, fraction = divmod(self.start, 1.0)
        for begin, end in pairwise(edges):
            for low in range(begin, end, _BLOCK_SAMPLES):
                elapsed = round((fraction + float(self.elapsed[low])) * NANOSECONDS_PER_S)
                stamp_ns = int(whole) * NANOSECONDS_PER_S + elapsed
                yield slice(low, min(low + _BLOCK_SAMPLES, end)), stamp_ns, int(self.counter[low])


def axis_blocks(
    table: Mapping[str, FloatArray], mapped: ColumnMap, rows: TableRows
) -> Iterator[AxisBlock]:
    """Yield axis blocks of ``rows``, cut at gaps in the count; ``table``: column name → (n,)."""
    for axis in ("b", "c"):
        if mapped.has(axis):
            check_turns(table[mapped.columns[axis].name], mapped.columns[axis].unit, axis)
    channels = {c: _channel(table, mapped.columns[c], len(rows.counter)) for c in AXES}
    for part, stamp_ns, first in rows.parts():
        yield AxisBlock(
            stamp_ns=stamp_ns,
            first_sample=first,
            sample_period=rows.period,
            **{c: values[part] for c, values in channels.items()},  # type: ignore[arg-type]
        )


def distance_blocks(
    table: Mapping[str, FloatArray], mapped: ColumnMap, rows: TableRows
) -> Iterator[DistanceBlock]:
    """Yield distance blocks of ``rows``; NaN and ``invalid`` readings have no target."""
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
    with np.errstate(invalid="ignore", over="ignore"):  # callers report NaN
        return np.asarray(table[column.name] * column.factor)


def check_share(values: FloatArray, unit: str) -> None:
    """Raise DataError if the median of ``values`` (n,), shares of full intensity, exceeds 1."""
    finite = values[np.isfinite(values)]
    middle = float(np.median(finite)) if len(finite) else 0.0
    if unit and middle > 1:
        raise DataError("streams.share" if unit == "1" else "streams.share_count", median=middle)


def check_turns(values: FloatArray, unit: str, axis: str) -> None:
    """Raise DataError if the angle of an axis wraps after one turn in another unit.

    values: (n,) in ``unit``, in order. An axis that turns one way, stays within a turn of some
    unit and falls back by that turn is in that unit: 359.3, 0.1, 0.8 are not radians.
    """
    finite = values[np.isfinite(values)]
    steps = np.diff(finite)
    if unit not in _TURNS or len(steps) < 2:
        return
    step, extent = float(np.median(steps)), float(np.ptp(finite))
    back = float(np.max(-np.sign(step) * steps))
    fits = [u for u, turn in _TURNS.items() if _NEARLY_ONE * turn < back and extent <= turn]
    if fits and unit not in fits and 0 < 10 * abs(step) < back:
        raise DataError("streams.turn", axis=axis, back=back, fitting=fits[0], unit=unit)
