"""Reads and writes point clouds: PLY (Stanford), PCD (Point Cloud Library, version 0.7)."""

import io
from collections.abc import Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.surface.measured_points import MeasuredPoints, measured
from omsm_ros.errors import FileError
from omsm_ros.io.files import atomic_file, explained_errors, open_regular
from omsm_ros.io.tables.text_table import rows_in
from omsm_ros.quantities import CLOUD_POINTS, shown
from omsm_ros.units import NOT_USED, LengthUnits, needed

IN_METRES = "lengths in metres"
"""The comment on units in our files."""

_OURS = {"x", "y", "height", "dynamic_error", "uncertainty"}
_MOST_LINES, _LONGEST_LINE = 500, 1000
_PLY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
_PLY_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "<"}
_PLY_NAMES = {"f4": "float", "f8": "double", "u4": "uint", "i4": "int"}
_PCD_KINDS = {"F": "f", "I": "i", "U": "u"}


def read_cloud(path: Path, units: LengthUnits | None) -> MeasuredPoints:
    """Read a PLY or a PCD file; metres if ours, else ``units``. FileError if incomplete."""
    what = f"cloud {str(path)!r}"
    with open_regular(path, FileError, "cloud") as stream:
        ply = stream.readline(_LONGEST_LINE).strip() == b"ply"
        stream.seek(0)
        lines = _header(stream, "end_header" if ply else "DATA ", what)
        entries = {parts[0]: parts[1:] for line in lines if (parts := line.split())}
        form = (entries.get("format" if ply else "DATA") or [""])[0]
        if form not in (_PLY_ORDERS if ply else ("ascii", "binary")):
            raise FileError(f"{what} is of format {shown(form)}; write it as binary or ascii")
        dtype, count = (
            _ply_vertices(lines, _PLY_ORDERS[form], what) if ply else _pcd_points(entries, what)
        )
        table = _records(stream, dtype, count, form == "ascii", what)
    return _points(table, lines, units, what)


def _header(stream: IO[bytes], last: str, what: str) -> list[str]:
    lines: list[str] = []
    for raw in islice(iter(lambda: stream.readline(_LONGEST_LINE), b""), _MOST_LINES):
        lines.append(raw.decode("ascii", "replace").strip())
        if lines[-1].startswith(last):
            return lines
    raise FileError(
        f"{what} has no end of its header ({last.strip()!r}), or was cut short; write it again"
    )


def _ply_vertices(lines: Sequence[str], order: str, what: str) -> tuple[np.dtype[np.void], int]:
    elements = [place for place, line in enumerate(lines) if line.startswith("element ")]
    if not elements or not lines[elements[0]].startswith("element vertex "):
        raise FileError(f"{what} does not begin with its vertices; write them first")
    end = elements[1] if len(elements) > 1 else len(lines)
    properties = [line.split() for line in lines[elements[0] : end] if line.startswith("property ")]
    if any(len(one) != 3 or one[1] not in _PLY_TYPES for one in properties):
        raise FileError(f"{what} has vertices with more than numbers; keep x, y, z and the like")
    fields = [(name, order + _PLY_TYPES[kind]) for _, kind, name in properties]
    return _dtype(fields, what), _count(lines[elements[0]].split()[2:], what)


def _pcd_points(entries: Mapping[str, Sequence[str]], what: str) -> tuple[np.dtype[np.void], int]:
    names, sizes, kinds = (entries.get(key, []) for key in ("FIELDS", "SIZE", "TYPE"))
    counts = entries.get("COUNT", ["1"] * len(names))
    if not len(names) == len(sizes) == len(kinds) == len(counts) or set(counts) - {"1"}:
        raise FileError(
            f"{what}: FIELDS, SIZE, TYPE and COUNT do not fit each other; write it again"
        )
    unknown = f"{what} has fields of unknown type"
    with explained_errors(unknown, "write numbers", caught=(KeyError, ValueError)):
        fields = [
            (name, f"<{_PCD_KINDS[kind]}{int(size)}")
            for name, size, kind in zip(names, sizes, kinds, strict=True)
        ]
    return _dtype(fields, what), _count(entries.get("POINTS", []), what)


def _dtype(fields: list[tuple[str, str]], what: str) -> np.dtype[np.void]:
    wrong = f"{what} has fields that cannot be read"
    with explained_errors(wrong, "name each once", caught=(TypeError, ValueError)):
        dtype = np.dtype(fields)
    if not {"x", "y"} <= set(dtype.names or ()) or not {"z", "height"} & set(dtype.names or ()):
        raise FileError(f"{what} has the fields {shown(dtype.names)}, expected x, y and z")
    return dtype


