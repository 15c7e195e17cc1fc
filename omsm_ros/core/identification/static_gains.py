"""The static gain between probe, encoder and reference sensor: whose scale is wrong?

Plain regressions on the plateaus; with a reference sensor on the same motion, three gains of which
two tell whether the scale of the probe or that of the encoder is wrong.
"""

from __future__ import annotations

import numpy as np

from omsm_ros.core.calibration.certificate import GainEstimate, StaticGain
from omsm_ros.core.estimation.steps import Edge, find_steps
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.streams.motion_record import MotionRecord
from omsm_ros.errors import StepTestError
from omsm_ros.linear_algebra import unit_columns

# Rest after an edge that is not averaged, for the response to settle.
_SETTLE_S = 0.1
# GainEstimate, drift and offset are three unknowns.
_LEAST_PLATEAUS = 4


def static_gains(record: MotionRecord) -> StaticGain:
    """Return the travel of one per travel of the other, magnitudes.

    From the means of the plateaus, with offset and linear drift fitted. The uncertainty is that of
    the regression over plateaus, so it contains whatever makes them scatter: noise, backlash,
    slip. Raises StepTestError with fewer than four plateaus.
    """
    steps = find_steps(record.z, record.sample_period)
    rests = _stationary_segments(steps.edges, len(record), round(_SETTLE_S / record.sample_period))
    readings = np.where(record.ok, record.distance, np.nan)
    time = _means(np.arange(len(record), dtype=np.float64), rests)
    encoder, probe = _means(record.z, rests), _means(np.asarray(readings), rests)
    if record.reference is None:
        return StaticGain(probe_per_encoder=_ratio(encoder, probe, time))
    reference = _means(record.reference, rests)
    return StaticGain(
        probe_per_encoder=_ratio(encoder, probe, time),
        probe_per_reference=_ratio(reference, probe, time),
        reference_per_encoder=_ratio(encoder, reference, time),
    )


def _stationary_segments(
    edges: tuple[Edge, ...], samples: int, settle: int
) -> list[tuple[int, int]]:
    starts = [0, *(edge.stop + settle for edge in edges)]
    stops = [*(edge.start for edge in edges), samples]
    rests = [(a, b) for a, b in zip(starts, stops, strict=True) if b - a >= 5]
    if len(rests) < _LEAST_PLATEAUS:
        raise StepTestError("identification.few_plateaus", found=len(rests), least=_LEAST_PLATEAUS)
    return rests


def _means(values: FloatArray, rests: list[tuple[int, int]]) -> FloatArray:
    means = [
        float(np.mean(part[np.isfinite(part)])) if np.any(np.isfinite(part)) else np.nan
        for part in (values[a:b] for a, b in rests)
    ]
    return np.asarray(means)


def _ratio(travel: FloatArray, other: FloatArray, time: FloatArray) -> GainEstimate:
    known = np.isfinite(travel) & np.isfinite(other)
    if np.sum(known) < _LEAST_PLATEAUS:
        raise StepTestError(
            "identification.few_plateaus", found=int(np.sum(known)), least=_LEAST_PLATEAUS
        )
    x, t, y = travel[known], time[known], other[known]
    columns = np.column_stack([x - x.mean(), t / t[-1], np.ones(len(x))])
    unit, scale = unit_columns(columns)
    inverse = np.linalg.pinv(unit)
    solved = inverse @ y
    residual = y - unit @ solved
    variance = float(residual @ residual) / max(len(y) - 3, 1)
    uncertainty = np.sqrt(variance * (inverse[0] @ inverse[0])) / scale[0]
    return GainEstimate(float(abs(solved[0]) / scale[0]), float(uncertainty))
