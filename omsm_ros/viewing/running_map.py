"""Which map do the points of a scan make while it grows, in bounded memory?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.samples.blocks import FloatArray, IntArray

# Smaller than any aperture: the first points may all lie in one place.
_LEAST_SPAN_M = 1e-5
# While so few have come, the grid is laid out anew around all of them: ten turns of a spiral, whose
# first one tells how wide it is. After that it doubles.
_EARLY_POINTS = 20_000
_MARGIN = 1.05


@dataclass(frozen=True, slots=True)
class Grid:
    """Where the cells lie: ``cells`` by ``cells`` of ``pitch`` [m] from ``left``, ``bottom`` [m].

    generation: another one whenever the cells before mean nothing any more
    """

    left: float
    bottom: float
    pitch: float
    cells: int
    generation: int


class RunningMap:
    """Mean of some values in each cell of a square grid that doubles its pitch as points demand.

    Memory is that of the cells, whatever the number of points; what was taken in stays in. Every
    change of a cell has a version, so that any number of readers can ask what is new to them.
    """

    def __init__(self, values: int, cells: int = 400) -> None:
        """values: of each point;  cells: along a side, even."""
        self._values, self._cells = values, cells
        self._grid: Grid | None = None
        self._version = self._next_generation = 0
        self._early: list[tuple[FloatArray, FloatArray, FloatArray]] | None = []
        self._clear()

    def _clear(self) -> None:
        cells = self._cells
        self._count = np.zeros((cells, cells), np.int64)
        self._sum = np.zeros((cells, cells, self._values))
        self._changed = np.zeros((cells, cells), np.int64)

    @property
    def grid(self) -> Grid | None:
        """Where the cells lie now; None before the first point."""
        return self._grid

    @property
    def version(self) -> int:
        """Of the newest change."""
        return self._version

    @property
    def points(self) -> int:
        """Points taken in."""
        return int(np.sum(self._count))

    def restart(self) -> None:
        """Forget all points: another part, or another scan of it."""
        generation = 0 if self._grid is None else self._grid.generation + 1
        self._clear()
        self._version += 1
        self._grid, self._early = None, []
        self._next_generation = generation

    def add(self, x: FloatArray, y: FloatArray, values: FloatArray) -> int:
        """Take in points at ``x``, ``y`` (n,) [m] with ``values`` (n, k); return how many.

        A point with anything that is no finite number is left out.
        """
        good = np.isfinite(x) & np.isfinite(y) & np.all(np.isfinite(values), axis=1)
        x, y, values = x[good], y[good], values[good]
        if not len(x):
            return 0
        self._remember(x, y, values)
        if self._grid is None or not self._holds(x, y):
            if self._early is not None:
                self._lay_out()
                return len(x)
            while not self._holds(x, y):
                self._double(x, y)
        self._enter(x, y, values)
        return len(x)

    def _remember(self, x: FloatArray, y: FloatArray, values: FloatArray) -> None:
        if self._early is None:
            return
        if self._grid is not None and sum(len(part) for part, *_ in self._early) > _EARLY_POINTS:
            self._early = None
            return
        self._early.append((x, y, values))

    def _enter(self, x: FloatArray, y: FloatArray, values: FloatArray) -> None:
        assert self._grid is not None
        column = ((x - self._grid.left) / self._grid.pitch).astype(np.intp)
        row = ((y - self._grid.bottom) / self._grid.pitch).astype(np.intp)
        self._version += 1
        np.add.at(self._count, (row, column), 1)
        np.add.at(self._sum, (row, column), values)
        self._changed[row, column] = self._version

    def _lay_out(self) -> None:
        """Lay the grid around all points so far, and enter them."""
        assert self._early is not None
        x, y, values = (np.concatenate(parts) for parts in zip(*self._early, strict=True))
        span = max(float(np.ptp(x)), float(np.ptp(y)), _LEAST_SPAN_M) * _MARGIN
        left = (float(x.min()) + float(x.max()) - span) / 2
        bottom = (float(y.min()) + float(y.max()) - span) / 2
        if self._grid is not None:
            self._next_generation = self._grid.generation + 1
        self._grid = Grid(left, bottom, span / self._cells, self._cells, self._next_generation)
        self._clear()
        self._enter(x, y, values)

    def _holds(self, x: FloatArray, y: FloatArray) -> bool:
        assert self._grid is not None
        size = self._grid.pitch * self._cells
        right, top = self._grid.left + size, self._grid.bottom + size
        return bool(
            x.min() >= self._grid.left
            and y.min() >= self._grid.bottom
            and x.max() < right
            and y.max() < top
        )

    def _double(self, x: FloatArray, y: FloatArray) -> None:
        """Merge cells by fours into one quarter of the grid: the one that leaves room for these."""
        old = self._grid
        assert old is not None
        half, size = self._cells // 2, old.pitch * self._cells
        to_left = bool(x.min() < old.left)
        below = bool(y.min() < old.bottom)
        count = self._count.reshape(half, 2, half, 2).sum(axis=(1, 3))
        total = self._sum.reshape(half, 2, half, 2, self._values).sum(axis=(1, 3))
        self._clear()
        rows = slice(half, None) if below else slice(0, half)
        columns = slice(half, None) if to_left else slice(0, half)
        self._count[rows, columns], self._sum[rows, columns] = count, total
        self._version += 1
        self._changed[rows, columns] = np.where(count > 0, self._version, 0)
        self._grid = Grid(
            old.left - size * to_left,
            old.bottom - size * below,
            2 * old.pitch,
            self._cells,
            old.generation + 1,
        )

    def since(self, version: int) -> tuple[IntArray, NDArray[np.float32]]:
        """Return the cells that changed after ``version``: place (m,), row by row; means (m, k).

        After another generation of the grid ask with 0.
        """
        place = np.flatnonzero(self._changed.ravel() > version)
        count = self._count.ravel()[place]
        means = self._sum.reshape(-1, self._values)[place] / count[:, np.newaxis]
        return place, means.astype(np.float32)
