"""Scattered points as means over square cells, beside a trend of the whole surface."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray, IntArray
from omsm_ros.core.surface.measured_points import MeasuredPoints
from omsm_ros.errors import DataError
from omsm_ros.quantities import MAP_SPACING
from omsm_ros.readable import quantity

# The orders that are judged; left in, they would bend within a cell.
TREND_DEGREE = 6
# Seven hundred for each of its 28 terms.
_TREND_POINTS = 20_000
# Twice as large cells are a quarter as many where the points fill the surface.
_FILLED = 3.5
# A wave of the sixth order has nearly three of them.
_FEWEST_CELLS_ACROSS = 8
# Points at a time: eighteen neighbours of each, of six columns, are 17 MB.
_PORTION = 20_000


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """Means of the points in square cells, each (k,).

    xx, xy, yy: mean products of the points' distances from the middle of their cell [m²]
    variance: mean square of their uncertainty [m²];  order: of the scan, 0 to 1
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


class Trend:
    """A polynomial of the whole surface, by least squares."""

    def __init__(self, points: MeasuredPoints) -> None:
        some = slice(None, None, max(len(points) // _TREND_POINTS, 1))
        x, y = points.x[some], points.y[some]
        self._middle = (float(np.mean(x)), float(np.mean(y)))
        self._scale = float(max(np.ptp(points.x), np.ptp(points.y))) / 2 or 1.0
        degree = TREND_DEGREE if len(x) > 10 * len(_powers(TREND_DEGREE)) else 1
        self._powers = _powers(degree)
        self._coefficients = np.linalg.lstsq(self._columns(x, y), points.height[some], rcond=1e-10)[
            0
        ]

    def at(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return its height [m], (n,)."""
        parts = [self._columns(x[p], y[p]) @ self._coefficients for p in portions(len(x))]
        return np.concatenate([np.empty(0), *parts])

    def slopes(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return its slopes [1], each (n,)."""
        step = 1e-5 * self._scale
        return (
            (self.at(x + step, y) - self.at(x - step, y)) / (2 * step),
            (self.at(x, y + step) - self.at(x, y - step)) / (2 * step),
        )

    def _columns(self, x: FloatArray, y: FloatArray) -> FloatArray:
        u, v = (x - self._middle[0]) / self._scale, (y - self._middle[1]) / self._scale
        powers_u, powers_v = ([np.ones_like(x)], [np.ones_like(x)])
        for _ in range(max(i + j for i, j in self._powers)):
            powers_u.append(powers_u[-1] * u)
            powers_v.append(powers_v[-1] * v)
        return np.stack([powers_u[i] * powers_v[j] for i, j in self._powers], axis=1)


def _powers(degree: int) -> list[tuple[int, int]]:
    return [(n - j, j) for n in range(degree + 1) for j in range(n + 1)]


def cell_side(x: FloatArray, y: FloatArray, most: int) -> float:
    """Return the least side [m] of cells that points (n,) fill, no more than ``most`` across."""
    wide, high = float(np.ptp(x)), float(np.ptp(y))
    extent = max(wide, high)
    if min(wide, high) < MAP_SPACING.low:
        raise DataError(
            f"the points cover {quantity(wide, 'm')} × {quantity(high, 'm')}, which is no area; "
            "a profile cannot be made into a map; give points that cover one"
        )
    side = max(float(np.sqrt(wide * high / len(x))), extent / most)
    while extent / side > _FEWEST_CELLS_ACROSS:
        if _occupied(x, y, side) >= _FILLED * _occupied(x, y, 2 * side):
            break
        side *= 2 ** (1 / 2)
    return side


def _occupied(x: FloatArray, y: FloatArray, side: float) -> int:
    column, row = _place(x, side), _place(y, side)
    return int(np.count_nonzero(np.bincount(column * (int(row.max()) + 1) + row)))


def _place(values: FloatArray, side: float) -> IntArray:
    return np.asarray(np.floor((values - values.min()) / side), np.int64)


def averaged(points: MeasuredPoints, height: FloatArray, side: float) -> tuple[Cells, IntArray]:
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
    cells = Cells(
        x=x,
        y=y,
        height=mean(height),
        xx=mean(dx * dx),
        xy=mean(dx * dy),
        yy=mean(dy * dy),
        variance=mean(spread**2),
        order=mean(_order(points)),
        points=count.astype(np.float64),
    )
    return cells, np.asarray(cell, np.int64)


def _order(points: MeasuredPoints) -> FloatArray:
    """Place of each point in the order of the scan, 0 to 1; NaN where it is not known."""
    if points.sample is None:
        return np.full(len(points), np.nan)
    first, span = points.sample.min(), max(float(np.ptp(points.sample)), 1.0)
    return np.asarray((points.sample - first) / span, np.float64)


def portions(count: int) -> Iterator[slice]:
    """Yield slices of 20 000 that cover ``count``."""
    for start in range(0, count, _PORTION):
        yield slice(start, start + _PORTION)
