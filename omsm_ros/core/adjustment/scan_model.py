"""Model of several scans of one part: a common surface, and parameters in which scans differ.

``h = S(P(t - τ)) + δ Dz - κ D²z + ε d + terms of the scan``, D = d/dt, with h the height after a
correction. The correction has a wrong lag (by δ), curvature of the gain (by κ [s²]) and static gain
(by the share ε). The probe is late relative to the slides by τ. Each scan except the first has its
own drift, clocking, shift and tilt of the part.

To first order two speeds or directions separate ``δ - τ`` from S, because its effect is
proportional to the speed; a following error, or a step test, separates δ from τ. At constant speed
clocking has the effect of a lag, so the repeatability of C limits the result.

S is ``S(r, θ) = Σ_jm B_j(r) (a_jm cos mθ + b_jm sin mθ)`` with cubic B-splines of the radius. In
one interval of radius only four splines differ from zero, so the normal equations are gathered by
interval. They are ``y = B a + X p + e``, with B the terms of the surface and X the columns of the
parameters p. With ``C = (BᵀB)⁻¹ BᵀX`` the columns ``X - B C`` are independent of the surface. Rows
are computed from the scans in portions, so memory holds the normal equations and one portion.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import linalg

from omsm_ros.core.adjustment.scan_reader import ScanColumns
from omsm_ros.core.streams.blocks import FloatArray, IntArray
from omsm_ros.errors import DataError

# Cubic B-splines over one interval, ascending powers of u in 0…1, one row each.
_SPLINES = np.array([[1, -3, 3, -1], [4, 0, -6, 3], [1, 3, 3, -3], [0, 0, 0, 1]]) / 6
_SLOPES = _SPLINES[:, 1:] * np.arange(1, 4)
SUPPORT = len(_SPLINES)
# Ridge over the largest diagonal element, which keeps a term without points at zero.
_RIDGE = 1e-12
# Points at a time, whose terms (4 MB) fit the cache.
_PORTION = 5_000
LAG, CURVATURE, GAIN, LATENCY = range(4)
DYNAMIC = 4
CLOCKING = 0
OWN = ("clocking", "shift_x", "shift_y", "tilt_x", "tilt_y")
# Least radius over the largest; nearer to the axis the points do not resolve the harmonics.
_INNER_SHARE = 0.01
# Intervals of radius (half a millimetre on a part of 25 mm), with at least two turns in each.
_MOST_INTERVALS, _TURNS_AN_INTERVAL, _LEAST_INTERVALS = 24, 2, 3
# Intervals of the drift over time: half a minute of four minutes, and at least five turns.
_MOST_DRIFT_INTERVALS, _TURNS_A_DRIFT = 8, 5


@dataclass(frozen=True, slots=True)
class PolarBasis:
    """Terms of the surface between two radii.

    inner, outer: [m];  intervals: of radius, of equal width;  harmonics: highest of the angle
    """

    inner: float
    outer: float
    intervals: int
    harmonics: int

    @property
    def waves(self) -> int:
        """Number of functions of the angle: 1, cos θ … cos Mθ, sin θ … sin Mθ."""
        return 2 * self.harmonics + 1

    @property
    def size(self) -> int:
        """Number of terms of the surface, spline by spline."""
        return (self.intervals + SUPPORT - 1) * self.waves

    @property
    def width(self) -> float:
        """Width of one interval [m]."""
        return (self.outer - self.inner) / self.intervals

    def interval(self, radius: FloatArray) -> IntArray:
        """Return the interval of each ``radius`` (n,) [m], (n,)."""
        place = ((radius - self.inner) / self.width).astype(np.int64)
        return np.asarray(np.clip(place, 0, self.intervals - 1), np.int64)

    def terms(self, interval: int) -> slice:
        """Return the slice of the terms that differ from zero in ``interval``."""
        return slice(interval * self.waves, (interval + SUPPORT) * self.waves)

    def amplitudes(self, coefficients: FloatArray) -> FloatArray:
        """Return the rms over radius of each harmonic's amplitude, from 1, (harmonics,) [m]."""
        shape = coefficients.reshape(-1, self.waves)
        middle = _SPLINES @ 0.5 ** np.arange(4)
        at_middles = sum(
            w * shape[k : k + self.intervals] for k, w in enumerate(middle)
        )  # fmt: skip
        power = np.mean(np.asarray(at_middles)[:, 1:] ** 2, axis=0)
        return np.asarray(np.sqrt(power[: self.harmonics] + power[self.harmonics :]))

    def rows(self, interval: int, radius: FloatArray, angle: FloatArray) -> PolarRows:
        """Return the terms of ``interval`` at points (n,) in it or near it."""
        u = (radius - self.inner) / self.width - interval
        powers = u[:, np.newaxis] ** np.arange(4)
        wave = np.exp(1j * angle)
        turns = np.cumprod(np.repeat(wave[:, np.newaxis], self.harmonics, axis=1), axis=1)
        waves = np.concatenate([np.ones((len(u), 1)), turns.real, turns.imag], axis=1)
        slopes = powers[:, :3] @ _SLOPES.T / self.width
        return PolarRows(powers @ _SPLINES.T, slopes, waves)


