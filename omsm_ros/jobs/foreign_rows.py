"""Which trigger number has each row of a foreign recording, and when was it taken?"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.core.samples.foreign_columns import (
    ColumnMap,
    Rows,
    check_epoch,
    counter_of_times,
    counter_of_triggers,
    period_of,
)
from omsm_ros.errors import FileError


@dataclass(frozen=True, slots=True)
class Origin:
    """Where a stream's time and count begin.

    start: instant [s, Unix] of ``epoch``, a time [s] of the recording;  zero: that of trigger 0
    """

    start: float = 0.0
    epoch: float = 0.0
    zero: float = 0.0


class RowCounter:
    """Counts the rows of a stream by their triggers, else by their time, else one by one."""

    def __init__(self, stream: str, mapped: ColumnMap, timed: bool, triggered: bool) -> None:
        """timed, triggered: which of both columns the ``stream``, a file or topic, has."""
        if not timed and mapped.sample_period is None:
            raise FileError(f"{stream} has no column of time; state sample_period in the map")
        self._mapped, self._timed, self._triggered = mapped, timed, triggered
        self._period = 0.0 if mapped.sample_period is None else mapped.sample_period
        self._last: tuple[float, int] | None = None
        self.origin = Origin(mapped.start)

    def begin(self, first: Mapping[str, FloatArray]) -> tuple[float | None, float]:
        """Take the period from the ``first`` rows; return the time of trigger 0, and it [s]."""
        times = self._times(first)
        if times is None:
            return None, self._period
        check_epoch(float(times[0]), self._mapped.columns["time"], self._mapped.start)
        self._period = period_of(times, self._mapped.sample_period)
        number = self._triggers(first)[0] if self._triggered else 0
        return float(times[0]) - number * self._period, self._period

    def count(self, piece: Mapping[str, FloatArray]) -> Rows:
        """Return the numbers and times of the next rows (column name → (n,))."""
        times, origin = self._times(piece), self.origin
        number = -1 if self._last is None else self._last[1]
        if self._triggered:
            counter = counter_of_triggers(self._triggers(piece), number)
        elif times is not None:
            before = self._last or (origin.zero - self._period, -1)
            counter = counter_of_times(times, self._period, before)
        else:
            counter = np.arange(number + 1, number + 1 + len(next(iter(piece.values()))))
        elapsed = counter * self._period if times is None else times - origin.epoch
        self._last = (0.0 if times is None else float(times[-1]), int(counter[-1]))
        return Rows(counter, elapsed, self._period, origin.start)

    def _times(self, piece: Mapping[str, FloatArray]) -> FloatArray | None:
        if not self._timed:
            return None
        column = self._mapped.columns["time"]
        return np.asarray(piece[column.name] * column.factor)

    def _triggers(self, piece: Mapping[str, FloatArray]) -> FloatArray:
        return piece[self._mapped.columns["trigger"].name]
