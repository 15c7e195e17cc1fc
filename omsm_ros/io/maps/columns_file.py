"""Reads and writes text with columns for x, y and height, and profiles of DABAM."""

import codecs
import io
import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.surface.measured_points import MeasuredPoints, measured
from omsm_ros.errors import FileError
from omsm_ros.io.files import atomic_file, load_object, open_regular
from omsm_ros.io.tables.text_table import rows_in
from omsm_ros.quantities import MAP_POINTS
from omsm_ros.units import (
    NOT_USED,
    WORDS,
    LengthUnits,
    metres_in,
    name_and_unit,
    needed,
    refuse_other,
)

# The greatest number of points of a map, in lines of sixty characters.
MAX_TEXT_BYTES = 60 * int(MAP_POINTS.high)
UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
_COMMENTS = ("#", "!", "%")
_LONGEST_HEADER, _LONGEST_LINE = 50, 10_000
_ROLES = {
    "x": "x",
    "y": "y",
    "z": "height",
    "height": "height",
    "sag": "height",
    "uncertainty": "uncertainty",
    "u": "uncertainty",
    "sample": "sample",
}
# Lines of more numbers without names are rows of a matrix, not points.
_LEAST_OF_A_MATRIX = 16
_PORTION = 100_000


def read_columns(path: Path, units: LengthUnits | None) -> MeasuredPoints:
    """Read a text of points; its units from its header, or ``units`` if it states none.

    Raises FileError for a text that is no table of points, or without any unit.
    """
    what = f"map {str(path)!r}"
    with open_regular(path, FileError, "map") as stream:
        if (size := stream.seek(0, io.SEEK_END)) > MAX_TEXT_BYTES:
            raise FileError(f"{what} has {size} bytes, at most {MAX_TEXT_BYTES} are read; thin it")
        stream.seek(0)
        encoding = "utf-16" if stream.read(len(UTF_16[0])) in UTF_16 else "utf-8-sig"
        stream.seek(0)
        header, first = _beginning(stream, encoding, what)
        stream.seek(0)
        body = io.TextIOWrapper(stream, encoding=encoding, errors="replace")
        if sizes := _sizes_of_matrix(header):
            found = _matrix(body, header, first, sizes, what)
            return replace(found, notes=(NOT_USED,) if units else ())
        names, scales, cells = _columns(header, first, units, what)
        table = _numbers(body, len(header), first, cells, sorted(names.values()), what)
    unused = cells - len(names)
    notes = [f"{unused} other columns were left out"] if unused > 0 else []
    at = {name: sorted(names.values()).index(place) for name, place in names.items()}
    column = {name: table[:, place] * scales[name] for name, place in at.items()}
    profile = "y" not in column
    return measured(
        column["x"],
        np.zeros_like(column["x"]) if profile else column["y"],
        column["height"],
        column.get("uncertainty"),
        (*notes, *(["a profile along x"] if profile else [])),
        sample=column.get("sample"),
    )


# The header of a matrix of heights: Gwyddion's ends with width, height and unit of the heights, in
# any language; an interferometer's has rows, columns, pixel, and a factor.
_NUMBER = r"\s*(\d+[.,]?\d*(?:e[-+]?\d+)?)"
_OF_GWYDDION = rf":{_NUMBER}\s*(\S+)\n[^:\n]+:{_NUMBER}\s*(\S+)\n[^:\n]+:()\s*(\S+)$"
_OF_PIXELS = (
    rf"h *={_NUMBER}\s+w *={_NUMBER}\npixel size *={_NUMBER}\s*(\S+)\n"
    rf".*\n.*factor \(-> (\S+)\) *={_NUMBER}$"
)


