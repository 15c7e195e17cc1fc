"""Convert recordings of other programs to a bag."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from omsm_ros.core.streams.blocks import AxisBlock, DistanceBlock, FloatArray
from omsm_ros.core.streams.imported_columns import (
    AXES,
    COUNTING,
    MOST_PERIOD_ERROR,
    PROBE,
    ColumnMap,
    TableRows,
    axis_blocks,
    check_epoch,
    counter_of_times,
    counter_of_triggers,
    distance_blocks,
    period_of,
    share_trigger,
)
from omsm_ros.errors import DataError, FileError, named_errors
from omsm_ros.io import bags
from omsm_ros.io.bag_writer import atomic_bag
from omsm_ros.io.tables.table import ForeignTable, TableForm, stated_unit
from omsm_ros.pipelines.progress import state_progress
from omsm_ros.quantities import shown
from omsm_ros.units import DATE, contradicts_unit

_ARRAYS, _TDMS = (".npy", ".npz", ".mat", ".h5", ".hdf5"), ".tdms"
_BAGS = (".mcap", ".bag", ".db3")


class RowCounter:
    """Number the rows of a stream by their triggers, else by their time, else one by one.

    start: instant [s, Unix] of ``epoch``, a time [s] of the recording
    zero: time [s] of the recording at trigger 0
    """

    def __init__(self, stream: str, mapped: ColumnMap, timed: bool, triggered: bool) -> None:
        """timed, triggered: whether the ``stream``, a file or topic, has these columns."""
        if not timed and mapped.sample_period is None:
            raise FileError(f"{stream} has no column of time; state sample_period in the map")
        self._mapped, self._timed, self._triggered = mapped, timed, triggered
        self._period = 0.0 if mapped.sample_period is None else mapped.sample_period
        self._last: tuple[float, int] | None = None
        self.start, self.epoch, self.zero = mapped.start, 0.0, 0.0

    def begin(self, first: Mapping[str, FloatArray]) -> tuple[float | None, float]:
        """Determine the period from the ``first`` rows; return time of trigger 0 and period [s]."""
        times = self._times(first)
        if times is None:
            return None, self._period
        check_epoch(float(times[0]), self._mapped.columns["time"], self._mapped.start)
        self._period = period_of(times, self._mapped.sample_period)
        number = self._triggers(first)[0] if self._triggered else 0
        return float(times[0]) - number * self._period, self._period

    def count(self, piece: Mapping[str, FloatArray]) -> TableRows:
        """Return the numbers and times of the next rows (column name → (n,))."""
        times = self._times(piece)
        number = -1 if self._last is None else self._last[1]
        if self._triggered:
            counter = counter_of_triggers(self._triggers(piece), number)
        elif times is not None:
            before = self._last or (self.zero - self._period, -1)
            counter = counter_of_times(times, self._period, before)
        else:
            counter = np.arange(number + 1, number + 1 + len(next(iter(piece.values()))))
        elapsed = counter * self._period if times is None else times - self.epoch
        self._last = (0.0 if times is None else float(times[-1]), int(counter[-1]))
        return TableRows(counter, elapsed, self._period, self.start)

    def _times(self, piece: Mapping[str, FloatArray]) -> FloatArray | None:
        if not self._timed:
            return None
        column = self._mapped.columns["time"]
        return np.asarray(piece[column.name] * column.factor)

    def _triggers(self, piece: Mapping[str, FloatArray]) -> FloatArray:
        return piece[self._mapped.columns["trigger"].name]


@dataclass(slots=True)
class ImportedFile:
    """Result of the import of one file, or of one topic of a bag.

    missing: missing trigger numbers;  invalid: invalid probe readings
    lost: rows with an axis that is not a number;  repeated_names: repeated header lines
    passed_over: messages without any of the columns
    own_clock: whether it has no trigger in common with the others, only time
    """

    file: str
    rows: int = 0
    axes: bool = False
    distance: bool = False
    sample_period: float = 0.0
    missing: int = 0
    invalid: int = 0
    lost: int = 0
    repeated_names: int = 0
    passed_over: int = 0
    own_clock: bool = False


def import_recording(
    files: Sequence[Path], mapped: ColumnMap, written: TableForm, out: Path
) -> list[ImportedFile]:
    """Write the bag ``out`` from ``files``; each has the axes, the probe, or both.

    Files with the same columns are concatenated. A file of axes and one of the probe are joined
    by their trigger numbers, their times, or row by row. Raises FileError and DataError for
    missing or ambiguous data; the bag is then not written.
    """
    with ExitStack() as opened:
        sources = []
        for path in files:
            for table in open_tables(path, written, mapped.names((*AXES, *PROBE))):
                opened.callback(table.close)
                sources.append(_Source(table, mapped))
        _write_bag(sources, mapped, out)
        return [source.found for source in sources]


def _write_bag(sources: Sequence[_Source], mapped: ColumnMap, out: Path) -> None:
    chains: dict[tuple[str, ...], list[_Source]] = {}
    for source in sources:
        chains.setdefault(source.channels, []).append(source)
    _check_streams(sources, list(chains), mapped)
    streams = [_Stream(chain, mapped) for chain in chains.values()]
    _align(streams, mapped)
    topics = [bags.AXES_TOPIC] * any(source.found.axes for source in sources)
    topics += [bags.DISTANCE_TOPIC] * any(source.found.distance for source in sources)
    done = 0
    with atomic_bag(out, topics) as bag:
        # Ordered by time, as in a recording, so that readers need not buffer one stream.
        merged = heapq.merge(*(s.blocks() for s in streams), key=lambda block: block.stamp_ns)
        for block in merged:
            bag.write_block(block)
            done += len(block)
            state_progress(done, 0)
        gaps = [s for s in streams if any(source.found.missing for source in s.sources)]
        uncounted = [s for s in streams if not s.counted]
        if gaps and uncounted:
            raise FileError(
                f"triggers are missing in {gaps[0].sources[0].found.file}, and "
                f"{uncounted[0].sources[0].found.file} has neither trigger nor time to assign its "
                "rows by; add one of these columns"
            )


def _check_streams(
    sources: Sequence[_Source], chains: list[tuple[str, ...]], mapped: ColumnMap
) -> None:
    """Raise FileError unless each stream is complete and from files with the same columns."""
    for channel in mapped.columns:
        if not mapped.has(channel):
            continue
        holders, name = [c for c in chains if channel in c], mapped.columns[channel].name
        if not holders:
            raise FileError("; ".join(source.without(name, channel) for source in sources))
        if len(holders) > 1 and channel not in COUNTING:
            raise FileError(
                f"files with different columns have the column {name!r} of {channel}; import them "
                "one by one, or leave out those that repeat it"
            )


class _Stream:
    """Files of the same columns, one after the other, with one row counter."""

    def __init__(self, sources: Sequence[_Source], mapped: ColumnMap) -> None:
        self.sources = sources
        channels = sources[0].channels
        self.triggered = "trigger" in channels
        self.counted = bool({*COUNTING} & {*channels})
        self.counter = RowCounter(sources[0].found.file, mapped, "time" in channels, self.triggered)
        first = sources[0].first()
        with named_errors(DataError, sources[0].found.file, DataError):
            self.begins, self.period = self.counter.begin(first)

    def blocks(self) -> Iterator[AxisBlock | DistanceBlock]:
        """Yield the blocks of all files."""
        for source in self.sources:
            yield from source.blocks(self.counter)


def _align(streams: Sequence[_Stream], mapped: ColumnMap) -> None:
    """Start the count of all streams at one origin, if their times share a trigger."""
    begun = [s.begins for s in streams if s.begins is not None]
    if not begun:
        return
    epoch = min(begun)
    start = epoch if mapped.dated else mapped.start
    counted = len(begun) < len(streams) or any(s.triggered for s in streams)
    together = counted or share_trigger(begun, [s.period for s in streams])
    for stream in streams:
        own = stream.begins is not None and not together
        stream.counter.start, stream.counter.epoch = start, epoch
        stream.counter.zero = stream.begins if own else epoch
        for source in stream.sources:
            source.found.own_clock = own


class _Source:
    """One table, and the results of reading it."""

    def __init__(self, table: ForeignTable, mapped: ColumnMap) -> None:
        self._table, self._mapped = table, mapped
        self._last: int | None = None
        wanted = [c for c in (*AXES, *PROBE, *COUNTING) if mapped.has(c)]
        self.channels = tuple(c for c in wanted if table.names.count(mapped.columns[c].name) == 1)
        streams = {*self.channels} - {*COUNTING}
        axes, probe = streams & {*AXES}, "distance" in streams
        self.found = ImportedFile(table.label, axes=bool(axes), distance=probe)
        lacking = [a for a in AXES if mapped.has(a) and a not in streams] if axes else []
        if lacking:
            name = mapped.columns[lacking[0]].name
            raise FileError(f"{self.without(name, lacking[0])}; give all axes in one file")
        table.used(mapped.names(self.channels))
        for channel in self.channels:
            column = mapped.columns[channel]
            stated = stated_unit(table, column.name)
            if contradicts_unit(stated, column.unit, channel):
                raise FileError(
                    f"{table} has {column.name!r} in {stated}, the map in {column.unit}; "
                    f"correct the map, or, if the file is wrong, write unit: count and count: what "
                    "one is in SI"
                )
        period = mapped.sample_period
        stated = table.sample_period
        if stated and period and abs(period / stated - 1) > MOST_PERIOD_ERROR:
            raise FileError(
                f"{table} states a sample period of {stated:g} s, the map {period:g} s; "
                "correct the map"
            )

    def without(self, name: str, channel: str) -> str:
        """Return why the column ``name`` of ``channel`` is not available here."""
        if often := self._table.names.count(name):
            return (
                f"{self._table} has {often} columns {name!r}, of which {channel} is one; "
                "rename the others"
            )
        return (
            f"{self._table} has no column {name!r} of {channel}, but {shown(self._table.names)}; "
            "name it as the file does"
        )

    def first(self) -> Mapping[str, FloatArray]:
        """Return the first rows; FileError if there are none."""
        for piece in self._pieces():
            return piece
        raise FileError(f"{self._table} has no row of numbers; check that it was written")

    def blocks(self, counter: RowCounter) -> Iterator[AxisBlock | DistanceBlock]:
        """Yield the file's blocks; ``counter`` continues from the file before."""
        found = self.found
        for piece in self._pieces():
            with named_errors(DataError, found.file, DataError):
                rows = counter.count(piece)
            before = int(rows.counter[0]) - 1 if self._last is None else self._last
            skipped = np.diff(rows.counter, prepend=before) - 1
            self._last = int(rows.counter[-1])
            found.missing += int(np.sum(skipped))
            found.rows += len(rows.counter)
            found.sample_period = rows.period
            for block in axis_blocks(piece, self._mapped, rows) if found.axes else ():
                finite = [np.isfinite(v) for v in (block.x, block.y, block.z, block.b, block.c)]
                found.lost += int(np.sum(~np.all(finite, axis=0)))
                yield block
            for reading in distance_blocks(piece, self._mapped, rows) if found.distance else ():
                found.invalid += int(np.sum(~reading.ok))
                yield reading
        found.repeated_names = self._table.repeated_names
        found.passed_over = self._table.passed_over

    def _pieces(self) -> Iterator[dict[str, FloatArray]]:
        names = list(dict.fromkeys(self._mapped.names(self.channels)))
        time = self._mapped.columns.get("time")
        dates = [n for n in names if time is not None and time.unit == DATE and n == time.name]
        return self._table.pieces(names, dates)


