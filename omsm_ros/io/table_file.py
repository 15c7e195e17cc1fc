"""Reads CSV with a line of names, and rows of numbers of any text."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import FileError
from omsm_ros.io.files import read_text
from omsm_ros.quantities import SIGNAL, shown

# Two hours of two columns at 1 kHz; they take 300 MB of memory.
MAX_TABLE_BYTES = 200_000_000
# The byte order mark, with which Windows begins texts in UTF-8.
_MARK = "\ufeff"
# Lines among which a misplaced line of names is searched.
_HEAD_LINES = 100
_ROWS = (
    "below the names stand numbers with decimal points, between commas, as many as there are "
    "names; delete other lines"
)


def load_columns(path: Path | str, names: tuple[str, ...]) -> list[FloatArray]:
    """Read the columns ``names`` of a CSV file, each (n,) in the units of the file.

    Raises FileError for a file without these columns, or with invalid numbers.
    """
    text = read_text(path, MAX_TABLE_BYTES, FileError, "table").removeprefix(_MARK)
    if "\r" in text:  # Windows' line ends, or old Macs'
        text = text.replace("\r\n", "\n").replace("\r", "\n")
    what = f"table {str(path)!r}"
    head, _, body = text.partition("\n")
    known = _cells(head, ",")
    for name in names:
        if known.count(name) != 1:
            raise FileError(
                f"{what} has {known.count(name)} columns {shown(name)} in its first line "
                f"{shown(head.strip())}; {_where(text, names)}"
            )
    places = [known.index(name) for name in names]
    table = rows_in(
        _lines_of(body), what, _ROWS, above=1, cells=len(known), delimiter=",", usecols=places
    )
    if len(table) < 2:
        raise FileError(f"{what} has {len(table)!r} lines of numbers; record more")
    for i, name in enumerate(names):
        if np.any(gone := np.isnan(table[:, i])):
            raise FileError(
                f"{what}: {name} has no reading in {int(np.sum(gone))} of {len(gone)} rows, "
                f"first in row {int(np.argmax(gone)) + 1}; cut the record there"
            )
    return [
        np.ascontiguousarray(SIGNAL.checked_all(table[:, i], FileError, f"{what}: {name}"))
        for i, name in enumerate(names)
    ]


def first_line(path: Path | str) -> list[str]:
    """Return the cells of the line of names of a CSV file."""
    text = read_text(path, MAX_TABLE_BYTES, FileError, "table").removeprefix(_MARK)
    return _cells(re.split("[\r\n]", text, maxsplit=1)[0], ",")


def _cells(line: str, mark: str) -> list[str]:
    return [cell.strip().strip('"') for cell in line.split(mark)]


def _where(text: str, names: tuple[str, ...]) -> str:
    """Return the remedy for a first line that does not name each of ``names`` once."""
    for number, line in enumerate(text.split("\n", _HEAD_LINES)[:_HEAD_LINES], 1):
        for mark in (",", ";", "\t"):
            cells = _cells(line, mark)
            if any(cells.count(name) != 1 for name in names):
                continue
            if mark != ",":
                return f"line {number} has them between {mark!r}: write commas, and decimal points"
            return f"line {number} has them: delete the lines above it"
    return "name columns as that line does, each once"


def _lines_of(text: str) -> Iterator[str]:
    """Yield the lines of a text one by one: a list of them takes four times its memory."""
    start = 0
    while (end := text.find("\n", start)) >= 0:
        yield text[start:end]
        start = end + 1
    yield text[start:]


def rows_in(
    lines: Iterable[str],
    what: str,
    remedy: str,
    *,
    above: int = 0,
    cells: int | None = None,
    **layout: Any,
) -> FloatArray:
    """Return the numbers of lines of text, (lines, columns); (0, …) of none.

    above: number of lines of the file above these;  cells: in each line, None if unknown
    layout: delimiter, comments, usecols, max_rows, converters of numpy.loadtxt

    Raises FileError, which calls the text ``what`` and names the ``remedy``, for the first other
    line.
    """
    seen = [above, ""]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of an empty text; the caller reports it
            return np.loadtxt(_rows(lines, seen, cells, layout), ndmin=2, **layout)
    except (ValueError, OSError) as err:
        # numpy takes one line at a time, so the error is in the last one.
        line = shown(str(seen[1]).strip())
        raise FileError(f"{what}, line {seen[0]}: {line} is no row of numbers; {remedy}") from err


def _rows(
    lines: Iterable[str], seen: list[Any], cells: int | None, layout: Mapping[str, Any]
) -> Iterator[str]:
    """Yield lines that are not blank, and note in ``seen`` number and text of the last one.

    Raises ValueError for a line with another number of ``cells``: numpy ignores additional cells,
    and a decimal comma makes one.
    """
    mark = layout.get("delimiter")
    marks = -1 if cells is None or mark is None else cells - 1
    for number, line in enumerate(lines, seen[0] + 1):
        seen[0], seen[1] = number, line
        if marks > 0 and line.count(mark) == marks:  # as nearly all are
            yield line
        elif line and not line.isspace():
            if cells is not None:
                _check_cells(line, mark, cells, layout.get("comments", "#") or ())
            yield line


def _check_cells(line: str, mark: str | None, cells: int, comments: str | Iterable[str]) -> None:
    for sign in comments:
        line = line.split(sign)[0]
    found = line.split(mark)
    while len(found) > cells and not found[-1].strip():
        found.pop()
    if line.strip() and len(found) != cells:
        raise ValueError(f"it has {len(found)} cells, not {cells}")
