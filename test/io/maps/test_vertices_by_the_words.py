"""PLY and PCD of any program: every type, order, line end and word that they may have."""

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from omsm_ros.errors import FileError
from omsm_ros.io.maps.read_map import read_points
from omsm_ros.units import units_of

METRE = units_of("m")
TYPES = {
    "char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I",
    "float": "f", "double": "d", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H",
    "int32": "i", "uint32": "I", "float32": "f", "float64": "d",
}  # fmt: skip
HEAD = "ply{e}format {form} 1.0{e}{more}element vertex {n}{e}{properties}end_header{e}"
ROWS = [(1, 2, 3), (4, 5, 6), (7, 8, 90)]


def ply(path, fields, rows, form="binary_little_endian", end="\n", more="", after=b""):
    """fields: name and type of each, as PLY calls it; binary big or little, or text."""
    properties = "".join(f"property {kind} {name}{end}" for name, kind in fields)
    head = HEAD.format(form=form, e=end, n=len(rows), properties=properties, more=more)
    if form == "ascii":
        body = "".join(" ".join(map(str, row)) + end for row in rows).encode()
    else:
        order = "<" if form.endswith("little_endian") else ">"
        layout = order + "".join(TYPES[kind] for _, kind in fields)
        body = b"".join(struct.pack(layout, *row) for row in rows)
    path.write_bytes(head.encode() + body + after)
    return path


@pytest.mark.parametrize("kind", TYPES)
@pytest.mark.parametrize("form", ["binary_little_endian", "binary_big_endian"])
def test_every_type_of_a_ply_is_its_number(tmp_path, kind, form):
    """At the ends of its range, where a wrong sign or order would show."""
    bits = 8 * struct.calcsize(TYPES[kind])
    low, high = {
        "f": (-0.1, 99.9), "i": (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1), "u": (0, 2**bits - 1),
    }["f" if TYPES[kind] in "fd" else "u" if TYPES[kind].isupper() else "i"]  # fmt: skip
    path = ply(tmp_path / "a.ply", [(n, kind) for n in "xyz"], [(1, low, high), (2, 3, 4)], form)
    points = read_points(path, units_of("pm"))
    exact = [struct.unpack(TYPES[kind], struct.pack(TYPES[kind], v))[0] for v in (low, high)]
    assert points.y[0] == exact[0] * 1e-12
    assert points.height[0] == exact[1] * 1e-12
    assert points.x.tolist() == [1e-12, 2e-12]


