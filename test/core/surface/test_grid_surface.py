"""A map as a surface: exact where a cubic is, silent where nobody measured."""

from __future__ import annotations

import numpy as np
import pytest

from omsm_ros.core.surface.height_grid import GridSurface, HeightGrid, as_grid
from omsm_ros.core.surface.measured_points import MeasuredPoints
from omsm_ros.errors import DataError

RNG = np.random.default_rng(3)
BICUBIC = RNG.normal(size=(4, 4))


def bicubic(x, y, along_x=0, along_y=0):
    """A polynomial of degree three in each of x and y [mm], or its derivative by them."""
    from numpy.polynomial.polynomial import polyder, polyval2d

    table = polyder(polyder(BICUBIC, along_x, axis=0), along_y, axis=1)
    return polyval2d(np.asarray(x) * 1e3, np.asarray(y) * 1e3, table) * 1e-6


def mapped(rows=9, columns=13, x0=-2e-3, y0=1e-3, dx=3e-4, dy=5e-4):
    empty = HeightGrid(height=np.zeros((rows, columns)), x0=x0, y0=y0, dx=dx, dy=dy)
    x, y = np.meshgrid(empty.x, empty.y)
    return HeightGrid(height=bicubic(x, y), x0=x0, y0=y0, dx=dx, dy=dy)


def inside(grid, count=200):
    return (RNG.uniform(v[0], v[-1], count) for v in (grid.x, grid.y))


@pytest.mark.parametrize("shape", [(9, 13), (4, 4), (4, 30), (25, 5)])
def test_a_cubic_is_met_between_the_places_too(shape):
    """In each direction a spline of degree three is the cubic that it passes through."""
    grid = mapped(*shape)
    surface, (x, y) = GridSurface(grid), inside(grid)
    size = np.abs(grid.height).max()
    np.testing.assert_allclose(surface.height(x, y), bicubic(x, y), atol=1e-12 * size)
    along_x, along_y = surface.gradient(x, y)
    np.testing.assert_allclose(along_x, bicubic(x, y, 1, 0) * 1e3, atol=1e-7 * size * 1e3)
    np.testing.assert_allclose(along_y, bicubic(x, y, 0, 1) * 1e3, atol=1e-7 * size * 1e3)


def test_between_places_a_wave_is_met_to_the_fourth_power_of_the_spacing():
    """Half the spacing leaves a sixteenth of the error, far from the edges."""

    def error(count):
        step = 1e-2 / (count - 1)
        empty = HeightGrid(height=np.zeros((count, count)), x0=0.0, y0=0.0, dx=step, dy=step)
        wave = np.sin(2 * np.pi * empty.x / 4e-3) * np.cos(2 * np.pi * empty.y / 5e-3)[:, None]
        surface = GridSurface(HeightGrid(height=wave, x0=0.0, y0=0.0, dx=step, dy=step))
        x, y = np.random.default_rng(1).uniform(3e-3, 7e-3, (2, 2000))
        truth = np.sin(2 * np.pi * x / 4e-3) * np.cos(2 * np.pi * y / 5e-3)
        return np.sqrt(np.mean((surface.height(x, y) - truth) ** 2))

    assert error(41) / error(81) == pytest.approx(16, rel=0.15)


def test_a_missing_place_silences_the_four_cells_around_it_and_no_other():
    grid = mapped()
    holed = grid.height.copy()
    holed[3, 5] = np.nan
    whole = GridSurface(grid)
    surface = GridSurface(HeightGrid(height=holed, x0=grid.x0, y0=grid.y0, dx=grid.dx, dy=grid.dy))
    # The middles of all cells.
    x, y = np.meshgrid(grid.x[:-1] + grid.dx / 2, grid.y[:-1] + grid.dy / 2)
    silent = np.zeros(x.shape, bool)
    silent[2:4, 4:6] = True
    np.testing.assert_array_equal(np.isnan(surface.height(x, y)), silent)
    for slope in surface.gradient(x, y):
        np.testing.assert_array_equal(np.isnan(slope), silent)
    # The value for the missing place changes the cells next to it much less than the map varies.
    near = np.abs(surface.height(x, y) - whole.height(x, y))[~silent]
    assert near.max() < 0.1 * np.ptp(grid.height)


def test_a_straight_row_with_a_gap_stays_straight():
    """The gap is bridged by its neighbours in the row, which a plane does not show."""
    empty = HeightGrid(height=np.zeros((8, 10)), x0=0.0, y0=0.0, dx=1e-3, dy=1e-3)
    plane = 1e-6 + 2e-3 * empty.x + 0 * empty.y[:, None]
    holed = plane.copy()
    holed[4, 3:6] = np.nan
    surface = GridSurface(HeightGrid(height=holed, x0=0.0, y0=0.0, dx=1e-3, dy=1e-3))
    x, y = np.meshgrid(empty.x, empty.y[[1, 6]] + 2e-4)
    np.testing.assert_allclose(surface.height(x, y), np.broadcast_to(plane[0], x.shape), atol=1e-16)


def test_a_row_of_which_nothing_is_known_does_not_hinder_the_others():
    grid = mapped()
    holed = grid.height.copy()
    holed[0] = np.nan
    surface = GridSurface(HeightGrid(height=holed, x0=grid.x0, y0=grid.y0, dx=grid.dx, dy=grid.dy))
    x, y = np.meshgrid(grid.x, grid.y)
    found = surface.height(x, y)
    assert np.all(np.isnan(found[0]))
    np.testing.assert_allclose(found[1:], grid.height[1:], rtol=1e-9, atol=1e-16)


