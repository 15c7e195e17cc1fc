"""Interpolate heights between measured points by local quadratic regression.

A trend, a polynomial of the whole surface, is subtracted first. The points are averaged in square
cells, so that a dense track counts no more than its neighbours. At each place a quadratic is
fitted to the surrounding cells, weighted by distance (tricube; Cleveland 1979). Wavelengths
shorter than the radius are averaged out. Places that the cells do not surround get no value.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from omsm_ros.core.kinematics.kinematics import PolynomialSurface
from omsm_ros.core.streams.blocks import BoolArray, FloatArray, IntArray
from omsm_ros.core.streams.statistics import spread
from omsm_ros.core.surface.height_grid import HeightGrid
from omsm_ros.core.surface.measured_points import MeasuredPoints
from omsm_ros.errors import DataError
from omsm_ros.quantities import MAP_SPACING

# The highest order that is compared; without it the surface would curve within a cell.
TREND_DEGREE = 6
# Seven hundred points for each of its 28 terms, and ten at least.
_TREND_POINTS, _ENOUGH_FOR_A_TREND = 20_000, 280
# Ratio of occupied cells at half the side from which the points fill the surface; at most 4.
_FILLED = 3.5
# A wave of the sixth order has nearly three cells.
_FEWEST_CELLS_ACROSS = 8
# Points at a time: eighteen neighbours of each, of six columns, are 17 MB.
_PORTION = 20_000
RADIUS_CELLS = 2.4
"""Radius of a local fit in sides of a cell: about eighteen cells for six coefficients."""
# One and a half times the six coefficients of a quadratic.
_LEAST_NEIGHBOURS = 9
# Largest variance of a value over that of the mean of one cell: 1/3 amid the points, more where
# the quadratic extrapolates.
_LARGEST_GAIN = 1.0
# Least eigenvalue of the scaled normal equations of an independent quadratic.
_WORST_CONDITION = 1e-6
# Factor of the radius, and places, for the estimate of the interpolation error (to 3 %).
_WIDER, _PROBED = 1.5, 3_000


@dataclass(frozen=True, slots=True, eq=False)
class AveragedCells:
    """Means of the points in square cells, each (k,).

    xx, xy, yy: mean products of the points' distances from the middle of their cell [m²]
    variance: mean square of their uncertainty [m²];  order: mean time in the scan, 0 to 1
    """

    x: FloatArray
    y: FloatArray
    height: FloatArray
    xx: FloatArray
    xy: FloatArray
    yy: FloatArray
    variance: FloatArray
    order: FloatArray
    points: FloatArray


def surface_trend(points: MeasuredPoints) -> PolynomialSurface:
    """Return the polynomial of the whole surface; a plane for few points."""
    some = slice(None, None, max(len(points) // _TREND_POINTS, 1))
    x, y, height = points.x[some], points.y[some], points.height[some]
    degree = TREND_DEGREE if len(x) > _ENOUGH_FOR_A_TREND else 1
    return PolynomialSurface.through(x, y, height, degree)


def cell_side(x: FloatArray, y: FloatArray, most: int) -> float:
    """Return the least side [m] of cells that points (n,) fill, at most ``most`` across.

    Raises DataError for points that cover no area.
    """
    width, high = float(np.ptp(x)), float(np.ptp(y))
    extent = max(width, high)
    if min(width, high) < MAP_SPACING.low:
        raise DataError("comparison.no_area", width=width, height=high)
    side = max(float(np.sqrt(width * high / len(x))), extent / most)
    while extent / side > _FEWEST_CELLS_ACROSS:
        if occupied(x, y, side) >= _FILLED * occupied(x, y, 2 * side):
            break
        side *= 2 ** (1 / 2)
    return side


def occupied(x: FloatArray, y: FloatArray, side: float) -> int:
    """Return the number of square cells of ``side`` [m] that hold any of the points (n,)."""
    column, row = _place(x, side), _place(y, side)
    return int(np.count_nonzero(np.bincount(column * (int(row.max()) + 1) + row)))


def _place(values: FloatArray, side: float) -> IntArray:
    return np.asarray(np.floor((values - values.min()) / side), np.int64)


def averaged(
    points: MeasuredPoints, height: FloatArray, side: float
) -> tuple[AveragedCells, IntArray]:
    """Return the means of the cells, and the cell of each point (n,)."""
    column, row = _place(points.x, side), _place(points.y, side)
    _, cell, count = np.unique(
        column * (int(row.max()) + 1) + row, return_inverse=True, return_counts=True
    )

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(cell, values, len(count)) / count, np.float64)

    x, y = mean(points.x), mean(points.y)
    dx, dy = points.x - x[cell], points.y - y[cell]
    spread = np.full(len(points), np.nan) if points.uncertainty is None else points.uncertainty
    cells = AveragedCells(
        x=x, y=y, height=mean(height), xx=mean(dx * dx), xy=mean(dx * dy), yy=mean(dy * dy),
        variance=mean(spread**2), order=mean(_order(points)), points=count.astype(np.float64),
    )  # fmt: skip
    return cells, np.asarray(cell, np.int64)


def _order(points: MeasuredPoints) -> FloatArray:
    """Return the time of each point in the scan, 0 to 1, NaN where it is unknown (n,)."""
    if points.sample is None:
        return np.full(len(points), np.nan)
    first, span = points.sample.min(), max(float(np.ptp(points.sample)), 1.0)
    return np.asarray((points.sample - first) / span, np.float64)


def portions(count: int) -> Iterator[slice]:
    """Yield slices of 20 000 that cover ``count``."""
    for start in range(0, count, _PORTION):
        yield slice(start, start + _PORTION)


Rows = Callable[[int, int], FloatArray]


class LocalHeights(NamedTuple):
    """Heights at places (m,), NaN where the points do not surround a place.

    value: [m];  slope_x, slope_y: [1];  density: points in a cell there, harmonic mean
    gain: variance of the value over that of one point, for independent errors
    stated: stated standard uncertainty of the points there [m], NaN if unknown
    order: mean time of the points in the scan, 0 to 1, NaN if unknown
    """

    value: FloatArray
    slope_x: FloatArray
    slope_y: FloatArray
    density: FloatArray
    gain: FloatArray
    stated: FloatArray
    order: FloatArray


class LocalQuadratic:
    """Surface between its points by local quadratic regression on cells of side ``cell`` [m].

    scatter: robust standard deviation of a point about the surface between its neighbours [m],
        with wavelengths shorter than a local fit resolves

    Raises DataError for points that fill fewer than nine cells.
    """

    def __init__(self, points: MeasuredPoints, cell: float) -> None:
        self.cell = cell
        self._trend = surface_trend(points)
        self._cells, self._cell = averaged(
            points, points.height - self._trend.height(points.x, points.y), cell
        )
        if len(self._cells.x) < _LEAST_NEIGHBOURS:
            raise DataError(
                "comparison.few_cells", count=len(self._cells.x), cell=cell, least=_LEAST_NEIGHBOURS
            )
        self._tree = cKDTree(np.column_stack([self._cells.x, self._cells.y]))
        some = slice(None, None, max(len(points) // _PROBED, 1))
        near = self.at(points.x[some], points.y[some])
        residual = (points.height[some] - near.value)[np.isfinite(near.value)]
        self.scatter = spread(residual) if len(residual) else 0.0

    def at(self, x: FloatArray, y: FloatArray) -> LocalHeights:
        """Return the heights, slopes and their uncertainties at x, y [m], each (m,)."""
        found = self._fitted(x, y, RADIUS_CELLS * self.cell)
        found[:3] += [self._trend.height(x, y), *self._trend.gradient(x, y)]
        return LocalHeights(*found)

    @property
    def surrounds_a_place(self) -> bool:
        """Whether any place can have enough cells within the radius of its fit."""
        # Nine cells within a radius of a place lie within two radii of each of the nine.
        least = self._tree.query(self._tree.data, k=[_LEAST_NEIGHBOURS])[0].min()
        return bool(least <= 2 * RADIUS_CELLS * self.cell)

    def carried(self, rows: Rows, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return errors of the points interpolated to x, y (m,), row by row, (s, m) [m].

        rows: function of a first point and a count c that returns errors (s, c) [m]
        """
        means = self._means(rows)
        parts = []
        for p in portions(len(x)):
            good, share, chosen = self._shares(x[p], y[p], RADIUS_CELLS * self.cell)
            part = np.full((len(means), len(good)), np.nan)
            part[:, good] = np.einsum("mk,smk->sm", share[:, 0], means[:, chosen])
            parts.append(part)
        return np.concatenate([np.empty((len(means), 0)), *parts], axis=1)

    def _means(self, rows: Rows) -> FloatArray:
        """Return the mean of each row over the points of each cell, (s, k)."""
        cells, sums = len(self._cells.x), np.zeros(1)
        for p in portions(len(self._cell)):
            cell = self._cell[p]
            part = [np.bincount(cell, values, cells) for values in rows(p.start, len(cell))]
            sums = sums + np.reshape(part, (-1, cells))
        return sums / self._cells.points

    def method_error(self, x: FloatArray, y: FloatArray) -> float:
        """Return an upper bound of the rms interpolation error at places like x, y (m,) [m].

        The error of a quadratic grows with the fourth power of its radius, and slower where the
        radius nears the wavelength. With the third power, a change of the radius by 1.5 changes
        the value by 1.5³ − 1 times the error, plus noise.
        """
        some = slice(None, None, max(len(x) // _PROBED, 1))
        radius = RADIUS_CELLS * self.cell
        near, far = (self._fitted(x[some], y[some], r)[0] for r in (radius, _WIDER * radius))
        change = (far - near)[np.isfinite(far - near)]
        if not len(change):
            return float("nan")
        return float(np.sqrt(np.mean(change**2))) / (_WIDER**3 - 1)

    def _fitted(self, x: FloatArray, y: FloatArray, radius: float) -> FloatArray:
        """Return the fields of :class:`LocalHeights` without the trend, (7, m)."""
        parts = [self._portion(x[p], y[p], radius) for p in portions(len(x))]
        return np.concatenate([np.empty((7, 0)), *parts], axis=1)

    def _portion(self, x: FloatArray, y: FloatArray, radius: float) -> FloatArray:
        cells = self._cells
        good, share, chosen = self._shares(x, y, radius)
        found = np.full((7, len(x)), np.nan)
        for place, scale in enumerate((1.0, 1 / radius, 1 / radius)):
            found[place, good] = scale * np.sum(share[:, place] * cells.height[chosen], axis=1)
        # The properties of the cells are averaged with positive weights.
        near = np.abs(share[:, 0]) / np.sum(np.abs(share[:, 0]), axis=1, keepdims=True)
        found[3, good] = 1 / np.sum(near / cells.points[chosen], axis=1)
        found[4, good] = np.sum(share[:, 0] ** 2 / cells.points[chosen], axis=1)
        found[5, good] = np.sqrt(np.sum(near * cells.variance[chosen], axis=1))
        found[6, good] = np.sum(near * cells.order[chosen], axis=1)
        found[:, ~(found[3] * found[4] < _LARGEST_GAIN)] = np.nan
        return found

    def _shares(
        self, x: FloatArray, y: FloatArray, radius: float
    ) -> tuple[BoolArray, FloatArray, IntArray]:
        """Return which places (m,) have enough cells, and weights (g, 3, k) of their cells (g, k).

        Weights in the value and in both slopes times the radius.
        """
        cells = self._cells
        most = min(int(4.5 * (radius / self.cell) ** 2) + 8, len(cells.x))
        distance, index = self._tree.query(
            np.column_stack([x, y]), k=most, distance_upper_bound=radius
        )
        inside = index < len(cells.x)
        index = np.where(inside, index, 0)
        share = np.minimum(distance / radius, 1.0)  # 1 without a cell
        weight = 1 - share * share * share  # powers take longer
        weight *= weight * weight
        # The weight saturates, because the model error does not fall with the number of points.
        weight *= (cells.points / (cells.points + np.median(cells.points)))[index]
        u = np.where(inside, (cells.x[index] - x[:, None]) / radius, 0.0)
        v = np.where(inside, (cells.y[index] - y[:, None]) / radius, 0.0)
        good = np.asarray(inside.sum(axis=1) >= _LEAST_NEIGHBOURS, np.bool_)
        chosen = index[good]
        moments = [m[chosen] / radius**2 for m in (cells.xx, cells.xy, cells.yy)]
        return good, _first_rows(u[good], v[good], moments, weight[good]), chosen


def _first_rows(
    u: FloatArray, v: FloatArray, moments: list[FloatArray], weight: FloatArray
) -> FloatArray:
    """Return the weights of the cells in value and slopes of the local quadratic, (m, 3, k).

    The mean of the quadratic over the points of a cell is fitted to the mean of the cell.
    """
    uu, uv, vv = moments
    basis = np.stack([np.ones_like(u), u, v, u * u + uu, u * v + uv, v * v + vv], axis=1)
    weighted = basis * weight[:, None]
    normal = weighted @ basis.transpose(0, 2, 1)
    scale = np.sqrt(np.einsum("mii->mi", normal))
    normal /= scale[:, :, None] * scale[:, None, :]
    # The eigenvalues sum to six, so that the lowest is at least the determinant over (6 / 5)⁵.
    doubtful = np.flatnonzero(np.linalg.det(normal) < 1.2**5 * _WORST_CONDITION)
    flat = doubtful[np.linalg.eigvalsh(normal[doubtful])[:, 0] < _WORST_CONDITION]
    # Where cells lie on two lines only, regularisation keeps the value and drops the curvature
    # across the lines.
    normal[flat] += 1e-4 * np.eye(6)
    first = np.eye(6)[:, :3] / scale[:, :, None]
    solved = np.linalg.solve(normal, first) / scale[:, :, None]
    return np.asarray(solved.transpose(0, 2, 1) @ weighted, np.float64)


def on_grid(
    points: MeasuredPoints, most: int, spacing: float | None = None
) -> tuple[HeightGrid, float]:
    """Return the points as a map of at most ``most`` columns or rows, as fine as they allow.

    The second value is an upper bound of the rms error of the map [m].

    spacing: of the map [m], None for the finest that the points fill

    Raises DataError for points without an area, and for a map that is too large or empty.
    """
    side = spacing or cell_side(points.x, points.y, most)
    shape = tuple(int(np.floor(np.ptp(v) / side)) + 1 for v in (points.y, points.x))
    if max(shape) > max(most, 20_000) or shape[0] * shape[1] > 25_000_000:
        raise DataError("comparison.map_too_large", spacing=side, columns=shape[1], rows=shape[0])
    x0, y0 = (float(v.min() + (np.ptp(v) % side) / 2) for v in (points.x, points.y))
    empty = HeightGrid(height=np.zeros(shape), x0=x0, y0=y0, dx=side, dy=side)
    x, y = (part.ravel() for part in np.meshgrid(empty.x, empty.y))
    surface = LocalQuadratic(points, side)
    if spacing and not surface.surrounds_a_place:  # a fine grid of nothing takes long to visit
        raise DataError("comparison.empty_map", spacing=side)
    height = surface.at(x, y).value.reshape(shape)
    if not np.any(np.isfinite(height)):
        raise DataError("comparison.empty_map", spacing=side)
    return replace(empty, height=height), surface.method_error(x, y)
