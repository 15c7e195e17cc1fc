"""Motions of the twin, recorded and identified, for several tests."""

from functools import lru_cache

import numpy as np

from benchmarks.recorded import record_from_arrays
from benchmarks.step_test import StepTest
from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.identification.identify import identify
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.motion_record import assemble
from omsm_ros.core.surface.nominal import Flat
from omsm_ros.twin.cell import Cell, record
from omsm_ros.twin.disturbances import Disturbances
from omsm_ros.twin.machine_errors import Drift, MachineErrors
from omsm_ros.twin.plant import Plant

STAND_OFF = -49e-6
STEPS, PLANT = StepTest(), Plant()
TRUTH = PLANT.dynamics


@lru_cache(maxsize=64)
def recorded(seed=1, motion=STEPS, plant=PLANT, sample_period=1e-3, drift=0.0):
    drifting = Disturbances(machine=MachineErrors(drift=Drift(ramp_m_per_s=drift)))
    cell = Cell(plant=plant, seed=seed, sample_period=sample_period, disturbances=drifting)
    return record(cell, motion, Flat(), stand_off=STAND_OFF)


def record_of(recording, **changed):
    seen = np.where(recording.distance.ok, recording.distance.distance, np.nan)
    arrays = {"z": recording.axes.z, "distance": seen, **changed}
    return record_from_arrays(recording.axes.sample_period, **arrays)


@lru_cache(maxsize=64)
def identified(seed=1):
    recording = recorded(seed)
    return identify(assemble([recording.axes], [recording.distance])).calibration


def from_noise(calibration: Calibration):
    """Return the covariance of the coefficients from noise, without undetected model errors."""
    size = len(calibration.covariance)
    return np.reshape(calibration.certificate.noise_covariance, (size, size))


def errors(calibration: Calibration, truth: TransferFunction, frequency):
    """Relative gain [1] and phase [rad] over the truth."""
    ratio = np.log(calibration.dynamics.response(frequency) / truth.response(frequency))
    return ratio.real, ratio.imag


def resonance(frequency, damping):
    omega = 2 * np.pi * frequency
    return TransferFunction.from_ascending([1.0], [1.0, 2 * damping / omega, omega**-2])
