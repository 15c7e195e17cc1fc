"""What will a motion cost? The prediction for a bag or for positions."""

from __future__ import annotations

import numpy as np

from omsm_ros.core.correction.predict import Prediction, predict_error
from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.machine.scan_path import ScanPath
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.errors import CalibrationError
from omsm_ros.jobs.read_bag import path_in
from omsm_ros.quantities import POSITION, SAMPLE_PERIOD


def predict_from(
    calibration: Calibration | None, bag: str, z: FloatArray, sample_period: float
) -> Prediction:
    """Predict the dynamic error of the motion in ``bag``, or of ``z`` [m] if that is empty."""
    if calibration is None:
        raise CalibrationError("no calibration in use; call identify or load one")
    if bag:
        return predict_error(calibration, path_in(bag))
    SAMPLE_PERIOD.checked(sample_period, name="sample_period")
    positions = POSITION.checked_all(np.asarray(z, np.float64), name="z")
    return predict_error(calibration, ScanPath(z=positions, sample_period=sample_period))
