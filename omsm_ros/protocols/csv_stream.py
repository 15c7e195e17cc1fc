"""The six-channel stream as text: one line a sample, columns by name.

Separated by commas or blanks, so what LinuxCNC's ``halsampler -t`` pipes out is read too (the
sample's number first, then the pins in their order). Axes are counts, with decimals if they
have any; distance is in nanometres, time in nanoseconds. Lines end with LF, CR or both. One that
holds anything else, or another number of columns, is no sample.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omsm_ros.errors import ConfigurationError

AXIS_COLUMNS = ("x", "y", "z", "b", "c")
COLUMNS = ("sequence", "device_time", "distance", "status", *AXIS_COLUMNS)
SKIPPED = "-"
_WHOLE = ("sequence", "device_time", "status")
# A longer line is none.
MAX_LINE_BYTES = 1024
_INTEGER = re.compile(rb"[-+]?\d{1,19}")
_NUMBER = re.compile(rb"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?")
_SEPARATOR = re.compile(rb"[,;\s]+")


# A line whose numbers cannot be what they are called is none: counts that no counter reaches,
# times of centuries, positions of hundreds of metres in tenths of a nanometre.
_RANGES = {"sequence": (0, 2**52), "device_time": (-(2**62), 2**62)}
_RANGES |= dict.fromkeys(AXIS_COLUMNS, (-(2**40), 2**40))
_OTHER_RANGE = (-(2**62), 2**62)


def check_columns(columns: Sequence[str]) -> None:
    """Raise ConfigurationError unless ``columns`` can be read.

    Each is one of COLUMNS, once, or SKIPPED; the sequence must be there, and something measured.
    """
    named = [name for name in columns if name != SKIPPED]
    if set(named) - set(COLUMNS) or len(set(named)) < len(named):
        raise ConfigurationError(f"columns {columns!r}, expected {COLUMNS!r}, each at most once")
    if "sequence" not in named or not {"distance", *AXIS_COLUMNS} & set(named):
        raise ConfigurationError(f"columns {columns!r} need a sequence, and distance or axes")


def row_dtype(columns: Sequence[str]) -> np.dtype[np.void]:
    """Return one line: whole numbers int64, the others float64."""
    named = [name for name in columns if name != SKIPPED]
    return np.dtype([(name, "<i8" if name in _WHOLE else "<f8") for name in named])


def encode_lines(rows: NDArray[np.void], columns: Sequence[str] = COLUMNS) -> list[bytes]:
    """Wire bytes of ``rows`` (n,) with a field a column."""
    lists = [rows[name].tolist() for name in columns]
    return [(",".join(map(_text, row)) + "\n").encode() for row in zip(*lists, strict=True)]


def _text(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:.17g}"


@dataclass(frozen=True, slots=True)
class LineStatistics:
    """What became of every byte and line.  lines: read;  malformed: lines that are no sample."""

    bytes_received: int
    bytes_pending: int
    lines: int
    malformed: int


class CsvDecoder:
    """Bytes in any portions → rows; nothing raises, memory is one line and a portion."""

    def __init__(self, columns: Sequence[str] = COLUMNS) -> None:
        """Raises ConfigurationError for columns that cannot be read."""
        check_columns(columns)
        self._columns = tuple(columns)
        self._dtype = row_dtype(columns)
        self._tail = b""
        self._received = self._lines = self._malformed = 0

    def reset(self) -> None:
        """Forget a line that was cut off."""
        self._malformed += bool(self._tail)
        self._tail = b""

    def feed(self, data: bytes) -> NDArray[np.void]:
        """Return the rows completed by ``data``, shape (n,)."""
        self._received += len(data)
        *lines, tail = (self._tail + data).replace(b"\r", b"\n").split(b"\n")
        self._tail = tail[: MAX_LINE_BYTES + 1]
        rows = [row for line in lines if (row := self._row(line)) is not None]
        self._lines += len(rows)
        return np.array(rows, self._dtype)

    @property
    def statistics(self) -> LineStatistics:
        """Return what became of every byte and line."""
        return LineStatistics(self._received, len(self._tail), self._lines, self._malformed)

    def _row(self, line: bytes) -> tuple[float, ...] | None:
        words = [word for word in _SEPARATOR.split(line) if word]
        if not words:
            return None
        row = self._values(words) if len(line) <= MAX_LINE_BYTES else None
        self._malformed += row is None
        return row

    def _values(self, words: list[bytes]) -> tuple[float, ...] | None:
        if len(words) != len(self._columns):
            return None
        row: list[float] = []
        for name, word in zip(self._columns, words, strict=True):
            if name == SKIPPED:
                continue
            whole = name in _WHOLE
            if not (_INTEGER if whole else _NUMBER).fullmatch(word):
                return None
            value = int(word) if whole else float(word)
            least, most = _RANGES.get(name, _OTHER_RANGE)
            if not least <= value <= most:
                return None
            row.append(value)
        return tuple(row)
