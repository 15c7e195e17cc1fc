"""The watch on a machine that may have changed."""

from functools import lru_cache

import numpy as np
import pytest
from soaked import soaked

from benchmarks.step_test import StepTest
from omsm_ros.cli.calibration import change_text
from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.calibration.repeatability import compare_calibrations
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.motion_record import assemble
from omsm_ros.core.surface.nominal import Flat
from omsm_ros.errors import CalibrationError
from omsm_ros.twin.cell import Cell, record
from omsm_ros.twin.plant import Plant


@lru_cache(maxsize=8)
def calibrated(seed, later=0.0, count=10):
    truth = Plant().dynamics
    plant = Plant(TransferFunction(truth.numerator, truth.denominator, truth.delay + later))
    recording = record(
        Cell(plant=plant, seed=seed), StepTest(count=count), Flat(), stand_off=-4.9e-6 * count
    )
    return identify(assemble([recording.axes], [recording.distance])).calibration


@pytest.mark.parametrize("seed", [2, *soaked(3, 4)])
def test_an_unchanged_machine_is_the_same(seed):
    change = compare_calibrations(calibrated(1), calibrated(seed, count=3))
    assert not change.changed
    assert change_text(change).startswith("no significant change")


def test_a_probe_that_got_later_is_seen_in_a_short_test():
    change = compare_calibrations(calibrated(1), calibrated(5, later=20e-6, count=3))
    assert change.changed
    assert change.delay == pytest.approx(20e-6, abs=8e-6)
    assert change.delay_sigmas > 4
    assert "changed: lag by +" in change_text(change)


def with_gain(calibration, gain):
    return Calibration(
        dynamics=calibration.dynamics,
        static_gain=gain,
        sample_period=calibration.sample_period,
        valid_up_to=calibration.valid_up_to,
        covariance=calibration.covariance,
        certificate=calibration.certificate,
    )


def test_a_changed_scale_is_a_change():
    old = calibrated(1)
    change = compare_calibrations(old, with_gain(old, old.static_gain * 1.001))
    assert change.changed
    assert change.static_gain == pytest.approx(1e-3)


def test_a_calibration_equals_itself():
    change = compare_calibrations(calibrated(1), calibrated(1))
    assert change.p_value == pytest.approx(1.0)
    assert change.delay == 0


def test_without_a_common_band_there_is_nothing_to_compare():
    old = calibrated(1)
    silent = Calibration(
        dynamics=old.dynamics,
        static_gain=1.0,
        sample_period=1e-3,
        valid_up_to=1e-3,
        covariance=np.asarray(old.covariance),
    )
    with pytest.raises(CalibrationError, match="no common band"):
        compare_calibrations(old, silent)
