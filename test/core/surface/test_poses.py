"""Surfaces moved and turned, against rigid motions of scipy and shapes that a motion leaves."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from omsm_ros.core.surface.aspheres import Asphere, Sphere, Toroid
from omsm_ros.core.surface.height_grid import gradient_of, unit_normal
from omsm_ros.core.surface.nominal import (
    PAPER_MIRROR,
    Flat,
    OffAxisParaboloid,
    XYPolynomial,
    XYTerm,
)
from omsm_ros.core.surface.posed import OffAxisSection, Pose, PosedSurface, Sum
from omsm_ros.errors import SurfaceError

RNG = np.random.default_rng(5)
X, Y = RNG.uniform(-6e-3, 6e-3, (2, 80))
FREEFORM = Sum((Sphere(0.08), XYPolynomial(0.01, (XYTerm(3, 0, 2e-5), XYTerm(1, 2, -3e-5)))))
POSES = [
    Pose(x=5e-4, y=-3e-4, piston=1e-4),
    Pose(tip=0.05, tilt=-0.08),
    Pose(clocking=2.5),
    Pose(x=-2e-3, y=1e-3, piston=-3e-4, tip=-0.1, tilt=0.06, clocking=-1.2),
]


def turned(pose: Pose) -> Rotation:
    """About the fixed axes x, then y, then z, as the docstring of a pose says."""
    return Rotation.from_euler("xyz", [pose.tip, pose.tilt, pose.clocking])


def carried(pose: Pose, points: np.ndarray) -> np.ndarray:
    """Where points (3, n) of the part lie on the machine."""
    return turned(pose).apply(points.T).T + np.array([[pose.x], [pose.y], [pose.piston]])


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("surface", [PAPER_MIRROR, FREEFORM, Toroid(-0.05, 0.07)])
def test_what_lies_on_the_part_lies_on_the_posed_part(surface, pose):
    there = carried(pose, np.stack([X, Y, surface.height(X, Y)]))
    found = PosedSurface(surface, pose).height(there[0], there[1])
    np.testing.assert_allclose(found, there[2], atol=3e-17)


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("surface", [PAPER_MIRROR, FREEFORM, Toroid(-0.05, 0.07)])
def test_normals_turn_with_the_part(surface, pose):
    there = carried(pose, np.stack([X, Y, surface.height(X, Y)]))
    normal = turned(pose).apply(unit_normal(*gradient_of(surface, X, Y)).T).T
    found = unit_normal(*PosedSurface(surface, pose).gradient(there[0], there[1]))
    np.testing.assert_allclose(found, normal, atol=1e-13)


@pytest.mark.parametrize("pose", POSES)
def test_a_pose_and_its_inverse_are_no_pose(pose):
    """Rᵀ is that of the inverse pose, whose origin is −Rᵀ t."""
    back = turned(pose).inv()
    tip, tilt, clocking = back.as_euler("xyz")
    x, y, z = -back.apply(pose.origin)
    inverse = Pose(x=x, y=y, piston=z, tip=tip, tilt=tilt, clocking=clocking)
    there_and_back = PosedSurface(PosedSurface(PAPER_MIRROR, pose), inverse)
    np.testing.assert_allclose(there_and_back.height(X, Y), PAPER_MIRROR.height(X, Y), atol=1e-15)


def test_two_poses_one_after_the_other_are_their_product():
    first, second = POSES[1], POSES[3]
    both = turned(second) * turned(first)
    tip, tilt, clocking = both.as_euler("xyz")
    x, y, z = turned(second).apply(first.origin) + second.origin
    product = Pose(x=x, y=y, piston=z, tip=tip, tilt=tilt, clocking=clocking)
    nested = PosedSurface(PosedSurface(FREEFORM, first), second)
    np.testing.assert_allclose(
        nested.height(X, Y), PosedSurface(FREEFORM, product).height(X, Y), atol=1e-15
    )


@given(*(st.floats(-3.1, 3.1) for _ in range(3)))
@settings(max_examples=30)
def test_a_rotation_keeps_lengths_and_hands_at_any_angle(tip, tilt, clocking):
    pose = Pose(tip=tip, tilt=tilt, clocking=clocking)
    np.testing.assert_allclose(pose.rotation, turned(pose).as_matrix(), atol=1e-15)
    assert np.linalg.det(pose.rotation) == pytest.approx(1.0)
    # Rᵀ dR is skew: to first order a rotation stays one.
    for rate in pose.rotation_rates():
        skew = pose.rotation.T @ rate
        np.testing.assert_allclose(skew, -skew.T, atol=1e-15)
        assert np.linalg.norm(skew) == pytest.approx(np.sqrt(2))


@pytest.mark.parametrize("radius", [0.05, -0.03])
@pytest.mark.parametrize("turn", [Pose(tip=0.2), Pose(tilt=-0.15), POSES[3]])
def test_a_turned_sphere_is_a_sphere_about_its_moved_centre(radius, turn):
    cx, cy, cz = carried(turn, np.array([[0.0], [0.0], [radius]])).ravel()
    found = PosedSurface(Sphere(radius), turn).height(X, Y)
    away = np.sqrt((X - cx) ** 2 + (Y - cy) ** 2 + (found - cz) ** 2)
    np.testing.assert_allclose(away, abs(radius), rtol=1e-14)
    assert np.all((found - cz) * radius < 0)


@pytest.mark.parametrize("pose", POSES)
def test_a_turned_plane_is_the_plane_of_its_normal(pose):
    normal = turned(pose).apply([0.0, 0.0, 1.0])
    middle = carried(pose, np.array([[0.0], [0.0], [2e-4]])).ravel()
    expected = middle[2] - (normal[0] * (X - middle[0]) + normal[1] * (Y - middle[1])) / normal[2]
    surface = PosedSurface(Flat(2e-4), pose)
    np.testing.assert_allclose(surface.height(X, Y), expected, atol=1e-18)
    for slope, along in zip(surface.gradient(X, Y), normal[:2], strict=True):
        np.testing.assert_allclose(slope, np.full(len(X), -along / normal[2]), atol=1e-15)


@pytest.mark.parametrize("clocking", [0.5, -2.0, 3.1])
def test_clocking_about_its_axis_leaves_a_shape_of_revolution(clocking):
    surface = Asphere(0.04, -0.8, (0.0, 1e3))
    posed = PosedSurface(surface, Pose(clocking=clocking))
    np.testing.assert_allclose(posed.height(X, Y), surface.height(X, Y), atol=1e-17)


def test_shifts_are_shifts_of_the_argument_and_of_the_height():
    moved = PosedSurface(PAPER_MIRROR, POSES[0])
    expected = PAPER_MIRROR.height(X - 5e-4, Y + 3e-4) + 1e-4
    np.testing.assert_allclose(moved.height(X, Y), expected, atol=1e-18)
    for one, other in zip(
        moved.gradient(X, Y), PAPER_MIRROR.gradient(X - 5e-4, Y + 3e-4), strict=True
    ):
        np.testing.assert_allclose(one, other, atol=1e-16)


def test_where_only_some_places_miss_the_part_the_others_have_their_height():
    pose = Pose(tip=0.05, x=1e-3)
    x = np.linspace(-0.03, 0.03, 61)
    found = PosedSurface(Sphere(0.02), pose).height(x, 0 * x)
    alone = [
        float(PosedSurface(Sphere(0.02), pose).height(x[k : k + 1], np.zeros(1))[0])
        for k in range(61)
    ]
    np.testing.assert_allclose(found, alone, atol=1e-17)
    cx, cy, cz = carried(pose, np.array([[0.0], [0.0], [0.02]])).ravel()
    sphere = cz - np.sqrt(np.maximum(0.02**2 - (x - cx) ** 2 - cy**2, 0.0))
    well_inside = np.abs(x - cx) < 0.018
    np.testing.assert_allclose(found[well_inside], sphere[well_inside], atol=1e-16)
    assert np.all(np.isnan(found[np.abs(x - cx) > 0.0205]))


def test_heights_of_a_posed_map_have_its_shape():
    posed = PosedSurface(PAPER_MIRROR, POSES[3])
    table = posed.height(X[:5, np.newaxis], Y[np.newaxis, :7])
    assert table.shape == (5, 7)
    one = posed.height(np.repeat(X[:5], 7), np.tile(Y[:7], 5)).reshape(5, 7)
    np.testing.assert_allclose(table, one, atol=1e-17)
    assert np.shape(posed.height(np.empty(0), np.empty(0))) == (0,)


# Sections.


@pytest.mark.parametrize(("distance", "azimuth"), [(0.02, 0.0), (0.01, 2.0), (-0.015, 0.3)])
def test_every_section_of_a_sphere_is_that_sphere(distance, azimuth):
    section = OffAxisSection(Sphere(0.05), distance, azimuth)
    np.testing.assert_allclose(section.height(X, Y), Sphere(0.05).height(X, Y), atol=2e-17)


def test_a_section_in_the_middle_is_its_parent_clocked():
    section = OffAxisSection(FREEFORM, 0.0, 0.0)
    # The freeform's own slope at its middle is none.
    np.testing.assert_allclose(section.height(X, Y), FREEFORM.height(X, Y), atol=1e-17)
    quarter = OffAxisSection(FREEFORM, 0.0, np.pi / 2)
    np.testing.assert_allclose(quarter.height(X, Y), FREEFORM.height(-Y, X), atol=1e-17)


@pytest.mark.parametrize("azimuth", [0.0, 1.0, -3.0])
def test_a_parent_of_revolution_does_not_show_the_azimuth(azimuth):
    one = OffAxisSection(Asphere(0.1016 / 2, -1.0), 0.0508, azimuth)
    closed = OffAxisParaboloid(0.0254, 0.0508)
    np.testing.assert_allclose(one.height(X, Y), closed.height(X, Y), atol=1e-16)
    for found, expected in zip(one.gradient(X, Y), closed.gradient(X, Y), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-13)


def test_two_sections_of_one_parent_are_equal_by_what_they_were_made_of():
    parent = Asphere(0.05)
    assert OffAxisSection(parent, 0.01, 0.2) == OffAxisSection(Asphere(0.05), 0.01, 0.2)
    assert OffAxisSection(parent, 0.01, 0.2) != OffAxisSection(parent, 0.01, 0.3)


def test_a_section_where_the_parent_has_ended_is_refused_by_its_distance():
    with pytest.raises(SurfaceError, match=r"distance is 0.03 m.*Sphere\(radius=0.02\)"):
        OffAxisSection(Sphere(0.02), 0.03)


# Sums.


def test_a_sum_is_the_sum_of_heights_and_of_slopes_in_any_order():
    parts = (Sphere(0.1), PAPER_MIRROR, XYPolynomial(0.01, (XYTerm(1, 2, 1e-6),)))
    one, other = Sum(parts), Sum(parts[::-1])
    by_hand = sum(part.height(X, Y) for part in parts)
    np.testing.assert_allclose(one.height(X, Y), by_hand, rtol=1e-15)
    np.testing.assert_allclose(other.height(X, Y), by_hand, rtol=1e-15)
    for k in range(2):
        slopes = sum(part.gradient(X, Y)[k] for part in parts)
        np.testing.assert_allclose(one.gradient(X, Y)[k], slopes, atol=1e-17)
    np.testing.assert_array_equal(Sum((PAPER_MIRROR,)).height(X, Y), PAPER_MIRROR.height(X, Y))


def test_a_shape_and_its_mould_are_flat():
    both = Sum((Sphere(0.03), Sphere(-0.03)))
    assert not np.any(both.height(X, Y))
    assert not np.any(both.gradient(X, Y))


@pytest.mark.parametrize(
    ("field", "value"),
    [("x", 11.0), ("y", np.nan), ("piston", -1e9), ("clocking", 3.3), ("tip", np.inf)],
)
def test_a_pose_that_no_part_has_is_refused_by_name(field, value):
    with pytest.raises(SurfaceError, match=f"^{field} is"):
        Pose(**{field: value})


# Normals.


def test_a_normal_is_a_unit_across_both_tangents():
    slope_x, slope_y = RNG.normal(0, 2, (2, 50))
    normal = unit_normal(slope_x, slope_y)
    np.testing.assert_allclose(np.sum(normal**2, axis=0), np.ones(50))
    one, nothing = np.ones(50), np.zeros(50)
    tangents = (np.stack([one, nothing, slope_x]), np.stack([nothing, one, slope_y]))
    for tangent in tangents:
        np.testing.assert_allclose(np.sum(normal * tangent, axis=0), nothing, atol=1e-15)
    np.testing.assert_allclose(
        normal, np.cross(*tangents, axis=0) / np.linalg.norm(np.cross(*tangents, axis=0), axis=0)
    )


def test_the_normal_of_a_sphere_points_to_its_centre():
    z = Sphere(0.04).height(X, Y)
    towards = np.stack([-X, -Y, 0.04 - z]) / 0.04
    np.testing.assert_allclose(unit_normal(*Sphere(0.04).gradient(X, Y)), towards, atol=1e-15)
