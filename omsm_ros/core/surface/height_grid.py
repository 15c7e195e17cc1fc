"""Heights at the crossings of evenly spaced rows and columns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray, IntArray
from omsm_ros.core.surface.measured_points import MeasuredPoints, measured
from omsm_ros.errors import DataError

# Coordinates written with five digits lie this much of a spacing beside their place.
_LARGEST_STRAY = 0.02
# Levels of a coordinate, as shares of its extent: finer than any map of 100 000 columns.
_LEVEL = 1e-7
# A map of which less than this is measured is a list of places.
_LEAST_FILLED = 0.2


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class HeightGrid:
    """A map: ``height[row, column]`` [m] at ``x0 + column·dx``, ``y0 + row·dy``; NaN = missing.

    Raises DataError for spacings that are not positive, or a map that is none.
    """

    height: FloatArray
    x0: float
    y0: float
    dx: float
    dy: float

    def __post_init__(self) -> None:
        if self.height.ndim != 2 or not self.height.size:
            raise DataError(f"map of shape {self.height.shape!r}, expected rows and columns")
        for name in ("dx", "dy"):
            spacing = getattr(self, name)
            if not (np.isfinite(spacing) and spacing > 0):
                raise DataError(f"spacing {name} of the map is {spacing!r} m, expected above zero")

    @property
    def x(self) -> FloatArray:
        """Positions of the columns [m]."""
        return np.asarray(self.x0 + self.dx * np.arange(self.height.shape[1]), np.float64)

    @property
    def y(self) -> FloatArray:
        """Positions of the rows [m]."""
        return np.asarray(self.y0 + self.dy * np.arange(self.height.shape[0]), np.float64)

    def points(self, notes: tuple[str, ...] = ()) -> MeasuredPoints:
        """Return the places that have a height, row by row."""
        x, y = np.meshgrid(self.x, self.y)
        return measured(x.ravel(), y.ravel(), self.height.ravel(), notes=notes)


def as_grid(points: MeasuredPoints) -> HeightGrid | None:
    """Return the map that the points are, without any interpolation; None if they are none."""
    columns, rows = _levels(points.x), _levels(points.y)
    if columns is None or rows is None:
        return None
    (column, x0, dx), (row, y0, dy) = columns, rows
    shape = (int(row.max()) + 1, int(column.max()) + 1)
    if min(shape) < 2 or shape[0] * shape[1] * _LEAST_FILLED > len(points):
        return None
    cell = row * shape[1] + column
    if len(np.unique(cell)) != len(cell):
        return None
    height = np.full(shape[0] * shape[1], np.nan)
    height[cell] = points.height
    return HeightGrid(height=height.reshape(shape), x0=x0, y0=y0, dx=dx, dy=dy)


def _levels(values: FloatArray) -> tuple[IntArray, float, float] | None:
    """Return the level of each value (n,), the first level and their step; None if uneven."""
    least, span = float(values.min()), float(np.ptp(values))
    if span <= 0:
        return None
    found = np.unique(np.round((values - least) / (span * _LEVEL)))
    steps = np.diff(found)
    steps = steps[steps > 3]  # rounding of one and the same level
    if not len(steps) or len(steps) > len(values) // 2:
        return None
    step = span / max(round(1 / (float(np.median(steps)) * _LEVEL)), 1)
    level = (values - least) / step
    number = np.round(level)
    if float(np.max(np.abs(level - number))) > _LARGEST_STRAY:
        return None
    return number.astype(np.int64), least, step