def _sizes_of_matrix(header: list[str]) -> list[float]:
    """Return width, height and unit of the values [m] of a matrix of heights; none of another."""
    text = "\n".join(filter(None, header)).replace(",", ".")
    found: list[tuple[Any, str]] = []
    if one := re.search(_OF_GWYDDION, text, re.IGNORECASE):
        found = list(zip(one.groups()[::2], one.groups()[1::2], strict=True))
    elif one := re.search(_OF_PIXELS, text, re.IGNORECASE):
        rows, columns, size, unit, of_heights, factor = one.groups()
        found = [(float(n) * float(size), unit) for n in (columns, rows)] + [(factor, of_heights)]
    sizes = [float(size or 1) * (metres_in(unit) or 0.0) for size, unit in found]
    return sizes if all(sizes) else []


def _matrix(
    body: io.TextIOBase, header: list[str], first: str, sizes: list[float], what: str
) -> MeasuredPoints:
    """Read a matrix of heights, the first row at the greatest y."""
    remedy = "write as many heights on every line, a missing one as nan"
    layout: dict[str, Any] = {"comments": list(_COMMENTS), "delimiter": _delimiter(first)}
    table = rows_in(islice(body, len(header), None), what, remedy, above=len(header), **layout)
    row, column = ((index.ravel() + 0.5) for index in np.indices(table.shape))
    x, y = column / table.shape[1] * sizes[0], (1 - row / table.shape[0]) * sizes[1]
    return measured(x, y, table.ravel() * sizes[2])


def _beginning(stream: IO[bytes], encoding: str, what: str) -> tuple[list[str], str]:
    header: list[str] = []
    # Text also ends lines at CR, as old Macs write; detached, it leaves the stream open.
    errors = "surrogateescape" if encoding == "utf-8-sig" else "replace"
    text = io.TextIOWrapper(stream, encoding=encoding, errors=errors)
    lines = [*islice(iter(lambda: text.readline(_LONGEST_LINE), ""), _LONGEST_HEADER)]
    text.detach()
    for raw in lines:
        line = _decoded(raw.encode("utf-8", "surrogateescape")).strip()
        if line and not line.startswith(_COMMENTS) and _all_numbers(line):
            return header, line
        header.append(line)
    raise FileError(
        f"{what} has no line of numbers among its first {_LONGEST_HEADER}; give a text with a "
        "column each for x, y and height"
    )


def _decoded(raw: bytes) -> str:
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError:  # µ in the encoding of Windows
        return raw.decode("latin-1")


def _all_numbers(line: str) -> bool:
    parts = [part for part in re.split(r"[,;\s]+", line) if part]
    try:
        [float(part) for part in parts]
    except ValueError:
        return False
    return bool(parts)


def _delimiter(line: str) -> str | None:
    return next((mark for mark in ";," if mark in line), None)


def _cells(line: str) -> tuple[int, int]:
    mark = _delimiter(line)
    full = line.rstrip(f" {mark}") if mark else line
    return len(full.split(mark)), len(line.split(mark))


def _columns(
    header: list[str], first: str, units: LengthUnits | None, what: str
) -> tuple[dict[str, int], dict[str, float], int]:
    """Return place and unit [m] of each column by its role, and the cells of a line."""
    named, count = _roles(header, _cells(first), what)
    places = {role: place for role, (place, _) in named.items()}
    if not named:
        if not 2 <= count < _LEAST_OF_A_MATRIX:
            raise FileError(
                f"{what} has {count} columns, expected x, y and height in each line, "
                "or x and height of a profile; write a matrix of heights with its x and y"
            )
        places = {"x": 0, "height": 1} if count == 2 else {"x": 0, "y": 1, "height": 2}
        named = _of_profile(header, what) if count == 2 else {}
        for names in map(_names, header if count > 2 else []):
            found = _named(names) if len(names) == count else {}
            if any(places.get(role, at) != at for role, (at, _) in found.items()):
                raise FileError(
                    f"{what} names its columns {', '.join(names)}, expected x, y and height among "
                    "them; name the column of the heights z"
                )
    stated = {role: unit for role, (_, unit) in named.items() if unit is not None}
    scales = dict.fromkeys(places, 1.0)
    for role in [name for name in places if name != "sample"]:
        side = "lateral" if role in "xy" else "height"
        if role in stated and units is not None:
            refuse_other(units, replace(units, **{side: stated[role]}), what)  # type: ignore[arg-type]
        scales[role] = stated[role] if role in stated else getattr(needed(units, what), side)
    return places, scales, count


