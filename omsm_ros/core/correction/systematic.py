"""Which errors act on a whole scan together, and what does each do to every height of it?

Noise averages out over points; a tilt, a centre that is off or a calibration that is wrong does
not. Such a source is a *sensitivity field* over the scan: the change of each height for one unit
of the source. With the standard uncertainty ``u`` of the source, the standard uncertainty of a
linear figure ``L`` of the heights (a mean, a Zernike coefficient) is ``u |L(field)|``; independent
sources, and the independent components of one source, add in squares (GUM, 5.1).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from omsm_ros.core.kinematics.kinematics import (
    Surface,
    WorkpiecePoints,
    slopes_by_differences,
    workpiece_xy,
)
from omsm_ros.core.streams.blocks import BoolArray, FloatArray
from omsm_ros.core.streams.statistics import EvenSelection
from omsm_ros.errors import ConfigurationError, DataError
from omsm_ros.quantities import MAP_SPACING

EVALUATED, DECLARED, NOT_EVALUATED = "evaluated", "declared", "not evaluated"

# Without a nominal surface its slopes come from a polynomial through the points.
_POLYNOMIAL_DEGREE = 6


@dataclass(frozen=True, eq=False, kw_only=True)
class ScanPoints:
    """Points of a scan in the order of time, each array (n,): what a sensitivity field looks at.

    time: since the start [s];  x, y, height: in the workpiece frame [m]
    z: of the probe, H(z) [m];  z_rate: its rate [m/s];  c: angle of the spindle [rad]
    distance: that the probe measured, growing with height [m]
    slope_x, slope_y: of the surface along the workpiece's x and y [1]; None where it is not known
    dynamics: of the heights by each independent direction of the calibration's covariance, per
        standard uncertainty [m], (r, n);  undetected: which of them are of what its step test could
        not show (r,)
    """

    time: FloatArray
    x: FloatArray
    y: FloatArray
    height: FloatArray
    z: FloatArray
    z_rate: FloatArray
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
        """Of the point from the spindle axis, along X of the machine [m], (n,)."""
        return self._slides[0]

    @property
    def slide_y(self) -> FloatArray:
        """Of the point from the spindle axis, along Y of the machine [m], (n,)."""
        return self._slides[1]

    @cached_property
    def _slides(self) -> tuple[FloatArray, FloatArray]:
        # Few sources ask for them, and a cosine costs as much as a filter.
        return workpiece_xy(self.x, self.y, -self.c)

    def with_slopes(self, surface: Surface | None) -> ScanPoints:
        """Return the points with the slopes of the nominal ``surface``.

        Without one they are those of a polynomial of degree 6 through the points themselves.
        """
        if surface is None:
            slope_x, slope_y = _polynomial_slopes(self.x, self.y, self.height)
        else:
            slope_x, slope_y = slopes_by_differences(surface, self.x, self.y)
        return replace(self, slope_x=slope_x, slope_y=slope_y)

    def height_change_of_shift(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the change of height [m] at its place of points taken for ``x``, ``y`` [m] off.

        A point reported at x + δ has the height of x: against the surface ``-δ ∂S/∂x``.
        Raises DataError where the slopes are not known.
        """
        if self.slope_x is None or self.slope_y is None:
            raise DataError("the slope of the surface is not known; give a nominal surface")
        return np.asarray(-self.slope_x * x - self.slope_y * y, np.float64)


@dataclass(frozen=True, eq=False, kw_only=True)
class SystematicSource:
    """A source of error that acts on the whole scan together.

    name: of the source;  unit: of its size, SI
    standard_uncertainty: of each of its independent components [unit], k = 1
    fields: change of each height [m] per unit of each component, (k, n), for ``ScanPoints``
    origin: EVALUATED from data, or DECLARED by somebody;  reason: in words
    needs_slope: True if the fields need the slope of the surface
    squares: sum of the squares of the fields, (n,), where that is had with less work

    Raises ConfigurationError for an uncertainty that is no finite number of zero or more.
    """

    name: str
    unit: str
    standard_uncertainty: float
    fields: Callable[[ScanPoints], FloatArray]
    origin: str = DECLARED
    reason: str = ""
    needs_slope: bool = False
    squares: Callable[[ScanPoints], FloatArray] | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.standard_uncertainty < np.inf:
            raise ConfigurationError(
                f"{self.name}: standard uncertainty {self.standard_uncertainty!r} {self.unit}, "
                "expected zero or more"
            )

    def standard_fields(self, points: ScanPoints) -> FloatArray:
        """Return the change of the heights [m] per standard uncertainty, (k, n)."""
        return np.asarray(self.standard_uncertainty * self.fields(points), np.float64)

    def variance(self, points: ScanPoints) -> FloatArray:
        """Return the variance of each height [m²], (n,)."""
        if self.squares is None:
            return np.asarray(np.sum(self.standard_fields(points) ** 2, axis=0), np.float64)
        return np.asarray(self.standard_uncertainty**2 * self.squares(points), np.float64)


def standard_fields(
    sources: Sequence[SystematicSource], points: ScanPoints
) -> dict[str, FloatArray]:
    """Return by name the change of the heights [m] per standard uncertainty, each (k, n).

    Sources of one name are one source with all their components.
    """
    found: dict[str, list[FloatArray]] = {}
    for source in sources:
        found.setdefault(source.name, []).append(source.standard_fields(points))
    return {name: np.concatenate(parts) for name, parts in found.items()}


