"""How late is a reference sensor against the encoder that watches the same motion?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from omsm_ros.core.fitting.steps import LEAST_SAMPLES
from omsm_ros.core.samples.motion_record import MotionRecord
from omsm_ros.least_squares import unit_columns


@dataclass(frozen=True, slots=True)
class ReferenceLag:
    """Lag of the reference behind the encoder [s] and its standard uncertainty [s]."""

    value: float
    uncertainty: float


def reference_lag(record: MotionRecord) -> ReferenceLag | None:
    """Return the lag of the reference; None where too little of both was recorded.

    To first order of the lag, ``reference = gain · (z - lag · dz/dt) + offset + drift``.
    """
    if record.reference is None:
        return None
    known = np.isfinite(record.reference)
    if record.z_lost is not None:
        known &= ~record.z_lost
    if np.sum(known) < LEAST_SAMPLES:
        return None
    columns = np.column_stack(
        [
            record.z - np.mean(record.z),
            -np.gradient(record.z, record.sample_period),
            np.ones(len(record)),
            np.linspace(-1.0, 1.0, len(record)),
        ]
    )[known]
    unit, scale = unit_columns(columns)
    inverse = np.linalg.pinv(unit)
    found = inverse @ record.reference[known]
    residual = record.reference[known] - unit @ found
    spread = float(np.sqrt(residual @ residual / (len(residual) - 4) * (inverse[1] @ inverse[1])))
    gain = float(found[0] / scale[0])
    if gain == 0:
        return None
    return ReferenceLag(float(found[1] / scale[1]) / gain, abs(spread / scale[1] / gain))
