"""Text of points and grids: what carries its unit, what must be asked for it, what is no map."""

from dataclasses import replace

import numpy as np
import pytest

from omsm_ros.errors import FileError
from omsm_ros.io.maps.grid_sag_file import read_grid_sag, write_grid_sag
from omsm_ros.io.maps.read_map import read_points
from omsm_ros.io.maps.vertex_file import write_ply
from omsm_ros.units import name_and_unit, units_of

from .surfaces import by_place, grid

MM, NM = 1e-3, 1e-9
TABLE = np.array([[0.0, 0.0, 5.0], [1.0, 0.0, 6.0], [0.0, 2.0, 7.0], [1.0, 2.0, 8.5]])


def _text(tmp_path, text, name="map.xyz"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("header", "lateral", "vertical"),
    [
        ("! X/mm/t/t/tY/mm/t/t/tZ/mm\n", MM, MM),
        ("x_m,y_m,height_m\n", 1, 1),
        ("# x [mm]  y [mm]  z [nm]\n", MM, NM),
        ("X (mm)\tY (mm)\tZ (µm)\n", MM, 1e-6),
        ("instrument 7\nof March\nx_um;y_um;z_nm\n", 1e-6, NM),
        ("# X/Millimeters, Y/Millimeters, Z/NanoMeters\n", MM, NM),
    ],
)
def test_units_are_those_of_the_header(tmp_path, header, lateral, vertical):
    mark = "," if "," in header and not header.startswith("#") else ";" if ";" in header else " "
    lines = "".join(mark.join(f"{v:.9g}" for v in row) + "\n" for row in TABLE)
    points = read_points(_text(tmp_path, header + lines))
    assert points.x == pytest.approx(TABLE[:, 0] * lateral, rel=1e-12)
    assert points.y == pytest.approx(TABLE[:, 1] * lateral, rel=1e-12)
    assert points.height == pytest.approx(TABLE[:, 2] * vertical, rel=1e-12)


@pytest.mark.parametrize("header", ["", "x y z\n", "# from the lab\n", "x,y,z\n"])
def test_a_unit_that_is_not_there_is_asked_for(tmp_path, header):
    mark = "," if "," in header else " "
    lines = "".join(mark.join(map(str, row)) + "\n" for row in TABLE)
    path = _text(tmp_path, header + lines)
    with pytest.raises(FileError, match=r"does not say in which unit.*--unit mm"):
        read_points(path)
    points = read_points(path, units_of("mm,nm"))
    assert points.x == pytest.approx(TABLE[:, 0] * MM)
    assert points.height == pytest.approx(TABLE[:, 2] * NM)


@pytest.mark.parametrize(
    ("name", "text", "reported"),
    [
        ("a.xyz", "x_mm y_mm z_nm\n", "x and y are in mm, and --unit says um"),
        ("a.xyz", "x_um y_um z_nm\n", "heights are in nm, and --unit says um"),
        ("a.dat", "5 5 0.1 0.1 0 0 0\n", "x and y are in mm, and --unit says um"),
    ],
)
def test_a_unit_that_the_text_contradicts_is_refused(tmp_path, name, text, reported):
    """One of the two is wrong by a thousand; the one in the text silently won before."""
    path = tmp_path / name
    path.write_text(text + "1 2 3\n" * 25)
    with pytest.raises(FileError, match=f"{reported}; leave --unit out"):
        read_points(path, units_of("um"))
    # With two files, the unit is for the other one.
    read_points(path, replace(units_of("um"), where_unsaid=True))


def test_a_cloud_of_ours_is_in_metres_and_a_note_says_so(tmp_path):
    path = tmp_path / "a.ply"
    write_ply(path, np.ones(9, [("x", "<f8"), ("y", "<f8"), ("z", "<f8")]))
    points = read_points(path, units_of("um"))
    assert points.x.tolist() == [1.0] * 9
    assert "--unit was not used" in points.notes[0]
    assert read_points(path, units_of("m")).notes == ()