def _polynomial_slopes(
    x: FloatArray, y: FloatArray, height: FloatArray
) -> tuple[FloatArray, FloatArray]:
    scale = float(max(np.max(abs(x), initial=0.0), np.max(abs(y), initial=0.0)))
    scale = scale if scale > MAP_SPACING.low else 1.0  # all is one place, but for the last bits
    powers = [(i, j) for i in range(_POLYNOMIAL_DEGREE + 1) for j in range(i + 1)]
    u, v = (np.vander(a / scale, _POLYNOMIAL_DEGREE + 1, increasing=True) for a in (x, y))
    design = np.stack([u[:, i - j] * v[:, j] for i, j in powers], axis=1)
    coefficient = np.linalg.lstsq(design, height, rcond=None)[0] / scale
    slope_x, slope_y = np.zeros(len(x)), np.zeros(len(x))
    for value, (i, j) in zip(coefficient, powers, strict=True):
        if i > j:
            slope_x += value * (i - j) * u[:, i - j - 1] * v[:, j]
        if j:
            slope_y += value * j * u[:, i - j] * v[:, j - 1]
    return slope_x, slope_y


# What do the systematic errors of a scan do to each of its points, however many there are?
#
# Sensitivity fields are had at some points, evenly chosen; between them they are interpolated in
# the
# order of the scan. Components that hardly count are left out, so that a figure of the heights is
# propagated through a few fields, not through hundreds.

# Of the variance of one source: half a hundredth of its standard uncertainty. Of that of all: a
# figure may look where the largest ones do nothing, so a five-hundredth of a standard uncertainty.
_LEFT_OUT_OF_ONE, _LEFT_OUT_OF_ALL = 1e-2, 4e-6
# Sources of the calibration: in every scan that it corrects, each of their directions has one size.
_OF_THE_CALIBRATION = ("dynamics", "could_hide", "lateral_lag", "static_gain")
# With fewer points a turn what repeats twice in it would be cut off between them.
_LEAST_POINTS_PER_TURN = 12


@dataclass(frozen=True, eq=False)
class ScanFields:
    """Independent systematic errors of a scan.

    names: of the source of each, (s,);  every: of how many points of the scan one is here
    fields: change of the heights [m] per standard uncertainty, (s, m)
    bounds: names of the sources of which only an upper bound is known
    aligned: names of the sources whose fields are, in this order, those of the same errors in
        every scan with the same calibration
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
        last = self.fields.shape[1] - 1
        place = np.minimum((first + np.arange(count)) / self.every, last)
        below = np.minimum(place.astype(np.int64), max(last - 1, 0))
        share = place - below
        above = np.minimum(below + 1, last)
        return np.asarray(
            self.fields[:, below] * (1 - share) + self.fields[:, above] * share, np.float64
        )


def scan_fields(
    fields: Mapping[str, FloatArray], every: int, bounds: Collection[str] = ()
) -> ScanFields:
    """Return the components that count of ``fields``, by source (k, m) [m].

    bounds: names of the sources of which only an upper bound is known
    """
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
    # To be found again in another scan, they stay together.
    together = {name for name, own in zip(names, counts, strict=True) if own and name in aligned}
    kept = np.flatnonzero(counts | np.isin(names, list(together)))
    left = tuple(names[k] for k in kept)
    known = tuple(name for name in bounds if name in left)
    same = tuple(name for name in aligned if name in together)
    return ScanFields(left, np.array([rows[k] for k in kept]), every, known, same)


def resolves_per_turn_waves(points: ScanPoints) -> bool:
    """Return whether ``points`` are close enough for what repeats with the spindle's turns."""
    # An angle that is wrapped jumps by a turn once a turn.
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


# Which points stand for a whole scan where its systematic errors are judged?
#
# Sensitivity fields are smooth over a scan: a few thousand points, evenly chosen in time, show what
# millions would, in memory that does not grow.

# Sixteen points a turn of the paper's scan and more: enough for what repeats eight times a turn.
MOST_TRACED = 8192

_COLUMNS = ("time", "x", "y", "height", "z", "z_rate", "c", "distance")


class ScanTrace:
    """Points of a scan, evenly chosen while they pass; time and Z count from the first one.

    seen: points that passed
    undetected: which changes by the covariance are of what the step test could not show, (r,)
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
        c: FloatArray,
        motion: FloatArray,
        distance: FloatArray,
    ) -> ScanPoints:
        """Take in the next points, each array (n,), and return them as fields look at them.

        session, time: of the trigger's counter, by which the samples are counted [s]; what comes
            after a restart of the counter is taken to follow at once
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
            c=c,
            distance=distance,
            dynamics=motion[2:],
            undetected=self.undetected,
        )
        self._keep(points)
        return points

    @property
    def every(self) -> int:
        """Of how many points one is kept."""
        return self._kept.every

    def _keep(self, points: ScanPoints) -> None:
        self.seen += len(points)
        chosen = self._kept.chosen(len(points))
        rows = [getattr(points, name)[chosen] for name in _COLUMNS]
        self._kept.add_chosen(np.stack([*rows, *points.dynamics[:, chosen]]).T, len(points))

    def points(self) -> ScanPoints:
        """Return those kept, in the order of time."""
        rows = self._kept.rows() if self.seen else np.empty((0, len(_COLUMNS)))
        columns = dict(zip(_COLUMNS, rows.T, strict=False))
        return ScanPoints(**columns, dynamics=rows.T[len(_COLUMNS) :], undetected=self.undetected)
