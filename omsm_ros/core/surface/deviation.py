"""Deviation of measured points from a nominal surface, its statistics and profiles.

Points may come in any order and need no grid. They are not filtered or thinned.
"""

from dataclasses import dataclass

import numpy as np

from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.streams.blocks import FloatArray, IntArray
from omsm_ros.core.streams.statistics import EvenSelection
from omsm_ros.core.surface.area_weights import area_weights
from omsm_ros.errors import DataError, Notice
from omsm_ros.linear_algebra import least_squares

# Sectors of a ring that must all have points: a form with up to five waves a turn averages out.
_SECTORS = 12
# Deviation relative to the shape that shows a wrong radius, sign, unit or position; form errors are
# a hundredth of the shape.
_UNLIKE = 0.3
# Deviation of a nearly flat part that may be form error, and shape that is rounding only [m].
_FORM_M, _ROUNDING_M = 0.2e-6, 1e-12
# Number of points that determines a shape.
_ENOUGH_POINTS = 20_000
# Points kept for area weights, 12 MB.
_MOST_WEIGHED = 2**19
# Most intervals of a profile; more are a wrong unit of the spacing, and would not fit into memory.
_MOST_INTERVALS = 1_000_000


@dataclass(frozen=True, slots=True)
class FormStatistics:
    """Statistics of a deviation.

    peak_to_valley: largest minus smallest [m];  points: number of points
    rms, rms_area_weighted: root mean square about zero, with equal weights of points or areas [m]
    """

    peak_to_valley: float
    rms: float
    rms_area_weighted: float
    points: int


@dataclass(frozen=True, slots=True, eq=False)
class Profile:
    """Mean deviation in successive intervals, without empty ones; k = 0 if all are empty.

    position: mean position of the points of an interval [m], increasing, (k,)
    value: their mean [m], (k,), or of each of several deviations (e, k);  points: their number (k,)
    """

    position: FloatArray
    value: FloatArray
    points: IntArray


def deviation(x: FloatArray, y: FloatArray, height: FloatArray, nominal: Surface) -> FloatArray:
    """Return height minus nominal height [m] at x, y [m], each (n,), in the frame of the surface.

    Raises DataError where the cloud is not finite or reaches beyond the nominal surface.
    """
    _check(x=x, y=y, height=height)
    expected = nominal.height(x, y)
    outside = int(np.sum(~np.isfinite(expected)))
    if outside:
        raise DataError("surface.outside", outside=outside, points=len(x), nominal=repr(nominal))
    return np.asarray(height - expected, np.float64)


def level(
    x: FloatArray, y: FloatArray, deviation: FloatArray, *, tilt: bool = False,
    weights: FloatArray | None = None,
) -> FloatArray:  # fmt: skip
    """Return the deviation (n,) [m] minus its least-squares piston and, with ``tilt``, its tilt.

    The piston is the unknown stand-off of the probe; the tilt is the seat of the part on the
    spindle. ``weights`` (n,): the points stand for areas ∝ them.
    """
    weight = np.ones_like(deviation) if weights is None else weights
    _check(x=x, y=y, deviation=deviation, weights=weight)
    design = np.column_stack([np.ones_like(x), x, y] if tilt else [np.ones_like(x)])
    root = np.sqrt(weight)
    fitted = least_squares(design * root[:, np.newaxis], deviation * root)
    return np.asarray(deviation - design @ fitted, np.float64)


