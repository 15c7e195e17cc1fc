"""A recording of another program, made into a bag."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from omsm_ros.core.samples.blocks import AxisBlock, DistanceBlock, FloatArray, IntArray
from omsm_ros.core.samples.foreign_columns import (
    AXES,
    COUNTING,
    PROBE,
    ColumnMap,
    axis_blocks,
    counter_of_times,
    counter_of_triggers,
    distance_blocks,
    period_of,
)
from omsm_ros.errors import FileError
from omsm_ros.jobs.read_bag import Progress, no_progress
from omsm_ros.storage import bags
from omsm_ros.storage.foreign_tables import ForeignTable, TextForm
from omsm_ros.storage.recording.bag_writer import whole_bag


@dataclass(slots=True)
class ImportedFile:
    """What came out of one file.

    missing: trigger numbers that it skips;  invalid: readings of the probe that are none
    lost: rows where an axis is no number;  repeated_names: lines that repeat the line of names
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


def import_recording(
    files: Sequence[Path],
    mapped: ColumnMap,
    written: TextForm,
    out: Path,
    progress: Progress = no_progress,
) -> list[ImportedFile]:
    """Write the bag ``out`` from ``files``; each has the axes, the probe, or both.

    Files with the same columns continue each other; a file of axes and one of the probe lie
    side by side, row by row, or by their columns of trigger numbers or time. Raises FileError and
    DataError for what is missing or unclear; the bag then does not appear.
    """
    sources = [_Source(ForeignTable(path, written), mapped) for path in files]
    chains: dict[tuple[str, ...], list[_Source]] = {}
    for source in sources:
        chains.setdefault(source.channels, []).append(source)
    _check_streams(list(chains), mapped)
    topics = [bags.AXES_TOPIC] * any("z" in c for c in chains)
    topics += [bags.DISTANCE_TOPIC] * any("distance" in c for c in chains)
    done = 0
    with whole_bag(out, topics) as bag:
        # By time, as they would have been recorded, so that no reader has to keep one back.
        merged = heapq.merge(*map(_continued, chains.values()), key=lambda block: block.stamp_ns)
        for block in merged:
            if isinstance(block, AxisBlock):
                bag.write_axes(block)
            else:
                bag.write_distance(block)
            done += len(block)
            progress(done, 0)
    return [source.found for source in sources]


def _check_streams(chains: list[tuple[str, ...]], mapped: ColumnMap) -> None:
    """Every channel of the map comes from files of one kind, and each stream is whole."""
    for channel in mapped.columns:
        if not mapped.has(channel) or channel in COUNTING:
            continue
        holders = [c for c in chains if channel in c]
        if len(holders) != 1:
            found = "no file has" if not holders else "files with different columns have"
            raise FileError(
                f"{found} the column {mapped.columns[channel].name!r} of {channel}; "
                "name it as the file's line of names does, in one kind of file"
            )


def _continued(sources: Iterable[_Source]) -> Iterator[AxisBlock | DistanceBlock]:
    last: tuple[float, int] | None = None
    for source in sources:
        yield from source.blocks(last)
        last = source.last


class _Source:
    """One file, and how far it was read."""

    def __init__(self, table: ForeignTable, mapped: ColumnMap) -> None:
        self._table, self._mapped = table, mapped
        wanted = [c for c in (*AXES, *PROBE, *COUNTING) if mapped.has(c)]
        self.channels = tuple(c for c in wanted if table.names.count(mapped.columns[c].name) == 1)
        streams = {*self.channels} - {*COUNTING}
        if not streams:
            wanted_names = [mapped.columns[c].name for c in wanted]
            raise FileError(
                f"{table} has none of the columns {wanted_names}, but {table.names[:20]}; "
                "name the columns as its line of names does, each once"
            )
        self.last: tuple[float, int] | None = None
        axes, probe = streams & {*AXES}, "distance" in streams
        self.found = ImportedFile(str(table.path), axes=bool(axes), distance=probe)
        lacking = [a for a in AXES if mapped.has(a) and a not in streams] if axes else []
        if lacking:
            raise FileError(
                f"{table} has {sorted(axes)}, but not {lacking}; axes are latched together and "
                "come from one file"
            )

    def blocks(self, before: tuple[float, int] | None) -> Iterator[AxisBlock | DistanceBlock]:
        """Yield the file's blocks; ``before``: time [s] and number of the row before its first."""
        self.last = before
        names = self._mapped.names(self.channels)
        for piece in self._table.pieces(list(dict.fromkeys(names))):
            counter = self._counted(piece)
            yield from self._made(piece, counter)
        self.found.repeated_names = self._table.repeated_names
        if not self.found.rows:
            raise FileError(f"{self._table} has no row of numbers; check that it was written")

    def _made(
        self, piece: dict[str, FloatArray], counter: IntArray
    ) -> Iterator[AxisBlock | DistanceBlock]:
        found = self.found
        period = found.sample_period
        if found.axes:
            for block in axis_blocks(piece, self._mapped, counter, period):
                finite = [np.isfinite(v) for v in (block.x, block.y, block.z, block.b, block.c)]
                found.lost += int(np.sum(~np.all(finite, axis=0)))
                yield block
        if found.distance:
            for reading in distance_blocks(piece, self._mapped, counter, period):
                found.invalid += int(np.sum(~reading.ok))
                yield reading

    def _counted(self, piece: dict[str, FloatArray]) -> IntArray:
        """Trigger number of each row: from its column, from time, or row by row."""
        columns, found = self._mapped.columns, self.found
        rows = len(next(iter(piece.values())))
        number = -1 if self.last is None else self.last[1]
        times = piece[columns["time"].name] * columns["time"].factor if self._has("time") else None
        if times is not None and not found.sample_period:
            found.sample_period = period_of(times, self._mapped.sample_period)
        if not found.sample_period:
            if self._mapped.sample_period is None:
                raise FileError(f"{self._table} has no column of time; give sample_period")
            found.sample_period = self._mapped.sample_period
        if self._has("trigger"):
            counter = counter_of_triggers(piece[columns["trigger"].name], number)
        elif times is not None:
            counter = counter_of_times(times, found.sample_period, self.last)
        else:
            counter = np.arange(number + 1, number + 1 + rows)
        first = int(counter[0]) if not found.rows else number + 1
        found.rows += rows
        found.missing += int(counter[-1]) + 1 - first - rows
        self.last = (float(times[-1]) if times is not None else 0.0, int(counter[-1]))
        return counter

    def _has(self, channel: str) -> bool:
        return channel in self.channels
