"""Files of points by their public descriptions alone: Python's own library, and nothing of ours."""

from __future__ import annotations

import csv
import hashlib
import struct
import zipfile
from xml.etree import ElementTree

_PLY = {
    "char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I",
    "float": "f", "double": "d",
}  # fmt: skip
_PCD = {"F4": "f", "F8": "d", "U1": "B", "U4": "I", "I4": "i"}
_X3P = {"I": "h", "L": "i", "F": "f", "D": "d"}


def ply(path):
    """Columns by name of a binary little-endian PLY with vertices alone (Turk, 1994)."""
    raw = path.read_bytes()
    end = raw.index(b"end_header\n") + len(b"end_header\n")
    lines = raw[:end].decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    words = [line.split() for line in lines if not line.startswith("comment")]
    (count,) = (int(w[2]) for w in words if w[:2] == ["element", "vertex"])
    properties = [w[1:] for w in words if w[0] == "property"]
    rows = list(struct.iter_unpack("<" + "".join(_PLY[kind] for kind, _ in properties), raw[end:]))
    assert len(rows) == count
    return _columns([name for _, name in properties], rows)


def pcd(path):
    """Columns by name of a binary PCD 0.7 (Point Cloud Library)."""
    head, _, body = path.read_bytes().partition(b"DATA binary\n")
    lines = [line.split() for line in head.decode("ascii").splitlines() if line[0] != "#"]
    words = {line[0]: line[1:] for line in lines}
    assert words["VERSION"] == ["0.7"]
    assert set(words["COUNT"]) == {"1"}
    kinds = [t + s for t, s in zip(words["TYPE"], words["SIZE"], strict=True)]
    rows = list(struct.iter_unpack("<" + "".join(_PCD[kind] for kind in kinds), body))
    assert [int(words[name][0]) for name in ("WIDTH", "HEIGHT", "POINTS")] == [
        len(rows), 1, len(rows),
    ]  # fmt: skip
    return _columns(words["FIELDS"], rows)


def text(path):
    """Columns by name of CSV, or of xyz after its ``#`` line of names."""
    with open(path, newline="", encoding="ascii") as stream:
        lines = stream.read().splitlines()
    if lines[0].startswith("# "):
        names, rows = lines[0][2:].split(), [line.split(" ") for line in lines[1:]]
    else:
        names, *rows = csv.reader(lines)
    return _columns(names, [[float(cell) for cell in row] for row in rows])


def x3p(path):
    """Header and heights [m] of a map after ISO 25178-72: rows of columns, None = missing."""
    with zipfile.ZipFile(path) as archive:
        assert archive.testzip() is None
        main = archive.read("main.xml")
        root = ElementTree.fromstring(main)
        data = archive.read(root.find("Record3/DataLink/PointDataLink").text)
        reported = root.find("Record3/DataLink/MD5ChecksumPointData").text
        assert reported.lower() == hashlib.md5(data).hexdigest()
        checksum = archive.read(root.find("Record4/ChecksumFile").text).split()[0]
        assert checksum.decode().lower() == hashlib.md5(main).hexdigest()
    axes = {
        name: {part.tag: part.text for part in root.find(f"Record1/Axes/{name}")}
        for name in ("CX", "CY", "CZ")
    }
    size = [int(root.find(f"Record3/MatrixDimension/Size{name}").text) for name in "XYZ"]
    values = [v for (v,) in struct.iter_unpack("<" + _X3P[axes["CZ"]["DataType"]], data)]
    assert len(values) == size[0] * size[1] * size[2]
    step = float(axes["CZ"].get("Increment") or 1)
    start = float(axes["CZ"].get("Offset") or 0)
    known = [None if v != v else v * step + start for v in values]
    rows = [known[low : low + size[0]] for low in range(0, len(known), size[0])]
    return root, axes, rows


def _columns(names, rows):
    return {name: [row[place] for row in rows] for place, name in enumerate(names)}
