"""Does a calibration hold on a free path? The paper's Fig. 9 from a bag."""

from __future__ import annotations

import numpy as np

from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.dynamics.discretisation import discretise
from omsm_ros.core.dynamics.recursion import through
from omsm_ros.core.fitting.preparation import check_gain
from omsm_ros.core.fitting.steps import check_usable
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.core.samples.motion_record import MotionRecord
from omsm_ros.core.samples.slips import EQUAL_COUNTS, CommonTrigger
from omsm_ros.core.verification.free_path import PathCheck, check_path
from omsm_ros.errors import DataError
from omsm_ros.jobs.identify_bag import motion_of_bag
from omsm_ros.jobs.progress import Progress, no_progress
from omsm_ros.least_squares import least_squares
from omsm_ros.storage.recording.topics import AnyBag


def path_check_of(
    path: AnyBag,
    calibration: Calibration,
    progress: Progress = no_progress,
    trigger: CommonTrigger = EQUAL_COUNTS,
    by_stamps: bool = False,
) -> PathCheck:
    """Return the paper's Fig. 9: errors and phase lags of a free path on a fixed target.

    trigger: what is stated of the counters of axes and distance
    by_stamps: join both by their stamps, not by their counters
    """
    record = motion_of_bag(path, trigger=trigger, by_stamps=by_stamps, progress=progress)
    check_usable(record)
    predicted = through(discretise(calibration.dynamics, record.sample_period), record.z)
    distance = _bridged(record)
    _check_follows(predicted, -distance / calibration.static_gain)
    return check_path(
        record.z,
        distance,
        predicted,
        calibration.static_gain,
        record.sample_period,
    )


def _check_follows(predicted: FloatArray, seen: FloatArray) -> None:
    """Raise DataError unless the probe sees the motion: before a part it sees the surface.

    predicted: where the probe is, by the model;  seen: by its own readings, both (n,) [m]
    """
    columns = np.column_stack([predicted - np.mean(predicted)])
    gain = float(least_squares(columns, seen - np.mean(seen))[0])
    check_gain(gain)
    if gain < 0:
        raise DataError(
            "the distance goes the other way with Z than in the step test of the calibration; turn "
            "its sign, in the driver or the map"
        )


def _bridged(record: MotionRecord) -> FloatArray:
    """Return the distance, dropouts bridged by lines: a Hilbert transform has no use for gaps."""
    index = np.arange(len(record))
    return np.interp(index, index[record.ok], record.distance[record.ok])