@pytest.mark.parametrize("side", ["left", "right", "lower", "upper"])
def test_the_map_ends_at_its_last_places(side):
    grid = mapped()
    surface = GridSurface(grid)
    middle = {"x": float(grid.x[6]), "y": float(grid.y[4])}
    name, edge, out = {
        "left": ("x", grid.x[0], -1e-9),
        "right": ("x", grid.x[-1], 1e-9),
        "lower": ("y", grid.y[0], -1e-9),
        "upper": ("y", grid.y[-1], 1e-9),
    }[side]
    at = {n: np.array([v, v]) for n, v in middle.items()}
    at[name] = np.array([edge, edge + out])
    found = surface.height(at["x"], at["y"])
    assert found[0] == pytest.approx(bicubic(at["x"][0], at["y"][0]), rel=1e-9)
    assert np.isnan(found[1])


def test_places_that_are_no_numbers_have_no_height():
    surface = GridSurface(mapped())
    strange = np.array([np.nan, np.inf, -np.inf, -1e-3])
    assert np.isnan(surface.height(strange, np.full(4, 2e-3))).tolist() == [True] * 3 + [False]
    assert np.all(np.isnan(surface.height(np.full(3, -1e-3), strange[:3])))


def test_rows_and_columns_spread_over_each_other():
    grid = mapped()
    surface = GridSurface(grid)
    table = surface.height(grid.x[np.newaxis], grid.y[:, np.newaxis])
    np.testing.assert_allclose(table, grid.height, rtol=1e-9, atol=1e-16)
    assert surface.height(grid.x0, grid.y0) == pytest.approx(grid.height[0, 0])


@pytest.mark.parametrize("shape", [(3, 9), (9, 3), (1, 1)])
def test_a_map_too_small_for_a_cubic_is_refused(shape):
    small = HeightGrid(height=np.zeros(shape), x0=0.0, y0=0.0, dx=1e-3, dy=1e-3)
    with pytest.raises(DataError, match=r"map of shape .*expected 4 rows and columns"):
        GridSurface(small)


# Points that are a map.


def test_the_places_of_a_map_are_its_first_and_even_steps():
    grid = mapped(rows=5, columns=4)
    np.testing.assert_allclose(grid.x, [-2e-3, -1.7e-3, -1.4e-3, -1.1e-3])
    np.testing.assert_allclose(grid.y, [1e-3, 1.5e-3, 2e-3, 2.5e-3, 3e-3])
    points = grid.points(notes=("seen",))
    assert points.notes == ("seen",)
    # Row by row: x runs first.
    np.testing.assert_array_equal(points.x[:4], grid.x)
    np.testing.assert_array_equal(points.y[:4], np.full(4, grid.y[0]))
    np.testing.assert_array_equal(points.height, grid.height.ravel())


@pytest.mark.parametrize("shape", [(2, 2), (2, 40), (40, 2), (17, 23)])
def test_a_map_of_any_shape_comes_back_from_its_points(shape):
    made = mapped(*shape)
    found = as_grid(made.points())
    np.testing.assert_array_equal(found.height, made.height)
    for name in ("x0", "y0", "dx", "dy"):
        assert getattr(found, name) == pytest.approx(getattr(made, name), rel=1e-12)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 500.0])
@pytest.mark.parametrize("shift", [0.0, 0.04])
def test_what_is_a_map_does_not_depend_on_its_size_and_place(scale, shift):
    made = mapped(12, 15)
    p = made.points()
    found = as_grid(MeasuredPoints(x=scale * p.x + shift, y=scale * p.y - shift, height=p.height))
    np.testing.assert_array_equal(found.height, made.height)
    assert found.dx == pytest.approx(scale * made.dx, rel=1e-6)


def test_rows_are_kept_apart_from_columns():
    """Exchanged coordinates are the transposed map."""
    made = mapped(6, 11)
    p = made.points()
    found = as_grid(MeasuredPoints(x=p.y, y=p.x, height=p.height))
    np.testing.assert_array_equal(found.height, made.height.T)
    assert (found.dx, found.dy) == (pytest.approx(made.dy), pytest.approx(made.dx))


def test_a_sparse_map_keeps_its_holes():
    """A third of the places has no height: a disc with a hole, say."""
    made = mapped(20, 20)
    holed = np.where(RNG.random((20, 20)) < 0.35, np.nan, made.height)
    found = as_grid(
        HeightGrid(height=holed, x0=made.x0, y0=made.y0, dx=made.dx, dy=made.dy).points()
    )
    np.testing.assert_array_equal(found.height, holed)


def test_a_handful_of_places_of_a_fine_raster_is_a_list():
    made = mapped(60, 60)
    few = made.points().part(RNG.permutation(3600)[:200])
    assert as_grid(few) is None


@pytest.mark.parametrize("moved", ["x", "y"])
def test_one_point_off_its_row_or_column_makes_it_no_map(moved):
    p = mapped(10, 12).points()
    columns = {"x": p.x.copy(), "y": p.y.copy(), "height": p.height}
    columns[moved][37] += 1e-4
    assert as_grid(MeasuredPoints(**columns)) is None


def test_places_of_one_column_or_one_row_are_no_map():
    line, same = np.linspace(0, 1e-2, 30), np.full(30, 2e-3)
    for x, y in ((line, same), (same, line), (same, same)):
        assert as_grid(MeasuredPoints(x=x, y=y, height=np.zeros(30))) is None


def test_rows_at_distances_of_one_and_two_are_rows_of_a_map_with_one_missing():
    made = mapped(5, 12)
    kept = np.array([0, 1, 3, 4])
    x, y = np.meshgrid(made.x, made.y[kept])
    found = as_grid(MeasuredPoints(x=x.ravel(), y=y.ravel(), height=made.height[kept].ravel()))
    assert found.height.shape == (5, 12)
    assert np.all(np.isnan(found.height[2]))
    np.testing.assert_array_equal(found.height[kept], made.height[kept])
