"""Effects of a registration: rigid motions of scipy, portions, and scans that are no sphere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from omsm_ros.core.registration.placement import Placement, PointBatch, dof_columns, placed
from omsm_ros.core.registration.probe_alignment import SphereScan, align_on_sphere
from omsm_ros.core.registration.register import register
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.core.surface.posed import Pose, PosedSurface
from omsm_ros.errors import DataError

RNG = np.random.default_rng(4)
POINTS, RADIUS = 6000, 12e-3
TURN = np.linspace(0, 80 * np.pi, POINTS)
X, Y = np.linspace(RADIUS, 0, POINTS) * [np.cos(TURN), np.sin(TURN)]
POSE = Pose(x=2e-4, y=-1e-4, piston=1e-4, tip=2e-3, tilt=-1e-3)
HEIGHT = PosedSurface(PAPER_MIRROR, POSE).height(X, Y) + RNG.normal(0, 5e-9, POINTS)
NAMES = ("piston", "tip", "tilt", "x", "y")


def portion(part=slice(None), systematic=0):
    return PointBatch(X[part], Y[part], HEIGHT[part], np.zeros((systematic, len(X[part]))))


@pytest.fixture(scope="module")
def found():
    return register(PAPER_MIRROR, lambda: [portion()], NAMES)


@pytest.fixture(scope="module")
def points(found):
    return placed(PAPER_MIRROR, found.placement, portion(slice(None, None, 40)))


def test_a_scan_in_portions_is_the_scan(found):
    """Use portions of whole groups of 128 points, so that correlated errors are grouped alike."""
    cuts = [slice(k, k + 1280) for k in range(0, POINTS, 1280)]
    again = register(PAPER_MIRROR, lambda: [portion(cut) for cut in cuts], NAMES)
    for name in NAMES:
        assert again.placement.value(name) == pytest.approx(found.placement.value(name), rel=1e-9)
        assert again.spread.get(name) == pytest.approx(found.spread.get(name), rel=1e-6)
    assert again.noise == pytest.approx(found.noise)


def test_before_the_fit_the_deviation_was_that_of_the_part_where_it_sits(found):
    far = placed(PAPER_MIRROR, Placement(), portion()).deviation
    assert found.before == pytest.approx(np.sqrt(np.mean(far**2)))
    assert found.noise == pytest.approx(5e-9, rel=0.05)


def test_effects_of_the_pose_add_up_to_its_covariance(found, points):
    """At each point the variance of what the uncertain pose does to the deviation."""
    pose, sources = found.effects(points, np.empty((0, len(points.x))))
    columns = dof_columns(found.placement, points, NAMES)
    covariance = found.pose_effects.T @ found.pose_effects
    expected = np.einsum("pn,pq,qn->n", columns, covariance, columns)
    np.testing.assert_allclose(np.sum(pose**2, axis=0), expected, rtol=1e-6)
    assert sources.shape == (0, len(points.x))
    spread = np.sqrt(np.diag(covariance))
    assert [found.spread.get(name) for name in NAMES] == pytest.approx(list(spread))


def test_what_the_pose_may_be_off_by_displaces_the_places_of_the_part(found, points):
    """By rigid motions: there with the pose that was found, back with one that is off."""
    pose = found.placement.pose
    x, y = points.x, points.y
    moved = found.displaced(x, y)
    assert moved.shape == (len(NAMES), 2, len(x))
    local = np.stack([x, y, PAPER_MIRROR.height(x, y)])
    there = Rotation.from_euler("xyz", [pose.tip, pose.tilt, pose.clocking]).apply(local.T).T
    there = there + pose.origin[:, np.newaxis]
    for step, way in zip(found.pose_effects, moved, strict=True):
        other = found.placement.moved(NAMES, step).pose
        turn = Rotation.from_euler("xyz", [other.tip, other.tilt, other.clocking])
        back = turn.inv().apply((there - other.origin[:, np.newaxis]).T).T
        np.testing.assert_allclose(way, (back - local)[:2], atol=1e-15)
    assert found.moves.tolist() == [0, 1, 2, 3, 4]
    assert found.undetermined_displacements(x, y).shape == (0, 2, len(x))


def test_the_points_left_out_are_those_of_their_place_in_the_file(found):
    marked = replace(found, dust=np.array([3, 17, 18, 40]))
    assert np.flatnonzero(~marked.good(0, 60)).tolist() == [3, 17, 18, 40]
    assert np.flatnonzero(~marked.good(10, 9)).tolist() == [7, 8]


def test_a_machine_whose_zero_is_elsewhere_finds_the_part_elsewhere(found):
    """All points shifted, by whole millimetres: the origin goes with them, and nothing turns."""
    away = {"x": 1e-3, "y": -2e-3, "piston": 3e-3}
    moved = PointBatch(X + 1e-3, Y - 2e-3, HEIGHT + 3e-3, np.empty((0, POINTS)))
    there = register(PAPER_MIRROR, lambda: [moved], NAMES)
    for name in NAMES:
        expected = found.placement.value(name) + away.get(name, 0.0)
        # Parts are expected within a millimetre of their place, which draws by a part of that.
        assert there.placement.value(name) == pytest.approx(expected, abs=found.spread.get(name))


def test_a_smaller_aperture_knows_the_tilts_less_well(found):
    inner = register(PAPER_MIRROR, lambda: [portion()], NAMES, aperture=Aperture(5e-3))
    for name in ("tip", "tilt", "x", "y"):
        assert inner.spread.get(name) > found.spread.get(name)
    assert inner.disc == Aperture(5e-3)


# The scan of a sphere.


def still(count=2000):
    zero = np.zeros(count)
    return SphereScan(x=zero, y=zero, z=zero, b=zero, c=zero, distance=zero)


def test_a_probe_that_rests_shows_no_centre():
    with pytest.raises(DataError, match="scan across it while the spindle turns"):
        align_on_sphere(still(), 0.02)


def test_a_scan_of_a_flat_is_no_sphere():
    """Refuse a flat scan by its radius, although the centre leaves the machine during the fit."""
    n = 3000
    c, x = np.linspace(0, 60 * np.pi, n), np.linspace(8e-3, 0, n)
    scan = SphereScan(x=x, y=0 * x, z=0 * x, b=0 * x, c=c, distance=RNG.normal(0, 1e-8, n))
    with pytest.raises(DataError, match=r"does not fit a sphere of radius 20.0 mm.*its sign"):
        align_on_sphere(scan, 0.02)