def open_tables(path: Path, form: TableForm, wanted: Sequence[str]) -> list[ForeignTable]:
    """Return the tables of a recording that have some of the columns ``wanted``.

    A file has one table; a bag has one for each topic. Raises FileError if it cannot be read, or
    has none of the columns.
    """
    suffix = path.suffix.lower()
    if suffix in _BAGS or (path / "metadata.yaml").is_file():
        return _topics(path.parent if suffix == ".db3" else path, wanted)
    table = _table(path, suffix, form)
    if not any(table.names.count(name) == 1 for name in wanted):
        table.close()
        hint = table.hint(wanted) or "name the columns as it does, each once"
        held = table.names[:20] or "no column of numbers at all"
        raise FileError(f"{table} has none of the columns {list(wanted)}, but {held}; {hint}")
    return [table]


def _table(path: Path, suffix: str, form: TableForm) -> ForeignTable:
    # Imported when needed: some are optional packages, and all take time to load.
    if suffix in (*_ARRAYS, _TDMS):
        from omsm_ros.io.tables.binary_table import ArrayTable, TdmsTable

        return TdmsTable(path) if suffix == _TDMS else ArrayTable(path)
    from omsm_ros.io.tables.text_table import TextTable

    return TextTable(path, form)


def _topics(path: Path, wanted: Sequence[str]) -> list[ForeignTable]:
    from omsm_ros.io.tables.binary_table import topics_of

    topics = topics_of(path)
    found: list[ForeignTable] = [t for t in topics if set(t.names) & set(wanted)]
    if not found:
        for topic in topics:
            topic.close()
        held = [name for t in topics for name in t.names if name.startswith("/")]
        raise FileError(
            f"bag {str(path)!r} has none of the columns {list(wanted)}, but {held[:20]}; "
            "name them by topic and field"
        )
    return found