def _of_profile(header: list[str], what: str) -> dict[str, tuple[int, float | None]]:
    """Return place and unit of position and height of two columns with names of any language.

    Raises FileError for a unit that is no length, as of slopes.
    """
    for line in reversed(header):
        names = _names(line)
        if len(names) != 2:
            continue
        roles = [_ROLES.get(name_and_unit(name)[0]) for name in names]
        if roles[0] not in (None, "x") or roles[1] not in (None, "height", "y"):
            raise FileError(
                f"{what} has 2 columns, expected x, y and height, or x and height; export them so"
            )
        for name in names:
            unit = re.search(r"[\[(/_]\s*([^\s\[\](),/_]+)\s*[\])]?\s*$", name)
            if unit and unit[1] in WORDS and metres_in(unit[1]) is None:
                raise FileError(f"{what}: {name!r} is no length; give positions and heights")
        found = {role: (k, name_and_unit(names[k])[1]) for k, role in enumerate(("x", "height"))}
        return found if any(unit for _, unit in found.values()) else {}
    return {}


def _roles(
    header: list[str], cells: tuple[int, int], what: str
) -> tuple[dict[str, tuple[int, float | None]], int]:
    """Return place and unit of each named column by its role, and the cells of a line.

    Raises FileError if the line of names has another number of cells than the numbers, repeats a
    name, or states another unit than a line of units below it.
    """
    for place in reversed(range(len(header))):
        names = _names(header[place])
        found = _named(names)
        if not ({"x", "height"} if cells[0] == 2 else {"x", "y", "height"}) <= set(found):
            continue
        if not cells[0] <= len(names) <= cells[1]:
            if header[place].startswith(_COMMENTS):  # a comment with such words
                continue
            raise FileError(
                f"{what}: line {place + 1} names {len(names)} columns, the lines below have "
                f"{cells[0]}; name each column once, and write decimal points"
            )
        for role, (at, _) in found.items():
            if names.count(names[at]) > 1 or sum(name_and_unit(n)[0] == role for n in names) > 1:
                raise FileError(f"{what} has the column {names[at]!r} twice; name each once")
        return _with_units(found, header[place + 1 :], what), len(names)
    return {}, cells[0]


def _names(line: str) -> list[str]:
    """Return the cells of a possible line of names, with empty ones between delimiters."""
    text = line.lstrip("#!% ").replace("/t", "\t").rstrip(" ,;\t")
    if _delimiter(text):
        return [part.strip().strip('"') for part in re.split("[,;]", text)]
    parts = [part.strip() for part in text.split("\t") if part.strip()]
    return parts if len(parts) >= 3 else re.sub(r"\s+(?=[\[(])", "", text).split()


def _named(names: list[str]) -> dict[str, tuple[int, float | None]]:
    found: dict[str, tuple[int, float | None]] = {}
    for place, (name, unit) in enumerate(map(name_and_unit, names)):
        role = _ROLES.get(name)
        # Our clouds have the height twice; "height" has full precision.
        if role and (role not in found or name == "height"):
            found[role] = (place, unit)
    return found


def _with_units(
    found: dict[str, tuple[int, float | None]], below: list[str], what: str
) -> dict[str, tuple[int, float | None]]:
    for line in below:
        units = [metres_in(name.strip("[]() ")) for name in _names(line)]
        for role, (place, own) in found.items():
            stated = units[place] if place < len(units) else None
            if own is not None and stated is not None and stated != own:
                raise FileError(
                    f"{what} states two units of {role}, by its name and on the line below it; "
                    "delete the wrong one"
                )
            found[role] = (place, stated if own is None else own)
    return found


