"""Does a calibration hold on a free path? The paper's Fig. 9 from a bag."""

from __future__ import annotations

import numpy as np

from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.dynamics.discretisation import discretise
from omsm_ros.core.dynamics.recursion import through
from omsm_ros.core.fitting.steps import check_usable
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.core.samples.motion_record import MotionRecord
from omsm_ros.core.samples.slips import EQUAL_COUNTS, CommonTrigger
from omsm_ros.core.verification.free_path import PathCheck, check_path
from omsm_ros.jobs.identify_bag import motion_of_bag
from omsm_ros.jobs.progress import Progress, no_progress
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
    return check_path(
        record.z,
        _bridged(record),
        predicted,
        calibration.static_gain,
        record.sample_period,
    )


def _bridged(record: MotionRecord) -> FloatArray:
    """Return the distance, dropouts bridged by lines: a Hilbert transform has no use for gaps."""
    index = np.arange(len(record))
    return np.interp(index, index[record.ok], record.distance[record.ok])
