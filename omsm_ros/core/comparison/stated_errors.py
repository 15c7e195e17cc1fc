"""Errors of a measurement at the places where it is compared.

The noise follows from the scatter of the points. Systematic errors are given by their fields, the
effect of each source on each point of the scan; without fields, the stated uncertainty counts as an
error of unknown form with a correlation length. A drift that is not stated is estimated from the
difference.

A systematic error is a sum of shapes over the surface, each with an independent amplitude of
standard deviation one (Karhunen-Loève expansion): a shape is its effect on every height [m].
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.spatial.distance import cdist
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

# An error correlated over half the radius of a disc needs 19 shapes, over a quarter 57; four times
# as many nodes give the same.
_NODES = 400
# Share of the variance that is left out; it changes a standard uncertainty by 0.25 %.
_LEFT_OUT = 0.005
# Sizes of a drift that are tried, 12 % apart, from invisible to implausible.
_DRIFTS_M = np.geomspace(1e-11, 1e-5, 121)


def unknown_form(x: FloatArray, y: FloatArray, size: FloatArray, length: float) -> FloatArray:
    """Return the shapes (k, m) of an error of standard deviation ``size`` (m,) [m] at x, y (m,).

    Its correlation falls with the distance d as ``exp(−d² / 2 length²)``. The shapes are computed
    on 400 distant places, extended to the others (Nyström) and scaled to the full variance. The
    distance of these places is the least correlation length.
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
    """Return the indices of the nodes, and the least distance between two of them [m].

    Each node is the place farthest from those before it (T. Gonzalez, Theor. Comput. Sci. 38, 293).
    """
    nodes, apart = [0], 0.0
    nearest = np.hypot(x - x[0], y - y[0])
    while len(nodes) < min(_NODES, len(x)) and (farthest := float(nearest.max())) > 0:
        nodes.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, np.hypot(x - x[nodes[-1]], y - y[nodes[-1]]))
        apart = farthest
    return np.array(nodes), apart


def _kernel(one: FloatArray, other: FloatArray, length: float) -> FloatArray:
    return np.asarray(np.exp(-cdist(one, other, "sqeuclidean") / (2 * length**2)), np.float64)


def drift(order: FloatArray, size: float) -> FloatArray:
    """Return the shapes (k, m) of a random walk with standard deviation ``size`` [m] at its end.

    order: time of each place (m,), 0 at the beginning of the scan and 1 at its end
    """
    return np.asarray(size * components(random_walk, order), np.float64)


def likely_drift(
    difference: FloatArray, known: FloatArray, noise: FloatArray, drifts: FloatArray
) -> float:
    """Return the standard deviation of an unknown drift [m], estimated from a difference.

    difference: (m,) [m];  known: shapes of the other errors (k, m) [m]
    noise: independent standard deviation of each place (m,) [m]
    drifts: shapes for a size of one metre (l, m)

    The difference has the distribution ``N(0, noise² + knownᵀ known + s² driftsᵀ drifts)``.
    The prior of the size s is uniform in log s. Twice the result covers 95.45 % of the drift
    averaged over the posterior of s, as a Student factor does for one observation.
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


@dataclass(frozen=True, slots=True, eq=False)
class ErrorFields:
    """Effects of systematic errors on points.

    names: source of each;  at: returns them (s, count) [m] at ``count`` points from a first one on
    aligned: names of sources with the same error in every scan of one calibration
    """

    names: tuple[str, ...]
    at: Callable[[int, int], FloatArray]
    aligned: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ComparedMeasurement:
    """Points of a measurement and their systematic errors.

    name: for messages;  fields: effects of systematic errors on the points; None: unknown
    common: standard uncertainty that neighbouring heights have in common, without ``fields`` [m];
        None: that of the points
    drift: standard deviation of the drift at the end of the scan [m]; None: not stated, unless one
        of the fields is a drift or a walk
    calibration: id of the calibration that corrected the points; empty: unknown
    pose: effects of errors of the pose that was removed; None: no pose was removed
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
        """Origin of the size of the drift."""
        if self.points.sample is None:
            return AT_ONCE
        # A steady rate does not say how large a walk is.
        names = set() if self.fields is None else set(self.fields.names)
        in_fields = not names.isdisjoint((DRIFT, "drift_walk"))
        return STATED if self.drift is not None or in_fields else ESTIMATED

    @property
    def duration(self) -> float:
        """Number of samples from the first point to the last."""
        return 1.0 if self.points.sample is None else max(float(np.ptp(self.points.sample)), 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class ComparisonSide:
    """One measurement in a comparison.

    surface: between its points;  taken: heights at the places;  x, y: places in its own frame [m]
    interpolation: upper bound of the rms interpolation error [m]
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
    """Return the errors of both, None where they are unknown, and the sources in common."""
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
    """Return the shapes by source, each (k, m) [m], None if they are unknown."""
    m = half.measurement
    pose = {} if m.pose is None else _carried(half, m.pose)
    if m.fields is not None:
        return {**_carried(half, m.fields), **pose}
    size = half.taken.stated if m.common is None else np.full(len(half.x), m.common)
    if not np.all(np.isfinite(size)):
        return None
    return {UNKNOWN_FORM: unknown_form(matched.x, matched.y, size, length), **pose}


def _carried(half: ComparisonSide, fields: ErrorFields) -> dict[str, FloatArray]:
    """Return the ``fields`` interpolated to the places, by source, each (k, m) [m]."""
    if not fields.names:
        return {}
    rows = half.surface.carried(fields.at, half.x, half.y)
    return {
        name: rows[[k for k, own in enumerate(fields.names) if own == name]]
        for name in dict.fromkeys(fields.names)
    }


def _drifts(
    halves: tuple[ComparisonSide, ComparisonSide], matched: Matched,
    known: tuple[MeasurementErrors, MeasurementErrors], shared: tuple[str, ...],
) -> list[dict[str, FloatArray]]:  # fmt: skip
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
