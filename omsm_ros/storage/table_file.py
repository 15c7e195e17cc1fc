"""A plain table: CSV with a line of names, then numbers."""

from __future__ import annotations

import io
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.errors import FileError
from omsm_ros.quantities import SIGNAL, shown
from omsm_ros.storage.files import read_text, said

# Two hours of two columns at 1 kHz, in three hundred megabytes of memory.
MAX_TABLE_BYTES = 200_000_000
# With which Windows begins texts in UTF-8.
_MARK = "\ufeff"
# Among which the line of names is looked for, where the first is none.
_HEAD_LINES = 100


def load_columns(path: Path | str, names: tuple[str, ...]) -> list[FloatArray]:
    """Read the columns ``names`` of a CSV file, each (n,) in the units of the file.

    Raises FileError for a file without such columns, or with anything but plausible numbers.
    """
    text = read_text(path, MAX_TABLE_BYTES, FileError, "table").removeprefix(_MARK)
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
    try:
        table = numbers_in(body, what, places)
    except FileError as err:
        raise _culprit(body, what, places) or err from None
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


def _cells(line: str, mark: str) -> list[str]:
    return [cell.strip().strip('"') for cell in line.split(mark)]


def _where(text: str, names: tuple[str, ...]) -> str:
    """Return what to do about a first line that does not name each of ``names`` once."""
    for number, line in enumerate(text.split("\n", _HEAD_LINES)[:_HEAD_LINES], 1):
        for mark in (",", ";", "\t"):
            cells = _cells(line, mark)
            if any(cells.count(name) != 1 for name in names):
                continue
            if mark != ",":
                return f"line {number} has them between {mark!r}: write commas, and decimal points"
            return f"line {number} has them: delete what stands above it"
    return "name columns as that line does, each once"


def _culprit(body: str, what: str, places: Sequence[int]) -> FileError | None:
    """Return the first line below the names that is no row, None if each is one."""
    for number, line in enumerate(body.split("\n"), 2):
        cells = line.split("#")[0].split(",")
        try:
            if line.strip():
                [float(cells[place]) for place in places]
        except (ValueError, IndexError):
            return FileError(
                f"{what}, line {number}: {shown(line.strip())} is no row of numbers; below the "
                "names stand numbers with decimal points, between commas; delete other lines"
            )
    return None


def numbers_in(body: str, what: str, places: Sequence[int] | None = None) -> FloatArray:
    """Return numbers of a CSV text without its line of names, (lines, columns ``places`` or all).

    Raises FileError, which calls the text ``what``, for anything but numbers.
    """
    remedy = "write a line of names, then numbers"
    return rows_in(io.StringIO(body), what, remedy, delimiter=",", usecols=places)


def rows_in(source: Any, what: str, remedy: str, **layout: Any) -> FloatArray:
    """Return the numbers of lines of text, (lines, columns); (0, …) of none.

    source, layout: as numpy.loadtxt takes them

    Raises FileError, which calls the text ``what`` and names the ``remedy``, for other lines.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # that it is empty; the caller says so
            return np.loadtxt(source, ndmin=2, **layout)
    except (ValueError, OSError) as err:
        raise FileError(f"{what} is no table: {said(err)}; {remedy}") from err
