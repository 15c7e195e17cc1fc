"""What may a measurement be wrong by, at the places where it is compared?

Its noise is read off its own scatter. What its heights share is known by its fields, the effect of
each source on each point of the scan; where there are none, the stated uncertainty is taken for an
error of a form that nobody knows, correlated over a length. A drift that nobody states is
estimated from the difference, and so the part of it that goes with the time of a scan is not held
against either.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.special import erf

from omsm_ros.core.comparison.agreement import (
    COVERAGE_FACTOR,
    MeasurementErrors,
    shapes_of_difference,
)
from omsm_ros.core.comparison.matching import Matched
from omsm_ros.core.comparison.resampling import LocalHeights, LocalQuadratic
from omsm_ros.core.correction.source_kinds import components, random_walk
from omsm_ros.core.streams.blocks import FloatArray, IntArray
from omsm_ros.core.surface.measured_points import MeasuredPoints

# In which shapes may a measurement be wrong as a whole?
#
# Noise averages out over an area; a drift, a reference surface or a filter that is a little wrong
# does not. Such an error is a sum of shapes over the surface, each with an independent size of
# standard deviation one (Karhunen and Loève): a shape then is what it does to every height [m].

# Of an error correlated over half the radius of a disc 19 shapes hold what is kept, over a quarter
# 57, as with four times as many nodes.
_NODES = 400
# Of the variance, which changes a standard uncertainty by 0.25 %.
_LEFT_OUT = 0.005
# What is tried: from what no scan shows to what no scan survives, 12 % apart.
_DRIFTS_M = np.geomspace(1e-11, 1e-5, 121)


def unknown_form(x: FloatArray, y: FloatArray, size: FloatArray, length: float) -> FloatArray:
    """Return the shapes (k, m) of an error of standard deviation ``size`` (m,) [m] at x, y (m,).

    Its covariance falls with the distance d as ``exp(−d² / 2 length²)``. The shapes are found on
    400 of the places, as far from each other as can be, and carried to the others (Nyström), and
    scaled to the full variance. A length shorter than their distance is taken for it.
    """
    if len(x) == 0 or not np.any(size > 0):
        return np.empty((0, len(x)))
    some, apart = _nodes(x, y)
    length = max(length, apart)
    nodes = np.column_stack([x[some], y[some]])
    values, vectors = np.linalg.eigh(_kernel(nodes, nodes, length))
    values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
    share = np.cumsum(values) / values.sum()
    kept = int(np.searchsorted(share, 1 - _LEFT_OUT)) + 1
    carried = _kernel(np.column_stack([x, y]), nodes, length) @ (
        vectors[:, :kept] / np.sqrt(values[:kept])
    )
    found = np.linalg.norm(carried, axis=1, keepdims=True)
    return np.asarray((size[:, np.newaxis] * carried / np.maximum(found, 1e-9)).T, np.float64)


def _nodes(x: FloatArray, y: FloatArray) -> tuple[IntArray, float]:
    """Return the numbers of the nodes, and the least distance between two of them [m].

    Each is the place that is farthest from those before it (T. Gonzalez, Theor. Comput. Sci. 38,
    293): of a map of rows, every k-th place would leave wide gaps between columns of nodes.
    """
    nodes, apart = [0], 0.0
    nearest = np.hypot(x - x[0], y - y[0])
    while len(nodes) < min(_NODES, len(x)) and (farthest := float(nearest.max())) > 0:
        nodes.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, np.hypot(x - x[nodes[-1]], y - y[nodes[-1]]))
        apart = farthest
    return np.array(nodes), apart


def _kernel(one: FloatArray, other: FloatArray, length: float) -> FloatArray:
    square = np.sum((one[:, np.newaxis] - other[np.newaxis]) ** 2, axis=2)
    return np.asarray(np.exp(-square / (2 * length**2)), np.float64)


def drift(order: FloatArray, size: float) -> FloatArray:
    """Return the shapes (k, m) of a random walk in time that scatters by ``size`` [m] at its end.

    order: time of each place (m,), 0 at the beginning of the scan and 1 at its end
    """
    return np.asarray(size * components(random_walk, order), np.float64)


def likely_drift(
    difference: FloatArray, known: FloatArray, noise: FloatArray, drifts: FloatArray
) -> float:
    """Return the size of a drift of which nobody knows how large it was [m], from a difference.

    difference: (m,) [m];  known: shapes of the other errors (k, m) [m]
    noise: independent standard deviation of each place (m,) [m]
    drifts: shapes for a size of one metre (l, m)

    With ``difference ~ N(0, noise² + knownᵀ known + s² driftsᵀ drifts)`` some sizes s are likelier
    than others, a priori each alike in its logarithm; two of the size returned hold 95.45 % of
    what those make together. A drift of which the difference shows little may be larger than
    the likeliest: where one number alone told its size, the factor would be Student's.
    """
    some = np.linspace(0, len(difference) - 1, min(_NODES, len(difference))).astype(np.int64)
    shapes = known[:, some]
    covariance = shapes.T @ shapes + np.diag(noise[some] ** 2 + (1e-12) ** 2)
    root = cholesky(covariance, lower=True)
    data = solve_triangular(root, difference[some], lower=True)
    walked = solve_triangular(root, drifts[:, some].T, lower=True)
    values, vectors = np.linalg.eigh(walked.T @ walked)
    values = np.maximum(values, 0.0)
    square = (vectors.T @ (walked.T @ data)) ** 2
    sizes = _DRIFTS_M[:, np.newaxis]
    likelihood = np.sum(square * sizes**2 / (1 + sizes**2 * values), axis=1)
    likelihood -= np.sum(np.log1p(sizes**2 * values), axis=1)
    weight = np.exp(0.5 * (likelihood - likelihood.max()))
    held = erf(COVERAGE_FACTOR / np.sqrt(2) * sizes / _DRIFTS_M) @ (weight / weight.sum())
    return float(np.interp(erf(COVERAGE_FACTOR / np.sqrt(2)), held, _DRIFTS_M))


UNKNOWN_FORM, DRIFT = "unknown form", "drift"
AT_ONCE, STATED, ESTIMATED, NOT_KNOWN = (
    "taken at once", "stated", "estimated from the difference", "not known",
)  # fmt: skip


class ErrorFields(Protocol):
    """What systematic errors do to points, as a scan's ``ScanFields`` has it."""

    @property
    def names(self) -> tuple[str, ...]:
        """Name of the source of each field."""
        ...

    @property
    def aligned(self) -> tuple[str, ...]:
        """Names of those whose fields are the same errors in every scan of one calibration."""
        ...

    def at(self, first: int, count: int) -> FloatArray:
        """Return the fields (s, count) [m] at the points from ``first`` on."""
        ...


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ComparedMeasurement:
    """Points and what is known of their errors beside the scatter that they show themselves.

    name: in messages
    fields: what its systematic errors do to its points; None: not known
    common: standard uncertainty of what neighbouring heights share where there are no ``fields``
        [m]; None: that of the points
    drift: standard deviation of the drift at the end of the scan [m]; None: nobody states it,
        unless one of the fields is a drift
    calibration: what the points were corrected by; empty: not known
    pose: what the pose that was taken off may be wrong by; None: none was
    """

    name: str
    points: MeasuredPoints
    fields: ErrorFields | None = None
    common: float | None = None
    drift: float | None = None
    calibration: str = ""
    pose: ErrorFields | None = None

    @property
    def drift_from(self) -> str:
        """Who knows the size of its drift."""
        if self.points.sample is None:
            return AT_ONCE
        in_fields = self.fields is not None and any(n.startswith(DRIFT) for n in self.fields.names)
        return STATED if self.drift is not None or in_fields else ESTIMATED

    @property
    def duration(self) -> float:
        """Samples from the first point to the last."""
        return 1.0 if self.points.sample is None else max(float(np.ptp(self.points.sample)), 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class ComparisonSide:
    """One measurement in a comparison.

    surface: between its points;  taken: its heights at the places;  x, y: those in its own frame
    interpolation: rms error between the points, from above [m]
    """

    measurement: ComparedMeasurement
    surface: LocalQuadratic
    taken: LocalHeights
    x: FloatArray
    y: FloatArray
    interpolation: float


def errors_of(
    halves: tuple[ComparisonSide, ComparisonSide], matched: Matched, length: float
) -> tuple[tuple[MeasurementErrors | None, MeasurementErrors | None], tuple[str, ...]]:
    """Return the errors of both, None for one of which nobody states any, and what they share."""
    one, other = (_known(half, matched, length) for half in halves)
    if one is None or other is None:
        return (one, other), ()
    shared = _shared(halves, (one, other))
    drifts = _drifts(halves, matched, (one, other), shared)
    first, second = (
        replace(errors, shapes={**errors.shapes, **drifted})
        for errors, drifted in zip((one, other), drifts, strict=True)
    )
    return (first, second), shared


def _shared(
    halves: tuple[ComparisonSide, ComparisonSide],
    errors: tuple[MeasurementErrors, MeasurementErrors],
) -> tuple[str, ...]:
    """Return sources of one and the same error in both: those of the calibration that both used."""
    ids = {half.measurement.calibration for half in halves}
    if len(ids) > 1 or not all(ids):
        return ()
    one, other = (half.measurement.fields for half in halves)
    if one is None or other is None:
        return ()
    return tuple(
        name
        for name in one.aligned
        if name in other.aligned and len(errors[0].shapes[name]) == len(errors[1].shapes[name])
    )


def _known(half: ComparisonSide, matched: Matched, length: float) -> MeasurementErrors | None:
    shapes = _shapes(half, matched, length)
    if shapes is None:
        return None
    noise, taken = half.surface.scatter**2, half.taken
    return MeasurementErrors(
        shapes=shapes,
        single=np.sqrt(noise * taken.gain + half.interpolation**2),
        averaged=np.sqrt(noise / taken.density + half.interpolation**2),
    )


def _shapes(half: ComparisonSide, matched: Matched, length: float) -> dict[str, FloatArray] | None:
    """Return the shapes by source, each (k, m) [m]; None if nobody states any."""
    m = half.measurement
    pose = {} if m.pose is None else _carried(half, m.pose)
    if m.fields is not None:
        return {**_carried(half, m.fields), **pose}
    size = half.taken.stated if m.common is None else np.full(len(half.x), m.common)
    if not np.all(np.isfinite(size)):
        return None
    return {UNKNOWN_FORM: unknown_form(matched.x, matched.y, size, length), **pose}


def _carried(half: ComparisonSide, fields: ErrorFields) -> dict[str, FloatArray]:
    """Return the fields of the points as shapes at the places, by source, each (k, m) [m]."""
    if not fields.names:
        return {}
    rows = half.surface.carried(fields.at, half.x, half.y)
    return {
        name: rows[[k for k, own in enumerate(fields.names) if own == name]]
        for name in dict.fromkeys(fields.names)
    }


def _drifts(
    halves: tuple[ComparisonSide, ComparisonSide],
    matched: Matched,
    known: tuple[MeasurementErrors, MeasurementErrors],
    shared: tuple[str, ...],
) -> list[dict[str, FloatArray]]:
    """Return shapes of both drifts; one that nobody states is estimated from the difference."""
    found: list[dict[str, FloatArray]] = [{}, {}]
    longest = max(half.measurement.duration for half in halves)
    unit: dict[int, FloatArray] = {}
    for place, half in enumerate(halves):
        m = half.measurement
        if m.drift_from == ESTIMATED:
            unit[place] = drift(half.taken.order, float(np.sqrt(m.duration / longest)))
        elif m.drift_from == STATED and m.drift:
            found[place] = {DRIFT: drift(half.taken.order, m.drift)}
    if not unit:
        return found
    stated = [rows for f in found for rows in f.values()]
    others = np.concatenate([shapes_of_difference(known, shared), *stated])
    size = likely_drift(
        matched.difference,
        matched.without_fit(others),
        np.hypot(known[0].single, known[1].single),
        matched.without_fit(np.concatenate(list(unit.values()))),
    )
    for place, rows in unit.items():
        found[place] = {DRIFT: size * rows}
    return found


def drift_size(errors: MeasurementErrors | None) -> float:
    """Return the largest standard deviation of a drift over the places [m]."""
    rows = [] if errors is None else [r for n, r in errors.shapes.items() if n.startswith(DRIFT)]
    if not rows or not sum(len(r) for r in rows):
        return 0.0
    return float(np.sqrt(np.max(np.sum(np.concatenate(rows) ** 2, axis=0))))
