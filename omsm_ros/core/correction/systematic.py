"""Systematic errors of a scan as sensitivity fields over its points.

Noise averages out over points; a tilt, a wrong centre or a wrong calibration does not. Such a
source is a *sensitivity field*: the change of each height for one unit of the source. With the
standard uncertainty ``u`` of the source, that of a linear figure ``L`` of the heights (a mean, a
Zernike coefficient) is ``u |L(field)|``; independent sources, and the independent components of
one source, add in squares (GUM, 5.1).

Fields are computed at points that are evenly chosen in the order of the scan, and interpolated
between them. Components with a negligible share are left out.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from omsm_ros.core.kinematics.kinematics import (
    PolynomialSurface,
    Surface,
    WorkpiecePoints,
    slopes_by_differences,
    workpiece_xy,
)
from omsm_ros.core.streams.blocks import BoolArray, FloatArray
from omsm_ros.core.streams.statistics import EvenSelection
from omsm_ros.errors import DataError

EVALUATED, DECLARED, NOT_EVALUATED = "evaluated", "declared", "not evaluated"
ASSUMED = "assumed"

# Degree of the polynomial through the points that gives the slopes without a nominal surface.
_POLYNOMIAL_DEGREE = 6


@dataclass(frozen=True, eq=False, kw_only=True)
class ScanPoints:
    """Points of a scan in the order of time, each array (n,): arguments of sensitivity fields.

    time: since the start [s];  x, y, height: in the workpiece frame [m]
    z: of the probe, H(z) [m];  z_rate: its rate [m/s];  b, c: angles of table and spindle [rad]
    distance: that the probe measured, growing with height [m]
    slope_x, slope_y: of the surface along the workpiece's x and y [1]; None if not known
    dynamics: change of the heights per standard uncertainty along each independent direction of
        the calibration's covariance [m], (r, n)
    undetected: True for directions of undetected model error (r,)
    """

    time: FloatArray
    x: FloatArray
    y: FloatArray
    height: FloatArray
    z: FloatArray
    z_rate: FloatArray
    b: FloatArray
    c: FloatArray
    distance: FloatArray
    slope_x: FloatArray | None = None
    slope_y: FloatArray | None = None
    dynamics: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    undetected: BoolArray = field(default_factory=lambda: np.zeros(0, np.bool_))

    def __len__(self) -> int:
        return len(self.time)

    @property
    def slide_x(self) -> FloatArray:
        """Position relative to the spindle axis along X of the machine [m], (n,)."""
        return self._slides[0]

    @property
    def slide_y(self) -> FloatArray:
        """Position relative to the spindle axis along Y of the machine [m], (n,)."""
        return self._slides[1]

    @cached_property
    def _slides(self) -> tuple[FloatArray, FloatArray]:
        # Cached and lazy: few sources need it, and a cosine costs as much as a filter.
        return workpiece_xy(self.x, self.y, -self.c)

    def with_slopes(self, surface: Surface | None) -> ScanPoints:
        """Return the points with the slopes of the nominal ``surface``.

        If it is None, the slopes are those of a polynomial of degree 6 through the points.
        """
        if surface is None:
            through = PolynomialSurface.through(self.x, self.y, self.height, _POLYNOMIAL_DEGREE)
            slope_x, slope_y = through.gradient(self.x, self.y)
        else:
            slope_x, slope_y = slopes_by_differences(surface, self.x, self.y)
        return replace(self, slope_x=slope_x, slope_y=slope_y)

    def height_change_of_shift(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height errors [m] of points that are reported with a shift ``x``, ``y`` [m].

        A point reported at x + δ has the height at x, an error of ``-δ ∂S/∂x``. Raises DataError
        if the slopes are not known.
        """
        if self.slope_x is None or self.slope_y is None:
            raise DataError("correction.no_slope")
        return np.asarray(-self.slope_x * x - self.slope_y * y, np.float64)


# Share of the variance that may be left out: of one source (0.5 % of its standard uncertainty), and
# of all sources (0.2 %, because a figure may not depend on the largest sources).
_LEFT_OUT_OF_ONE, _LEFT_OUT_OF_ALL = 1e-2, 4e-6
# Sources of the calibration, which are the same errors in every scan that it corrects.
_OF_THE_CALIBRATION = ("dynamics", "undetected_model_error", "probe_latency", "static_gain")
# Interpolation between fewer points a turn would lose an error with two waves a turn.
_LEAST_POINTS_PER_TURN = 12


@dataclass(frozen=True, eq=False)
class ScanFields:
    """Independent systematic errors of a scan.

    names: source of each component, (s,);  every: step from one point to the next in the scan
    fields: change of the heights [m] per standard uncertainty, (s, m)
    bounds: names of the sources of which only an upper bound is known
    aligned: names of the sources whose components are the same errors in every scan with the same
        calibration
    """

    names: tuple[str, ...]
    fields: FloatArray
    every: int
    bounds: tuple[str, ...] = ()
    aligned: tuple[str, ...] = ()

    def at(self, first: int, count: int) -> FloatArray:
        """Return the fields (s, count) [m] at the scan's points from ``first`` on."""
        if not self.fields.size:
            return np.zeros((len(self.names), count))
        place, kept = (first + np.arange(count)) / self.every, np.arange(self.fields.shape[1])
        return np.stack([np.interp(place, kept, row) for row in self.fields])


