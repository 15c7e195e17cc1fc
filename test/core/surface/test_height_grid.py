"""Points that are a map, and points that only resemble one."""

import numpy as np
import pytest

from omsm_ros.core.surface.height_grid import GridSurface, HeightGrid, as_grid
from omsm_ros.core.surface.measured_points import MeasuredPoints, measured
from omsm_ros.errors import DataError


def _grid(rows=12, columns=7):
    height = np.arange(float(rows * columns)).reshape(rows, columns)
    height[3, 4] = height[0, 0] = np.nan
    return HeightGrid(height=height, x0=-0.3, y0=0.7, dx=1e-3, dy=2.5e-4)


@pytest.mark.parametrize("digits", [12, 6])
def test_a_map_is_found_in_any_order_of_its_points(digits):
    made = _grid()
    points = made.points()
    order = np.random.default_rng(1).permutation(len(points))
    mixed = MeasuredPoints(
        x=np.round(points.x[order], digits),
        y=np.round(points.y[order], digits),
        height=points.height[order],
    )
    found = as_grid(mixed)
    assert np.array_equal(found.height, made.height, equal_nan=True)
    assert (found.x0, found.y0) == pytest.approx((-0.3, 0.7), abs=1e-6)
    assert (found.dx, found.dy) == pytest.approx((1e-3, 2.5e-4), rel=1e-6)


def test_scattered_points_are_no_map():
    rng = np.random.default_rng(2)
    x, y, z = rng.random((3, 5000))
    assert as_grid(MeasuredPoints(x=x, y=y, height=z)) is None


def test_a_spiral_is_no_map():
    t = np.linspace(0, 200, 20_000)
    spiral = MeasuredPoints(x=t * np.cos(t) * 1e-4, y=t * np.sin(t) * 1e-4, height=0 * t)
    assert as_grid(spiral) is None


def test_places_measured_twice_are_no_map():
    points = _grid().points()
    twice = [np.append(part, part[5]) for part in (points.x, points.y, points.height)]
    assert as_grid(MeasuredPoints(x=twice[0], y=twice[1], height=twice[2])) is None


def test_a_profile_is_no_map():
    x = np.linspace(0, 1, 50)
    assert as_grid(MeasuredPoints(x=x, y=np.zeros(50), height=x)) is None


def test_points_without_a_height_are_counted_and_left_out():
    x = np.arange(4.0)
    points = measured(x, x, np.array([1.0, np.nan, 3.0, np.inf]), np.arange(4.0))
    assert (len(points), points.missing) == (2, 2)
    assert points.uncertainty.tolist() == [0, 2]


@pytest.mark.parametrize(
    ("change", "reported"),
    [
        ({"x": np.zeros(3)}, "one length"),
        ({"uncertainty": np.zeros(3)}, "one length"),
        ({"x": np.array([1.0, np.nan])}, "x"),
        ({"height": np.array([1.0, 1e9])}, "height"),
    ],
)
def test_points_that_are_none_are_refused(change, reported):
    columns = {"x": np.zeros(2), "y": np.zeros(2), "height": np.zeros(2)} | change
    with pytest.raises(DataError, match=reported):
        MeasuredPoints(**columns)


def test_no_points_are_refused():
    with pytest.raises(DataError, match="without points"):
        MeasuredPoints(x=np.empty(0), y=np.empty(0), height=np.empty(0))


@pytest.mark.parametrize("change", [{"dx": 0.0}, {"dy": np.nan}, {"height": np.zeros(3)}])
def test_a_map_that_is_none_is_refused(change):
    with pytest.raises(DataError, match="map"):
        HeightGrid(**{"height": np.zeros((2, 2)), "x0": 0, "y0": 0, "dx": 1, "dy": 1} | change)


def test_a_map_has_its_heights_up_to_its_last_row_and_column():
    random = np.random.default_rng(4)
    grid = HeightGrid(height=random.normal(size=(6, 9)), x0=-0.3, y0=0.7, dx=1e-3, dy=2.5e-4)
    surface = GridSurface(grid)
    x, y = np.meshgrid(grid.x, grid.y)
    np.testing.assert_allclose(surface.height(x, y), grid.height, atol=1e-9)
    beyond = surface.height(grid.x[-1] + np.array([1e-5, 0.0]), grid.y[-1] + np.array([0.0, 1e-5]))
    assert np.all(np.isnan(beyond))
