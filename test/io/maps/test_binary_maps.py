"""Maps of interferometers and profilers, clouds of viewers: bytes after their published layouts."""

import struct
import sys
import zipfile
from types import SimpleNamespace

import numpy as np
import pytest

from omsm_ros.errors import FileError
from omsm_ros.io.maps import instrument_files, vertex_file
from omsm_ros.io.maps.read_map import read_points
from omsm_ros.units import units_of

from .surfaces import by_place, grid

# MetroPro.

WAVELENGTH, SCALE, PIXEL = 632.8e-9, 0.5, 85e-6
NO_DATUM = 2147483640


def metropro(phase, *, resolution=1, intensity=(0, 0, 0), pixel=PIXEL, sign=0, magic=0x6F):
    """A file after the layout in the MetroPro reference guide; phase in steps, row 0 on top."""
    head = bytearray(834)
    rows, columns = phase.shape

    def put(form, place, value):
        struct.pack_into(form, head, place, value)

    head[:4] = bytes([0x88, 0x1B, 0x03, magic])
    put(">H", 4, 1)
    put(">I", 6, len(head))
    for place, value in zip((52, 54, 56), intensity, strict=True):
        put(">H", place, value)
    put(">H", 68, columns)
    put(">H", 70, rows)
    put(">I", 72, 4 * phase.size)
    for place, value in ((164, SCALE), (168, WAVELENGTH), (176, 1.0), (184, pixel)):
        put(">f", place, value)
    put(">h", 218, resolution)
    put(">h", 232, sign)
    grey = bytes(2 * int(np.prod(intensity)))
    return bytes(head) + grey + phase.astype(">i4").tobytes()


@pytest.mark.parametrize(("resolution", "steps"), [(0, 4096), (1, 32768), (2, 131072)])
@pytest.mark.parametrize("intensity", [(0, 0, 0), (4, 3, 2)])
def test_a_fringe_is_half_a_wavelength(tmp_path, resolution, steps, intensity):
    phase = np.array([[steps, 0, NO_DATUM], [0, 2 * steps, 0]])
    path = tmp_path / "zygo.dat"
    path.write_bytes(metropro(phase, resolution=resolution, intensity=intensity))
    points = read_points(path)
    assert (len(points), points.missing) == (5, 1)
    high = np.argmax(points.height)
    assert points.height[high] == pytest.approx(WAVELENGTH, rel=1e-6)
    assert (points.x[high], points.y[high]) == pytest.approx((PIXEL, 0))
    half = np.argmin(np.abs(points.height - WAVELENGTH / 2))
    assert (points.x[half], points.y[half]) == pytest.approx((0, PIXEL))


def test_a_unit_that_no_format_asks_for_is_reported_as_not_used(tmp_path):
    path = tmp_path / "zygo.dat"
    path.write_bytes(metropro(np.array([[4096, 0], [0, 0]])))
    points = read_points(path, units_of("mm"))
    assert "--unit was not used" in points.notes[-1]
    assert points.height.max() == pytest.approx(WAVELENGTH / 16, rel=1e-6)


def test_an_inverted_sign_is_reported(tmp_path):
    path = tmp_path / "zygo.dat"
    path.write_bytes(metropro(np.array([[4096, 0], [0, 0]]), sign=1))
    points = read_points(path)
    assert points.height.min() == pytest.approx(-WAVELENGTH / 16, rel=1e-6)
    assert "negated" in points.notes[0]


@pytest.mark.parametrize(
    ("raw", "reported"),
    [
        (metropro(np.zeros((2, 2)))[:-1], "too few for 2 × 2 points"),
        (metropro(np.zeros((2, 2)))[:500], "no header"),
        (metropro(np.zeros((2, 2)), pixel=0.0), "no lateral calibration"),
        (metropro(np.zeros((2, 2)), pixel=float("nan")), "no lateral calibration"),
        (metropro(np.zeros((2, 2)), resolution=9), "how high a fringe is"),
        (metropro(np.full((2, 2), NO_DATUM)), "without points"),
        (metropro(np.zeros((0, 0))), "number of points is 0"),
    ],
)
def test_a_metropro_file_that_cannot_be_scaled_is_refused(tmp_path, raw, reported):
    path = tmp_path / "zygo.dat"
    path.write_bytes(raw)
    with pytest.raises(FileError, match=reported):
        read_points(path)


