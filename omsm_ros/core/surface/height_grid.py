"""Height maps on an even grid, as points and as nominal surfaces; slopes of surfaces."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import scipy  # whose parts are loaded when they are used

from omsm_ros.core.kinematics.kinematics import Surface, slopes_by_differences
from omsm_ros.core.streams.blocks import FloatArray, IntArray
from omsm_ros.core.surface.measured_points import MeasuredPoints, measured
from omsm_ros.errors import DataError
from omsm_ros.quantities import MAP_SPACING, POSITION
from omsm_ros.units import MICROMETRE_M

# Largest deviation of a coordinate from the grid, in spacings, from rounding to five digits.
_LARGEST_DEVIATION = 0.02
# Resolution of a coordinate relative to its extent, finer than a map of 100 000 columns.
_LEVEL = 1e-7
# Least share of measured places of a map; fewer points are a list.
_LEAST_FILLED = 0.2
# Rounding of a place on the edge of a map, in spacings.
_SLACK = 1e-9


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class HeightGrid:
    """A map: ``height[row, column]`` [m] at ``x0 + column·dx``, ``y0 + row·dy``; NaN = missing.

    Raises DataError for implausible spacings or positions, or an array that is no map.
    """

    height: FloatArray
    x0: float
    y0: float
    dx: float
    dy: float

    def __post_init__(self) -> None:
        if self.height.ndim != 2 or not self.height.size:
            raise DataError("surface.map", shape=self.height.shape)
        for name in ("dx", "dy"):
            MAP_SPACING.checked(getattr(self, name), DataError, f"spacing {name} of the map")
        for name in ("x0", "y0"):
            POSITION.checked(getattr(self, name), DataError, f"{name} of the map")

    @property
    def x(self) -> FloatArray:
        """Positions of the columns [m]."""
        return np.asarray(self.x0 + self.dx * np.arange(self.height.shape[1]), np.float64)

    @property
    def y(self) -> FloatArray:
        """Positions of the rows [m]."""
        return np.asarray(self.y0 + self.dy * np.arange(self.height.shape[0]), np.float64)

    def points(self, notes: tuple[str, ...] = ()) -> MeasuredPoints:
        """Return the points with a height, row by row."""
        x, y = np.meshgrid(self.x, self.y)
        return measured(x.ravel(), y.ravel(), self.height.ravel(), notes=notes)


def as_grid(points: MeasuredPoints) -> HeightGrid | None:
    """Return the map with the points as its places, not interpolated; None if not on a grid."""
    columns, rows = _levels(points.x), _levels(points.y)
    if columns is None or rows is None:
        return None
    (column, x0, dx), (row, y0, dy) = columns, rows
    shape = (int(row.max()) + 1, int(column.max()) + 1)
    if min(shape) < 2 or shape[0] * shape[1] * _LEAST_FILLED > len(points):
        return None
    cell = row * shape[1] + column
    height = np.full(shape[0] * shape[1], np.nan)
    height[cell] = points.height
    if np.count_nonzero(np.isfinite(height)) != len(cell):  # several points at one place
        return None
    return HeightGrid(height=height.reshape(shape), x0=x0, y0=y0, dx=dx, dy=dy)


def _levels(values: FloatArray) -> tuple[IntArray, float, float] | None:
    """Return the level of each value (n,), the first level and their step; None if uneven."""
    least, span = float(values.min()), float(np.ptp(values))
    if span < MAP_SPACING.low:
        return None
    found = np.unique(np.round((values - least) / (span * _LEVEL)))
    steps = np.diff(found)
    steps = steps[steps > 3]  # rounding of equal coordinates
    if not len(steps) or len(steps) > len(values) // 2:
        return None
    step = span / max(round(1 / (float(np.median(steps)) * _LEVEL)), 1)
    level = (values - least) / step
    number = np.round(level)
    if float(np.max(np.abs(level - number))) > _LARGEST_DEVIATION:
        return None
    return number.astype(np.int64), least, step


class GridSurface:
    """A map as a nominal surface, interpolated by cubic splines.

    The height is NaN beyond its edges and where one of the four places around is missing. Raises
    DataError for a map of fewer than four rows or columns.
    """

    def __init__(self, grid: HeightGrid) -> None:
        if min(grid.height.shape) < 4:
            raise DataError("surface.small_map", shape=grid.height.shape)
        self._grid = grid
        # Missing places are filled, so that the spline in the complete cells is smooth.
        filled = np.where(np.isfinite(grid.height), grid.height, _filled(grid.height))
        self._spline = scipy.interpolate.RectBivariateSpline(grid.y, grid.x, filled)
        # NaN where one of the four places around is missing; the edges belong to the map.
        y, x = (np.r_[v[0] - s, v[1:-1], v[-1] + s] for v, s in
                ((grid.y, _SLACK * grid.dy), (grid.x, _SLACK * grid.dx)))  # fmt: skip
        linear = scipy.interpolate.RegularGridInterpolator
        self._linear = linear((y, x), grid.height, bounds_error=False)

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m]; NaN where the map has none."""
        return self._at(x, y, 0, 0)

    def gradient(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the slopes ∂z/∂x, ∂z/∂y [1]."""
        return self._at(x, y, 1, 0), self._at(x, y, 0, 1)

    def _at(self, x: FloatArray, y: FloatArray, dx: int, dy: int) -> FloatArray:
        across, along = (np.asarray(v, np.float64) for v in np.broadcast_arrays(x, y))
        known = np.isfinite(self._linear((along, across)))
        places = (np.where(known, v, start) for v, start in
                  ((along, self._grid.y0), (across, self._grid.x0)))  # fmt: skip
        return np.where(known, self._spline.ev(*places, dx=dy, dy=dx), np.nan)


def _filled(height: FloatArray) -> FloatArray:
    """Return the map with missing places interpolated along the row, or the mean of the map."""
    made = np.full_like(height, np.nanmean(height))
    index = np.arange(height.shape[1])
    for row, values in enumerate(height):
        known = np.isfinite(values)
        if np.any(known):
            made[row] = np.interp(index, index[known], values[known])
    return made


Gradient: TypeAlias = tuple[FloatArray, FloatArray]
"""Slopes ∂z/∂x and ∂z/∂y [1], each of the shape of x and y."""

# Step of central differences for a shape without slopes. Their error is step²/6 times the third
# derivative, 1e-9 on an optic with a radius of 50 mm; rounding of the height is 1e-17 m.
_STEP_M = 2 * MICROMETRE_M


def gradient_of(surface: Surface, x: FloatArray, y: FloatArray) -> Gradient:
    """Return the slopes of ``surface`` at x, y [m], by differences if it has no gradient."""
    in_closed_form: Callable[..., Gradient] | None = getattr(surface, "gradient", None)
    if in_closed_form is None:
        return slopes_by_differences(surface, x, y, _STEP_M)
    return in_closed_form(x, y)


def unit_normal(slope_x: FloatArray, slope_y: FloatArray) -> FloatArray:
    """Return the upward unit normals (3, …) of a surface with these slopes."""
    length = np.sqrt(1 + slope_x**2 + slope_y**2)
    return np.stack([-slope_x / length, -slope_y / length, 1 / length])
