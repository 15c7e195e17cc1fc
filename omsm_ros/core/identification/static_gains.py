"""The static gain, attributed: is it the probe's scale, or the encoder's?

Plain regressions on the plateaus; with a reference sensor on the same motion, three gains
of which two say who is wrong.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from omsm_ros.core.fitting.steps import Edge, find_steps
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.core.samples.motion_record import MotionRecord
from omsm_ros.errors import StepTestError
from omsm_ros.least_squares import unit_columns

# Rest after an edge that is not averaged, for the response to settle.
_SETTLE_S = 0.1
# Gain, drift and offset are three unknowns.
_LEAST_PLATEAUS = 4


@dataclass(frozen=True, slots=True)
class Gain:
    """A ratio of travels [1] and its standard uncertainty."""

    value: float
    uncertainty: float


@dataclass(frozen=True, slots=True)
class StaticGains:
    """Travel of one per travel of the other, magnitudes; None without a reference sensor."""

    probe_per_encoder: Gain
    probe_per_reference: Gain | None
    reference_per_encoder: Gain | None


def static_gains(record: MotionRecord) -> StaticGains:
    """Return the gains from the means of the plateaus, offset and linear drift allowed for.

    The uncertainty is that of the regression over plateaus, so it holds for whatever makes
    them scatter: noise, backlash, slip. Raises StepTestError with fewer than four plateaus.
    """
    steps = find_steps(record.z, record.sample_period)
    rests = _rests(steps.edges, len(record), round(_SETTLE_S / record.sample_period))
    readings = np.where(record.ok, record.distance, np.nan)
    time = _means(np.arange(len(record), dtype=np.float64), rests)
    encoder, probe = _means(record.z, rests), _means(np.asarray(readings), rests)
    if record.reference is None:
        return StaticGains(_ratio(encoder, probe, time), None, None)
    reference = _means(record.reference, rests)
    return StaticGains(
        _ratio(encoder, probe, time),
        _ratio(reference, probe, time),
        _ratio(encoder, reference, time),
    )


def _rests(edges: tuple[Edge, ...], samples: int, settle: int) -> list[tuple[int, int]]:
    starts = [0, *(edge.stop + settle for edge in edges)]
    stops = [*(edge.start for edge in edges), samples]
    rests = [(a, b) for a, b in zip(starts, stops, strict=True) if b - a >= 5]
    if len(rests) < _LEAST_PLATEAUS:
        raise StepTestError(
            f"{len(rests)!r} plateaus of rest, at least {_LEAST_PLATEAUS} are needed for a gain; "
            "make more steps or rest longer"
        )
    return rests


def _means(values: FloatArray, rests: list[tuple[int, int]]) -> FloatArray:
    means = [
        float(np.mean(part[np.isfinite(part)])) if np.any(np.isfinite(part)) else np.nan
        for part in (values[a:b] for a, b in rests)
    ]
    return np.asarray(means)


def _ratio(travel: FloatArray, other: FloatArray, time: FloatArray) -> Gain:
    known = np.isfinite(travel) & np.isfinite(other)
    if np.sum(known) < _LEAST_PLATEAUS:
        raise StepTestError(
            f"{int(np.sum(known))!r} plateaus with readings, at least {_LEAST_PLATEAUS} are needed"
        )
    x, t, y = travel[known], time[known], other[known]
    columns = np.column_stack([x - x.mean(), t / t[-1], np.ones(len(x))])
    unit, scale = unit_columns(columns)
    inverse = np.linalg.pinv(unit)
    solved = inverse @ y
    residual = y - unit @ solved
    variance = float(residual @ residual) / max(len(y) - 3, 1)
    uncertainty = np.sqrt(variance * (inverse[0] @ inverse[0])) / scale[0]
    return Gain(float(abs(solved[0]) / scale[0]), float(uncertainty))
