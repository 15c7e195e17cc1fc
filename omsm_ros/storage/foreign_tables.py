"""Named columns of numbers in other programs' files: text, NumPy, MATLAB, HDF5.

Read in pieces, so that ten million rows need no more memory than a hundred thousand. A column of
a table in NumPy, MATLAB or HDF5 is named ``dataset[3]``, counted from 0; a plain array's columns
are ``[0]``, ``[1]`` and so on.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.errors import FileError
from omsm_ros.quantities import shown
from omsm_ros.storage.files import open_regular, said

MAX_ROWS = 200_000_000
_PIECE_ROWS = 100_000
_MAX_LINE_CHARACTERS = 100_000
# What is loaded whole: NumPy's and MATLAB's own files.
_MAX_WHOLE_BYTES = 4_000_000_000

_INDEXED = re.compile(r"(.*)\[(\d{1,4})\]")


@dataclass(frozen=True, slots=True)
class TextForm:
    """How a table in text is written.

    delimiter: between columns;  decimal: the sign before the fraction
    lines_before: before the line of names;  lines_after: between it and the first numbers
    """

    delimiter: str = ","
    decimal: str = "."
    lines_before: int = 0
    lines_after: int = 0


class ForeignTable:
    """A file of columns: ``names`` of those that it has, ``pieces`` of their numbers.

    repeated_names: lines met so far that repeat the line of names, and hold no numbers
    """

    def __init__(self, path: Path, form: TextForm) -> None:
        self.path = path
        self.repeated_names = 0
        self._form = form
        self._read = {
            ".npy": self._numpy, ".npz": self._numpy, ".mat": self._matlab,
            ".h5": self._hdf5, ".hdf5": self._hdf5,
        }.get(path.suffix.lower())  # fmt: skip
        self._arrays: Mapping[str, Any] = {}
        if self._read is not None:
            self._arrays = self._translated()
        self.names = self._names_of_text() if self._read is None else self._names_of_arrays()

    def pieces(self, names: Sequence[str]) -> Iterator[dict[str, FloatArray]]:
        """Yield the columns ``names`` in pieces of rows, each (n,) in the units of the file.

        Raises FileError for what is no number, naming the row.
        """
        rows = 0
        for piece in self._text(names) if self._read is None else self._sliced(names):
            rows += len(piece[names[0]])
            if rows > MAX_ROWS:
                raise FileError(f"{self} has more than {MAX_ROWS} rows; split it")
            yield piece

    def __str__(self) -> str:
        return f"table {str(self.path)!r}"

    # ---------------------------------------------------------------------------- text

    def _names_of_text(self) -> list[str]:
        with self._opened() as stream:
            line = self._skipped(stream, self._form.lines_before)
        return [name.strip().strip('"') for name in line.split(self._form.delimiter)]

    def _opened(self) -> io.TextIOWrapper:
        raw = open_regular(self.path, FileError, "table")
        return io.TextIOWrapper(raw, encoding="utf-8-sig", errors="replace", newline=None)

    def _skipped(self, stream: io.TextIOWrapper, lines: int) -> str:
        """The line after ``lines`` others."""
        for line in islice(iter(lambda: stream.readline(_MAX_LINE_CHARACTERS), ""), lines, None):
            if line.strip():
                return line.strip()
        raise FileError(f"{self} has no line of names after {lines} lines; give its first line one")

    def _text(self, names: Sequence[str]) -> Iterator[dict[str, FloatArray]]:
        places = [self.names.index(name) for name in names]
        row = self._form.lines_before + self._form.lines_after + 2
        with self._opened() as stream:
            head = self._skipped(stream, self._form.lines_before)
            for _ in range(self._form.lines_after):
                stream.readline(_MAX_LINE_CHARACTERS)
            while lines := list(islice(stream, _PIECE_ROWS)):
                numbers = self._numbers(lines, head, places, row)
                row += len(lines)
                if len(numbers):
                    yield {n: np.ascontiguousarray(numbers[:, i]) for i, n in enumerate(names)}

    def _numbers(self, lines: list[str], head: str, places: list[int], row: int) -> FloatArray:
        try:
            return self._loaded(lines, places)
        except ValueError:
            # Joined logs repeat their line of names: no numbers are lost with it.
            kept = [line for line in lines if line.strip() != head]
            self.repeated_names += len(lines) - len(kept)
            try:
                return self._loaded(kept, places)
            except ValueError:
                raise self._culprit(lines, head, places, row) from None

    def _loaded(self, lines: list[str], places: list[int]) -> FloatArray:
        lines = [line for line in lines if not line.isspace()]
        if not lines:
            return np.empty((0, len(places)))
        mark = self._form.delimiter
        # A cell too many, such as a decimal comma makes, would shift all that follow it.
        wanted = len(self.names) - 1
        if any(line.count(mark) != wanted and not self._ends_in_mark(line) for line in lines):
            raise ValueError
        if self._form.decimal != ".":
            lines = [line.replace(self._form.decimal, ".") for line in lines]
        how = {"delimiter": mark, "usecols": places, "ndmin": 2, "comments": None}
        try:
            return np.loadtxt(lines, **how)
        except ValueError:
            return np.loadtxt(lines, converters=_number, encoding="utf-8", **how)

    def _ends_in_mark(self, line: str) -> bool:
        mark = self._form.delimiter
        return line.rstrip("\r\n").endswith(mark) and line.count(mark) == len(self.names)

    def _culprit(self, lines: list[str], head: str, places: list[int], row: int) -> FileError:
        """The first line that is no row of numbers, and what may be wrong with it."""
        for number, line in enumerate(lines, row):
            try:
                self._loaded([line] if line.strip() != head else [], places)
            except (ValueError, IndexError):
                remedy = "write numbers there, or leave it empty where there is no reading"
                if "," in line and self._form.decimal == "." and ";" in line:
                    remedy = (
                        "for decimal commas, write decimal: ',' and delimiter: ';' into the map"
                    )
                return FileError(
                    f"{self}, line {number}: {shown(line.strip())} is no row; {remedy}"
                )
        return FileError(f"{self}: lines {row} to {row + len(lines)} are no table")

    # -------------------------------------------------------------------------- arrays

    def _translated(self) -> Mapping[str, Any]:
        with open_regular(self.path, FileError, "table") as stream:
            size = stream.seek(0, io.SEEK_END)
        if size > _MAX_WHOLE_BYTES and self._read != self._hdf5:
            raise FileError(f"{self} has {size} bytes, at most {_MAX_WHOLE_BYTES}; split it")
        assert self._read is not None
        try:
            return self._read()
        except FileError:
            raise
        except Exception as err:  # whatever a library says of a damaged file
            raise FileError(
                f"{self} cannot be read: {said(err)}; write it again, or as CSV"
            ) from err

    def _numpy(self) -> Mapping[str, Any]:
        with open_regular(self.path, FileError, "table") as stream:
            loaded = np.load(stream)  # no pickles, by default
            if isinstance(loaded, np.ndarray):
                return {"": loaded}
            return {name: loaded[name] for name in loaded.files}

    def _matlab(self) -> Mapping[str, Any]:
        from scipy.io import loadmat

        with open_regular(self.path, FileError, "table") as stream:
            if stream.read(10) == b"MATLAB 7.3":  # which is HDF5 under another name
                return self._hdf5()
        loaded = loadmat(self.path, squeeze_me=True, mat_dtype=True)
        return {name: v for name, v in loaded.items() if isinstance(v, np.ndarray)}

    def _hdf5(self) -> Mapping[str, Any]:
        try:
            import h5py
        except ImportError as err:
            raise FileError(f"{self} needs h5py; pip install h5py, or give CSV") from err
        found: dict[str, Any] = {}
        stack = ExitStack()
        file = stack.enter_context(h5py.File(self.path, "r"))

        def keep(name: str, item: object) -> None:
            if isinstance(item, h5py.Dataset):
                # MATLAB writes a column of numbers as a table of one row.
                row = item.ndim == 2 and item.shape[0] == 1
                found[name] = item[0] if row else item

        file.visititems(keep)
        return found

    def _names_of_arrays(self) -> list[str]:
        names = []
        for name, array in self._arrays.items():
            if array.dtype.kind not in "fiu":
                continue
            if array.ndim == 1:
                names.append(name)
            elif array.ndim == 2:
                names += [f"{name}[{column}]" for column in range(min(array.shape[1], 1000))]
        return names

    def _sliced(self, names: Sequence[str]) -> Iterator[dict[str, FloatArray]]:
        views = {name: self._view(name) for name in names}
        lengths = {name: len(array) for name, (array, _) in views.items()}
        if len(set(lengths.values())) > 1:
            raise FileError(f"{self} has columns of different lengths {lengths}; cut them alike")
        for low in range(0, lengths[names[0]], _PIECE_ROWS):
            rows = slice(low, low + _PIECE_ROWS)
            yield {
                name: np.asarray(array[rows] if column is None else array[rows, column], np.float64)
                for name, (array, column) in views.items()
            }

    def _view(self, name: str) -> tuple[Any, int | None]:
        if name in self._arrays:
            return self._arrays[name], None
        indexed = _INDEXED.fullmatch(name)
        assert indexed is not None  # it is one of self.names
        return self._arrays[indexed[1]], int(indexed[2])


def _number(text: str) -> float:
    """A number of a table; an empty cell is a reading that is not there."""
    text = text.strip().strip('"')
    if "_" in text:
        raise ValueError  # Python would take 1_000 for a thousand
    return float(text) if text else float("nan")
