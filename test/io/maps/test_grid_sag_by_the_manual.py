"""Grid sag written and read line by line, after the manual of the program that made the format."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from omsm_ros.core.surface.height_grid import HeightGrid
from omsm_ros.errors import FileError, OmsmError
from omsm_ros.io.maps.grid_sag_file import is_grid_sag, read_grid_sag, write_grid_sag
from omsm_ros.io.maps.read_map import read_points
from omsm_ros.units import units_of

UNITS = {0: 1e-3, 1: 1e-2, 2: 0.0254, 3: 1.0}
COLUMNS, ROWS = 5, 6


def sag(path, first, lines=None, mark=" ", above=""):
    """A line a point, from the upper left: heights 0, 1, 2, …"""
    lines = [f"{k}" for k in range(COLUMNS * ROWS)] if lines is None else lines
    head = mark.join(map(str, (COLUMNS, ROWS, *first)))
    path.write_text(above + head + "\n" + "\n".join(lines) + "\n")
    return path


def by_hand(path):
    """Every point of a file of ours in the order of its lines: x, y, height or None [m]."""
    head, *lines = path.read_text().splitlines()
    columns, rows, dx, dy, unit, cx, cy = (float(part) for part in head.split())
    assert len(lines) == columns * rows
    scale = UNITS[int(unit)]
    found = []
    for place, line in enumerate(lines):
        column, row = place % int(columns), place // int(columns)
        height, _, _, _, flag = line.split()
        x = cx + dx * (column - (columns - 1) / 2)
        y = cy + dy * ((rows - 1) / 2 - row)
        found.append((x * scale, y * scale, None if flag != "0" else float(height) * scale))
    return found


@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize("signs", [(1, 1), (-1, 1), (1, -1)])
def test_each_unit_scales_places_and_heights(tmp_path, unit, signs):
    """A spacing has a direction in some programs; the order of the lines is fixed all the same."""
    metres = UNITS[unit]
    first = (0.5 * signs[0], 0.25 * signs[1], unit, 2, -3)
    points = read_points(sag(tmp_path / "a.dat", first))
    assert len(points) == COLUMNS * ROWS
    lowest = np.argmin(points.height)
    assert points.x[lowest] == pytest.approx((2 - 2 * 0.5) * metres, rel=1e-12)
    assert points.y[lowest] == pytest.approx((-3 + 2.5 * 0.25) * metres, rel=1e-12)
    second = np.flatnonzero(np.isclose(points.height, metres, rtol=1e-12))[0]
    assert points.x[second] - points.x[lowest] == pytest.approx(0.5 * metres, rel=1e-9)
    assert points.y[second] == points.y[lowest]
    assert points.height.max() == pytest.approx(29 * metres, rel=1e-12)


@pytest.mark.parametrize(
    ("form", "missing"),
    [("{}", 0), ("{} 0 0 0", 0), ("{} 0 0 0 0", 0), ("{} 9 9 9", 0), ("{} 0 0 0 1", 30)],
)
def test_derivatives_and_flags_may_be_left_out(tmp_path, form, missing):
    path = sag(tmp_path / "a.grd", (1, 1, 0), [form.format(k) for k in range(30)])
    if missing:
        with pytest.raises(FileError, match="without points"):
            read_points(path)
    else:
        points = read_points(path)
        assert np.sort(points.height).tolist() == pytest.approx([k * 1e-3 for k in range(30)])


@pytest.mark.parametrize("flag", ["1", "2", "-1"])
def test_any_flag_but_zero_is_no_datum(tmp_path, flag):
    lines = [f"{k} 0 0 0 {flag if k in (7, 9) else 0}" for k in range(30)]
    grid = read_grid_sag(sag(tmp_path / "a.dat", (1, 1, 3), lines))
    held = grid.height[::-1].ravel()
    assert np.flatnonzero(np.isnan(held)).tolist() == [7, 9]


def test_without_decentres_the_centre_of_the_map_is_the_origin(tmp_path):
    grid = read_grid_sag(sag(tmp_path / "a.dat", (0.5, 0.25, 0)))
    assert grid.x.mean() == pytest.approx(0, abs=1e-18)
    assert grid.y.mean() == pytest.approx(0, abs=1e-18)
    assert np.ptp(grid.x) == pytest.approx(2e-3)
    assert np.ptp(grid.y) == pytest.approx(1.25e-3)


def test_comments_and_empty_lines_above_and_among_the_points(tmp_path):
    lines = [f"{k}" for k in range(30)]
    lines[3:3] = ["! between", "", "  "]
    lines[-1] += " ! the last"
    above = "! of a mirror\n\n! 9 9 9 9 9\n"
    grid = read_grid_sag(sag(tmp_path / "a.dat", (1, 1, 3), lines, above=above))
    assert grid.height[::-1].ravel().tolist() == list(range(30))


@settings(max_examples=25)
@given(
    st.integers(5, 8), st.integers(5, 8), st.floats(1e-6, 1e-2), st.floats(1e-6, 1e-2),
    st.floats(-1, 1), st.floats(-1, 1), st.randoms(use_true_random=False),
)  # fmt: skip
def test_written_is_read_by_hand_and_by_us(tmp_path_factory, rows, columns, dx, dy, x0, y0, random):
    path = tmp_path_factory.mktemp("sag") / "a.dat"
    height = np.array([[random.uniform(-1e-3, 1e-3) for _ in range(columns)] for _ in range(rows)])
    height[random.randrange(rows), random.randrange(columns)] = np.nan
    grid = HeightGrid(height=height, x0=x0, y0=y0, dx=dx, dy=dy)
    write_grid_sag(path, grid)
    found = by_hand(path)
    for place, (x, y, value) in enumerate(found):
        row, column = rows - 1 - place // columns, place % columns
        wanted = height[row, column]
        assert value == (None if np.isnan(wanted) else wanted)
        assert x == pytest.approx(x0 + dx * column, abs=1e-14)
        assert y == pytest.approx(y0 + dy * row, abs=1e-14)
    back = read_grid_sag(path)
    np.testing.assert_array_equal(back.height, height)
    assert (back.dx, back.dy) == (dx, dy)


def test_slopes_next_to_missing_points_are_zero_and_never_nan(tmp_path):
    """Programs would interpolate with them: what is not known must not be a number at large."""
    y, x = np.mgrid[:7, :7] * 1e-3
    height = 0.3 * x - 0.2 * y
    height[3, 3] = np.nan
    write_grid_sag(tmp_path / "a.dat", HeightGrid(height=height, x0=0, y0=0, dx=1e-3, dy=1e-3))
    table = np.loadtxt(tmp_path / "a.dat", skiprows=1).reshape(7, 7, 5)[::-1]
    assert np.all(np.isfinite(table))
    assert table[3, 3].tolist()[0] == 0
    assert table[3, 3, 4] == 1
    assert np.sum(table[..., 4]) == 1
    adjacent = np.zeros((7, 7), bool)
    adjacent[3, [2, 3, 4]] = True
    assert np.all(table[adjacent][:, 1][[0, 2]] == 0)
    assert table[~adjacent][:, 1] == pytest.approx(0.3, rel=1e-8)
    assert table[[0, 1, 5, 6]][..., 2] == pytest.approx(-0.2, rel=1e-8)


@pytest.mark.parametrize(
    ("first", "second", "is_one"),
    [
        ("5 5 1 1 0 0 0", "1", True),
        ("5 5 1 1 0", "1 0 0 0", True),
        ("5 5 1 1 3", "1 0 0 0 0", True),
        ("4 5 1 1 0 0 0", "1", False),
        ("5 4 1 1 0 0 0", "1", False),
        ("5.5 5 1 1 0 0 0", "1", False),
        ("5 5 0 1 0 0 0", "1", False),
        ("5 5 1 0 0 0 0", "1", False),
        ("5 5 1 1 0.5 0 0", "1", False),
        ("5 5 1 1 0 0", "1", False),
        ("5 5 1 nan 0 0 0", "1", False),
        ("x y z 1 0 0 0", "1", False),
        ("", "", False),
        ("5 5 1 1 4 0 0", "1", True),
        ("5 5 1 1 4 0 0", "1 2", False),
        ("5 5 1 1 4", "1 2 3 4 5", False),
    ],
)
def test_which_first_lines_are_those_of_a_grid_sag(first, second, is_one):
    assert is_grid_sag(first, second) is is_one


@pytest.mark.parametrize(
    ("first", "reported"),
    [
        ((1, 1, 7), "unit 7, the fifth number of its first line, expected 0 .mm., 1 .cm., 2 .inch"),
        ((1, 1), "must begin with columns, rows .5 or more., two spacings, unit and decentres"),
        ((1, 0, 0), "must begin with columns, rows"),
        ((1, 1e9, 3), "spacing dy of the map"),
        ((1, 1, 3, 1e9, 0), "x0 of the map"),
    ],
)
def test_an_impossible_first_line_is_reported(tmp_path, first, reported):
    with pytest.raises(OmsmError, match=reported):
        read_grid_sag(sag(tmp_path / "a.dat", first))


def test_the_unit_that_is_given_must_be_the_one_of_the_file(tmp_path):
    path = sag(tmp_path / "a.dat", (1, 1, 2))
    assert read_points(path, units_of("in")).height.max() == pytest.approx(29 * 0.0254)
    with pytest.raises(FileError, match="x and y are in inch, and --unit says mm"):
        read_points(path, units_of("mm"))
    with pytest.raises(FileError, match="its heights are in inch, and --unit says um"):
        read_points(path, units_of("in,um"))
