"""How far is a measured surface from the nominal one?

All functions take a cloud in any order; none needs a grid. Nothing is filtered or
thinned: every point that is passed in counts in the statistics.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.streams.blocks import FloatArray, IntArray
from omsm_ros.core.streams.statistics import EvenSelection
from omsm_ros.core.surface.area_weights import area_weights
from omsm_ros.errors import DataError
from omsm_ros.linear_algebra import least_squares
from omsm_ros.readable import plain, quantity

# Of a ring of a profile, each seen once at least: form of up to five waves around averages out.
_SECTORS = 12
# A radius off by a third, a sign, a unit or a place; form errors are a hundredth of a shape.
_UNLIKE = 0.3
# Of a nearly flat part the form itself may be more than its shape.
_PLAINLY_M, _ROUNDING_M = 0.2e-6, 1e-12
# So many points tell what a shape is.
_ENOUGH_POINTS = 20_000
# Three numbers each: 12 MB.
_MOST_WEIGHED = 2**19
# Beyond this a spacing is a mistaken unit, and its rings would not fit into memory.
_MOST_STRETCHES = 1_000_000


@dataclass(frozen=True, slots=True)
class FormStatistics:
    """Figures of a deviation.

    peak_to_valley: largest minus smallest [m]
    rms: root mean square about zero, every point alike [m]
    rms_area_weighted: the same, every piece of area alike [m]
    points: number of points these stand on
    """

    peak_to_valley: float
    rms: float
    rms_area_weighted: float
    points: int


@dataclass(frozen=True, slots=True, eq=False)
class Profile:
    """Mean deviation over successive stretches; stretches without points are left out.

    It is empty, k = 0, where the cloud does not touch the line.

    position: mean position of the points of a stretch [m], increasing, (k,)
    value: their mean [m], (k,)
    points: how many they are, (k,)
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
        raise DataError(
            f"{outside} of {len(x)} points lie where the nominal surface {nominal!r} has no "
            "height; check its parameters and the units of the cloud"
        )
    return np.asarray(height - expected, np.float64)


def level(
    x: FloatArray,
    y: FloatArray,
    deviation: FloatArray,
    *,
    tilt: bool = False,
    weights: FloatArray | None = None,
) -> FloatArray:
    """Return deviation (n,) [m] without its least-squares piston, and without tilt if asked for.

    A piston is the unknown stand-off of the probe; remove a tilt only where the part's
    seat on the spindle is not of interest. ``weights`` (n,) as for :func:`statistics`.
    """
    weight = np.ones_like(deviation) if weights is None else weights
    _check(x=x, y=y, deviation=deviation, weights=weight)
    design = np.column_stack([np.ones_like(x), x, y] if tilt else [np.ones_like(x)])
    root = np.sqrt(weight)
    fitted = least_squares(design * root[:, np.newaxis], deviation * root)
    return np.asarray(deviation - design @ fitted, np.float64)


