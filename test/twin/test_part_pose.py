"""The pose of the part against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from omsm_ros.core.surface.aspheres import Sphere
from omsm_ros.core.surface.nominal import PAPER_MIRROR, PAPER_MIRROR_RADIUS_M, Flat
from omsm_ros.errors import ConfigurationError
from omsm_ros.twin.part import MountedSurface, PartPose, mounted_surface

ALL_SIX = PartPose(
    x_m=5e-6, y_m=-3e-6, z_m=1e-6, tilt_x_rad=1e-3, tilt_y_rad=-2e-3, clocking_rad=0.3
)


def _plane():
    line = np.linspace(-1, 1, 21) * PAPER_MIRROR_RADIUS_M * 0.7
    return (axis.ravel() for axis in np.meshgrid(line, line))


def test_a_tilted_flat_is_a_plane():
    x, y = _plane()
    a, b = 1e-3, 2e-3
    found = MountedSurface(Flat(), PartPose(tilt_x_rad=a, tilt_y_rad=b)).height(x, y)
    # Normal of the flat after a turn about x, then y: (cos a sin b, -sin a, cos a cos b).
    expected = -(x * np.cos(a) * np.sin(b) - y * np.sin(a)) / (np.cos(a) * np.cos(b))
    np.testing.assert_allclose(found, expected, atol=1e-17)


def test_a_shifted_sphere_is_a_sphere_elsewhere():
    x, y = _plane()
    found = MountedSurface(Sphere(0.1), PartPose(x_m=1e-3, y_m=2e-3, z_m=3e-6)).height(x, y)
    expected = 3e-6 + 0.1 - np.sqrt(0.01 - (x - 1e-3) ** 2 - (y - 2e-3) ** 2)
    np.testing.assert_allclose(found, expected, atol=1e-16)


def test_a_sphere_turned_about_its_centre_is_the_same():
    tilt, r = 2e-3, 0.1
    # The centre is at (0, 0, r); a turn about y through the origin takes it to (r sin, 0, r cos).
    pose = PartPose(tilt_y_rad=tilt, x_m=-r * np.sin(tilt), z_m=r * (1 - np.cos(tilt)))
    x, y = _plane()
    np.testing.assert_allclose(
        MountedSurface(Sphere(r), pose).height(x, y), Sphere(r).height(x, y), atol=1e-15
    )


def test_every_point_of_a_posed_mirror_lies_on_the_mirror_when_put_back():
    x, y = _plane()
    z = MountedSurface(PAPER_MIRROR, ALL_SIX).height(x, y)
    shift = np.array([[ALL_SIX.x_m], [ALL_SIX.y_m], [ALL_SIX.z_m]])
    back = ALL_SIX.rotation.T @ (np.array([x, y, z]) - shift)
    np.testing.assert_allclose(back[2], PAPER_MIRROR.height(back[0], back[1]), atol=1e-13)


def test_clocking_turns_the_part_about_the_spindle():
    x, y = _plane()
    turned = MountedSurface(PAPER_MIRROR, PartPose(clocking_rad=np.pi / 2)).height(x, y)
    np.testing.assert_allclose(turned, PAPER_MIRROR.height(y, -x), atol=1e-17)


def test_a_part_that_sits_right_is_itself():
    assert mounted_surface(PAPER_MIRROR, PartPose()) is PAPER_MIRROR


def test_angles_must_be_numbers():
    with pytest.raises(ConfigurationError, match="tilt_x_rad"):
        PartPose(tilt_x_rad=np.inf)
