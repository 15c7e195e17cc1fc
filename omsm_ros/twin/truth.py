"""Compare a correction with the true values of a simulated recording."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from omsm_ros.core.streams.blocks import FloatArray, IntArray
from omsm_ros.errors import DataError
from omsm_ros.twin.cell import Recording


@dataclass(frozen=True, slots=True)
class ErrorFigures:
    """Peak to valley and root mean square about zero of an error [m]."""

    peak_to_valley: float
    rms: float


def spread(error: FloatArray, weight: FloatArray | None = None) -> ErrorFigures:
    """Return the figures of ``error`` (n,) [m], the rms weighted by ``weight`` (n,) if given."""
    if not len(error):
        raise DataError("no points to compare with the truth")
    return ErrorFigures(float(np.ptp(error)), float(np.sqrt(np.average(error**2, weights=weight))))


@dataclass(frozen=True, slots=True)
class TruthComparison:
    """Errors at the corrected points; rms of the dynamic errors is weighted by area.

    dynamic_error_before: true motion of the probe minus the encoder
    dynamic_error_after: true motion of the probe minus the filtered encoder
    surface_deviation: corrected height minus the true surface
    """

    dynamic_error_before: ErrorFigures
    dynamic_error_after: ErrorFigures
    surface_deviation: ErrorFigures


def compare_with_truth(
    recording: Recording, sample: ArrayLike, height: FloatArray, dynamic_error: FloatArray
) -> TruthComparison:
    """Compare corrected points, each array (n,), with the true values of their recording.

    sample: trigger counter;  height, dynamic_error: as in ``cloud.ply`` [m]
    """
    index: IntArray = np.asarray(sample, np.int64) - recording.axes.first_sample
    if np.any((index < 0) | (index >= len(recording.axes))):
        raise DataError(
            f"samples {index.min()}…{index.max()} do not belong to this recording of "
            f"{len(recording.axes)}"
        )
    encoder = recording.axes.z[index]
    filtered = encoder - dynamic_error
    motion = recording.probe_motion[index]
    # In a spiral of constant feed and speed a point stands for an area proportional to its radius.
    radius = np.abs(recording.axes.x[index])
    return TruthComparison(
        dynamic_error_before=spread(motion - encoder, radius),
        dynamic_error_after=spread(motion - filtered, radius),
        surface_deviation=spread(height - recording.surface_height[index]),
    )
