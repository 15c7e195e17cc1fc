"""A long step test is as true as a short one."""

import numpy as np
import pytest

from benchmarks.recorded import record_from_arrays
from benchmarks.step_test import StepTest
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.lti.frequency_response import response_band
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.motion_record import assemble
from omsm_ros.core.surface.nominal import Flat
from omsm_ros.twin.cell import Cell, record
from omsm_ros.twin.plant import Plant

from .recorded_motions import STAND_OFF

OMEGA = 2 * np.pi * 60
MODE = TransferFunction.from_ascending([1.0], [1.0, 0.2 / OMEGA, OMEGA**-2])
LINES = np.array([1.0, 5.0, 15.0, 50.0])


def recorded(truth):
    made = record(
        Cell(plant=Plant(truth), seed=8), StepTest(dwell=2.5), Flat(), stand_off=STAND_OFF
    )
    return assemble([made.axes], [made.distance])


@pytest.fixture(scope="module")
def of_mode():
    return recorded(MODE)


@pytest.mark.soak
def test_what_is_stated_holds_the_truth(of_mode):
    calibration = identify(of_mode).calibration
    assert calibration.certificate.verdict == "accepted"
    band = response_band(calibration.dynamics, calibration.covariance, LINES)
    off = np.log(calibration.dynamics.response(LINES) / MODE.response(LINES))
    assert np.all(abs(off) < 3 * np.hypot(band.gain, band.phase))


@pytest.mark.soak
def test_a_latency_that_jumps_rejects_a_long_test_too(of_mode):
    half = len(of_mode) // 2
    later = np.where(np.arange(len(of_mode)) < half, of_mode.distance, np.roll(of_mode.distance, 1))
    found = identify(
        record_from_arrays(of_mode.sample_period, of_mode.z, later)
    ).calibration.certificate
    assert found.verdict == "rejected"
    assert "identification.large_residual" in {finding.code for finding in found.reasons}
