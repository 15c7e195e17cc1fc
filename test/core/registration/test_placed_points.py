"""Points in the frame of the part: distances in closed form, rigid motions, selections."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from omsm_ros.core.registration.placement import (
    LEAST_POINTS,
    POSE_PARAMETERS,
    Placement,
    PointBatch,
    dof_columns,
    inside_aperture,
    placed,
    selection,
)
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.core.surface.aspheres import Asphere, Sphere, Toroid
from omsm_ros.core.surface.height_grid import gradient_of, unit_normal
from omsm_ros.core.surface.nominal import PAPER_MIRROR, Flat
from omsm_ros.core.surface.posed import Pose
from omsm_ros.errors import DataError

RNG = np.random.default_rng(2)
N = 300
X, Y = RNG.uniform(-6e-3, 6e-3, (2, N))
OFF = RNG.normal(0, 2e-6, N)
POSE = Pose(x=1e-3, y=-2e-3, piston=5e-4, tip=0.03, tilt=-0.05, clocking=0.9)


def portion(points):
    return PointBatch(*points, np.empty((0, points.shape[1])))


def adjacent(surface, off=OFF):
    """Points of the part that lie ``off`` [m] along its normal, (3, n)."""
    foot = np.stack([X, Y, surface.height(X, Y)])
    return foot + off * unit_normal(*gradient_of(surface, X, Y))


def carried(pose, points):
    turn = Rotation.from_euler("xyz", [pose.tip, pose.tilt, pose.clocking])
    return turn.apply(points.T).T + pose.origin[:, np.newaxis]


@pytest.mark.parametrize("pose", [Pose(), POSE])
@pytest.mark.parametrize("surface", [PAPER_MIRROR, Sphere(-0.03), Toroid(0.05, -0.04), Flat(1e-4)])
def test_points_along_the_normal_deviate_by_their_distance(surface, pose):
    """Exact but for deviation squared times curvature: 2 µm squared over 30 mm are 0.1 nm."""
    found = placed(surface, Placement(pose), portion(carried(pose, adjacent(surface))))
    np.testing.assert_allclose(found.deviation, OFF, atol=1e-12)
    np.testing.assert_allclose(np.stack([found.x, found.y]), adjacent(surface)[:2], atol=1e-16)
    np.testing.assert_allclose(found.normal, unit_normal(*gradient_of(surface, X, Y)), atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(found.normal, axis=0), np.ones(N))


def test_the_deviation_does_not_know_where_the_part_sits():
    """Points and pose moved alike: nothing changes."""
    here = placed(PAPER_MIRROR, Placement(), portion(adjacent(PAPER_MIRROR)))
    there = placed(PAPER_MIRROR, Placement(POSE), portion(carried(POSE, adjacent(PAPER_MIRROR))))
    np.testing.assert_allclose(there.deviation, here.deviation, atol=1e-17)
    turn = Rotation.from_euler("xyz", [POSE.tip, POSE.tilt, POSE.clocking])
    np.testing.assert_allclose(there.from_origin, turn.apply(here.from_origin.T).T, atol=1e-16)


def test_power_is_a_bowl_that_the_nominal_does_not_have():
    """``power r²/2`` above the surface is no deviation any more."""
    power = 0.02
    bowl = Sphere(0.1).height(X, Y) + power / 2 * (X**2 + Y**2)
    found = placed(Sphere(0.1), Placement(Pose(), power), portion(np.stack([X, Y, bowl])))
    np.testing.assert_allclose(found.deviation, np.zeros(N), atol=1e-18)


def test_of_a_plane_moves_do_what_geometry_says():
    """Piston lowers the points beside it, a tip those of y, a tilt raises those of x."""
    flat = portion(np.stack([X, Y, 0 * X]))
    columns = dof_columns(Placement(), placed(Flat(), Placement(), flat), POSE_PARAMETERS)
    expected = [-np.ones(N), -Y, X, 0 * X, 0 * X, 0 * X, -(X**2 + Y**2) / 2]
    np.testing.assert_allclose(columns, expected, atol=1e-18)


def test_of_a_sphere_a_shift_does_what_a_tilt_does_by_its_radius():
    on_it = portion(np.stack([X, Y, Sphere(0.05).height(X, Y)]))
    at = placed(Sphere(0.05), Placement(), on_it)
    columns = dict(zip(POSE_PARAMETERS, dof_columns(Placement(), at, POSE_PARAMETERS), strict=True))
    # Turned by an angle about the vertex, the centre, R above it, moves by R times the angle.
    np.testing.assert_allclose(columns["tilt"], 0.05 * columns["x"], atol=1e-16)
    np.testing.assert_allclose(columns["tip"], -0.05 * columns["y"], atol=1e-16)
    np.testing.assert_allclose(columns["clocking"], 0 * X, atol=1e-18)


def test_columns_come_in_the_order_in_which_freedoms_are_named():
    at = placed(PAPER_MIRROR, Placement(POSE), portion(carried(POSE, adjacent(PAPER_MIRROR))))
    every = dict(
        zip(POSE_PARAMETERS, dof_columns(Placement(POSE), at, POSE_PARAMETERS), strict=True)
    )
    names = ("power", "x", "piston", "clocking")
    some = dof_columns(Placement(POSE), at, names)
    np.testing.assert_array_equal(some, [every[name] for name in names])
    assert dof_columns(Placement(POSE), at, ()).shape == (0, N)


# Placements.


def test_a_placement_moves_by_the_names_of_its_freedoms():
    found = Placement(Pose(x=1e-3, tip=0.1), 0.5).moved(
        ("tip", "power", "clocking"), np.array([0.05, -0.2, 0.3])
    )
    values = [found.value(name) for name in POSE_PARAMETERS]
    assert values == pytest.approx([0.0, 0.15, 0.0, 1e-3, 0.0, 0.3, 0.3])
    back = found.moved(("tip", "power", "clocking"), np.array([-0.05, 0.2, -0.3]))
    assert back.value("tip") == pytest.approx(0.1)


@pytest.mark.parametrize(("name", "step"), [("x", 20.0), ("tip", 4.0), ("piston", np.nan)])
def test_a_fit_that_strays_is_reported_with_what_to_check(name, step):
    with pytest.raises(DataError, match=r"no pose brings the points .* sign of its radii"):
        Placement().moved([name], np.array([step]))


def test_points_beyond_the_aperture_or_the_surface_do_not_count():
    x, y = RNG.uniform(-0.03, 0.03, (2, 4000))
    z = np.where(np.hypot(x, y) < 0.02, Sphere(0.02).height(x, y), 0.0)
    at = placed(Sphere(0.02), Placement(), portion(np.stack([x, y, z])))
    whole = inside_aperture(at, None)
    assert np.all(np.hypot(whole.x, whole.y) < 0.02)
    inner = inside_aperture(at, Aperture(0.01))
    assert len(inner.x) == np.sum(np.hypot(x, y) <= 0.01)
    assert inner.normal.shape == inner.from_origin.shape == (3, len(inner.x))
    np.testing.assert_allclose(inner.deviation, np.zeros(len(inner.x)), atol=1e-15)


@pytest.mark.parametrize("count", [LEAST_POINTS - 1, LEAST_POINTS])
def test_as_many_points_as_the_fit_needs_are_enough(count):
    on_it = np.stack([X[:count], Y[:count], 0 * X[:count]])
    at = placed(Flat(), Placement(), portion(on_it))
    if count == LEAST_POINTS:
        assert len(inside_aperture(at, None).x) == count
        return
    with pytest.raises(DataError, match="199 points lie on the nominal surface, expected 200"):
        inside_aperture(at, None)


@pytest.mark.parametrize(
    ("size", "said"), [(0.0, "0 nm"), (1e-304, "m"), (4e-10, "0.790 nm|0.80. nm|0.79. nm")]
)
def test_points_closer_than_atoms_are_refused(size, said):
    """A cloud in a unit that it does not have; squares of the least vanish, and no form is left."""
    at = placed(Flat(), Placement(), portion(size / 6e-3 * np.stack([X, Y, 0 * X])))
    with pytest.raises(DataError, match=f"within .*{said}.*check the units of the cloud"):
        inside_aperture(at, None)


# Selections.


@pytest.mark.parametrize("cut", [1, 7, 1000])
def test_a_selection_does_not_know_how_the_points_came(cut):
    points = RNG.normal(size=(3, 1000))
    portions = [portion(points[:, k : k + cut]) for k in range(0, 1000, cut)]
    found = selection(lambda: portions, 300)
    np.testing.assert_array_equal(np.stack(found[:3]), points[:, ::4])
    assert found.systematic.shape == (0, 250)


def test_nothing_to_select_from_is_refused():
    with pytest.raises(DataError, match="0 points: there is nothing to register"):
        selection(list, 100)


def test_a_shape_with_aspheric_terms_is_met_along_its_normal_too():
    """By the nearest of many points of its profile, without slopes."""
    surface = Asphere(0.02, -0.5, (0.0, 3e3))
    point = np.array([[4e-3], [0.0], [float(surface.height(4e-3, 0.0)) + 3e-6]])
    r = 4e-3 + np.linspace(-3e-6, 3e-6, 20_001)
    away = np.hypot(r - point[0], surface.height(r, 0 * r) - point[2])
    found = placed(surface, Placement(), portion(point)).deviation
    assert found[0] == pytest.approx(away.min(), abs=2e-11)