def mismatch_text(x: FloatArray, y: FloatArray, height: FloatArray, nominal: Surface) -> list[str]:
    """Return what says that points are not of ``nominal``, in words for people, or nothing.

    x, y, height: [m], each (n,), in the frame of the surface
    A measurement with a wrong sign, unit or place deviates by as much as the shape itself. What
    has no shape, a plane, cannot be told so.
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
    if shape < _ROUNDING_M or left < max(_UNLIKE * shape, _PLAINLY_M):
        return []
    return [
        f"the points depart from the nominal surface by {quantity(left, 'm')} rms beside a tilt, "
        f"and that from a plane by {quantity(shape, 'm')}: they are not of this surface, or lie "
        "elsewhere on it; check its parameters, and sign, unit and zero of each axis"
    ]


def statistics(deviation: FloatArray, weights: FloatArray) -> FormStatistics:
    """Return the figures of a deviation (n,) [m] whose points stand for areas ∝ ``weights`` (n,).

    Raises DataError for values that are not finite or weights that are not areas.
    """
    _check(deviation=deviation, weights=weights)
    total = float(np.sum(weights))
    if np.any(weights < 0) or total <= 0:
        raise DataError(
            f"weights from {float(weights.min())!r} to {float(weights.max())!r}, expected areas"
        )
    square = np.square(deviation)
    return FormStatistics(
        peak_to_valley=float(np.ptp(deviation)),
        rms=float(np.sqrt(np.mean(square))),
        rms_area_weighted=float(np.sqrt(np.sum(weights * square) / total)),
        points=len(deviation),
    )


class RunningStatistics:
    """Statistics of a cloud that comes in portions, its piston removed as by :func:`level`.

    Peak to valley and rms are of all points, exact up to rounding: sums are taken about the first
    value, for a deviation is small against its stand-off. What is weighted by area is of all, or
    of a quarter of a million and more, evenly chosen.
    """

    def __init__(self) -> None:
        self._points = 0
        self._start = 0.0
        self._least, self._most = np.inf, -np.inf
        self._sum = self._square = 0.0
        self._weighed = EvenSelection(_MOST_WEIGHED)

    def add(self, x: FloatArray, y: FloatArray, deviation: FloatArray) -> None:
        """Take in the next portion of the scan, each array (n,) [m]."""
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
        """Return the statistics of all portions so far. Raises DataError if there was none."""
        if not self._points:
            raise DataError("0 points: there is nothing to take statistics of; give one or more")
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
    x: FloatArray,
    y: FloatArray,
    deviation: FloatArray,
    *,
    angle: float = 0.0,
    half_width: float,
    spacing: float,
) -> Profile:
    """Return the profile through the origin at ``angle`` [rad] from x: 0 is along x, π/2 along y.

    Points up to ``half_width`` [m] beside the line are averaged over every ``spacing`` [m].
    """
    _check(x=x, y=y, deviation=deviation)
    along = x * np.cos(angle) + y * np.sin(angle)
    across = y * np.cos(angle) - x * np.sin(angle)
    near = np.abs(across) <= half_width
    return _averaged(along[near], deviation[near], spacing)


def radial_profile(
    x: FloatArray, y: FloatArray, deviation: FloatArray, *, spacing: float
) -> Profile:
    """Return mean over rings of width ``spacing`` [m] about the origin: what a turned part repeats.

    Each of 12 directions counts alike, and a ring that was not seen in all of them is left
    out: over a part of a turn the errors of the other orders would not average to zero.
    Choose ``spacing`` wider than the feed per turn.
    """
    _check(x=x, y=y, deviation=deviation)
    radius = np.hypot(x, y)
    ring = _stretches(radius, spacing)
    sector = np.floor(np.arctan2(y, x) / (2 * np.pi) * _SECTORS).astype(np.int64) % _SECTORS
    cell = ring * _SECTORS + sector
    shape = (int(ring.max()) + 1, _SECTORS)
    points, radii, values = (
        np.bincount(cell, part, shape[0] * shape[1]).reshape(shape)
        for part in (None, radius, deviation)
    )
    whole = np.all(points > 0, axis=1)
    return Profile(
        position=np.mean(radii[whole] / points[whole], axis=1),
        value=np.mean(values[whole] / points[whole], axis=1),
        points=np.sum(points[whole], axis=1).astype(np.int64),
    )


def _averaged(position: FloatArray, value: FloatArray, spacing: float) -> Profile:
    stretch = _stretches(position, spacing)
    filled, index, points = np.unique(stretch, return_inverse=True, return_counts=True)
    return Profile(
        position=np.bincount(index, position, len(filled)) / points,
        value=np.bincount(index, value, len(filled)) / points,
        points=points.astype(np.int64),
    )


def _stretches(position: FloatArray, spacing: float) -> IntArray:
    if not (np.isfinite(spacing) and spacing > 0):
        raise DataError(f"spacing of a profile is {spacing!r} m, expected a positive number")
    extent = float(np.max(np.abs(position), initial=0.0)) / spacing
    if extent > _MOST_STRETCHES:
        raise DataError(
            f"spacing {spacing!r} m cuts the profile into {plain(extent)} stretches; widen it"
        )
    return np.asarray(np.floor(position / spacing), np.int64)


def _check(**arrays: FloatArray) -> None:
    lengths = {name: np.shape(array) for name, array in arrays.items()}
    if len(set(lengths.values())) != 1 or any(len(shape) != 1 for shape in lengths.values()):
        raise DataError(f"form: arrays of shapes {lengths!r}, expected one row of one length each")
    for name, array in arrays.items():
        if not len(array):
            raise DataError(f"form: {name} is empty; give one point or more")
        bad = int(np.sum(~np.isfinite(array)))
        if bad:
            raise DataError(
                f"form: {bad} of {len(array)} values of {name} are not finite; drop and count them"
            )
