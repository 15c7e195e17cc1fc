"""Drift, spindle, slides and the mount of the probe against closed forms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from omsm_ros.core.kinematics.kinematics import Geometry, workpiece_points
from omsm_ros.core.kinematics.trajectories import AxisPositions, Circle, Spiral
from omsm_ros.core.surface.aspheres import Sphere
from omsm_ros.core.surface.nominal import Flat
from omsm_ros.errors import ConfigurationError
from omsm_ros.twin.cell import Cell, Probe, record
from omsm_ros.twin.disturbances import Disturbances
from omsm_ros.twin.machine_errors import (
    Drift,
    Harmonic,
    MachineErrors,
    SpindleError,
    Straightness,
    random_walk,
)
from omsm_ros.twin.plant import Trajectory

QUIET = Probe(scale=1.0, noise=0.0, resolution=0.0, half_range=1e-3)
RADIUS = 8e-3


def _seen(machine, motion, surface=None):
    cell = Cell(probe=QUIET, encoder_noise=0.0, disturbances=Disturbances(machine=machine))
    return record(cell, motion, surface or Flat())


def _turn(surface=None):
    return Circle(surface or Flat(), RADIUS, 30.0, turns=2.0)


def _angle():
    return np.arange(4000) * 1e-3 * np.pi


def _spindle(**kwargs):
    return MachineErrors(spindle=SpindleError(**kwargs))


def test_axial_error_is_read_as_it_is():
    made = _seen(_spindle(axial_m=(Harmonic(amplitude=25e-9, per_turn=2, phase_rad=0.3),)), _turn())
    expected = 25e-9 * np.cos(2 * _angle() + 0.3)
    np.testing.assert_allclose(made.distance.distance, expected, atol=1e-18)
    np.testing.assert_array_equal(made.surface_height, 0.0)  # the part is not to blame


def test_tilt_grows_with_the_radius():
    tilt = (Harmonic(amplitude=1e-6, per_turn=1),)
    made = _seen(_spindle(tilt_rad=tilt), _turn())
    np.testing.assert_allclose(made.distance.distance, 1e-6 * RADIUS * np.cos(_angle()), atol=1e-18)
    spiral = Spiral(Flat(), RADIUS, 2e-3, 30.0)
    made = _seen(_spindle(tilt_rad=tilt), spiral)
    assert np.ptp(made.distance.distance[-2000:]) < 0.3 * np.ptp(made.distance.distance[:2000])


def test_radial_error_moves_the_place_that_is_looked_at():
    """A vector that stands still in the machine shifts the part against the probe there."""
    still = (Harmonic(amplitude=2e-6, per_turn=0, phase_rad=np.pi / 3),)
    made = _seen(_spindle(radial_m=still), _turn())
    c, x, y = _angle(), RADIUS - 2e-6 * np.cos(np.pi / 3), -2e-6 * np.sin(np.pi / 3)
    np.testing.assert_allclose(made.truth.x, x * np.cos(c) + y * np.sin(c), atol=1e-15)
    np.testing.assert_allclose(made.truth.y, -x * np.sin(c) + y * np.cos(c), atol=1e-15)


def test_radial_error_once_a_turn_is_eccentricity():
    """Turning with the part, in the part's frame it is a fixed shift."""
    once = (Harmonic(amplitude=2e-6, per_turn=1),)
    made = _seen(_spindle(radial_m=once), _turn())
    clean = _seen(MachineErrors(), _turn())
    # The machine turns positions back by c, so the vector (cos c, sin c) becomes (1, 0).
    np.testing.assert_allclose(made.truth.x - clean.truth.x, -2e-6, atol=1e-15)
    np.testing.assert_allclose(made.truth.y - clean.truth.y, 0.0, atol=1e-15)


@pytest.mark.parametrize(
    ("name", "size", "expected"),
    [("axial_noise_m", 5e-9, 5e-9), ("tilt_noise_rad", 1e-6, 1e-6 * RADIUS)],
)
def test_asynchronous_error_has_its_rms(name, size, expected):
    made = _seen(_spindle(**{name: size}), _turn())
    assert np.std(made.distance.distance) == pytest.approx(expected, rel=0.05)


def test_asynchronous_radial_error_has_its_rms():
    made = _seen(_spindle(radial_noise_m=1e-7), _turn())
    clean = _seen(MachineErrors(), _turn())
    for axis in ("x", "y"):
        moved = getattr(made.truth, axis) - getattr(clean.truth, axis)
        assert np.std(moved) == pytest.approx(1e-7, rel=0.05)


def test_a_bowed_slide_makes_a_bowed_profile():
    bow = Straightness(bow_m=100e-9, half_travel_m=10e-3, periodic_m=20e-9, period_m=1e-3)
    spiral = Spiral(Flat(), RADIUS, 1e-3, 30.0)
    made = _seen(MachineErrors(x_slide_along_z=bow), spiral)
    x = made.axes.x
    expected = 100e-9 * (x / 10e-3) ** 2 + 20e-9 * np.sin(2 * np.pi * x / 1e-3)
    np.testing.assert_allclose(made.distance.distance, expected, atol=1e-18)


