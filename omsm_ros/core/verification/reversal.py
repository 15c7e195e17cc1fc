"""Is the lag latency, or mechanics?

A late probe looks where the workpiece was a moment ago: each height belongs to a point
``lag`` earlier on the path, and turning the spindle the other way shifts it to the other
side. A mechanical lag of Z alone does not. Two scans of the same surface, one in each
direction, share the surface and differ by the shift:

``h(P) = S(P) - lag · V · ∇S(P) + piston of the scan``

with P the points' positions and V their velocity over the workpiece. S is a smooth surface
fitted to both scans; what it cannot follow is the same in both and does not pass for a lag.

Where Z follows the surface, an error of the calibration's own delay leaves the same mark
``V · ∇S``. The estimate cannot be better than that delay is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev
from scipy import linalg

from omsm_ros.core.correction.surface_points import SurfacePoints, join_points
from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.dynamics.transfer_function import ComplexArray
from omsm_ros.core.samples.blocks import FloatArray, IntArray
from omsm_ros.core.samples.even_selection import EvenSelection
from omsm_ros.errors import DataError

DEFAULT_DEGREE = 8
_ITERATIONS = 20
_CONVERGED_S = 1e-9
# Residuals are taken as correlated along the path within groups of so many points.
_GROUP_POINTS = 200
_MIN_POINTS = 20 * _GROUP_POINTS
# Of one scan: with 45 terms of the surface and their slopes a hundred megabytes.
_MAX_POINTS = 75_000
# A surface whose azimuthal slope gives less than this is no test of a lag.
_MAX_UNCERTAINTY_S = 0.1


@dataclass(frozen=True)
class SidewaysLag:
    """How late the probe's reading is against X and C.

    lag, uncertainty: [s], k = 1;  lag_of_z: of the calibration at low frequency [s]
    residual: rms that lag and surface leave [m];  points, used: of all scans, and fitted
    latency: True if the lag of Z is latency, False if mechanical, None if neither within 3 u
    """

    lag: float
    uncertainty: float
    lag_of_z: float
    residual: float
    points: int
    used: int
    latency: bool | None


class ScanPath:
    """A scan that comes in portions, in bounded memory: where its points lie, and their velocity.

    points: how many came;  used: how many, evenly chosen, are kept to be fitted
    """

    def __init__(self, sample_period: float) -> None:
        self._period = sample_period
        self._last: SurfacePoints | None = None
        self._kept = EvenSelection(_MAX_POINTS)
        self.points = 0

    @classmethod
    def of(cls, points: SurfacePoints, sample_period: float) -> ScanPath:
        """The path of a whole scan, sampled every ``sample_period`` [s]."""
        path = cls(sample_period)
        path.add(points)
        return path

    @property
    def used(self) -> int:
        """Points that are kept."""
        return len(self._kept)

    def add(self, points: SurfacePoints) -> None:
        """Take in the next points, corrected with lateral_lag=0."""
        self.points += len(points)
        points = join_points([self._last, points])
        self._last = points.part(slice(max(len(points) - 2, 0), None))
        if len(points) < 3:
            return
        position = points.x + 1j * points.y
        apart = points.sample[2:] - points.sample[:-2]
        # Where a point is missing the velocity is not that of the point between.
        whole = apart == 2
        velocity = (position[2:] - position[:-2])[whole] / (2 * self._period)
        kept = np.stack([position[1:-1][whole], velocity, points.height[1:-1][whole]], axis=1)
        self._kept.add(kept)

    def columns(self) -> tuple[ComplexArray, ComplexArray, FloatArray]:
        """Position and velocity [m], [m/s] as x + jy, and height [m], each (used,).

        Raises DataError for a scan that is too short.
        """
        rows = self._kept.rows()
        if len(rows) < _MIN_POINTS:
            raise DataError(f"scan of {self.points} points, expected {_MIN_POINTS} or more")
        return rows[:, 0], rows[:, 1], rows[:, 2].real


def sideways_lag(
    scans: Sequence[ScanPath], calibration: Calibration, degree: int = DEFAULT_DEGREE
) -> SidewaysLag:
    """Lag of the probe against X and C from scans with opposite spindle directions.

    scans: corrected with ``calibration``, two or more, of one surface
    degree: of the surface in x and y; more for a rougher surface

    Raises DataError if the scans turn the same way, are too short, or the surface has no
    slope along the path.
    """
    path = _Path.of(scans)
    lag, jacobian, residual = 0.0, np.empty((0, 0)), np.empty(0)
    for _ in range(_ITERATIONS):
        surface, slopes = path.design(lag, degree)
        jacobian, residual = _without_nuisance(surface, slopes, path)
        square = float(jacobian @ jacobian)
        if square == 0:
            raise DataError(_NO_SLOPE)
        step = float(jacobian @ residual) / square
        lag += step
        if abs(step) < _CONVERGED_S:
            break
    spread = _grouped_uncertainty(jacobian, residual, path.scan)
    if not spread < _MAX_UNCERTAINTY_S:
        raise DataError(_NO_SLOPE)
    of_z = calibration.dynamics.low_frequency_delay
    uncertainty = float(np.hypot(spread, calibration.low_frequency_delay_uncertainty))
    return SidewaysLag(
        lag=lag,
        uncertainty=uncertainty,
        lag_of_z=of_z,
        residual=float(np.sqrt(np.mean(residual**2))),
        points=sum(scan.points for scan in scans),
        used=sum(scan.used for scan in scans),
        latency=_verdict(lag, uncertainty, of_z),
    )


_NO_SLOPE = (
    "the surface does not change along the path, so a lag leaves no trace; scan a surface "
    "that is not symmetric about the spindle"
)


@dataclass(frozen=True, eq=False)
class _Path:
    """All points: positions and velocities as x + jy in units of the largest radius, (n,)."""

    position: ComplexArray
    velocity: ComplexArray
    height: FloatArray
    scan: IntArray
    pistons: FloatArray

    @classmethod
    def of(cls, scans: Sequence[ScanPath]) -> _Path:
        if len(scans) < 2:
            raise DataError(f"{len(scans)} scan, expected one in each spindle direction")
        parts = [scan.columns() for scan in scans]
        turns = [float(np.sum(np.imag(np.conj(p) * v))) for p, v, _ in parts]
        if not min(turns) < 0 < max(turns):
            raise DataError("both scans turn the same way; reverse the spindle for one of them")
        position: ComplexArray = np.concatenate([p for p, _, _ in parts])
        velocity: ComplexArray = np.concatenate([v for _, v, _ in parts])
        height = np.concatenate([h for _, _, h in parts])
        radius = np.complex128(np.max(abs(position)))
        scan = np.repeat(np.arange(len(scans)), [len(p) for p, _, _ in parts])
        pistons = (scan[:, np.newaxis] == np.arange(1, len(scans))).astype(np.float64)
        return cls(position / radius, velocity / radius, height, scan, pistons)

    def design(self, lag: float, degree: int) -> tuple[FloatArray, tuple[FloatArray, FloatArray]]:
        """Terms of the surface (n, k) where the points were ``lag`` ago, and of its slopes."""
        earlier = self.position - lag * self.velocity
        # Just beyond the rim, so that a point shifted outwards stays inside the basis.
        x, y = earlier.real / 1.05, earlier.imag / 1.05
        ex, ey = np.array([(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]).T
        tx, ty = (np.asarray(chebyshev.chebvander(v, degree), np.float64) for v in (x, y))
        dx, dy = _derivative_vander(tx, degree), _derivative_vander(ty, degree)
        along_x = dx[:, ex] * ty[:, ey] / 1.05
        along_y = tx[:, ex] * dy[:, ey] / 1.05
        return tx[:, ex] * ty[:, ey], (along_x, along_y)


def _derivative_vander(vander: FloatArray, degree: int) -> FloatArray:
    """Derivatives of the Chebyshev polynomials whose values are ``vander`` (n, degree + 1)."""
    coefficients = np.zeros((degree + 1, degree + 1))
    for k in range(1, degree + 1):
        coefficients[:k, k] = chebyshev.chebder(np.eye(degree + 1)[k])[:k]
    return np.asarray(vander @ coefficients)


def _without_nuisance(
    surface: FloatArray, slopes: tuple[FloatArray, FloatArray], path: _Path
) -> tuple[FloatArray, FloatArray]:
    """What is left of the lag's trace and of the heights once surface and pistons are fitted."""
    terms = np.concatenate([surface, path.pistons], axis=1)
    # The basis is close to orthogonal, so the normal equations lose no digits that matter.
    normal = linalg.cho_factor(terms.T @ terms)

    def fitted(values: FloatArray) -> FloatArray:
        return np.asarray(linalg.cho_solve(normal, terms.T @ values), np.float64)

    shares = fitted(path.height)
    of_surface, velocity = shares[: surface.shape[1]], path.velocity
    trace = -(velocity.real * (slopes[0] @ of_surface) + velocity.imag * (slopes[1] @ of_surface))
    return trace - terms @ fitted(trace), path.height - terms @ shares


def _grouped_uncertainty(trace: FloatArray, residual: FloatArray, scan: IntArray) -> float:
    """Standard uncertainty of the lag, residuals being correlated within groups of samples."""
    change = np.flatnonzero(np.diff(scan)) + 1
    group = np.arange(len(scan)) // _GROUP_POINTS
    edges = np.union1d(np.flatnonzero(np.diff(group)) + 1, change)
    scores = np.add.reduceat(trace * residual, np.r_[0, edges])
    correction = len(scores) / (len(scores) - 1)
    return float(np.sqrt(correction * np.sum(scores**2)) / (trace @ trace))


def _verdict(lag: float, uncertainty: float, lag_of_z: float) -> bool | None:
    late, prompt = abs(lag - lag_of_z) <= 3 * uncertainty, abs(lag) <= 3 * uncertainty
    return late if late != prompt else None
