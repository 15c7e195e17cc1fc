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


def load_columns(path: Path | str, names: tuple[str, ...]) -> list[FloatArray]:
    """Read the columns ``names`` of a CSV file, each (n,) in the units of the file.

    Raises FileError for a file without such columns, or with anything but plausible numbers.
    """
    text = read_text(path, MAX_TABLE_BYTES, FileError, "table")
    what = f"table {str(path)!r}"
    head, _, body = text.partition("\n")
    known = [name.strip().strip('"') for name in head.split(",")]
    for name in names:
        if known.count(name) != 1:
            raise FileError(
                f"{what} has {known.count(name)} columns {shown(name)} in its first line "
                f"{shown(head.strip())}; name columns as that line does, each once"
            )
    places = [known.index(name) for name in names]
    table = numbers_in(body, what, places)
    if len(table) < 2:
        raise FileError(f"{what} has {len(table)!r} lines of numbers; record more")
    return [
        np.ascontiguousarray(SIGNAL.checked_all(table[:, i], FileError, f"{what}: {name}"))
        for i, name in enumerate(names)
    ]


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
