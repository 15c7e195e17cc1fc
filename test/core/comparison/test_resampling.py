"""Heights between the points, against surfaces whose heights everywhere are known."""

import numpy as np
import pytest

from omsm_ros.core.comparison.resampling import LocalQuadratic, cell_side, on_grid
from omsm_ros.core.surface.measured_points import MeasuredPoints
from omsm_ros.errors import DataError

RADIUS = 5e-3


def _spiral(feed=0.1e-3, speed_rpm=30, period=10e-3):
    """Places of a scan from the rim to the centre, as dense there as scans are."""
    turns = RADIUS / feed
    time = np.arange(0, turns * 60 / speed_rpm, period)
    angle = 2 * np.pi * speed_rpm / 60 * time
    radius = RADIUS - feed * angle / (2 * np.pi)
    return radius * np.cos(angle), radius * np.sin(angle)


def _points(height, places=None, noise=0.0, stated=None, seed=0):
    x, y = _spiral() if places is None else places
    rng = np.random.default_rng(seed)
    return MeasuredPoints(
        x=x,
        y=y,
        height=height(x, y) + rng.normal(0, noise, len(x)),
        uncertainty=None if stated is None else np.full(len(x), stated),
    )


def _inside(count=2000, seed=3):
    rng = np.random.default_rng(seed)
    r, a = 0.9 * RADIUS * np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    return r * np.cos(a), r * np.sin(a)


def paraboloid(x, y):
    return (x**2 + y**2) / (4 * 25.4e-3) + 0.3 * x


def ripple(x, y):
    """Ten periods over the aperture, 20 nm."""
    return 20e-9 * np.cos(2 * np.pi * x / 1e-3) * np.cos(2 * np.pi * y / 1.3e-3)


def test_a_steep_paraboloid_is_met_to_a_hundredth_of_a_nanometre():
    points = _points(paraboloid)
    surface = LocalQuadratic(points, cell_side(points.x, points.y, 200))
    x, y = _inside()
    found = surface.at(x, y)
    assert np.max(np.abs(found.value - paraboloid(x, y))) < 1e-11
    assert found.slope_x == pytest.approx(x / (2 * 25.4e-3) + 0.3, abs=1e-6)
    assert found.slope_y == pytest.approx(y / (2 * 25.4e-3), abs=1e-6)
    assert np.all(np.isnan(found.stated))


def test_the_error_of_the_method_is_stated_from_above_and_not_far_above():
    points = _points(ripple)
    surface = LocalQuadratic(points, cell_side(points.x, points.y, 200))
    x, y = _inside()
    true = float(np.sqrt(np.mean((surface.at(x, y).value - ripple(x, y)) ** 2)))
    stated = surface.method_error(x, y)
    assert 0 < true < 1e-9
    assert 0.7 * true < stated < 3 * true


@pytest.mark.soak
def test_independent_errors_scatter_as_stated():
    """Against many repetitions of the noise."""
    x, y = _inside(60)
    places = _spiral()
    side = cell_side(*places, 200)
    zero = lambda x, y: 0 * x  # noqa: E731
    runs = [
        LocalQuadratic(_points(zero, places, 10e-9, 10e-9, seed), side).at(x, y)
        for seed in range(30)
    ]
    scatter = np.std([run.value for run in runs], axis=0)
    assert np.median(scatter / (10e-9 * np.sqrt(runs[0].gain))) == pytest.approx(1, abs=0.08)
    assert runs[0].stated == pytest.approx(10e-9)
    assert np.all(runs[0].gain < 0.6)


def test_no_height_is_made_up_outside_or_in_a_hole():
    points = _points(paraboloid)
    hole = np.hypot(points.x - 2e-3, points.y) < 1e-3
    points = points.part(~hole)
    surface = LocalQuadratic(points, cell_side(points.x, points.y, 200))
    x = np.array([2e-3, 5.6e-3, 0.0, 0.0, -2e-3])
    y = np.array([0.0, 0.0, -7e-3, 1e-4, 0.0])
    assert np.isfinite(surface.at(x, y).value).tolist() == [False, False, False, True, True]


def test_the_whole_aperture_has_heights():
    points = _points(paraboloid)
    grid, _ = on_grid(points, 200)
    x, y = np.meshgrid(grid.x, grid.y)
    inside = np.hypot(x, y) < RADIUS - grid.dx
    assert np.all(np.isfinite(grid.height[inside]))
    outside = np.hypot(x, y) > RADIUS + grid.dx
    assert not np.any(np.isfinite(grid.height[outside]))
    filled = np.isfinite(grid.height)
    error = grid.height[filled] - paraboloid(x, y)[filled]
    assert np.max(np.abs(error)) < 1e-10


def test_cells_of_a_spiral_are_about_one_feed_across():
    side = cell_side(*_spiral(feed=0.1e-3), 1000)
    assert 0.08e-3 < side < 0.25e-3


def test_a_profile_and_a_handful_of_points_are_no_surface():
    x = np.linspace(0, 1e-2, 100)
    with pytest.raises(DataError, match="which is no area"):
        on_grid(MeasuredPoints(x=x, y=0 * x, height=x), 100)
    rng = np.random.default_rng(0)
    few = MeasuredPoints(x=rng.random(5), y=rng.random(5), height=rng.random(5))
    with pytest.raises(DataError, match="expected 9 or more for a surface"):
        LocalQuadratic(few, 0.2)


def test_a_spacing_of_a_wrong_unit_is_refused():
    with pytest.raises(DataError, match="widen 'spacing'"):
        on_grid(_points(paraboloid), 200, spacing=1e-9)


def test_a_spacing_finer_than_the_points_that_leaves_no_height_is_refused():
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-1e-3, 1e-3, (2, 500))
    with pytest.raises(DataError, match=r"spacing of 1\.00 µm is finer .* widen 'spacing'"):
        on_grid(MeasuredPoints(x=x, y=y, height=0 * x), 200, spacing=1e-6)
