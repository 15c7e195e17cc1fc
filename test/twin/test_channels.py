"""Reference sensor and accelerometer against the motion that they are on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from benchmarks.step_test import StepTest
from omsm_ros.core.kinematics.trajectories import AxisPositions, Circle
from omsm_ros.core.ripple.density import aliased_frequency
from omsm_ros.core.streams.blocks import Status
from omsm_ros.core.surface.nominal import Flat
from omsm_ros.errors import ConfigurationError
from omsm_ros.twin.cell import Cell, record
from omsm_ros.twin.disturbances import Disturbances, VibrationLine
from omsm_ros.twin.sensors import AccelerationSensor, ReferenceSensor

SILENT = {"noise_m_per_s2": 0.0}


@dataclass(frozen=True)
class Swing:
    """Z swings for ever."""

    frequency: float
    amplitude: float = 10e-6
    duration: float = 4.0

    def positions(self, time):
        zero = np.zeros_like(time)
        z = self.amplitude * np.cos(2 * np.pi * self.frequency * time)
        return AxisPositions(zero, zero, z, zero, zero)


def _seen(motion, **disturbances):
    return record(Cell(disturbances=Disturbances(**disturbances)), motion, Flat())


def _amplitude(values, frequency, period=1e-3):
    settled = values[len(values) // 2 :]
    time = np.arange(len(settled)) * period
    basis = np.exp(-2j * np.pi * frequency * time)
    return abs(2 * np.mean((settled - settled.mean()) * basis))


def test_the_reference_reads_the_slide():
    sensor = ReferenceSensor(noise_m=0.0, scale_ppm=50.0, cubic_m=30e-9)
    made = _seen(StepTest(), reference=sensor)
    z = made.truth.slide
    expected = z * (1 + 50e-6) + 30e-9 * (z / 125e-6) ** 3
    np.testing.assert_allclose(made.reference.distance, expected, atol=1e-18)
    np.testing.assert_array_equal(made.motion_record().reference, made.reference.distance)


@pytest.mark.parametrize("late", [0.2e-3, 1e-3])
def test_a_late_reference_is_late_by_its_latency(late):
    made = _seen(Swing(2.0), reference=ReferenceSensor(noise_m=0.0, latency_s=late))
    time = np.arange(4000) * 1e-3 - late
    servo = Cell().plant.servo.response(2.0)
    expected = (10e-6 * servo * np.exp(4j * np.pi * time)).real
    np.testing.assert_allclose(made.reference.distance, expected, atol=1e-12)


def test_the_reference_has_noise_and_a_range():
    made = _seen(Swing(1.0, amplitude=200e-6), reference=ReferenceSensor(noise_m=3e-9))
    beyond = abs(made.truth.slide) > 125e-6
    assert 0.3 < np.mean(beyond) < 0.7
    np.testing.assert_array_equal(made.reference.ok, ~beyond)
    assert set(made.reference.status[beyond]) == {Status.OUT_OF_RANGE}
    error = (made.reference.distance - made.truth.slide)[~beyond]
    assert np.std(error) == pytest.approx(3e-9, rel=0.05)


@pytest.mark.parametrize("frequency", [3.0, 15.0, 50.0])
def test_the_accelerometer_feels_the_probe(frequency):
    made = _seen(Swing(frequency), accelerometer=AccelerationSensor(**SILENT, high_pass_hz=0.5))
    plant = Cell().plant
    gain = abs(plant.servo.response(frequency) * plant.dynamics.response(frequency))
    high_pass = 1 / np.hypot(1, 0.5 / frequency)
    expected = (2 * np.pi * frequency) ** 2 * 10e-6 * gain * high_pass
    assert _amplitude(made.acceleration.z, frequency) == pytest.approx(expected, rel=5e-3)


def test_it_feels_a_vibration_that_the_probe_sees_at_its_own_rate():
    line = VibrationLine(amplitude_m=20e-9, frequency_hz=680.0)
    expected = (2 * np.pi * 680) ** 2 * 20e-9
    for period, seen_at in ((None, aliased_frequency(680.0, 1000.0)), (1e-4, 680.0)):
        sensor = AccelerationSensor(**SILENT, sample_period_s=period)
        made = _seen(Swing(0.0), vibration=(line,), accelerometer=sensor)
        block = made.acceleration
        assert block.sample_period == (period or 1e-3)
        assert len(block) == round(4.0 / block.sample_period)
        found = _amplitude(block.z, float(seen_at), block.sample_period)
        assert found == pytest.approx(expected, rel=1e-2)


def test_a_line_in_step_with_the_spindle_shakes_at_its_order():
    line = VibrationLine(amplitude_m=20e-9, per_turn=20.0)
    circle = Circle(Flat(), 5e-3, 120.0, turns=8.0)
    made = _seen(circle, vibration=(line,), accelerometer=AccelerationSensor(**SILENT))
    assert _amplitude(made.acceleration.z, 40.0) == pytest.approx(
        (2 * np.pi * 40) ** 2 * 20e-9, rel=1e-3
    )


def test_it_moves_down_when_the_workpiece_comes_nearer():
    """Seen by the probe as nearer, felt as the probe's own fall."""
    line = VibrationLine(amplitude_m=20e-9, frequency_hz=40.0, phase_rad=0.0)
    made = _seen(Swing(0.0), vibration=(line,), accelerometer=AccelerationSensor(**SILENT))
    time = np.arange(4000) * 1e-3
    nearer = 20e-9 * np.sin(2 * np.pi * 40 * time)
    late = slice(2000, None)
    along = np.dot(made.acceleration.z[late], nearer[late])
    assert along > 0.99 * np.linalg.norm(made.acceleration.z[late]) * np.linalg.norm(nearer[late])


def test_it_has_noise_and_cross_talk():
    sensor = AccelerationSensor(noise_m_per_s2=1e-3)
    made = _seen(Swing(0.0), accelerometer=sensor)
    for axis in "xyz":
        assert np.std(getattr(made.acceleration, axis)) == pytest.approx(1e-3, rel=0.05)
    crossed = _seen(Swing(15.0), accelerometer=AccelerationSensor(**SILENT, cross_talk=0.02))
    np.testing.assert_allclose(crossed.acceleration.x, 0.02 * crossed.acceleration.z)


def test_sizes_that_cannot_be_are_named():
    with pytest.raises(ConfigurationError, match="sample_period_s"):
        AccelerationSensor(sample_period_s=0.0)
    with pytest.raises(ConfigurationError, match="number from 5e-06"):
        AccelerationSensor(sample_period_s=1e-9)
    with pytest.raises(ConfigurationError, match="half_range_m"):
        ReferenceSensor(half_range_m=-1.0)
