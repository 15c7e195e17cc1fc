"""Align the probe with the spindle axis from a scan of a reference sphere.

An offset of the probe along the feed shows as a cusp or a dimple at the centre of the sphere, an
offset across the feed as a flat centre. A beam inclined by β measures d β to the side at a
distance d. Offset and inclination are fitted so that the corrected points lie on the sphere.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy import optimize

from omsm_ros.core.correction.systematic import ScanPoints
from omsm_ros.core.kinematics.kinematics import Geometry, workpiece_points
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.streams.statistics import noise_of
from omsm_ros.errors import ConfigurationError, DataError
from omsm_ros.linear_algebra import least_squares, unit_columns
from omsm_ros.units import MICROMETRE_M

MOST_POINTS = 60_000
"""Points of a scan that are fitted, which bounds time and memory."""

_OfUnknown = Callable[[FloatArray], FloatArray]
# Ten groups of consecutive points, from which a standard deviation is known to 25 %.
_MIN_POINTS = 1000
# Consecutive points within which residuals may be correlated: 0.1 s at 1 kHz.
_GROUP_POINTS = 100
# Unit of slopes in the fit, a milliradian; lengths are in micrometres.
_SLOPE_UNIT = 1e-3
# Certified radii are known to better; a larger deviation is a wrong sphere or a wrong entry.
_RADIUS_KNOWN = 2e-4
# A deviation of five standard uncertainties is no chance.
_CERTAIN = 5.0
# Over a shorter range of distance an inclined beam shifts no point by a nanometre.
_USEFUL_DISTANCE_M = 2e-6
# Singular values below this share of the largest are rounding.
_SINGULAR = 1e-13


@dataclass(frozen=True, eq=False, kw_only=True)
class SphereScan:
    """Samples of a sphere before kinematics, each array (n,).

    x, y: slides [m];  z: H(z) [m];  b, c: [rad];  distance: corrected, growing with height [m]
    """

    x: FloatArray
    y: FloatArray
    z: FloatArray
    b: FloatArray
    c: FloatArray
    distance: FloatArray

    @classmethod
    def of(cls, points: ScanPoints) -> SphereScan:
        """Return the samples behind points that were corrected without geometry and latency."""
        along, away = points.distance * np.cos(points.b), points.distance * np.sin(points.b)
        return cls(
            x=points.slide_x - away, y=points.slide_y, z=points.height - along, b=points.b,
            c=points.c, distance=points.distance,
        )  # fmt: skip


@dataclass(frozen=True)
class Alignment:
    """Geometry of the probe with its uncertainty.

    uncertainty: standard uncertainties of centre_x, centre_y [m], beam_x, beam_y [1]
    sphere: centre in the workpiece frame and radius [m]
    residual: rms [m];  scatter: of a point about its neighbours, the residual of noise alone [m]
    beam_found: False where the distance hardly varied;  used: number of points fitted
    """

    geometry: Geometry
    uncertainty: tuple[float, float, float, float]
    sphere: tuple[float, float, float, float]
    residual: float
    scatter: float
    beam_found: bool
    used: int


def align_on_sphere(scan: SphereScan, radius: float, geometry: Geometry | None = None) -> Alignment:
    """Fit the spindle centre and the inclination of the beam to a scan of a sphere.

    radius: certified radius [m], negative for a convex sphere
    geometry: the known place of the probe, and the start of centre and beam

    Raises DataError for a scan that is too short, or does not fit a sphere of this radius.
    """
    if len(scan.z) < _MIN_POINTS:
        raise DataError("registration.short_sphere_scan", points=len(scan.z), least=_MIN_POINTS)
    start = geometry or Geometry()
    beam = bool(np.ptp(scan.distance) > _USEFUL_DISTANCE_M)
    first = _first_guess(scan, radius, start, beam)
    free = _fitted(
        radius,
        lambda u: _misfit(scan, u[-1] * MICROMETRE_M, start, u[:-1]),
        lambda u: np.c_[_jacobian(scan, start, u[:-1]), np.full(len(scan.z), -np.sign(radius))],
        np.append(first, radius / MICROMETRE_M),
    )
    known = _checked_radius(free, radius)
    found = _fitted(
        radius, lambda u: _misfit(scan, radius, start, u), lambda u: _jacobian(scan, start, u),
        first,
    )  # fmt: skip
    residual = _rms(found)
    deviations = _standard_uncertainties(found.jac, found.fun)
    if not known:
        # The effect of the deviation of the radius adds to the uncertainty.
        deviations = np.hypot(deviations, found.x - free.x[:-1])
    aligned = _with(start, found.x)
    in_si = np.append(deviations[:2] * MICROMETRE_M, (deviations[5:] * _SLOPE_UNIT))
    lean = in_si[2:] if beam else (np.inf, np.inf)
    sphere = tuple(float(v) * MICROMETRE_M for v in found.x[2:5])
    return Alignment(
        geometry=aligned,
        uncertainty=(float(in_si[0]), float(in_si[1]), float(lean[0]), float(lean[1])),
        sphere=(sphere[0], sphere[1], sphere[2], radius), residual=residual,
        scatter=noise_of(found.fun) * MICROMETRE_M, beam_found=beam, used=len(scan.z),
    )  # fmt: skip


def _fitted(
    radius: float, misfit: _OfUnknown, jacobian: _OfUnknown, first: FloatArray
) -> optimize.OptimizeResult:
    try:
        found = optimize.least_squares(misfit, first, jac=jacobian, method="lm", x_scale="jac")
    except ConfigurationError as err:  # the centre leaves the range of a geometry
        raise DataError("registration.sphere_outside_machine", radius=radius) from err
    if not found.success or _rms(found) > 0.01 * abs(radius):
        raise DataError("registration.no_sphere", radius=radius, residual=_rms(found))
    return found


def _rms(found: optimize.OptimizeResult) -> float:
    """Return the rms distance of the points from the sphere [m]."""
    return float(np.sqrt(np.mean(found.fun**2)) * MICROMETRE_M)


def _checked_radius(free: optimize.OptimizeResult, radius: float) -> bool:
    """Return whether the fitted radius, the last unknown, agrees with ``radius``.

    Raises DataError for a deviation that would make the fitted centre wrong.
    """
    fits = float(free.x[-1]) * MICROMETRE_M
    spread = float(_standard_uncertainties(free.jac, free.fun)[-1]) * MICROMETRE_M
    off = abs(fits - radius)
    if off > max(_CERTAIN * spread, _RADIUS_KNOWN * abs(radius)):
        raise DataError("registration.other_radius", fitted=fits, uncertainty=spread, radius=radius)
    return off <= 2 * spread


def _with(geometry: Geometry, unknown: FloatArray) -> Geometry:
    x, y = map(float, unknown[:2] * MICROMETRE_M)
    centred = replace(geometry, centre_x=x, centre_y=y)
    if len(unknown) == 5:
        return centred
    x, y = map(float, unknown[5:] * _SLOPE_UNIT)
    return replace(centred, beam_x=x, beam_y=y)


def _misfit(scan: SphereScan, radius: float, geometry: Geometry, unknown: FloatArray) -> FloatArray:
    """Return the distances of the points from the sphere [µm], (n,)."""
    away = np.sqrt(np.sum(_from_centre(scan, geometry, unknown) ** 2, axis=0))
    return np.asarray((away - abs(radius)) / MICROMETRE_M, np.float64)


def _from_centre(scan: SphereScan, geometry: Geometry, unknown: FloatArray) -> FloatArray:
    """Return the points from the centre of the sphere (3, n) [m]."""
    slides = (scan.x, scan.y, scan.z)
    points = workpiece_points(_with(geometry, unknown), slides, scan.b, scan.c, scan.distance)
    return np.stack(points) - unknown[2:5, np.newaxis] * MICROMETRE_M


def _jacobian(scan: SphereScan, geometry: Geometry, unknown: FloatArray) -> FloatArray:
    """Return the derivatives of :func:`_misfit` (n, 5 or 7).

    Analytic in the centres, because on a centred sphere an offset across the feed has a
    second-order effect only, which finite differences would hide in their rounding.
    """
    away = _from_centre(scan, geometry, unknown)
    x, y, z = away / np.sqrt(np.sum(away**2, axis=0))
    cosine, sine = np.cos(scan.c), np.sin(scan.c)
    columns = [y * sine - x * cosine, -x * sine - y * cosine, -x, -y, -z]
    for k in range(5, len(unknown)):
        # The end of the beam is nearly linear in its inclination: a difference over a milliradian.
        step = np.zeros_like(unknown)
        step[k] = 0.5
        ends = [_from_centre(scan, geometry, unknown + way) for way in (step, -step)]
        columns.append(np.sum((ends[0] - ends[1]) * [x, y, z], axis=0) / MICROMETRE_M)
    return np.stack(columns, axis=1)


def _first_guess(scan: SphereScan, radius: float, geometry: Geometry, beam: bool) -> FloatArray:
    """Return start values: the centre lies one radius from the vertex of a fitted paraboloid."""
    points = workpiece_points(geometry, (scan.x, scan.y, scan.z), scan.b, scan.c, scan.distance)
    ones = np.ones(len(points.x))
    terms = np.stack([ones, points.x, points.y, points.x**2 + points.y**2], axis=1)
    level, slope_x, slope_y, _ = least_squares(terms, points.height)
    centre = np.array([-slope_x * radius, -slope_y * radius, level + radius]) / MICROMETRE_M
    known = np.array([geometry.centre_x, geometry.centre_y]) / MICROMETRE_M
    lean = np.array([geometry.beam_x, geometry.beam_y]) / _SLOPE_UNIT
    return np.concatenate([known, centre, lean if beam else lean[:0]])


def _standard_uncertainties(jacobian: FloatArray, residual: FloatArray) -> FloatArray:
    """Return standard uncertainties for residuals that are correlated within groups of points."""
    # Singular values of scaled columns, because normal equations square the condition number.
    unit, scale = unit_columns(jacobian)
    _, values, rows = np.linalg.svd(unit, full_matrices=False)
    if values[-1] <= _SINGULAR * values[0]:
        raise DataError("registration.centre_not_determined")
    root = rows.T / values / scale[:, np.newaxis]
    inverse = root @ root.T
    edges = np.arange(0, len(residual), _GROUP_POINTS)
    scores = np.add.reduceat(jacobian * residual[:, np.newaxis], edges, axis=0)
    correction = len(scores) / (len(scores) - 1)
    covariance = inverse @ (correction * scores.T @ scores) @ inverse
    with np.errstate(invalid="ignore"):  # an undetermined variance may round below zero
        return np.asarray(np.sqrt(np.diag(covariance)), np.float64)