def scan_fields(
    fields: Mapping[str, FloatArray], every: int, bounds: Collection[str] = ()
) -> ScanFields:
    """Return the components of ``fields``, by source (k, m) [m], that are not negligible."""
    names: list[str] = []
    rows: list[FloatArray] = []
    aligned = tuple(name for name in _OF_THE_CALIBRATION if name in fields)
    for name, found in fields.items():
        own = found if name in aligned else _principal(found)
        names += [name] * len(own)
        rows += list(own)
    if not rows:
        return ScanFields((), np.empty((0, 0)), every)
    counts = _count(np.array(rows), _LEFT_OUT_OF_ALL)
    # All components of an aligned source are kept, so that scans can be compared.
    together = {name for name, own in zip(names, counts, strict=True) if own and name in aligned}
    kept = np.flatnonzero(counts | np.isin(names, list(together)))
    left = tuple(names[k] for k in kept)
    known = tuple(name for name in bounds if name in left)
    same = tuple(name for name in aligned if name in together)
    return ScanFields(left, np.array([rows[k] for k in kept]), every, known, same)


def resolves_per_turn_waves(points: ScanPoints) -> bool:
    """Return whether ``points`` are dense enough for errors that repeat with the turns."""
    steps = np.abs(np.diff(np.unwrap(points.c)))
    return not len(steps) or float(np.median(steps)) <= 2 * np.pi / _LEAST_POINTS_PER_TURN


def _principal(fields: FloatArray) -> FloatArray:
    """Return uncorrelated rows whose squares add up as those of ``fields``, but for small ones."""
    moved = fields - np.mean(fields, axis=1, keepdims=True)
    rows = np.linalg.eigh(moved @ moved.T)[1].T @ fields
    return np.asarray(rows[_count(rows, _LEFT_OUT_OF_ONE)], np.float64)


def _count(rows: FloatArray, left_out: float) -> BoolArray:
    """Return which ``rows`` (k, n) make up all but the share ``left_out`` of their variance."""
    own = np.var(rows, axis=1)
    order = np.argsort(own)
    small = order[np.cumsum(own[order]) <= left_out * own.sum()]
    counts = np.ones(len(rows), bool)
    counts[small] = False
    return counts


# Number of points at which fields are computed, which bounds memory. Fields are smooth; 512 turns
# have sixteen points each, enough for errors with eight waves a turn.
MOST_TRACED = 8192

_COLUMNS = ("time", "x", "y", "height", "z", "z_rate", "b", "c", "distance")


class ScanTrace:
    """Selects evenly spaced points of a scan; time and Z are relative to the first point.

    seen: number of points of the scan;  undetected: see ``ScanPoints``
    """

    def __init__(self, most: int = MOST_TRACED) -> None:
        self._kept = EvenSelection(most)
        self._session: int | None = None
        self._late = self._last = 0.0
        self._first_z = 0.0
        self.undetected: BoolArray = np.zeros(0, np.bool_)
        self.seen = 0

    def add(
        self,
        session: int,
        time: FloatArray,
        where: WorkpiecePoints,
        turned: tuple[FloatArray, FloatArray],
        motion: FloatArray,
        distance: FloatArray,
    ) -> ScanPoints:
        """Take the next points, each array (n,), and return them as ``ScanPoints``.

        session, time: of the trigger counter [s]; after a restart of the counter the time
            continues without a gap
        turned: b and c [rad]
        motion: H(z), its rate, and its change by each direction of the covariance, (2 + r, n)
        """
        if len(time):
            if session != self._session:
                self._session, self._late = session, self._last - float(time[0])
            self._last = float(time[-1]) + self._late
            if not self.seen:
                self._first_z = float(motion[0, 0])
        points = ScanPoints(
            time=time + self._late,
            x=where.x,
            y=where.y,
            height=where.height,
            z=motion[0] - self._first_z,
            z_rate=motion[1],
            b=turned[0],
            c=turned[1],
            distance=distance,
            dynamics=motion[2:],
            undetected=self.undetected,
        )
        self.seen += len(points)
        chosen = self._kept.chosen(len(points))
        rows = [getattr(points, name)[chosen] for name in _COLUMNS]
        self._kept.add_chosen(np.stack([*rows, *points.dynamics[:, chosen]]).T, len(points))
        return points

    @property
    def every(self) -> int:
        """Step from one kept point to the next."""
        return self._kept.every

    def points(self) -> ScanPoints:
        """Return the kept points in the order of time."""
        rows = self._kept.rows() if self.seen else np.empty((0, len(_COLUMNS)))
        columns = dict(zip(_COLUMNS, rows.T, strict=False))
        return ScanPoints(**columns, dynamics=rows.T[len(_COLUMNS) :], undetected=self.undetected)
