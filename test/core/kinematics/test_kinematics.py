"""Machine axes to workpiece frame."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from omsm_ros.core.kinematics.kinematics import (
    Geometry,
    WorkpiecePoints,
    beam_quaternion,
    workpiece_points,
    workpiece_xy,
)
from omsm_ros.errors import ConfigurationError


def test_a_quarter_turn_by_hand() -> None:
    x, y = workpiece_xy(np.array([2.0, 0.0]), np.array([0.0, 3.0]), np.full(2, np.pi / 2))
    assert np.allclose(x, [0.0, 3.0])
    assert np.allclose(y, [-2.0, 0.0])


def test_a_point_fixed_on_the_turning_workpiece_stays_where_it_is() -> None:
    # A mark at (4, 1) mm of the workpiece is carried round by +c in the machine's frame.
    c = np.linspace(-7.0, 7.0, 50)
    mark = 4e-3 + 1e-3j
    seen = mark * np.exp(1j * c)
    x, y = workpiece_xy(seen.real, seen.imag, c)
    assert np.allclose(x, 4e-3, atol=1e-15)
    assert np.allclose(y, 1e-3, atol=1e-15)


def test_radius_is_kept() -> None:
    rng = np.random.default_rng(0)
    x, y, c = rng.normal(size=(3, 100))
    assert np.allclose(np.hypot(*workpiece_xy(x, y, c)), np.hypot(x, y))


def points(geometry: Geometry, **motion: float) -> WorkpiecePoints:
    """One point, of axes that rest at zero but for those named."""
    values = {name: np.array([motion.get(name, 0.0)]) for name in ("x", "y", "z", "b", "c", "d")}
    return workpiece_points(
        geometry, (values["x"], values["y"], values["z"]), values["b"], values["c"], values["d"]
    )


def test_without_geometry_the_distance_is_added_to_z() -> None:
    found = points(Geometry(), x=3e-3, z=1e-3, c=np.pi / 2, d=20e-6)
    assert np.allclose(np.ravel(found), [0.0, -3e-3, 1.02e-3], atol=1e-18)


def test_the_spindle_centre_is_taken_off_before_turning() -> None:
    geometry = Geometry(centre_x=10e-6, centre_y=-4e-6)
    found = points(geometry, x=10e-6, y=-4e-6, c=1.0)
    assert np.allclose(np.ravel(found), 0.0, atol=1e-18)


def rotation_about_y(angle: float) -> np.ndarray:
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])


def test_a_tilt_of_b_carries_offset_and_beam_round_the_pivot() -> None:
    geometry = Geometry(probe_x=5e-3, probe_z=-80e-3, beam_x=2e-3, beam_y=-1e-3)
    b, d, z = 0.03, 40e-6, 2e-3
    found = points(geometry, x=7e-3, z=z, b=b, d=d)
    # The second method: matrices on the whole chain, C at zero.
    offset = np.array([5e-3, 0.0, -80e-3])
    beam = np.array([2e-3, -1e-3, 1.0])
    beam /= np.linalg.norm(beam)
    seen = rotation_about_y(b) @ (offset + d * beam) - offset
    expected = seen + np.array([7e-3, 0.0, z])
    assert np.allclose(np.ravel(found), expected, rtol=0, atol=1e-16)


def test_a_small_tilt_of_a_long_arm_keeps_its_picometres() -> None:
    arm, b = 0.5, 1e-6
    found = points(Geometry(probe_z=-arm), b=b)
    assert found.height[0] == pytest.approx(arm * b**2 / 2, rel=1e-9, abs=0)
    assert found.x[0] == pytest.approx(-arm * b, rel=1e-9)


def test_a_tilted_beam_reads_the_cosine() -> None:
    found = points(Geometry(beam_x=0.01), d=50e-6)
    assert found.height[0] == pytest.approx(50e-6 * np.cos(np.arctan(0.01)), rel=1e-12)
    assert found.x[0] == pytest.approx(50e-6 * np.sin(np.arctan(0.01)), rel=1e-12)


def test_a_point_without_tilt_among_tilted_ones_is_the_same_to_the_last_bit() -> None:
    rng = np.random.default_rng(3)
    x, y, z, c, d = rng.normal(size=(5, 40)) * 1e-3
    geometry = Geometry(probe_x=1e-3, probe_z=-0.1, beam_x=1e-3)
    b = np.zeros(40)
    alone = workpiece_points(geometry, (x, y, z), b, c, d)
    b[20:] = 0.01
    mixed = workpiece_points(geometry, (x, y, z), b, c, d)
    for ours, theirs in zip(alone, mixed, strict=True):
        assert np.array_equal(ours[:20], theirs[:20])


@pytest.mark.parametrize("name", ["centre_x", "probe_z", "beam_y", "abbe_arm"])
def test_a_geometry_that_is_no_number_is_named(name: str) -> None:
    with pytest.raises(ConfigurationError, match=name):
        Geometry(**{name: np.nan})


@pytest.mark.parametrize("slopes", [(0.0, 0.0), (0.3, 0.0), (0.0, -0.2), (0.05, 0.07)])
def test_the_quaternion_turns_z_onto_the_beam(slopes: tuple[float, float]) -> None:
    """By the rotation that scipy makes of it; and the shortest one turns about no Z."""
    x, y, z, w = beam_quaternion(Geometry(beam_x=slopes[0], beam_y=slopes[1]))
    turned = Rotation.from_quat([x, y, z, w]).apply([0.0, 0.0, 1.0])
    beam = np.array([*slopes, 1.0])
    assert np.allclose(turned, beam / np.linalg.norm(beam), atol=1e-15)
    assert z == 0