def test_a_crooked_z_slide_carries_the_probe_laterally():
    """On a slope of 0.1 the place is off by the straightness at that Z."""
    crooked = Straightness(bow_m=1e-6, half_travel_m=1e-3)

    @dataclass(frozen=True)
    class Plunge:
        duration: float = 1.0

        def positions(self, time):
            zero = np.zeros_like(time)
            z = 0.5e-3 * np.sin(2 * np.pi * time)
            return AxisPositions(zero, zero, z, zero, zero)

    made = _seen(MachineErrors(z_slide_along_x=crooked), Plunge())
    z = 0.5e-3 * np.sin(2 * np.pi * np.arange(1000) * 1e-3)
    np.testing.assert_allclose(made.truth.x, 1e-6 * (z / 1e-3) ** 2, atol=1e-15)


@dataclass(frozen=True)
class Swivel:
    """B turns the probe over a surface while everything else stands."""

    at_x: float = 0.0
    at_z: float = 0.0
    duration: float = 1.0

    def positions(self, time):
        one = np.ones_like(time)
        b = 0.1 * np.sin(2 * np.pi * time)
        return AxisPositions(self.at_x * one, 0.0 * one, self.at_z * one, b, 0.7 * one)


@pytest.mark.parametrize("beam", [(0.0, 0.0), (0.02, -0.01)], ids=["straight", "slanting"])
def test_a_beam_ends_where_a_ray_meets_the_sphere(beam):
    r, pivot = 0.2, 0.05
    mount = Geometry(probe_x=1e-3, probe_z=pivot, beam_x=beam[0], beam_y=beam[1])
    # The probe's zero starts at the pivot's height plus its arm: put the pivot below the sphere.
    made = _seen(MachineErrors(mount=mount), Swivel(at_x=2e-3, at_z=-pivot), Sphere(r))
    b = made.axes.b
    turn = np.array([[np.cos(b), 0 * b, np.sin(b)], [0 * b, 1 + 0 * b, 0 * b],
                     [-np.sin(b), 0 * b, np.cos(b)]])  # fmt: skip
    # The mount is given relative to the arm at b = 0, so the pivot is one arm behind it.
    arm = np.array([1e-3, 0.0, pivot])
    origin = (
        np.array([2e-3, 0.0, -pivot])[:, None] + np.einsum("ijk,j->ik", turn, arm) - arm[:, None]
    )
    ray = np.array([*beam, 1.0])
    ray = np.einsum("ijk,j->ik", turn, ray / np.linalg.norm(ray))
    to_centre = origin - np.array([0.0, 0.0, r])[:, None]
    half = np.sum(ray * to_centre, axis=0)
    # The lower side of a sphere that stands on the plane is met first.
    met = -half - np.sqrt(half**2 - np.sum(to_centre**2, axis=0) + r**2)
    np.testing.assert_allclose(made.truth.distance, met, atol=1e-11)


def test_the_cores_kinematics_find_the_place_again():
    mount = Geometry(centre_x=3e-6, centre_y=-2e-6, probe_z=0.05, beam_x=0.01)
    machine = MachineErrors(mount=mount, b_wobble_rad=50e-6, b_wobble_hz=3.0)
    made = _seen(machine, _turn(Sphere(0.3)), Sphere(0.3))
    axes = made.axes
    assert np.ptp(axes.b) == pytest.approx(100e-6, rel=1e-3)
    slides = (axes.x, axes.y, made.probe_motion)
    found = workpiece_points(mount, slides, axes.b, axes.c, made.distance.distance)
    np.testing.assert_allclose(found.x, made.truth.x, atol=1e-14)
    np.testing.assert_allclose(found.y, made.truth.y, atol=1e-14)
    np.testing.assert_allclose(found.height, made.surface_height, atol=1e-13)


STILL = Trajectory(-1.0, 1.0, np.zeros(10))


def test_drift_in_its_four_kinds():
    t = np.linspace(0, 100, 11)
    ramp = Drift(ramp_m_per_s=1e-9).height(t, STILL)
    np.testing.assert_allclose(ramp, 1e-9 * t)
    slow = Drift(exponential_m=200e-9, time_constant_s=50.0).height(t, STILL)
    np.testing.assert_allclose(slow, 200e-9 * (1 - np.exp(-t / 50)), atol=1e-20)
    swing = Drift(sine_m=30e-9, period_s=40.0).height(t, STILL)
    assert swing[1] == pytest.approx(30e-9)
    assert np.all(abs(swing) <= 30e-9 * (1 + 1e-12))


def test_a_random_walk_spreads_with_the_root_of_time():
    times = np.arange(-5, 401) * 0.1
    walks = np.array([random_walk(times, np.random.default_rng(s)) for s in range(2000)])
    assert np.all(walks[:, 5] == 0)
    for index in (45, 405):
        assert np.std(walks[:, index]) == pytest.approx(np.sqrt(times[index]), rel=0.06)
    drift = Drift(random_walk_m_per_root_s=5e-9)
    np.testing.assert_allclose(
        drift.height(times, Trajectory(times[0], 0.1, walks[0])), 5e-9 * walks[0], atol=1e-20
    )


def test_sizes_that_cannot_be_are_named():
    with pytest.raises(ConfigurationError, match="period_s"):
        Drift(period_s=0.0)
    with pytest.raises(ConfigurationError, match="half_travel_m"):
        Straightness(half_travel_m=-1.0)
    with pytest.raises(ConfigurationError, match="axial_noise_m"):
        SpindleError(axial_noise_m=-1e-9)
