"""The spindle centre and the beam, recovered from spheres made by the inverse chain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import optimize

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.correction.correct import Corrector
from omsm_ros.core.correction.surface_points import join_points
from omsm_ros.core.correction.systematic import ScanTrace
from omsm_ros.core.kinematics.kinematics import Geometry, workpiece_points
from omsm_ros.core.kinematics.trajectories import Spiral
from omsm_ros.core.registration.probe_alignment import SphereScan, align_on_sphere
from omsm_ros.core.surface.aspheres import Sphere
from omsm_ros.errors import DataError
from omsm_ros.twin.cell import Cell, record
from omsm_ros.twin.plant import PAPER_STATIC_GAIN, Plant

RADIUS = 20e-3
TRUE = Geometry(centre_x=7e-6, centre_y=-3e-6, beam_x=4e-3, beam_y=-2e-3)


def sphere_scan(
    geometry: Geometry = TRUE,
    radius: float = RADIUS,
    noise: float = 10e-9,
    seed: int = 1,
    wobble: float = 40e-6,
) -> SphereScan:
    """Return the samples of a concave (radius > 0) or convex sphere, off centre.

    Z follows the sphere with a wobble, which the distance compensates; the distance is the
    intersection of the inclined beam with the sphere.
    """
    random = np.random.default_rng(seed)
    n = 6000
    c = np.linspace(0.0, 2 * np.pi * 60, n)
    x = np.linspace(4e-3, 0.0, n) + geometry.centre_x
    y = np.zeros(n)
    centre = np.array([30e-6, -20e-6, radius])
    follow = np.sign(radius) * (abs(radius) - np.sqrt(radius**2 - (x - geometry.centre_x) ** 2))
    z = follow + wobble * np.sin(0.37 * np.arange(n))

    def off_sphere(distance: np.ndarray) -> np.ndarray:
        p = workpiece_points(geometry, (x, y, z), np.zeros(n), c, distance)
        away = np.stack([p.x, p.y, p.height]) - centre[:, np.newaxis]
        return np.linalg.norm(away, axis=0) - abs(radius)

    distance = optimize.newton(off_sphere, np.zeros(n), tol=1e-14, maxiter=60)
    return SphereScan(
        x=x, y=y, z=z, b=np.zeros(n), c=c, distance=distance + random.normal(0.0, noise, n)
    )


@pytest.mark.parametrize("radius", [RADIUS, -RADIUS], ids=["concave", "convex"])
def test_centre_and_beam_are_recovered_within_their_uncertainty(radius: float) -> None:
    found = align_on_sphere(sphere_scan(radius=radius), radius)
    names = ("centre_x", "centre_y", "beam_x", "beam_y")
    for name, uncertainty in zip(names, found.uncertainty, strict=True):
        error = getattr(found.geometry, name) - getattr(TRUE, name)
        assert abs(error) < 4 * uncertainty, name
    # Off the feed's line the axis is missed in second order only, so it is seen less sharply.
    assert found.uncertainty[0] < 20e-9
    assert found.uncertainty[1] < 500e-9
    assert found.uncertainty[2] < 1e-4
    assert found.uncertainty[3] < 5e-3
    assert found.residual == pytest.approx(10e-9, rel=0.1)


def test_the_sphere_itself_is_found() -> None:
    found = align_on_sphere(sphere_scan(), RADIUS)
    assert np.allclose(found.sphere, (30e-6, -20e-6, RADIUS, RADIUS), rtol=0, atol=20e-9)


def test_without_distance_the_beam_cannot_be_seen() -> None:
    straight = replace(TRUE, beam_x=0.0, beam_y=0.0)
    scan = sphere_scan(straight, wobble=0.0)
    scan = replace(scan, z=scan.z + scan.distance, distance=np.zeros(len(scan.z)))
    found = align_on_sphere(scan, RADIUS)
    assert not found.beam_found
    assert found.uncertainty[2:] == (np.inf, np.inf)
    assert abs(found.geometry.centre_x - TRUE.centre_x) < 4 * found.uncertainty[0]


def test_the_stated_uncertainty_is_that_of_repetition() -> None:
    found = [align_on_sphere(sphere_scan(seed=seed), RADIUS) for seed in range(15)]
    scatter = np.std([f.geometry.centre_x for f in found], ddof=1)
    assert 0.5 < scatter / found[0].uncertainty[0] < 1.6


def test_with_the_geometry_found_the_sphere_is_round() -> None:
    scan = sphere_scan()
    geometry = align_on_sphere(scan, RADIUS).geometry
    again = align_on_sphere(scan, RADIUS, geometry)
    assert again.geometry.centre_x == pytest.approx(geometry.centre_x, abs=1e-10)


def test_a_scan_too_short_is_refused() -> None:
    scan = sphere_scan()
    few = SphereScan(
        **{name: getattr(scan, name)[:500] for name in ("x", "y", "z", "b", "c", "distance")}
    )
    with pytest.raises(DataError, match="scan of 500 points"):
        align_on_sphere(few, RADIUS)


@pytest.mark.parametrize("factor", [0.98, 1.002, 1.02])
def test_another_sphere_is_refused_and_its_radius_named(factor: float) -> None:
    with pytest.raises(DataError, match=r"sphere of radius 20\.0000\d+ mm .*check the radius"):
        align_on_sphere(sphere_scan(), factor * RADIUS)


def test_a_radius_that_is_hardly_right_is_in_the_uncertainty() -> None:
    exact, off = (align_on_sphere(sphere_scan(), f * RADIUS) for f in (1.0, 1.0001))
    error = abs(off.geometry.centre_x - TRUE.centre_x)
    assert error > 5 * exact.uncertainty[0]
    assert error < 2 * off.uncertainty[0]


def test_a_turned_table_is_undone() -> None:
    b, c, distance, x = np.random.default_rng(3).normal(0, [[0.1], [2], [1e-5], [1e-3]], (4, 50))
    z = 1e-4 * np.cos(c)
    place = workpiece_points(Geometry(), (x, 0 * x, z), b, c, distance)
    points = ScanTrace().add(0, b, place, (b, c), np.stack([z, 0 * z]), distance)
    found = SphereScan.of(points)
    for one, other in ((found.x, x), (found.y, 0 * x), (found.z, z)):
        assert np.allclose(one, other, rtol=0, atol=1e-17)


def test_a_scan_is_read_back_from_corrected_points() -> None:
    g = Plant().dynamics
    known = Calibration(
        dynamics=g,
        static_gain=PAPER_STATIC_GAIN,
        sample_period=1e-3,
        valid_up_to=100.0,
        covariance=np.zeros((7, 7)),
    )
    spiral = Spiral(Sphere(0.1), start_radius=4e-3, feed_per_turn=1e-3, spindle_speed=30.0)
    made = record(Cell(), spiral, Sphere(0.1))
    corrector = Corrector(known)
    corrector.push_axes(made.axes)
    corrector.push_distance(made.distance)
    points = join_points([corrector.finish()])
    scan = SphereScan.of(corrector.trace.points())
    assert np.array_equal(scan.c, made.axes.c[points.sample])
    assert np.allclose(scan.x, made.axes.x[points.sample], rtol=0, atol=1e-17)
    again = workpiece_points(Geometry(), (scan.x, scan.y, scan.z), scan.b, scan.c, scan.distance)
    assert np.allclose(again.height, points.height, rtol=0, atol=1e-17)
    assert np.allclose(again.x, points.x, rtol=0, atol=1e-17)
    found = align_on_sphere(scan, 0.1)
    assert abs(found.geometry.centre_x) < 4 * found.uncertainty[0]