@pytest.mark.parametrize("form", ["binary_little_endian", "binary_big_endian", "ascii"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_lines_of_windows_are_lines(tmp_path, form, end):
    path = ply(tmp_path / "a.ply", [(n, "double") for n in "xyz"], ROWS, form, end)
    points = read_points(path, METRE)
    assert points.height.tolist() == [3, 6, 90]


@pytest.mark.parametrize(
    "fields",
    [
        [("z", "float"), ("y", "double"), ("x", "uchar")],
        [("red", "uchar"), ("z", "float"), ("nx", "short"), ("y", "double"), ("x", "uchar")],
    ],
)
@pytest.mark.parametrize("form", ["binary_big_endian", "ascii"])
def test_columns_are_where_the_header_says(tmp_path, fields, form):
    place = {name: k for k, (name, _) in enumerate(fields)}
    rows = [[9] * len(fields) for _ in ROWS]
    for row, (x, y, z) in zip(rows, ROWS, strict=True):
        for name, value in zip("xyz", (x, y, z), strict=True):
            row[place[name]] = value
    points = read_points(ply(tmp_path / "a.ply", fields, rows, form), METRE)
    found = np.column_stack([points.x, points.y, points.height])
    assert found.tolist() == [list(row) for row in ROWS]


def test_comments_and_what_follows_the_vertices_change_nothing(tmp_path):
    fields = [(n, "float") for n in "xyz"]
    more = "comment element vertex 9\ncomment property float q\nobj_info end_of_the_day\n"
    path = ply(tmp_path / "a.ply", fields, ROWS, more=more, after=b"\x03" + b"\0" * 12)
    assert read_points(path, METRE).height.tolist() == [3, 6, 90]


def test_a_height_of_its_own_goes_before_z(tmp_path):
    """A cloud of ours shows viewers z in single precision."""
    fields = [("x", "float"), ("y", "float"), ("z", "float"), ("height", "double")]
    third = 1 / 3
    points = read_points(ply(tmp_path / "a.ply", fields, [(1, 2, third, third)]), METRE)
    assert points.height.tolist() == [third]


@pytest.mark.parametrize("kind", ["float", "double"])
def test_non_numeric_bits_are_reported_as_missing(tmp_path, kind):
    """Also a signalling NaN, which a processor may complain of."""
    layout, bits = {"float": ("<f", "<I"), "double": ("<d", "<Q")}[kind]
    signalling = struct.pack(bits, {"float": 0xFFA00001, "double": 0x7FF0000000000001}[kind])
    body = b"".join(struct.pack(layout, v) for v in (1.0, 2.0)) + signalling
    body += b"".join(struct.pack(layout, v) for v in (3.0, 4.0, 5.0))
    path = ply(tmp_path / "a.ply", [(n, kind) for n in "xyz"], [])
    path.write_bytes(path.read_bytes().replace(b"vertex 0", b"vertex 2") + body)
    points = read_points(path, METRE)
    assert (len(points), points.missing) == (1, 1)
    assert (points.x[0], points.y[0], points.height[0]) == (3.0, 4.0, 5.0)


@pytest.mark.parametrize(
    ("old", "new", "reported"),
    [
        (b"element vertex 3", b"element face 0\nelement vertex 3", "does not begin with its ver"),
        (b"element vertex 3\n", b"", "does not begin with its vertices; write them first"),
        (b"property float x", b"property list uchar float x", "vertices with more than numbers"),
        (b"property float x", b"property quad x", "vertices with more than numbers"),
        (b"property float x", b"property float y", "name each once"),
        (b"format binary_little_endian 1.0\n", b"", "is of format ''; write it as binary or"),
        (b"vertex 3", b"vertex 0", "number of points is 0"),
        (b"vertex 3", b"vertex -3", "number of points is '-3'"),
        (b"vertex 3", "vertex ٣".encode(), "number of points is"),
        (b"vertex 3", b"vertex 3 4", "number of points is '3 4'"),
        (b"vertex 3", b"vertex 4", "says that it has 4 points and holds 36 bytes"),
    ],
)
def test_a_header_that_contradicts_itself_is_reported(tmp_path, old, new, reported):
    path = ply(tmp_path / "a.ply", [(n, "float") for n in "xyz"], ROWS)
    raw = path.read_bytes()
    assert old in raw
    path.write_bytes(raw.replace(old, new, 1))
    with pytest.raises(FileError, match=reported) as refused:
        read_points(path, METRE)
    assert "a.ply" in str(refused.value)


@pytest.mark.parametrize("rows", [[(10, 20), (30, 40), (50, 60)], [(1, 2, 3, 4)] * 3])
def test_a_text_of_other_columns_than_its_header_is_refused(tmp_path, rows):
    path = ply(tmp_path / "a.ply", [(n, "float") for n in "xyz"], rows, "ascii")
    with pytest.raises(FileError, match="says 3 points of 3 numbers"):
        read_points(path, METRE)


def test_the_last_line_of_a_text_need_not_end(tmp_path):
    path = ply(tmp_path / "a.ply", [(n, "float") for n in "xyz"], [(1, 2, 3), (4, 5, 6)], "ascii")
    path.write_bytes(path.read_bytes().rstrip(b"\n"))
    assert read_points(path, METRE).height.tolist() == [3, 6]


PCD = """# .PCD v0.7
VERSION 0.7
FIELDS {names}
SIZE {sizes}
TYPE {kinds}
{count}WIDTH {n}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {n}
DATA {form}
"""
KINDS = {"b": ("I", 1), "B": ("U", 1), "h": ("I", 2), "H": ("U", 2), "i": ("I", 4), "I": ("U", 4),
         "q": ("I", 8), "Q": ("U", 8), "f": ("F", 4), "d": ("F", 8)}  # fmt: skip


@settings(max_examples=30)
@given(
    order=st.permutations(["x", "y", "z", "rgb"]),
    kinds=st.lists(st.sampled_from(list(KINDS)), min_size=4, max_size=4),
    rows=st.lists(st.tuples(*[st.integers(0, 100)] * 4), min_size=1, max_size=5),
    form=st.sampled_from(["binary", "ascii"]),
    counted=st.booleans(),
)
def test_any_layout_of_a_pcd_is_read(tmp_path_factory, order, kinds, rows, form, counted):
    path = tmp_path_factory.mktemp("pcd") / "a.pcd"
    head = PCD.format(
        names=" ".join(order), n=len(rows), form=form,
        sizes=" ".join(str(KINDS[k][1]) for k in kinds), kinds=" ".join(KINDS[k][0] for k in kinds),
        count="COUNT 1 1 1 1\n" if counted else "",
    )  # fmt: skip
    if form == "binary":
        body = b"".join(struct.pack("<" + "".join(kinds), *row) for row in rows)
    else:
        body = "".join(" ".join(map(str, row)) + "\n" for row in rows).encode()
    path.write_bytes(head.encode() + body)
    points = read_points(path, METRE)
    for name, found in (("x", points.x), ("y", points.y), ("z", points.height)):
        assert found.tolist() == [row[order.index(name)] for row in rows]


def test_places_without_a_reading_are_missing_in_a_pcd(tmp_path):
    head = PCD.format(
        names="x y z", sizes="4 4 4", kinds="F F F", n=3, form="ascii", count="COUNT 1 1 1\n"
    )
    (tmp_path / "a.pcd").write_text(head + "1 2 3\nnan nan nan\n4 5 6\n")
    points = read_points(tmp_path / "a.pcd", METRE)
    assert (points.missing, points.height.tolist()) == (1, [3, 6])


@pytest.mark.parametrize(
    ("old", "new", "reported"),
    [
        ("COUNT 1 1 1", "COUNT 1 1 2", "do not fit each other"),
        ("SIZE 4 4 4", "SIZE 4 four 4", "fields of unknown type.*write numbers"),
        ("SIZE 4 4 4\n", "", "do not fit each other"),
        ("FIELDS x y z", "FIELDS x x z", "name each once"),
        ("FIELDS x y z", "FIELDS x y q", r"fields \('x', 'y', 'q'\), expected x, y and z"),
        ("POINTS 1\n", "", "number of points is ''"),
        ("DATA binary\n", "", "no end of its header"),
    ],
)
def test_a_pcd_that_contradicts_itself_is_reported(tmp_path, old, new, reported):
    head = PCD.format(
        names="x y z", sizes="4 4 4", kinds="F F F", n=1, form="binary", count="COUNT 1 1 1\n"
    )
    assert old in head
    (tmp_path / "a.pcd").write_bytes(head.replace(old, new, 1).encode() + b"\0" * 12)
    with pytest.raises(FileError, match=reported) as refused:
        read_points(tmp_path / "a.pcd", METRE)
    assert "a.pcd" in str(refused.value)