@dataclass(frozen=True, eq=False)
class PolarRows:
    """Splines (n, 4), their slopes (n, 4) [1/m], and functions of the angle (n, waves)."""

    splines: FloatArray
    slopes: FloatArray
    waves: FloatArray

    def matrix(self) -> FloatArray:
        """Return the terms of one interval, (n, 4 · waves)."""
        product = self.splines[:, :, np.newaxis] * self.waves[:, np.newaxis, :]
        return np.asarray(product.reshape(len(self.splines), -1))

    def heights(self, coefficients: FloatArray) -> FloatArray:
        """Return S (n,) of the surface with ``coefficients`` (4 · waves,)."""
        shape = coefficients.reshape(SUPPORT, -1)
        return np.asarray(np.sum(self.splines * (self.waves @ shape.T), axis=1))

    def derivatives(self, coefficients: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return ∂S/∂r (n,) and ∂S/∂θ (n,) of the surface with ``coefficients`` (4 · waves,)."""
        shape = coefficients.reshape(SUPPORT, -1)
        along_radius = np.sum(self.slopes * (self.waves @ shape.T), axis=1)
        along_angle = np.sum(self.splines * (self.waves @ _turned(shape).T), axis=1)
        return along_radius, along_angle


def spline_columns(place: FloatArray, intervals: int) -> FloatArray:
    """Return cubic B-splines over ``intervals`` unit intervals at ``place``, (n, intervals + 3)."""
    interval = np.clip(place.astype(np.int64), 0, intervals - 1)
    powers = (place - interval)[:, np.newaxis] ** np.arange(4)
    columns = np.zeros((len(place), intervals + SUPPORT - 1))
    spline = interval[:, np.newaxis] + np.arange(SUPPORT)
    columns[np.arange(len(place))[:, np.newaxis], spline] = powers @ _SPLINES.T
    return columns


def _turned(shape: FloatArray) -> FloatArray:
    """Return the coefficients of ∂S/∂θ: (cos mθ)' = -m sin mθ, (sin mθ)' = m cos mθ."""
    harmonics = (shape.shape[1] - 1) // 2
    order = np.arange(1, harmonics + 1)
    cosines, sines = shape[:, 1 : harmonics + 1], shape[:, harmonics + 1 :]
    return np.concatenate([np.zeros((SUPPORT, 1)), order * sines, -order * cosines], axis=1)


@dataclass(frozen=True, eq=False)
class IntervalRows:
    """Points of one interval of radius: which (n,), and the surface's terms there."""

    interval: int
    points: IntArray
    rows: PolarRows


Columns = Callable[[IntervalRows], tuple[FloatArray, FloatArray]]
"""Function of a portion of n points that returns X (n, p) and y (n,)."""


@dataclass(frozen=True, eq=False)
class ReducedNormalEquations:
    """Normal equations of the parameters, with the surface eliminated.

    matrix, right, square: (p, p), (p,) and yᵀy
    shares: C (terms, p);  surface: coefficients when p = 0, (terms,)
    """

    matrix: FloatArray
    right: FloatArray
    square: float
    shares: FloatArray
    surface: FloatArray

    def misfit(self, parameters: FloatArray) -> float:
        """Return the residual sum of squares of ``parameters`` (p,) with the best surface."""
        return float(self.square + parameters @ (self.matrix @ parameters - 2 * self.right))

    def surface_of(self, parameters: FloatArray) -> FloatArray:
        """Return the coefficients of the best surface (terms,) for ``parameters`` (p,)."""
        return np.asarray(self.surface - self.shares @ parameters)


def portions(
    basis: PolarBasis, order: IntArray, interval: IntArray, radius: FloatArray, angle: FloatArray
) -> Iterator[IntervalRows]:
    """Yield all points in portions of one interval each.

    order: points sorted by interval and time;  interval: of each point
    radius, angle: of each point [m], [rad]
    """
    edges = np.searchsorted(interval[order], np.arange(basis.intervals + 1))
    for number, (first, last) in enumerate(pairwise(edges)):
        for begin in range(first, last, _PORTION):
            points = order[begin : min(begin + _PORTION, last)]
            yield IntervalRows(number, points, basis.rows(number, radius[points], angle[points]))


def normal_equations(
    basis: PolarBasis, parts: Iterator[IntervalRows], columns: Columns
) -> ReducedNormalEquations:
    """Return the normal equations of all ``parts`` with the surface eliminated."""
    size = basis.size
    of_surface, mixed, own = np.zeros((size, size)), np.zeros((size, 0)), np.zeros((0, 0))
    for part in parts:
        terms, (x, y) = part.rows.matrix(), columns(part)
        x = np.concatenate([x, y[:, np.newaxis]], axis=1)
        if not own.size:
            mixed, own = np.zeros((size, x.shape[1])), np.zeros((x.shape[1], x.shape[1]))
        here = basis.terms(part.interval)
        of_surface[here, here] += terms.T @ terms
        mixed[here] += terms.T @ x
        own += x.T @ x
    diagonal = np.diag_indices(size)
    of_surface[diagonal] += _RIDGE * np.max(of_surface[diagonal])
    shares = linalg.cho_solve(linalg.cho_factor(of_surface), mixed)
    reduced = own - mixed.T @ shares
    return ReducedNormalEquations(
        matrix=reduced[:-1, :-1],
        right=reduced[:-1, -1],
        square=float(reduced[-1, -1]),
        shares=shares[:, :-1],
        surface=shares[:, -1],
    )


@dataclass(frozen=True, slots=True)
class ScanPlacement:
    """Point of linearisation: latency [s], and clocking of each scan [rad], (scans,)."""

    latency: float
    clocking: FloatArray


class ScanModel:
    """Points of all scans, with the columns of the parameters.

    Parameters: lag, curvature, gain, latency; then for each scan except the first: clocking, shift
    and tilt, and drift over time.

    Raises DataError for fewer than two scans, or scans without a common ring.
    """

    def __init__(self, scans: Sequence[ScanColumns], harmonics: int) -> None:
        if len(scans) < 2:
            raise DataError("adjustment.one_scan", scans=len(scans))
        outer = min(float(np.max(s.radius)) for s in scans)
        inner = max(_INNER_SHARE * outer, *(float(np.min(s.radius)) for s in scans))
        if not inner < outer:
            raise DataError("adjustment.no_common_ring", inner=inner, outer=outer)
        within = [(s.radius >= inner) & (s.radius <= outer) for s in scans]
        if not all(map(np.any, within)):
            raise DataError("adjustment.no_points_in_ring", inner=inner, outer=outer)
        self.number = len(scans)
        self.scan: IntArray = np.repeat(
            np.arange(len(scans)), [np.count_nonzero(w) for w in within]
        )
        self._column = {
            name: np.concatenate([getattr(s, name)[w] for s, w in zip(scans, within, strict=True)])
            for name in ScanColumns.__dataclass_fields__
        }
        self.turns = [_turns(s) for s in scans]
        intervals = int(
            np.clip(min(self.turns) // _TURNS_AN_INTERVAL, _LEAST_INTERVALS, _MOST_INTERVALS)
        )
        self.basis = PolarBasis(inner, outer, intervals, harmonics)
        self._drifts = [
            _DriftSpline.of(s, turns) for s, turns in zip(scans, self.turns, strict=True)
        ]
        self._interval = self.basis.interval(self._column["radius"])
        self._order = np.lexsort((np.arange(len(self.scan)), self._interval))

    def __len__(self) -> int:
        return len(self.scan)

    @property
    def speeds(self) -> list[float]:
        """Median spindle speed of each scan [rad/s], with the sign of its C."""
        rate = self._column["angular_rate"]
        # The probe moves over the part against the rotation of C.
        return [-float(np.median(rate[self.scan == k])) for k in range(self.number)]

    def own(self, scan: int) -> slice:
        """Return the slice of clocking, shift and tilt of ``scan`` (1, 2, …)."""
        begin = DYNAMIC + sum(len(OWN) + self._drifts[k].size for k in range(1, scan))
        return slice(begin, begin + len(OWN))

    @property
    def size(self) -> int:
        """Number of parameters."""
        return int(self.own(self.number).start)

    def radius(self, part: IntervalRows) -> FloatArray:
        """Return the radius of the points of ``part`` [m]."""
        return np.asarray(self._column["radius"][part.points])

    def angle(self, part: IntervalRows) -> FloatArray:
        """Return the angle of the points of ``part``, on the part [rad]."""
        return np.asarray(self._column["angle"][part.points])

    def portions(self, place: ScanPlacement, every: int) -> Iterator[IntervalRows]:
        """Yield one of ``every`` points, with the terms of the surface at ``place``."""
        column = self._column
        radius = column["radius"] - place.latency * column["radial_rate"]
        turned = place.latency * column["angular_rate"] + place.clocking[self.scan]
        angle = column["angle"] - turned
        return portions(self.basis, self._order[::every], self._interval, radius, angle)

    def columns(
        self, part: IntervalRows, place: ScanPlacement, surface: FloatArray | None
    ) -> tuple[FloatArray, FloatArray]:
        """Return X (n, parameters) and y (n,) of the points of ``part``.

        surface: coefficients for its slopes; None leaves out the columns that need them
        """
        column = {name: values[part.points] for name, values in self._column.items()}
        scan = self.scan[part.points]
        x = np.zeros((len(part.points), self.size))
        y = column["height"].copy()
        x[:, LAG] = column["motion_rate"]
        x[:, CURVATURE] = -column["motion_acceleration"]
        # ε d = ε (S - H(z)), and εS is absorbed by the surface.
        x[:, GAIN] = -column["motion"]
        position = column["radius"] * np.exp(1j * column["angle"])
        for k in range(1, self.number):
            mine, own = scan == k, self.own(k)
            x[mine, own.start + 3] = position.real[mine]
            x[mine, own.start + 4] = position.imag[mine]
            drift = self._drifts[k]
            x[mine, own.stop : own.stop + drift.size] = drift.columns(column["time"][mine])
        if surface is None:
            return x, y
        here = surface[self.basis.terms(part.interval)]
        radial, angular = part.rows.derivatives(here)
        x[:, LATENCY] = -(radial * column["radial_rate"] + angular * column["angular_rate"])
        # The values are linearised at ``place``; this offset makes the parameters absolute.
        y += x[:, LATENCY] * place.latency - angular * place.clocking[scan]
        gradient = (radial + 1j * angular / column["radius"]) * position / column["radius"]
        for k in range(1, self.number):
            mine, own = scan == k, self.own(k)
            x[mine, own.start + CLOCKING] = -angular[mine]
            x[mine, own.start + 1] = -gradient.real[mine]
            x[mine, own.start + 2] = -gradient.imag[mine]
        return x, y


@dataclass(frozen=True)
class _DriftSpline:
    """Cubic spline over ``duration`` [s], including its constant."""

    duration: float
    intervals: int

    @classmethod
    def of(cls, scan: ScanColumns, turns: float) -> _DriftSpline:
        intervals = int(np.clip(turns // _TURNS_A_DRIFT, 1, _MOST_DRIFT_INTERVALS))
        return cls(float(scan.time[-1]), intervals)

    @property
    def size(self) -> int:
        return self.intervals + 3

    def columns(self, time: FloatArray) -> FloatArray:
        return spline_columns(time / self.duration * self.intervals, self.intervals)


def _turns(scan: ScanColumns) -> float:
    period = float(np.median(np.diff(scan.time)))
    turns = float(np.sum(np.abs(scan.angular_rate))) * period / (2 * np.pi)
    if not np.isfinite(turns):
        raise DataError("adjustment.unknown_speed")
    return turns