# Datx.


def datx(path, *, unit="NanoMeters", height=None, dx=1e-4, dy=2e-4, no_data=1e300):
    """The part of a .datx that says what its heights are, as Mx writes it."""
    h5py = pytest.importorskip("h5py", reason="the extra 'formats' is not installed")
    kind = np.dtype([("Category", "S16"), ("BaseUnit", "S16"), ("Parameters", "<f8", (4,))])
    with h5py.File(path, "w") as content:
        surface = content.create_dataset("Data/Surface/{A-1}", data=height)
        surface.attrs["No Data"] = np.array([no_data])
        surface.attrs["Unit"] = np.array([unit.encode()])
        for axis, size in (("X", dx), ("Y", dy)):
            entry = np.array([(b"LateralCat", b"Pixels", (0, size, 0, 0))], kind)
            surface.attrs[f"{axis} Converter"] = entry
        for key, value in (
            ("Wavelength", WAVELENGTH),
            ("Interferometric Scale Factor", SCALE),
            ("Obliquity Factor", 1.0),
        ):
            surface.attrs[key] = np.array([value])
    return path


@pytest.mark.parametrize(("unit", "metres"), [("NanoMeters", 1e-9), ("Fringes", 316.4e-9)])
def test_a_datx_carries_its_units(tmp_path, unit, metres):
    height = np.array([[1.0, 2.0, 1e300], [4.0, 5.0, 6.0]])
    points = read_points(datx(tmp_path / "a.datx", unit=unit, height=height))
    assert (len(points), points.missing) == (5, 1)
    top = np.argmin(points.height)
    assert points.height[top] == pytest.approx(metres)
    assert (points.x[top], points.y[top]) == pytest.approx((0, 2e-4))


@pytest.mark.parametrize(
    ("change", "reported"),
    [
        ({"unit": "Furlongs"}, "heights in 'Furlongs'"),
        ({"dx": 0.0}, "no lateral calibration"),
        ({"height": np.zeros(4)}, "shape"),
        ({"height": np.full((2, 2), 1e300)}, "without points"),
    ],
)
def test_a_datx_that_cannot_be_scaled_is_refused(tmp_path, change, reported):
    path = datx(tmp_path / "a.datx", **{"height": np.ones((2, 2)), **change})
    with pytest.raises(FileError, match=reported):
        read_points(path)


