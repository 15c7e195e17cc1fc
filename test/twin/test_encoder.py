"""The encoder of Z: scale, interpolation, counts, and a pitch that the probe does not share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from benchmarks.step_test import StepTest
from omsm_ros.core.kinematics.trajectories import AxisPositions
from omsm_ros.core.surface.nominal import Flat
from omsm_ros.errors import ConfigurationError
from omsm_ros.twin.cell import Cell, Probe, record
from omsm_ros.twin.disturbances import Disturbances
from omsm_ros.twin.sensors import EncoderErrors, Pitch

QUIET = Probe(scale=1.0, noise=0.0, resolution=0.0)


@dataclass(frozen=True)
class Swing:
    """Z swings for ever with ten micrometres' amplitude."""

    frequency: float
    duration: float = 2.0

    def positions(self, time):
        zero = np.zeros_like(time)
        z = 10e-6 * np.cos(2 * np.pi * self.frequency * time)
        return AxisPositions(zero, zero, z, zero, zero)


def _seen(errors, motion=None, **cell):
    cell = {"probe": QUIET, "encoder_noise": 0.0} | cell
    made = Cell(disturbances=Disturbances(encoder=errors), **cell)
    return record(made, motion or StepTest(count=3), Flat(), stand_off=-15e-6)


def test_the_scale_stretches_the_reading_and_nothing_else():
    made = _seen(EncoderErrors(scale_ppm=100.0))
    np.testing.assert_allclose(made.axes.z, made.truth.slide * (1 + 100e-6), atol=1e-18)
    assert made.truth.response.static_gain == pytest.approx(1 / (1 + 100e-6))
    clean = _seen(EncoderErrors())
    np.testing.assert_allclose(made.distance.distance, clean.distance.distance, atol=1e-18)


def test_interpolation_repeats_with_the_signal_period():
    made = _seen(EncoderErrors(interpolation_m=5e-9, signal_period_m=2e-6), Swing(1.0))
    z = made.truth.slide
    np.testing.assert_allclose(made.axes.z - z, 5e-9 * np.sin(2 * np.pi * z / 2e-6), atol=1e-18)


def test_counts_are_whole():
    counts = _seen(EncoderErrors(resolution_m=10e-9), Swing(1.0)).axes.z / 10e-9
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-6)


@pytest.mark.parametrize("arm", [0.1, -0.2])
def test_abbe_error_is_arm_times_angle(arm):
    pitch = Pitch(arm_m=arm, rad_per_m=1e-3, periodic_rad=0.5e-6, period_m=7e-6)
    made = _seen(EncoderErrors(pitch=pitch), Swing(1.0))
    z = made.truth.slide
    angle = 1e-3 * z + 0.5e-6 * np.sin(2 * np.pi * z / 7e-6)
    np.testing.assert_allclose(made.axes.z - z, arm * angle, atol=1e-17)


@pytest.mark.parametrize("frequency", [0.7, 15.0, 60.0, 120.0])
def test_pitch_under_acceleration_is_in_the_true_response(frequency):
    """Reading per encoder, both as they swing, is the response that the truth states."""
    pitch = Pitch(arm_m=0.1, rad_per_m=1e-3, rad_per_m_s2=1e-6, frequency_hz=60.0)
    made = _seen(EncoderErrors(pitch=pitch), Swing(frequency))
    late = slice(1000, None)  # the start has died away
    turning = np.exp(2j * np.pi * frequency * np.arange(2000)[late] * 1e-3)
    basis = np.column_stack([turning.real, -turning.imag, np.ones(len(turning))])

    def phasor(values):
        cosine, sine, _ = np.linalg.lstsq(basis, values[late], rcond=None)[0]
        return cosine + 1j * sine

    found = -phasor(made.distance.distance) / phasor(made.axes.z)
    expected = made.truth.response.response(frequency) * made.truth.response.static_gain
    assert found == pytest.approx(complex(expected), rel=3e-5)


def test_the_noise_is_the_cells_own():
    made = _seen(EncoderErrors(scale_ppm=1.0), encoder_noise=0.4e-9)
    error = made.axes.z - made.truth.slide
    assert np.std(error - error.mean()) == pytest.approx(0.4e-9, rel=0.05)


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: EncoderErrors(signal_period_m=0.0), "signal_period_m"),
        (lambda: EncoderErrors(resolution_m=-1e-9), "resolution_m"),
        (lambda: Pitch(arm_m=0.1, frequency_hz=0.0), "frequency_hz"),
    ],
)
def test_sizes_that_cannot_be_are_named(make, name):
    with pytest.raises(ConfigurationError, match=name):
        make()
