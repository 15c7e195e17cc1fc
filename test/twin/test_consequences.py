"""Effects of disturbances on the paper's scan, against estimates by hand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from omsm_ros.core.kinematics.kinematics import workpiece_xy
from omsm_ros.core.kinematics.trajectories import AxisPositions, Spiral
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.surface.nominal import PAPER_MIRROR, PAPER_MIRROR_RADIUS_M, Flat
from omsm_ros.twin.cell import Cell, Probe, record
from omsm_ros.twin.disturbances import Disturbances
from omsm_ros.twin.machine_errors import Drift, MachineErrors
from omsm_ros.twin.plant import Plant
from omsm_ros.twin.probe import ProbeErrors
from omsm_ros.twin.scenario import Scenario, scan_of, spiral_of

QUIET = Probe(scale=1.0, noise=0.0, resolution=0.0)
# A structure that is thirty times stiffer than the paper's: what lags is the probe.
PROMPT = Plant(dynamics=TransferFunction([1.0], [1.0, 1e-5]))
SPEED_RAD_S = np.pi  # 30 rpm
# The paper's scan with a tenth of its turns.
COARSE = Spiral(PAPER_MIRROR, PAPER_MIRROR_RADIUS_M, 1e-3, 30.0)


def _seen(disturbances, plant=PROMPT, motion=COARSE, surface=PAPER_MIRROR):
    cell = Cell(plant=plant, probe=QUIET, encoder_noise=0.0, disturbances=disturbances)
    return record(cell, motion, surface)


def _by_angle(x, y):
    """∂h/∂θ of the paper's mirror, with the part turning, at x, y [m]."""
    step = 1e-6
    ahead, behind = (
        PAPER_MIRROR.height(x * np.cos(a) + y * np.sin(a), y * np.cos(a) - x * np.sin(a))
        for a in (step, -step)
    )
    return (ahead - behind) / (2 * step)


def test_latency_is_invisible_until_it_is_corrected_as_if_it_were_structure():
    """On a followed surface ``z + d`` is right; filtering Z by the latency leaves -τ ω ∂h/∂θ."""
    late = 0.34e-3
    made = _seen(Disturbances(probe=ProbeErrors(latency_s=late)))
    x, y = workpiece_xy(made.axes.x, made.axes.y, made.axes.c)
    true = PAPER_MIRROR.height(x, y)
    raw = made.axes.z + made.distance.distance - true
    corrected = made.probe_motion + made.distance.distance - true
    assert np.ptp(raw) < 0.1e-6
    expected = -late * SPEED_RAD_S * _by_angle(x, y)
    assert np.ptp(expected) == pytest.approx(1.2e-6, rel=0.05)
    # Besides, X feeds at half a millimetre a second, over a slope of 0.17 at most.
    assert np.max(abs(corrected - expected)) < 0.5e-3 * late * 0.18
    # Told that it is latency, and looking for each point where it was, it is right again.
    x, y = made.truth.x, made.truth.y
    at_its_place = made.probe_motion + made.distance.distance - PAPER_MIRROR.height(x, y)
    assert np.max(abs(at_its_place)) < 1e-14


def test_structure_lags_in_z_only():
    """The same lag in the structure shows in the raw height, and at the point's own place."""
    plant = Plant(dynamics=TransferFunction([1.0], [1.0, 0.34e-3]))
    made = _seen(Disturbances(), plant)
    x, y = workpiece_xy(made.axes.x, made.axes.y, made.axes.c)
    np.testing.assert_array_equal(made.truth.x, x)
    raw = made.axes.z + made.distance.distance - PAPER_MIRROR.height(x, y)
    expected = 0.34e-3 * SPEED_RAD_S * _by_angle(x, y)
    # The servo lags too, by 1.6 ms: the raw error belongs to where Z was.
    assert np.ptp(raw) == pytest.approx(np.ptp(expected), rel=0.01)
    assert made.truth.response.latency_s == 0.0


@dataclass(frozen=True)
class Ramp:
    """Z climbs steadily."""

    speed: float
    duration: float = 1.0

    def positions(self, time):
        zero = np.zeros_like(time)
        return AxisPositions(zero, zero, self.speed * time, zero, zero)


@pytest.mark.parametrize("bandwidth", [50.0, 200.0])
def test_the_servo_follows_a_ramp_late_by_two_over_its_bandwidth(bandwidth):
    errors = Disturbances(servo_bandwidth_hz=bandwidth)
    made = _seen(errors, motion=Ramp(1e-3), surface=Flat())
    command = Ramp(1e-3).positions(made.truth.time).z
    expected = 1e-3 * 2 / (2 * np.pi * bandwidth)
    np.testing.assert_allclose(command - made.truth.slide, expected, rtol=1e-5)


def test_too_fast_a_scan_loses_its_target():
    """At 1221 rpm Z follows a tenth of a millimetre late, and the probe has ± 50 µm."""
    fast = Scenario(spindle_speed=1221.0)
    made = scan_of(fast)
    late = spiral_of(fast).positions(made.truth.time).z - made.truth.slide
    assert np.max(abs(late)) == pytest.approx(113e-6, rel=0.02)
    lost = np.mean(~made.distance.ok)
    assert lost == pytest.approx(0.22, abs=0.01)
    assert lost == pytest.approx(np.mean(abs(made.truth.distance) > 50e-6), abs=1e-9)


def test_drift_makes_a_cone():
    """Height over radius, as X feeds at a steady rate while the workpiece rises."""
    rise = 1e-9
    made = _seen(Disturbances(machine=MachineErrors(drift=Drift(ramp_m_per_s=rise))))
    found = made.probe_motion + made.distance.distance - made.surface_height
    feed = 1e-3 * 0.5  # m/s: a millimetre a turn, half a turn a second
    cone = rise * (PAPER_MIRROR_RADIUS_M - made.axes.x) / feed
    np.testing.assert_allclose(found, cone, rtol=0, atol=1e-15)


def test_an_error_by_the_square_of_the_slope_is_what_the_gradient_says():
    size = 5e-6  # 50 nm at 0.1 rad
    made = _seen(Disturbances(probe=ProbeErrors(slope_error_m_per_rad2=size)))
    x, y, h = made.truth.x, made.truth.y, 1e-6
    along_x = (PAPER_MIRROR.height(x + h, y) - PAPER_MIRROR.height(x - h, y)) / (2 * h)
    along_y = (PAPER_MIRROR.height(x, y + h) - PAPER_MIRROR.height(x, y - h)) / (2 * h)
    error = made.distance.distance - made.truth.distance
    np.testing.assert_allclose(error, size * (along_x**2 + along_y**2), rtol=0, atol=1e-15)
    assert np.ptp(error) > 100e-9