def mismatch(x: FloatArray, y: FloatArray, height: FloatArray, nominal: Surface) -> list[Notice]:
    """Return a notice if the points deviate from ``nominal`` by about its own shape, or nothing.

    x, y, height: [m], each (n,), in the frame of the surface

    A wrong sign, unit or position makes such a deviation. It cannot be found for a plane.
    """
    every = max(-(-len(x) // _ENOUGH_POINTS), 1)
    x, y, height = x[::every], y[::every], height[::every]
    expected = nominal.height(x, y)
    here = np.isfinite(height - expected)
    if np.sum(here) < 3:
        return []
    left, shape = (
        float(np.sqrt(np.mean(level(x[here], y[here], values[here], tilt=True) ** 2)))
        for values in (height - expected, expected)
    )
    if shape < _ROUNDING_M or left < max(_UNLIKE * shape, _FORM_M):
        return []
    return [Notice("surface.unlike", deviation=left, shape=shape)]


class RunningStatistics:
    """Statistics of points that come in portions, with the piston removed as by :func:`level`.

    Peak to valley and rms are exact up to rounding, because sums are taken about the first value.
    Area weights use all points, or an even selection of a quarter of a million and more.
    """

    def __init__(self) -> None:
        self._points = 0
        self._start = 0.0
        self._least, self._most = np.inf, -np.inf
        self._sum = self._square = 0.0
        self._weighed = EvenSelection(_MOST_WEIGHED)

    def add(self, x: FloatArray, y: FloatArray, deviation: FloatArray) -> None:
        """Take the next portion of the scan, each array (n,) [m]."""
        _check(x=x, y=y, deviation=deviation)
        if not self._points:
            self._start = float(deviation[0])
        shifted = deviation - self._start
        self._sum += float(shifted.sum())
        self._square += float(shifted @ shifted)
        self._points += len(x)
        self._least = min(self._least, float(shifted.min()))
        self._most = max(self._most, float(shifted.max()))
        self._weighed.add(np.stack([x, y, shifted], axis=1))

    def statistics(self) -> FormStatistics:
        """Return the statistics of all portions so far; raise DataError if there are none."""
        if not self._points:
            raise DataError("surface.no_points")
        x, y, shifted = self._weighed.rows().T
        weights = area_weights(x, y)
        piston = float(np.average(shifted, weights=weights))
        about_piston = self._square - 2 * piston * self._sum
        return FormStatistics(
            peak_to_valley=self._most - self._least,
            rms=float(np.sqrt(max(about_piston / self._points + piston**2, 0.0))),
            rms_area_weighted=float(np.sqrt(np.average((shifted - piston) ** 2, weights=weights))),
            points=self._points,
        )


def line_profile(
    x: FloatArray, y: FloatArray, deviation: FloatArray, *, angle: float = 0.0, half_width: float,
    spacing: float,
) -> Profile:  # fmt: skip
    """Return the profile through the origin at ``angle`` [rad] from x: 0 is along x, π/2 along y.

    Points within ``half_width`` [m] of the line are averaged over every ``spacing`` [m].
    deviation: (n,), or several (e, n) [m]
    """
    _check(x=x, y=y, deviation=np.sum(np.atleast_2d(deviation), axis=0))
    along = x * np.cos(angle) + y * np.sin(angle)
    across = y * np.cos(angle) - x * np.sin(angle)
    near = np.abs(across) <= half_width
    interval = _intervals(along[near], spacing)
    filled, index, points = np.unique(interval, return_inverse=True, return_counts=True)
    return Profile(
        position=np.bincount(index, along[near], len(filled)) / points,
        value=_sums(index, deviation[..., near], len(filled)) / points,
        points=points.astype(np.int64),
    )


def radial_profile(
    x: FloatArray, y: FloatArray, deviation: FloatArray, *, spacing: float
) -> Profile:
    """Return the mean over rings of width ``spacing`` [m] about the origin, the form of revolution.

    Each of 12 sectors has equal weight, and a ring without points in all of them is left out, so
    that other orders average to zero. ``spacing`` should exceed the feed per turn.
    deviation: (n,), or several (e, n) [m]
    """
    _check(x=x, y=y, deviation=np.sum(np.atleast_2d(deviation), axis=0))
    radius = np.hypot(x, y)
    ring = _intervals(radius, spacing)
    sector = np.floor(np.arctan2(y, x) / (2 * np.pi) * _SECTORS).astype(np.int64) % _SECTORS
    cell = ring * _SECTORS + sector
    shape = (int(ring.max()) + 1, _SECTORS)
    points, radii = (
        np.bincount(cell, part, shape[0] * shape[1]).reshape(shape) for part in (None, radius)
    )
    whole = np.all(points > 0, axis=1)
    values = _sums(cell, deviation, shape[0] * shape[1]).reshape(*deviation.shape[:-1], *shape)
    return Profile(
        position=np.mean(radii[whole] / points[whole], axis=1),
        value=np.mean(values[..., whole, :] / points[whole], axis=-1),
        points=np.sum(points[whole], axis=1).astype(np.int64),
    )


def _sums(cell: IntArray, values: FloatArray, count: int) -> FloatArray:
    """Return the sums of ``values`` (…, n) over ``count`` cells (…, c)."""
    found = [np.bincount(cell, row, count) for row in np.atleast_2d(values)]
    return np.reshape(found, (*values.shape[:-1], count))


def _intervals(position: FloatArray, spacing: float) -> IntArray:
    if not (np.isfinite(spacing) and spacing > 0):
        raise DataError("surface.spacing", spacing=spacing)
    extent = float(np.max(np.abs(position), initial=0.0)) / spacing
    if extent > _MOST_INTERVALS:
        raise DataError("surface.intervals", spacing=spacing, intervals=extent)
    return np.asarray(np.floor(position / spacing), np.int64)


def _check(**arrays: FloatArray) -> None:
    lengths = {name: np.shape(array) for name, array in arrays.items()}
    if len(set(lengths.values())) != 1 or any(len(shape) != 1 for shape in lengths.values()):
        raise DataError("surface.shapes", shapes=lengths)
    for name, array in arrays.items():
        if not len(array):
            raise DataError("surface.empty", name=name)
        bad = int(np.sum(~np.isfinite(array)))
        if bad:
            raise DataError("surface.not_finite", bad=bad, values=len(array), name=name)
