"""When the devices look: jitter, offsets, drift and late latches, in what they then report."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from omsm_ros.core.kinematics.trajectories import AxisPositions
from omsm_ros.core.surface.nominal import Flat
from omsm_ros.errors import ConfigurationError
from omsm_ros.twin.cell import Cell, Probe, record
from omsm_ros.twin.disturbances import Disturbances
from omsm_ros.twin.probe import ProbeErrors
from omsm_ros.twin.sensors import ClockErrors

SPEED = 1e-3  # m/s along Z
TURNING = 3.0  # rad/s
LAG_S = Cell().plant.dynamics.low_frequency_delay
SERVO_LAG_S = Cell().plant.servo.low_frequency_delay


@dataclass(frozen=True)
class Ramp:
    """Z climbs and C turns, each steadily, so that an error of time is an error of place."""

    duration: float = 4.0

    def positions(self, time):
        zero = np.zeros_like(time)
        return AxisPositions(zero, zero, SPEED * time, zero, TURNING * time)


def _seen(clocks, **probe):
    disturbances = Disturbances(clocks=clocks, probe=ProbeErrors(**probe))
    quiet = Probe(scale=1.0, noise=0.0, resolution=0.0, half_range=1.0)
    cell = Cell(probe=quiet, encoder_noise=0.0, disturbances=disturbances)
    return record(cell, Ramp(), Flat())


def _probe_time(made):
    """When the probe looked, from the ramp that it saw."""
    return -made.distance.distance / SPEED + SERVO_LAG_S + LAG_S


NOMINAL = np.arange(4000) * 1e-3


def test_without_errors_everything_is_in_time():
    made = _seen(ClockErrors())
    np.testing.assert_allclose(made.axes.z / SPEED + SERVO_LAG_S, NOMINAL, atol=1e-8)
    np.testing.assert_allclose(_probe_time(made), NOMINAL, atol=1e-8)
    np.testing.assert_allclose(made.axes.c, TURNING * NOMINAL, atol=1e-15)


def test_the_offset_of_the_probe_is_a_lag_with_the_other_sign():
    made = _seen(ClockErrors(probe_offset_s=0.25e-3), latency_s=0.4e-3)
    np.testing.assert_allclose(_probe_time(made), NOMINAL - 0.15e-3, atol=1e-8)
    assert made.truth.response.latency_s == pytest.approx(0.15e-3)


def test_a_drifting_clock_falls_behind():
    made = _seen(ClockErrors(probe_drift_ppm=100.0))
    np.testing.assert_allclose(_probe_time(made), NOMINAL * (1 + 100e-6), atol=1e-8)


def test_late_latches_are_later_and_only_theirs():
    made = _seen(ClockErrors(z_latch_late_s=0.1e-3, c_latch_late_s=0.3e-3))
    np.testing.assert_allclose(made.axes.z / SPEED + SERVO_LAG_S, NOMINAL + 0.1e-3, atol=1e-8)
    np.testing.assert_allclose(made.axes.c, TURNING * (NOMINAL + 0.3e-3), atol=1e-13)
    np.testing.assert_allclose(_probe_time(made), NOMINAL, atol=1e-8)
    assert made.truth.response.latency_s == pytest.approx(0.1e-3)
    # The truth of the carriage is at the trigger, whenever the encoder was latched.
    np.testing.assert_allclose(made.truth.slide / SPEED + SERVO_LAG_S, NOMINAL, atol=1e-8)


def test_jitter_of_the_trigger_is_common_to_all():
    made = _seen(ClockErrors(trigger_jitter_s=20e-6))
    jitter = made.truth.time - NOMINAL
    assert np.std(jitter) == pytest.approx(20e-6, rel=0.05)
    np.testing.assert_allclose(made.axes.z / SPEED + SERVO_LAG_S, made.truth.time, atol=1e-8)
    np.testing.assert_allclose(_probe_time(made), made.truth.time, atol=1e-8)
    np.testing.assert_allclose(made.axes.c / TURNING, made.truth.time, atol=1e-8)


def test_jitter_of_the_probe_is_its_own():
    made = _seen(ClockErrors(probe_jitter_s=20e-6))
    np.testing.assert_array_equal(made.truth.time, NOMINAL)
    assert np.std(_probe_time(made) - NOMINAL) == pytest.approx(20e-6, rel=0.05)
    np.testing.assert_allclose(made.axes.z / SPEED + SERVO_LAG_S, NOMINAL, atol=1e-8)


def test_jitter_cannot_be_negative():
    with pytest.raises(ConfigurationError, match="trigger_jitter_s"):
        ClockErrors(trigger_jitter_s=-1e-6)
