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

from omsm_ros.core.comparison.agreement import Errors, shapes_of_difference
from omsm_ros.core.comparison.error_shapes import drift, likely_drift, unknown_form
from omsm_ros.core.comparison.matching import Matched
from omsm_ros.core.comparison.resampling import LocalHeights, LocalQuadratic
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.core.surface.measured_points import MeasuredPoints

UNKNOWN_FORM, DRIFT = "unknown form", "drift"
AT_ONCE, STATED, ESTIMATED, NOT_KNOWN = (
    "taken at once", "stated", "estimated from the difference", "not known",
)  # fmt: skip


class Fields(Protocol):
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
class Measurement:
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
    fields: Fields | None = None
    common: float | None = None
    drift: float | None = None
    calibration: str = ""
    pose: Fields | None = None

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
class Half:
    """One measurement in a comparison.

    surface: between its points;  taken: its heights at the places;  x, y: those in its own frame
    interpolation: rms error between the points, from above [m]
    """

    measurement: Measurement
    surface: LocalQuadratic
    taken: LocalHeights
    x: FloatArray
    y: FloatArray
    interpolation: float


def errors_of(
    halves: tuple[Half, Half], matched: Matched, length: float
) -> tuple[tuple[Errors | None, Errors | None], tuple[str, ...]]:
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


def _shared(halves: tuple[Half, Half], errors: tuple[Errors, Errors]) -> tuple[str, ...]:
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


def _known(half: Half, matched: Matched, length: float) -> Errors | None:
    shapes = _shapes(half, matched, length)
    if shapes is None:
        return None
    noise, taken = half.surface.scatter**2, half.taken
    return Errors(
        shapes=shapes,
        single=np.sqrt(noise * taken.gain + half.interpolation**2),
        averaged=np.sqrt(noise / taken.density + half.interpolation**2),
    )


def _shapes(half: Half, matched: Matched, length: float) -> dict[str, FloatArray] | None:
    """Return the shapes by source, each (k, m) [m]; None if nobody states any."""
    m = half.measurement
    pose = {} if m.pose is None else _carried(half, m.pose)
    if m.fields is not None:
        return {**_carried(half, m.fields), **pose}
    size = half.taken.stated if m.common is None else np.full(len(half.x), m.common)
    if not np.all(np.isfinite(size)):
        return None
    return {UNKNOWN_FORM: unknown_form(matched.x, matched.y, size, length), **pose}


def _carried(half: Half, fields: Fields) -> dict[str, FloatArray]:
    """Return the fields of the points as shapes at the places, by source, each (k, m) [m]."""
    if not fields.names:
        return {}
    rows = half.surface.carried(fields.at, half.x, half.y)
    return {
        name: rows[[k for k, own in enumerate(fields.names) if own == name]]
        for name in dict.fromkeys(fields.names)
    }


def _drifts(
    halves: tuple[Half, Half],
    matched: Matched,
    known: tuple[Errors, Errors],
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


def drift_size(errors: Errors | None) -> float:
    """Return the largest standard deviation of a drift over the places [m]."""
    rows = [] if errors is None else [r for n, r in errors.shapes.items() if n.startswith(DRIFT)]
    if not rows or not sum(len(r) for r in rows):
        return 0.0
    return float(np.sqrt(np.max(np.sum(np.concatenate(rows) ** 2, axis=0))))