def test_hdf5_of_others_and_hdf5_cut_short_are_refused(tmp_path):
    h5py = pytest.importorskip("h5py", reason="the extra 'formats' is not installed")
    with h5py.File(tmp_path / "other.h5", "w") as content:
        content["x"] = np.arange(9000.0)
    with pytest.raises(FileError, match=r"neither a table of ours nor a .datx"):
        read_points(tmp_path / "other.h5")
    raw = datx(tmp_path / "a.datx", height=np.ones((90, 90))).read_bytes()
    (tmp_path / "cut.datx").write_bytes(raw[: len(raw) // 3])
    with pytest.raises(FileError, match="cannot be read"):
        read_points(tmp_path / "cut.datx")


def test_a_library_that_is_missing_is_named(tmp_path, monkeypatch):
    path = datx(tmp_path / "a.datx", height=np.ones((2, 2)))
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(FileError, match="needs a further Python package: pip install h5py"):
        read_points(path)


# X3p.


def test_an_x3p_of_another_program(tmp_path):
    x3pio = pytest.importorskip("x3pio", reason="the extra 'formats' is not installed")
    made = grid()
    x3pio.write(tmp_path / "a.x3p", made.height, x_scale=made.dx, y_scale=made.dy)
    points = read_points(tmp_path / "a.x3p")
    assert points.missing == 1
    expected = by_place(made.points()) - [made.x0, made.y0, 0]
    assert by_place(points) == pytest.approx(expected, abs=1e-15)


def test_an_x3p_cloud_and_an_x3p_of_integers(tmp_path):
    x3pio = pytest.importorskip("x3pio", reason="the extra 'formats' is not installed")
    places = by_place(grid().points())
    x3pio.write_points(tmp_path / "cloud.x3p", places)
    assert by_place(read_points(tmp_path / "cloud.x3p")) == pytest.approx(places, abs=1e-15)
    made = grid(hole=False)
    x3pio.write(
        tmp_path / "i.x3p", made.height, x_scale=1e-4, y_scale=1e-4, z_type=x3pio.DataType.INT16
    )
    back = read_points(tmp_path / "i.x3p")
    assert np.sort(back.height) == pytest.approx(np.sort(made.height.ravel()), abs=2e-12)
    steps = x3pio.Axis(x3pio.AxisType.ABSOLUTE, x3pio.DataType.INT16, 1.0)
    header = SimpleNamespace(x=steps, y=steps, z=steps)
    with pytest.raises(ValueError, match="whole numbers without an increment"):
        instrument_files._places(x3pio, SimpleNamespace(layers=[made], header=header))


def test_our_x3p_is_of_the_revision_that_all_take(tmp_path):
    pytest.importorskip("x3pio", reason="the extra 'formats' is not installed")
    made = grid()
    instrument_files.write_x3p(tmp_path / "a.x3p", made, "a comment")
    with zipfile.ZipFile(tmp_path / "a.x3p") as archive:
        text = archive.read("main.xml").decode()
    assert "<Revision>ISO5436 - 2000</Revision>" in text
    assert "<FeatureType>SUR</FeatureType>" in text
    points = read_points(tmp_path / "a.x3p")
    assert by_place(points) == pytest.approx(by_place(made.points()), abs=1e-15)


def test_an_x3p_bomb_and_an_x3p_of_nothing_are_refused(tmp_path, monkeypatch):
    pytest.importorskip("x3pio", reason="the extra 'formats' is not installed")
    instrument_files.write_x3p(tmp_path / "a.x3p", grid(), "")
    monkeypatch.setattr(instrument_files, "MAX_UNPACKED_BYTES", 100)
    with pytest.raises(FileError, match="at most 100 are read"):
        read_points(tmp_path / "a.x3p")
    monkeypatch.undo()
    raw = (tmp_path / "a.x3p").read_bytes()
    (tmp_path / "cut.x3p").write_bytes(raw[:200])
    with zipfile.ZipFile(tmp_path / "empty.x3p", "w") as archive:
        archive.writestr("main.xml", "<a/>")
    for name in ("cut.x3p", "empty.x3p"):
        with pytest.raises(FileError, match="cannot be read"):
            read_points(tmp_path / name)


# PLY and PCD.

PLY = """ply
format {form} 1.0
comment from a scanner
element vertex 3
property float x
property float y
property float z
property uchar red
element face 1
property list uchar int vertex_indices
end_header
"""
VERTICES = [(0.0, 0.5, 1.5, 7), (1.0, 0.25, 2.5, 8), (2.0, 0.125, 3.5, 9)]


@pytest.mark.parametrize(
    ("form", "order"), [("binary_little_endian", "<"), ("binary_big_endian", ">"), ("ascii", "")]
)
def test_a_ply_of_a_scanner(tmp_path, form, order):
    head = PLY.format(form=form).encode()
    if order:
        body = b"".join(struct.pack(f"{order}fffB", *v) for v in VERTICES)
        body += struct.pack(f"{order}Biii", 3, 0, 1, 2)
    else:
        body = "".join(" ".join(map(str, v)) + "\n" for v in VERTICES).encode() + b"3 0 1 2\n"
    (tmp_path / "a.ply").write_bytes(head + body)
    with pytest.raises(FileError, match="--unit"):
        read_points(tmp_path / "a.ply")
    points = read_points(tmp_path / "a.ply", units_of("mm"))
    assert points.x == pytest.approx([0, 1e-3, 2e-3])
    assert points.y == pytest.approx([0.5e-3, 0.25e-3, 0.125e-3])
    assert points.height == pytest.approx([1.5e-3, 2.5e-3, 3.5e-3])


PCD = """# .PCD v.7 - Point Cloud Data file format
VERSION .7
FIELDS x y z rgb
SIZE 4 4 4 4
TYPE F F F U
COUNT 1 1 1 1
WIDTH 2
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS 2
DATA {form}
"""


@pytest.mark.parametrize("form", ["ascii", "binary"])
def test_a_pcd_of_a_viewer(tmp_path, form):
    rows = [(0.5, 1.5, 2.5, 9), (3.5, 4.5, 5.5, 8)]
    if form == "binary":
        body = b"".join(struct.pack("<fffI", *row) for row in rows)
    else:
        body = "".join(" ".join(map(str, row)) + "\n" for row in rows).encode()
    (tmp_path / "a.pcd").write_bytes(PCD.format(form=form).encode() + body)
    points = read_points(tmp_path / "a.pcd", units_of("m"))
    assert points.x.tolist() == [0.5, 3.5]
    assert points.height.tolist() == [2.5, 5.5]


@pytest.mark.parametrize(
    ("name", "raw", "reported"),
    [
        ("a.ply", b"ply\nformat ascii 1.0\n", "no end of its header"),
        ("a.ply", PLY.format(form="ascii").encode(), "was cut short"),
        ("a.ply", PLY.format(form="zip").encode(), "of format 'zip'"),
        ("a.ply", PLY.replace(" z", " q").format(form="ascii").encode(), "expected x, y and z"),
        ("a.ply", PLY.replace("vertex 3", "vertex 3e9").format(form="ascii").encode(), "3e9"),
        (
            "a.ply",
            PLY.replace("vertex 3", "vertex 99999999999")
            .format(form="binary_little_endian")
            .encode(),
            "expected a whole number from 1 to",
        ),
        ("a.ply", PLY.replace("uchar red", "list uchar red").format(form="ascii").encode(), "more"),
        ("a.pcd", PCD.format(form="binary_compressed").encode(), "write it as binary"),
        ("a.pcd", PCD.replace("SIZE 4 4 4 4", "SIZE 4").format(form="ascii").encode(), "fit"),
        ("a.pcd", PCD.replace("TYPE F", "TYPE Q").format(form="ascii").encode(), "unknown type"),
        ("a.pcd", PCD.replace("SIZE 4", "SIZE 5").format(form="ascii").encode(), "cannot be read"),
        (
            "a.pcd",
            PCD.format(form="ascii").encode() + b"1 2 three 4\n1 2 3 4\n",
            "below its header, line 1: .* is no row",
        ),
    ],
)
def test_a_cloud_that_lies_is_refused(tmp_path, name, raw, reported):
    (tmp_path / name).write_bytes(raw)
    with pytest.raises(FileError, match=reported) as refused:
        read_points(tmp_path / name, units_of("mm"))
    assert "\n" not in str(refused.value)


def test_the_longest_header_is_bounded(tmp_path):
    (tmp_path / "a.ply").write_bytes(b"ply\n" + b"comment x\n" * 10_000)
    with pytest.raises(FileError, match="no end of its header"):
        read_points(tmp_path / "a.ply")


@pytest.mark.parametrize("name", ["a.ply", "a.pcd"])
def test_what_we_write_needs_no_unit(tmp_path, name):
    table = np.array(
        [(0.5, 1.5, 2.5, 0.1), (3.5, 4.5, 5.5, 0.2)],
        [(column, "<f8") for column in ("x", "y", "z", "uncertainty")],
    )
    write = vertex_file.write_ply if name.endswith("ply") else vertex_file.write_pcd
    write(tmp_path / name, table)
    points = read_points(tmp_path / name)
    assert points.height.tolist() == [2.5, 5.5]
    assert points.uncertainty.tolist() == [0.1, 0.2]


@pytest.mark.parametrize("raw", [b"\0\1\2\3" * 99, b"GIF89a" + b"\0" * 50])
def test_bytes_of_no_format_are_refused(tmp_path, raw):
    (tmp_path / "a.bin").write_bytes(raw)
    with pytest.raises(FileError, match=r"none of the formats that|needs a further Python package"):
        read_points(tmp_path / "a.bin")


def test_a_folder_without_a_result_is_reported(tmp_path):
    with pytest.raises(FileError, match=r"no map at .*cloud\.ply"):
        read_points(tmp_path)
