"""The simulation against finer steps of itself, and against closed forms."""

from dataclasses import dataclass

import numpy as np
import pytest

from benchmarks.step_test import StepTest
from benchmarks.twin_motions import respond
from omsm_ros.core.kinematics.trajectories import AxisPositions, Chirp, Spiral
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.surface.nominal import PAPER_MIRROR, PAPER_MIRROR_RADIUS_M
from omsm_ros.errors import ConfigurationError
from omsm_ros.twin.plant import PAPER_DYNAMICS, Plant
from omsm_ros.units import NANOMETRE_M

PERIOD = 1e-3
LATE = TransferFunction(PAPER_DYNAMICS.numerator, PAPER_DYNAMICS.denominator, 0.7e-3)


@pytest.mark.parametrize("plant", [Plant(), Plant(LATE)], ids=["Eq. 12", "with a delay"])
@pytest.mark.parametrize(
    ("motion", "samples"),
    [
        (Spiral(PAPER_MIRROR, PAPER_MIRROR_RADIUS_M, 1e-4, 30.0), 8_000),
        (StepTest(count=3), 3_500),
        (StepTest(count=3, rise=0.0), 3_500),
        (Chirp(duration=8.0), 8_000),
    ],
    ids=["scan", "step test", "sharp steps", "chirp"],
)
def test_halving_the_step_changes_nothing_above_a_tenth_of_a_nanometre(plant, motion, samples):
    # A sharp edge is exact only on the grid, and 0.7 ms are no whole number of sixteenths of 1 ms.
    substeps = 80 if plant.dynamics.delay else 16
    default = respond(plant, motion, samples, PERIOD, substeps)
    halved = respond(plant, motion, samples, PERIOD, 2 * substeps)
    assert np.max(np.abs(halved.slide - default.slide)) < 0.1 * NANOMETRE_M
    assert np.max(np.abs(halved.probe - default.probe)) < 0.1 * NANOMETRE_M


@dataclass(frozen=True)
class Swing:
    """Z swings for ever with a micrometre's amplitude."""

    frequency: float
    duration: float = 2.0

    def positions(self, time):
        zero = np.zeros_like(time)
        return AxisPositions(
            zero, zero, 1e-6 * np.cos(2 * np.pi * self.frequency * time), zero, zero
        )


@pytest.mark.parametrize("frequency", [1.5, 15.0, 120.0])
@pytest.mark.parametrize("dynamics", [PAPER_DYNAMICS, LATE], ids=["Eq. 12", "with a delay"])
def test_a_swing_comes_out_with_the_gain_and_phase_of_the_transfer_function(frequency, dynamics):
    plant = Plant(dynamics)
    moved = respond(plant, Swing(frequency), 2000, PERIOD, substeps=64)
    turning = np.exp(2j * np.pi * frequency * np.arange(2000) * PERIOD)
    slide = plant.servo.response(frequency)
    probe = slide * dynamics.response(frequency)
    np.testing.assert_allclose(moved.slide, 1e-6 * (slide * turning).real, atol=2e-11)
    np.testing.assert_allclose(moved.probe, 1e-6 * (probe * turning).real, atol=2e-11)


def test_a_long_motion_is_the_same_however_it_is_cut(monkeypatch):
    motion = Chirp()
    whole = respond(Plant(), motion, 3000, PERIOD)
    monkeypatch.setattr("omsm_ros.twin.plant._CHUNK_SAMPLES", 701)
    cut = respond(Plant(), motion, 3000, PERIOD)
    np.testing.assert_allclose(cut.probe, whole.probe, rtol=0, atol=1e-15)


def test_plants_that_cannot_be_are_refused():
    with pytest.raises(ConfigurationError, match="unstable"):
        Plant(TransferFunction([1.0], [1.0, -1.0]))
    with pytest.raises(ConfigurationError, match="bandwidth"):
        Plant(servo_bandwidth=0.0)