def test_a_unit_that_the_text_says_too_is_taken(tmp_path):
    path = _text(tmp_path, "x_mm y_mm z_nm\n1 2 3\n")
    assert read_points(path, units_of("mm,nm")).height == pytest.approx(3 * NM)
    half = _text(tmp_path, "x_mm y_mm z\n1 2 3\n")
    assert read_points(half, units_of("mm,um")).height == pytest.approx(3e-6)


def test_columns_are_found_by_name_in_any_order(tmp_path):
    text = "label_m,height_m,uncertainty_m,y_m,x_m,sample\n"
    text += "".join(f"9,{z},{z / 100},{y},{x},{i + 4}\n" for i, (x, y, z) in enumerate(TABLE))
    points = read_points(_text(tmp_path, text, "map.csv"))
    assert points.x.tolist() == TABLE[:, 0].tolist()
    assert points.y.tolist() == TABLE[:, 1].tolist()
    assert points.height.tolist() == TABLE[:, 2].tolist()
    assert points.uncertainty == pytest.approx(TABLE[:, 2] / 100)
    assert points.sample.tolist() == [4, 5, 6, 7]
    assert points.notes == ("1 other columns were left out",)


@pytest.mark.parametrize("header", ["", "x_mm y_mm z_mm\n"])
def test_a_mark_of_the_encoding_is_no_number_and_no_name(tmp_path, header):
    """As editors of Windows write it: the first point was taken for a header before."""
    path = tmp_path / "map.xyz"
    path.write_bytes(b"\xef\xbb\xbf" + (header + "1 2 3\n4 5 6\n").encode())
    points = read_points(path, units_of("mm"))
    assert points.x == pytest.approx([1e-3, 4e-3])


def test_a_grid_sag_with_a_mark_of_the_encoding_is_one(tmp_path):
    path = tmp_path / "map.dat"
    path.write_bytes(b"\xef\xbb\xbf" + b"5 5 1 1 0 0 0\n" + b"1 0 0 0 0\n" * 25)
    assert len(read_points(path)) == 25


@pytest.mark.parametrize("encoding", ["utf-16-le", "utf-16-be"])
def test_text_in_utf_16_is_read(tmp_path, encoding):
    path = tmp_path / "map.csv"
    text = "\ufeffx in µm,y in mm,z in nm\n0,0,5\n1,2,6\n"
    path.write_bytes(text.encode(encoding))
    points = read_points(path)
    assert points.x == pytest.approx([0, 1e-6])
    assert points.y == pytest.approx([0, 2e-3])
    assert points.height == pytest.approx([5e-9, 6e-9])
    path.write_bytes(text.encode(encoding)[:-1])
    with pytest.raises(FileError, match="is no row of numbers"):
        read_points(path)


def test_two_columns_x_and_y_are_a_profile(tmp_path):
    """A file without heights would be no map, so that y is the height, as of a stylus."""
    points = read_points(_text(tmp_path, "x in mm,y in µm\n0,3\n1,4\n", "map.csv"))
    assert points.height == pytest.approx([3e-6, 4e-6])
    assert points.notes == ("a profile along x",)


def test_a_height_that_is_missing_is_counted(tmp_path):
    points = read_points(_text(tmp_path, "x_m y_m z_m\n0 0 1\n1 0 nan\n0 1 NaN\n1 1 2\n"))
    assert (len(points), points.missing) == (2, 2)


