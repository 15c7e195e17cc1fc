"""Motions that never rest identify too, and are trusted no further than they go."""

import numpy as np
import pytest

from omsm_ros.core.confidence import response_band
from omsm_ros.core.identify import identify
from omsm_ros.core.motion_record import MotionRecord, assemble
from omsm_ros.core.surface import Flat
from omsm_ros.core.trajectory import Chirp, Multisine
from omsm_ros.core.transfer_function import TransferFunction
from omsm_ros.twin.cell import Cell, record
from omsm_ros.twin.plant import Plant

OMEGA = 2 * np.pi * 60
LIGHT_MODE = Plant(TransferFunction.from_ascending([1.0], [1.0, 0.04 / OMEGA, OMEGA**-2]))
# Starts and ends in full swing.
FROM_THE_MIDDLE = slice(7321, 21_117)
WHOLE = slice(None)


def identified(motion, plant, part, seed):
    made = record(Cell(plant=plant, seed=seed), motion, Flat())
    whole = assemble([made.axes], [made.distance])
    return identify(
        MotionRecord.from_arrays(whole.sample_period, whole.z[part], whole.distance[part])
    )


@pytest.mark.parametrize(
    ("motion", "plant", "part", "reaches"),
    [
        (Chirp(), Plant(), WHOLE, 15.0),
        (Chirp(), LIGHT_MODE, WHOLE, 15.0),
        (Chirp(), LIGHT_MODE, FROM_THE_MIDDLE, 12.7),
        (Chirp(end_frequency=50.0, peak_to_peak=20e-6), LIGHT_MODE, FROM_THE_MIDDLE, 42.0),
        (Multisine(), Plant(), WHOLE, 14.9),
        (Multisine(), LIGHT_MODE, WHOLE, 14.9),
    ],
)
@pytest.mark.parametrize("seed", [3, 4])
def test_the_truth_lies_in_the_band_as_far_as_the_motion_goes(motion, plant, part, reaches, seed):
    calibration = identified(motion, plant, part, seed)
    assert 0.9 * reaches < calibration.valid_up_to < 1.3 * reaches
    assert calibration.certificate["verdict"].startswith("accepted up to")
    frequency = np.geomspace(0.5, calibration.valid_up_to, 20)
    found, truth = (g.response(frequency) for g in (calibration.dynamics, plant.dynamics))
    error = np.log(found / truth)
    band = response_band(calibration.dynamics, calibration.covariance, frequency)
    assert np.max(np.abs(error.real) / band.gain) < 3.5
    assert np.max(np.abs(error.imag) / band.phase) < 3.5
