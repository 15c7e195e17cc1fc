import numpy as np
import pytest

from omsm_ros.core.surface.aspheres import Sphere
from omsm_ros.core.surface.nominal import PAPER_MIRROR, Flat, OffAxisParaboloid
from omsm_ros.errors import SurfaceError

RNG = np.random.default_rng(0)
X, Y = RNG.uniform(-12.7e-3, 12.7e-3, (2, 500))


@pytest.mark.parametrize(("focal", "distance"), [(25.4e-3, 50.8e-3), (1.0, 0.2), (50e-3, 0.0)])
def test_every_point_of_the_piece_lies_on_the_parent(focal, distance):
    w = OffAxisParaboloid(focal, distance).height(X, Y)
    tilt = np.arctan(distance / (2 * focal))
    # Rotate the tangent frame back into the parent's.
    radial = distance + X * np.cos(tilt) - w * np.sin(tilt)
    axial = distance**2 / (4 * focal) + X * np.sin(tilt) + w * np.cos(tilt)
    np.testing.assert_allclose(axial, (radial**2 + Y**2) / (4 * focal), atol=1e-17)


def test_height_and_slope_vanish_at_the_centre():
    assert PAPER_MIRROR.height(0.0, 0.0) == 0
    step = 1e-6
    heights = PAPER_MIRROR.height(np.array([step, -step, 0, 0]), np.array([0, 0, step, -step]))
    assert np.all(abs(heights) < 2 * step**2 / 0.05)


def test_sphere_has_its_radius_everywhere():
    radius = 0.1
    z = Sphere(radius).height(X, Y)
    np.testing.assert_allclose(np.sqrt(X**2 + Y**2 + (z - radius) ** 2), radius, rtol=1e-15)
    np.testing.assert_array_equal(Sphere(-radius).height(X, Y), -z)
    assert np.isnan(Sphere(radius).height(0.2, 0.0))


def test_flat_is_flat():
    np.testing.assert_array_equal(Flat(2.0).height(X, Y), np.full(500, 2.0))


@pytest.mark.parametrize(
    ("shape", "named"),
    [
        (lambda: Sphere(0.0), "radius is 0.0 m"),
        (lambda: Sphere(1e300), "radius"),
        (lambda: Sphere(np.nan), "radius"),
        (lambda: Flat(np.inf), "level"),
        (lambda: OffAxisParaboloid(-1.0, 0.0), "parent_focal_length is -1.0 m"),
        (lambda: OffAxisParaboloid(1.0, 1e6), "off_axis_distance"),
    ],
)
def test_a_surface_that_nobody_makes_is_refused_by_name(shape, named):
    with pytest.raises(SurfaceError, match=named):
        shape()