def _count(text: Sequence[str], what: str) -> int:
    said = " ".join(text)
    count = int(said) if said.isascii() and said.isdecimal() and len(said) <= 12 else said
    return int(CLOUD_POINTS.checked(count, FileError, f"{what}: number of points"))


def _records(
    stream: IO[bytes], dtype: np.dtype[np.void], count: int, ascii_text: bool, what: str
) -> NDArray[np.void]:
    begin = stream.tell()
    held = stream.seek(0, io.SEEK_END) - begin
    stream.seek(begin)
    # The last line of a text may have no end.
    least = 2 * len(dtype.names or ()) * count - 1 if ascii_text else dtype.itemsize * count
    if held < least:
        raise FileError(
            f"{what} says that it has {count} points and holds {held} bytes of them; it was cut "
            "short, write it again"
        )
    if not ascii_text:
        # Mapped, since the columns are read one by one.
        return np.memmap(stream, dtype, mode="r", offset=begin, shape=(count,))
    names = list(dtype.names or ())
    lines = (line.decode("latin-1") for line in stream)
    columns = rows_in(lines, f"{what}, below its header", "write a line a point", max_rows=count).T
    if columns.shape != (len(names), count):
        raise FileError(
            f"{what} says {count} points of {len(names)} numbers; it was cut short, write it again"
        )
    found: NDArray[np.void] = np.rec.fromarrays([*columns], names=names)  # type: ignore[call-overload]
    return found


def _points(
    table: NDArray[np.void], lines: Sequence[str], units: LengthUnits | None, what: str
) -> MeasuredPoints:
    names = table.dtype.names or ()
    ours = set(names) >= _OURS or any(IN_METRES in line for line in lines)
    metres = LengthUnits(1.0, 1.0)
    scale = metres if ours else needed(units, what)
    spread = _scaled(table["uncertainty"]) if ours and "uncertainty" in names else None
    return measured(
        _scaled(table["x"], scale.lateral),
        _scaled(table["y"], scale.lateral),
        _scaled(table["height" if "height" in names else "z"], scale.height),
        None if spread is None or not np.any(np.isfinite(spread)) else spread,
        notes=(NOT_USED,) if ours and units not in (None, metres) else (),
        sample=table["sample"] if ours and "sample" in names else None,
    )


def _scaled(values: NDArray[Any], scale: float = 1.0) -> NDArray[np.float64]:
    """Return ``scale`` times values (n,), without signalling NaN, which damaged bytes may be."""
    with np.errstate(invalid="ignore"):
        found = values.astype(np.float64)
    found[np.isnan(found)] = np.nan
    found *= scale
    return np.asarray(found)


def write_ply(path: Path, table: NDArray[np.void]) -> None:
    """Write records (n,) of lengths in metres as binary PLY."""
    fields = [(name, table.dtype[name].str[1:]) for name in table.dtype.names or ()]
    lines = ["ply", "format binary_little_endian 1.0", f"comment {IN_METRES}"]
    lines += [f"element vertex {len(table)}"]
    lines += [f"property {_PLY_NAMES[kind]} {name}" for name, kind in fields]
    _write(path, [*lines, "end_header"], table)


def write_pcd(path: Path, table: NDArray[np.void]) -> None:
    """Write records (n,) of lengths in metres as binary PCD 0.7."""
    kinds = [table.dtype[name].str[1:] for name in table.dtype.names or ()]
    lines = [f"# .PCD v0.7 - {IN_METRES}", "VERSION 0.7"]
    lines += [f"FIELDS {' '.join(table.dtype.names or ())}"]
    lines += [f"SIZE {' '.join(kind[1:] for kind in kinds)}"]
    lines += [f"TYPE {' '.join(kind[0].upper() for kind in kinds)}"]
    lines += [f"COUNT {' '.join('1' for _ in kinds)}"]
    lines += [f"WIDTH {len(table)}", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0"]
    _write(path, [*lines, f"POINTS {len(table)}", "DATA binary"], table)


def _write(path: Path, lines: Sequence[str], table: NDArray[np.void]) -> None:
    with atomic_file(path) as stream:
        stream.write(("\n".join(lines) + "\n").encode("ascii"))
        stream.write(np.ascontiguousarray(table).data)