@pytest.mark.parametrize(
    ("text", "reported"),
    [
        ("", "is empty"),
        ("hello\nworld\n", "no line of numbers"),
        ("y_mm z_mm\n1 2\n3 4\n", "has 2 columns, expected x, y and height"),
        ("index,x,y\n0,1,2\n1,3,4\n", "index, x, y, expected x, y and height among them"),
        ("x_m y_m z_m\n1 2 3\n4 5 six\n", "is no row of numbers.*decimal points"),
        ("x_m;y_m;z_m\n1.5;2.5;3.5\n1,5;2,5;3,5\n", "is no row of numbers.*decimal points"),
        ("x_m y_m z_m\n1 2 3\n4 5\n", "line 3: '4 5' is no row"),
        ("x_m y_m z_m\n1 2 nan\n", "surface without points"),
        ("x_m y_m z_m\n1 2 3\n1e9 2 3\n", "give it in metres"),
        ("x_m y_m z_m\n1 2 3\ninf 2 3\n", "give it in metres"),
        ("x_mm,y_mm,z_mm\n1,5,2,5,3,5\n", "line 1 names 3 columns, .* have 6"),  # decimal commas
        ("x_mm,y_mm,z_mm\n1,2,3\n1,5,2,3\n", "line 3: '1,5,2,3' is no row"),
        ("x_mm,y_mm,z_mm,z_mm\n1,2,3,4\n", "'z_mm' twice"),
        ("x_m,y_m,z_m\nmm,mm,mm\n1,2,3\n", "two units of x"),
        ("\n" * 60 + "1 2 3\n", "no line of numbers among its first 50"),
    ],
)
def test_a_file_without_a_map_is_reported_in_one_line(tmp_path, text, reported):
    with pytest.raises(FileError, match=reported) as refused:
        read_points(_text(tmp_path, text))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "text",
    [
        ",x_mm,y_mm,z_um\n0,1,2,3\n1,4,5,6\n",  # as pandas numbers its lines
        "x,y,z\n[mm],[mm],[um]\n1,2,3\n4,5,6\n",  # units on a line of their own
        "x_mm;y_mm;z_um;remark\n1;2;3;\n4;5;6;7\n",
        "x_mm,y_mm,z_um\n1,2,3\n  \n4,5,6\n\t\n",
    ],
)
def test_the_columns_of_a_text_are_where_its_names_say(tmp_path, text):
    points = read_points(_text(tmp_path, text))
    assert points.x == pytest.approx([1e-3, 4e-3])
    assert points.y == pytest.approx([2e-3, 5e-3])
    assert points.height == pytest.approx([3e-6, 6e-6])


@pytest.mark.parametrize("text", ["furlong", "mm,nm,m", "", "mm,", "1e-3"])
def test_an_unknown_unit_is_refused(text):
    with pytest.raises(FileError, match=r"unit .* is not known"):
        units_of(text)


@pytest.mark.parametrize(
    ("text", "name", "unit"),
    [
        ("x", "x", None),
        ("dynamic_error_m", "dynamic_error", 1.0),
        ("Z [µm]", "z", 1e-6),
        ("Height (Angstrom)", "height", 1e-10),
        ("speed [m/s]", "speed [m/s]", None),
        ("sample", "sample", None),
        ("Lateral um", "lateral", 1e-6),
        ("x in µm", "x", 1e-6),
    ],
)
def test_name_and_unit(text, name, unit):
    assert name_and_unit(text) == (name, unit)


# Grid sag.


def test_a_grid_sag_begins_at_the_upper_left(tmp_path):
    """Written by hand after the manual: x runs first, y falls; 1 = centimetres."""
    rows = [[f"{10 * r + c} 0 0 0" for c in range(6)] for r in range(5)]
    rows[1][2] += " 1"
    rows = [[line if line.endswith(" 1") else line + " 0" for line in row] for row in rows]
    text = "! made by hand\n6 5 0.5 0.25 1 2 3\n" + "\n".join(line for row in rows for line in row)
    points = read_points(_text(tmp_path, text, "sag.DAT"))
    assert (len(points), points.missing) == (29, 1)
    first = np.argmin(points.height)
    assert (points.x[first], points.y[first]) == pytest.approx((0.75e-2, 3.5e-2))
    last = np.argmax(points.height)
    assert (points.x[last], points.y[last]) == pytest.approx((3.25e-2, 2.5e-2))
    assert points.height[last] == pytest.approx(45e-2)


def test_a_grid_sag_comes_back(tmp_path):
    made = grid()
    write_grid_sag(tmp_path / "sag.dat", made)
    back = read_grid_sag(tmp_path / "sag.dat")
    assert np.array_equal(back.height, made.height, equal_nan=True)
    assert (back.x0, back.y0, back.dx, back.dy) == pytest.approx(
        (made.x0, made.y0, made.dx, made.dy), rel=1e-12
    )


