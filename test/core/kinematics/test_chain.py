"""The chain from workpiece to probe as matrices of scipy, and the motions that it must carry."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from omsm_ros.core.kinematics.kinematics import (
    Geometry,
    beam_quaternion,
    workpiece_points,
    workpiece_xy,
)
from omsm_ros.errors import ConfigurationError

RNG = np.random.default_rng(6)
N = 40
SLIDES = tuple(RNG.uniform(-1e-2, 1e-2, (3, N)))
B, C, D = RNG.uniform(-0.3, 0.3, N), RNG.uniform(-40.0, 40.0, N), RNG.uniform(-1e-4, 1e-4, N)
GEOMETRY = Geometry(
    centre_x=8e-6, centre_y=-5e-6, probe_x=12e-3, probe_z=-0.1, beam_x=3e-3, beam_y=-7e-3
)


def seen(geometry=GEOMETRY, slides=SLIDES, b=B, c=C, d=D):
    return np.stack(workpiece_points(geometry, slides, b, c, d))


def by_matrices(geometry, slides, b, c, d):
    """Workpiece ← C ← Y, X ← base ← Z ← B ← probe, one rigid motion after the other."""
    beam = np.array([geometry.beam_x, geometry.beam_y, 1.0])
    beam /= np.linalg.norm(beam)
    found = []
    for x, y, z, tilt, turn, distance in zip(*slides, b, c, d, strict=True):
        at_zero = np.array([geometry.probe_x, 0.0, geometry.probe_z])
        tip = Rotation.from_euler("y", tilt).apply(at_zero + distance * beam)
        # The pivot lies where the tip at b = 0 has the position of the slides.
        in_base = tip - at_zero + [x - geometry.centre_x, y - geometry.centre_y, z]
        found.append(Rotation.from_euler("z", turn).inv().apply(in_base))
    return np.array(found).T


@pytest.mark.parametrize(
    "geometry",
    [
        Geometry(),
        GEOMETRY,
        Geometry(probe_x=-0.05, probe_z=0.2),
        Geometry(beam_x=0.5, beam_y=-0.5),
        Geometry(centre_x=1e-3, abbe_arm=0.1),
    ],
)
def test_points_are_those_of_the_rigid_motions_of_the_chain(geometry):
    expected = by_matrices(geometry, SLIDES, B, C, D)
    np.testing.assert_allclose(seen(geometry), expected, atol=1e-16)
    # A probe that does not tilt takes a way of its own.
    expected = by_matrices(geometry, SLIDES, 0 * B, C, D)
    np.testing.assert_allclose(seen(geometry, b=0 * B), expected, atol=1e-16)


@pytest.mark.parametrize("turn", [0.7, -3.0, 2 * np.pi])
def test_a_workpiece_that_is_turned_on_is_seen_turned_back(turn):
    x, y, height = seen(c=C + turn)
    before = seen()
    expected = Rotation.from_euler("z", -turn).apply(before.T).T
    np.testing.assert_allclose([x, y, height], expected, atol=1e-16)


def test_slides_carry_the_point_with_them():
    """Z along the height; X and Y as far over the chuck, whichever way it is turned."""
    x, y, z = SLIDES
    before = seen()
    np.testing.assert_allclose(seen(slides=(x, y, z + 3e-3))[2] - before[2], np.full(N, 3e-3))
    moved = seen(slides=(x + 3e-3, y - 4e-3, z)) - before
    np.testing.assert_allclose(np.hypot(moved[0], moved[1]), np.full(N, 5e-3))
    np.testing.assert_allclose(moved[2], np.zeros(N), atol=1e-18)


def test_a_longer_distance_goes_on_along_one_and_the_same_beam():
    """Equal steps of the distance are equal steps of the point, each as long as the other."""
    steps = np.array([seen(d=D + k * 1e-5) for k in range(3)])
    first, second = np.diff(steps, axis=0)
    np.testing.assert_allclose(first, second, atol=1e-16)
    np.testing.assert_allclose(np.linalg.norm(first, axis=0), np.full(N, 1e-5), rtol=1e-9)


def test_at_zero_distance_the_lean_of_the_beam_is_not_seen():
    straight = Geometry(
        **{n: getattr(GEOMETRY, n) for n in ("centre_x", "centre_y", "probe_x", "probe_z")}
    )
    np.testing.assert_allclose(seen(d=0 * D), seen(straight, d=0 * D), atol=1e-18)


def test_at_b_of_zero_the_place_of_the_pivot_is_not_seen():
    other = Geometry(
        **{n: getattr(GEOMETRY, n) for n in ("centre_x", "centre_y", "beam_x", "beam_y")}
    )
    np.testing.assert_allclose(seen(b=0 * B), seen(other, b=0 * B), atol=1e-17)


def test_the_abbe_arm_moves_no_point():
    np.testing.assert_array_equal(seen(Geometry()), seen(Geometry(abbe_arm=0.3)))


@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(-1e4, 1e4))
@settings(max_examples=40)
def test_turned_back_and_on_again_a_position_is_itself(x, y, c):
    u, v = workpiece_xy(np.array([x]), np.array([y]), np.array([c]))
    back = workpiece_xy(u, v, -np.array([c]))
    np.testing.assert_allclose(np.ravel(back), [x, y], atol=1e-15)


@given(st.floats(-1, 1), st.floats(-1, 1))
@settings(max_examples=40)
def test_a_beam_is_the_z_axis_of_its_quaternion_which_is_of_unit_length(beam_x, beam_y):
    quaternion = beam_quaternion(Geometry(beam_x=beam_x, beam_y=beam_y))
    assert np.linalg.norm(quaternion) == pytest.approx(1.0)
    matrix = Rotation.from_quat(quaternion).as_matrix()
    beam = np.array([beam_x, beam_y, 1.0])
    np.testing.assert_allclose(matrix[:, 2], beam / np.linalg.norm(beam), atol=1e-15)
    # The shortest: by no more than the angle between the two.
    angle = Rotation.from_quat(quaternion).magnitude()
    assert angle == pytest.approx(np.arctan(np.hypot(beam_x, beam_y)), abs=1e-12)


def test_a_beam_along_z_is_not_turned():
    assert beam_quaternion(Geometry()) == (0.0, 0.0, 0.0, 1.0)


@pytest.mark.parametrize(
    ("name", "value", "reported"),
    [
        ("centre_x", 11.0, "centre_x is 11.0 m.*metres"),
        ("probe_z", -1e3, "probe_z is -1000.0 m"),
        ("beam_x", 1.5, "beam_x is 1.5.*tangent of the angle"),
        ("beam_y", "steep", "beam_y is 'steep'"),
    ],
)
def test_what_no_cell_has_is_refused_by_name_value_and_unit(name, value, reported):
    with pytest.raises(ConfigurationError, match=reported):
        Geometry(**{name: value})