def _numbers(
    body: io.TextIOBase, above: int, first: str, cells: int, columns: list[int], what: str
) -> FloatArray:
    remedy = (
        "write decimal points, a height that is missing as nan, and the same columns on every line"
    )
    layout = {"comments": list(_COMMENTS), "delimiter": _delimiter(first), "usecols": columns}
    lines: Iterator[str] = islice(body, above, None)
    if ";" in first and "," in first and "." not in first:
        lines = (line.replace(",", ".") for line in lines)
    return rows_in(lines, what, remedy, above=above, cells=cells, **layout)


def write_columns(path: Path, columns: Mapping[str, NDArray[np.generic]], *, csv: bool) -> None:
    """Write columns (n,) of one length by their names, as CSV or, for xyz, after a ``#`` line."""
    mark = "," if csv else " "
    with atomic_file(path, "w") as stream:
        stream.write(("" if csv else "# ") + mark.join(columns) + "\n")
        formats = [
            "%d" if part.dtype.kind in "iu" else "%.9g" if part.dtype.itemsize <= 4 else "%.17g"
            for part in columns.values()
        ]
        for start in range(0, len(next(iter(columns.values()))), _PORTION):
            rows = slice(start, start + _PORTION)
            portion = np.column_stack([part[rows] for part in columns.values()])
            np.savetxt(stream, portion, fmt=formats, delimiter=mark)


# A profile of the DABAM collection has its columns in ``NAME.dat`` and a description in
# ``NAME.txt``. ``FILE_FORMAT`` 1 has slopes in the second column, 2 heights; 3 and 4 the same in
# pairs of columns. Further columns (residuals) are derived and ignored.

_MAX_HEADER_BYTES = 100_000
_MAX_DATA_BYTES = 200_000_000
_SLOPES, _HEIGHTS = (1, 3), (2, 4)


def has_dabam_header(path: Path) -> bool:
    """Return whether ``NAME.txt`` describes ``path`` as a profile of DABAM."""
    header_path = path.with_suffix(".txt")
    if path.suffix.lower() != ".dat" or header_path == path or not header_path.is_file():
        return False
    try:
        return "FILE_FORMAT" in load_object(header_path, "header", _MAX_HEADER_BYTES)
    except FileError:
        return False


def read_dabam(path: Path) -> MeasuredPoints:
    """Read a profile as points along x at y = 0; slopes are integrated by the trapezoidal rule.

    Raises FileError if columns and header do not agree.
    """
    what = f"profile {str(path)!r}"
    header = load_object(path.with_suffix(".txt"), "header", _MAX_HEADER_BYTES)
    form, skip = header.get("FILE_FORMAT"), header.get("FILE_HEADER_LINES")
    factors = [header.get(key) for key in ("X1_FACTOR", "Y1_FACTOR")]
    numbers = [n for n in factors if isinstance(n, float | int) and n != 0]
    known = form in (*_SLOPES, *_HEIGHTS) and isinstance(skip, int) and 0 <= skip <= 1000
    if not known or len(numbers) != 2:
        raise FileError(
            f"{what}: its header says FILE_FORMAT {form!r}, FILE_HEADER_LINES {skip!r}, factors "
            f"{factors!r}; expected 1 to 4, a count, and numbers other than zero"
        )
    assert isinstance(skip, int)
    with open_regular(path, FileError, "profile") as stream:
        lines = stream.read(_MAX_DATA_BYTES).decode("utf-8", "replace").splitlines()[skip:]
    table = rows_in(lines, what, "check FILE_HEADER_LINES", above=skip, usecols=(0, 1))
    if not len(table):
        raise FileError(
            f"{what} has no points after its {skip} lines of header; check FILE_HEADER_LINES"
        )
    place, height = (table[:, i] * float(numbers[i]) for i in (0, 1))
    notes = ("a profile along x",)
    if form in _SLOPES:
        steps = np.diff(place) * (height[1:] + height[:-1]) / 2
        height, notes = np.cumsum([0.0, *steps]), ("a profile along x; its slopes were integrated",)
    return measured(place, np.zeros_like(height), height, notes=notes)