def test_the_slopes_of_a_grid_sag_are_those_of_the_surface(tmp_path):
    made = grid(rows=40, columns=40, dx=1e-5, dy=2e-5, hole=False)
    write_grid_sag(tmp_path / "sag.dat", made)
    table = np.loadtxt(tmp_path / "sag.dat", skiprows=1).reshape(40, 40, 5)[::-1]
    x, y = np.meshgrid(made.x, made.y)
    inside = (slice(1, -1), slice(1, -1))
    slope_x = 3e-6 + 2e-3 * x + 2e-3 * y + 18e-6 * np.cos(900 * x)
    assert table[inside][..., 1] == pytest.approx(slope_x[inside], abs=1e-8)
    assert table[inside][..., 2] == pytest.approx((2e-3 * x - 7e-6)[inside], abs=1e-9)
    assert table[inside][..., 3] == pytest.approx(2e-3, abs=1e-6)


@pytest.mark.parametrize(
    ("text", "reported"),
    [
        ("6 5 0.5 0.25 0 0 0\n1 0 0 0\n", r"says 6 × 5 points and has 1"),
        ("6 5 0.5 0.25 0 0 0\nz\n", "line 2: 'z' is no row"),
        ("90000 90000 0.5 0.25 0 0 0\n1\n", "number of points is 8100000000"),
        ("6 5 0.5 0.25 9 0 0\n1 0 0 0 0\n", r"unit 9, the fifth .* 0 \(mm\), .* 3 \(m\)"),
        ("! by hand\n6 5 0.5 0.25 -1\n1\n", "has unit -1"),
    ],
)
def test_a_grid_sag_that_lies_is_refused(tmp_path, text, reported):
    with pytest.raises(FileError, match=reported):
        read_points(_text(tmp_path, text, "sag.dat"))


def test_a_map_that_readers_would_refuse_is_not_written(tmp_path):
    with pytest.raises(FileError, match="5 × 5 points or more"):
        write_grid_sag(tmp_path / "sag.dat", grid(rows=4))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("unit", [0, 9])
def test_seven_columns_are_no_grid_sag(tmp_path, unit):
    text = "x_m y_m z_m a b c d\n" + f"6 5 0.5 0.25 {unit} 0 0\n" * 3
    assert read_points(_text(tmp_path, text, "map.dat")).height.tolist() == [0.5] * 3


def test_seven_columns_without_a_header_are_no_grid_sag_of_an_unknown_unit(tmp_path):
    path = _text(tmp_path, "6 5 0.5 0.25 9 0 0\n" * 3, "map.dat")
    with pytest.raises(FileError, match="--unit"):
        read_points(path)


def test_by_place_sees_a_transposed_map():
    """The helper of these tests can fail."""
    made = grid(hole=False).points()
    other = type(made)(x=made.y, y=made.x, height=made.height)
    assert not np.allclose(by_place(made), by_place(other))


@pytest.mark.parametrize(
    "head",
    [
        "# Channel: Z\n# Width: 20.0 µm\n# Height: 0.02 mm\n# Value units: nm\n",
        "# Kanal: Z\n# Breite: 20,0 µm\n# Höhe: 0,02 mm\n# Werteeinheiten: nm\n",
        "h=10 w=20\npixel size=1.0e-006 m\ndata unit=rad\nheight conversion factor (-> m)=1E-009\n",
    ],
)
def test_a_matrix_of_heights_has_the_sizes_and_units_of_its_header(tmp_path, head):
    """Programs export the first row at the top: a height of x + 2 y comes back."""
    pitch = 1e-6 if "pixel" in head else 2e-6
    x, y = np.meshgrid((np.arange(20) + 0.5) * 1e-6, (np.arange(10) + 0.5)[::-1] * pitch)
    path, height = tmp_path / "matrix.txt", x + 2 * y
    height[3, 4] = np.nan
    np.savetxt(path, height * 1e9, header=head.rstrip(), comments="", encoding="utf-8")
    found = read_points(path)
    assert len(found) == 199
    assert found.missing == 1
    assert found.height == pytest.approx(found.x + 2 * found.y, rel=1e-12)
    assert (np.ptp(found.x), np.ptp(found.y)) == pytest.approx((19e-6, 9 * pitch))
