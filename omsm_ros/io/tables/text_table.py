"""Reads tables in text, such as CSV, of loggers, controls and spreadsheets."""

from __future__ import annotations

import codecs
import csv
import io
import re
import warnings
from bisect import bisect_left
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import FileError
from omsm_ros.io.files import open_regular
from omsm_ros.io.tables.table import ForeignTable, TableForm, micro_sign
from omsm_ros.quantities import SIGNAL, shown
from omsm_ros.units import NANOSECONDS_PER_S, WORDS

EXPECTED = "expected a date after ISO 8601, as 2026-11-21T14:03:05.125+01:00"

_DATE = re.compile(
    r"(\d{4}-\d\d-\d\d)[T ](\d\d:\d\d(?::\d\d)?)(?:[.,](\d{1,9}))?\s*"
    r"(Z|[+-](?:0\d|1[0-4])(?::?[0-5]\d)?)?"
)
# The range of 64 bits of nanoseconds; other dates would wrap.
_FIRST_DAY, _LAST_DAY = "1700-01-01", "2261-12-31"


def seconds_since_1970(texts: Sequence[str], zone: str) -> FloatArray:
    """Return the instants (n,) of dates [s], rounded to a quarter of a microsecond.

    zone: of dates without one; empty = they must state it

    Raises ValueError with the remedy for another text, or a date without a zone.
    """
    days, shifts = [], []
    for text in texts:
        found = _DATE.fullmatch(text.strip().strip('"'))
        if found is None:
            raise ValueError(EXPECTED)
        day, clock, fraction, stated = found.groups()
        if not (stated or zone):
            raise ValueError("the date has no time zone; write it into the map, as zone: '+01:00'")
        if stated and zone:
            raise ValueError("the date states its time zone; leave zone out of the map")
        if not _FIRST_DAY <= day <= _LAST_DAY:
            raise ValueError(f"expected a date from {_FIRST_DAY} to {_LAST_DAY}")
        days.append(f"{day}T{clock}" + (f".{fraction}" if fraction else ""))
        shifts.append(shift_of(stated or zone))
    since = np.array(days, "datetime64[ns]").astype(np.int64)
    return np.asarray(since / NANOSECONDS_PER_S - np.array(shifts))


def shift_of(zone: str) -> float:
    """Return the offset of a zone from UTC [s]: of "Z", "+01", "+01:00" or "+0100"."""
    if zone == "Z":
        return 0.0
    hours, minutes = int(zone[1:3]), int(zone[3:].lstrip(":") or 0)
    return (1.0 if zone[0] == "+" else -1.0) * (hours * 3600.0 + minutes * 60.0)


# About a hundred thousand rows of five columns.
_PIECE_CHARACTERS = 4_000_000
_MAX_LINE_CHARACTERS = 100_000
_PROBED_BYTES = 65_536
# Lines among which a misplaced line of names is searched.
_HEAD_LINES = 1000
# Lines at the end of each piece that are checked for averages, totals, "end of log".
_FOOT_LINES = 20
_NO_TEXT = {
    b"PK\x03\x04": "it is a workbook or an archive; save the sheet as CSV",
    b"\xd0\xcf\x11\xe0": "it is a workbook; save the sheet as CSV",
    b"TDSm": "it is TDMS; name it .tdms",
    b"\x89HDF": "it is HDF5; name it .h5",
    b"\x89MCA": "it is a ROS bag; name it .mcap",
}
# µm, µs and [°] in DOS; in Windows they would be æm, æs and [ø].
_DOS_UNIT = re.compile(rb"(?<![A-Za-z\x80-\xff])\xe6[ms]\b|[\[(]\xf8[\])]")
_DELIMITERS = (";", "\t", ",", "|")
# 1 234, 1'234 or 1,234.5, of which 1,234 alone may be a decimal comma; spaces may be narrow.
_GROUPED = re.compile("[+-]?\\d{1,3}(?:[ '\u2019\u00a0\u202f]\\d{3})+(?:\\.\\d*)?|.*,.*\\..*")


class TextTable(ForeignTable):
    """A table of lines below a line of names; read piece by piece."""

    def __init__(self, path: Path, form: TableForm, remedy: str = "") -> None:
        """remedy: for every line that is no row; empty: what the map of the columns lacks."""
        super().__init__(path)
        self._form, self._stated_remedy = form, remedy
        self._encoding = self._probed()
        _, lines = next(self._lines(), (1, []))
        self._top = lines[:_HEAD_LINES]
        place = form.lines_before
        while place < len(lines) and not lines[place].strip():
            place += 1
        if place >= len(lines):
            kind = "line of names" if form.named else "row of numbers"
            raise FileError(
                f"{self} has no {kind} after {form.lines_before} lines; give its first line one"
            )
        head = self._named_cells(lines[place])
        self._head = lines[place].strip() if form.named else None
        self._first_row = place + 1 + form.lines_after if form.named else place
        body = [line for line in lines[self._first_row :] if line.strip()]
        self._first_cells = self._cells(body[0]) if body else []
        self.names = head if form.named else [f"[{i}]" for i in range(len(head))]
        for line in reversed(lines[place + 1 : self._first_row] if form.named else []):
            cells = [cell.strip().strip("[]()").strip() for cell in self._named_cells(line)]
            named = zip(self.names, cells, strict=False)
            self.units.update({name: unit for name, unit in named if unit in WORDS})

    def hint(self, names: Sequence[str]) -> str:
        """Return the place of the line of names, or the delimiter of its cells."""
        if found := self.place_of(names):
            number, mark = found
            if mark != self._form.delimiter:
                return f"line {number + 1} has them: write delimiter: {mark!r} into the map"
            return f"line {number + 1} has them: write lines_before_names: {number}"
        if self._form.named and all(_is_number(name) for name in self.names):
            return "its first line holds numbers: name its columns by place, from [0]"
        return ""

    def place_of(self, names: Sequence[str]) -> tuple[int, str] | None:
        """Return the first line that has ``names``, from 0, and its delimiter; None without one."""
        for number, line in enumerate(self._top):
            for mark in (self._form.delimiter, *_DELIMITERS):
                if set(names) <= {cell.strip().strip('"') for cell in line.split(mark)}:
                    return number, mark
        return None

    def _probed(self) -> str:
        """Return the encoding of the file; FileError if it is not text."""
        with open_regular(self.path, FileError, "table") as stream:
            start = stream.read(_PROBED_BYTES)
        if start.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
            return "utf-16"
        for mark, remedy in _NO_TEXT.items():
            if start.startswith(mark):
                raise FileError(f"{self} is no text: {remedy}")
        if b"\0" in start:
            raise FileError(f"{self} is no text: it holds zero bytes; save it as CSV in UTF-8")
        try:
            codecs.getincrementaldecoder("utf-8")().decode(start)
        except UnicodeDecodeError:
            # Names of columns hold µ and °, of western Windows or DOS.
            return "cp437" if _DOS_UNIT.search(start) else "cp1252"
        return "utf-8-sig"

    def _lines(self) -> Iterator[tuple[int, list[str]]]:
        number, rest = 1, ""
        raw = open_regular(self.path, FileError, "table")
        with io.TextIOWrapper(raw, self._encoding, "replace", newline=None) as stream:
            while text := stream.read(_PIECE_CHARACTERS):
                lines = (rest + text).split("\n")
                # The last line may have no end.
                rest = lines.pop() if len(text) == _PIECE_CHARACTERS or not lines[-1] else ""
                if len(rest) > _MAX_LINE_CHARACTERS:
                    raise FileError(
                        f"{self}, line {number + len(lines)} has more than "
                        f"{_MAX_LINE_CHARACTERS} characters; it is no table of numbers"
                    )
                yield number, lines
                number += len(lines)
            if rest:
                yield number, [rest]

    def _cells(self, line: str) -> list[str]:
        mark = self._form.delimiter
        return line.split() if mark == " " else line.split(mark)

    def _named_cells(self, line: str) -> list[str]:
        if len(line) > _MAX_LINE_CHARACTERS:
            raise FileError(
                f"{self} has {len(line)} characters in a line; give a table of numbers, one row a "
                "line"
            )
        cells = self._cells(line)
        if '"' in line and self._form.delimiter != " ":
            cells = next(csv.reader([line], delimiter=self._form.delimiter), cells)
        return [micro_sign(cell.strip().strip('"')) for cell in cells]

    def _pieces(
        self, names: Sequence[str], dates: frozenset[str]
    ) -> Iterator[dict[str, FloatArray]]:
        rows = _Rows(self, [self.names.index(n) for n in names], [n in dates for n in names])
        for number, piece in self._lines():
            skip = max(0, self._first_row - (number - 1))
            lines = piece[skip:]
            columns = self._numbers(lines, rows, number + skip)
            self._check_foot(lines, number + skip)
            if len(columns[0]):
                yield dict(zip(names, columns, strict=True))

    def _numbers(self, lines: list[str], rows: _Rows, number: int) -> list[FloatArray]:
        lines_with = [(number + i, line) for i, line in enumerate(lines) if line.strip()]
        kept = [line for _, line in lines_with]
        try:
            return rows.read(kept)
        except ValueError:
            if not self._stated_remedy:  # joined logs repeat their line of names
                lines_with = [pair for pair in lines_with if pair[1].strip() != self._head]
            self.repeated_names += len(kept) - len(lines_with)
            try:
                return rows.read([line for _, line in lines_with])
            except ValueError:
                raise self._culprit(lines_with, rows) from None

    def _check_foot(self, lines: list[str], first_number: int) -> None:
        """Raise FileError for a line below the table that is no sample, such as "mean;4.5"."""
        if self._stated_remedy:
            return  # a cell that is no number raised there
        known = {"", *(text.lower() for text in self._form.missing)}
        low = max(0, len(lines) - _FOOT_LINES)
        for number, line in enumerate(lines[low:], first_number + low):
            if line.strip() == self._head:
                continue
            for first, cell in zip(self._first_cells, self._cells(line), strict=False):
                if _is_number(first) and not _is_number(cell) and cell.strip().lower() not in known:
                    raise FileError(
                        f"{self}, line {number}: {shown(line.strip())} has {shown(cell.strip())} "
                        "where the first row has a number; if it is no row of the table, delete it"
                    )

    def _culprit(self, lines: list[tuple[int, str]], rows: _Rows) -> FileError:
        def unreadable(last: int) -> bool:
            try:
                rows.read([line for _, line in lines[: last + 1]])
            except ValueError:
                return True
            return False

        number, line = lines[bisect_left(range(len(lines)), True, key=unreadable)]
        return FileError(
            f"{self}, line {number}: {shown(line.strip())} is no row of numbers; "
            f"{self._remedy(number, line, rows)}"
        )

    def _remedy(self, number: int, line: str, rows: _Rows) -> str:
        if self._stated_remedy:
            return self._stated_remedy
        cells = self._cells(line)
        of_units = number == self._first_row + 1 and not any(map(_is_number, cells))
        if of_units and self._form.named and len(cells) == len(self.names):
            return "if it is a line of units, write lines_after_names: 1 into the map"
        if any(_GROUPED.fullmatch(cell.strip().strip('"')) for cell in cells):
            return "write numbers without marks between thousands"
        if self._form.decimal == "." and self._form.delimiter != "," and "," in line:
            return "for decimal commas, write decimal: ',' into the map"
        if self._form.decimal == "." and ";" in line and "," in line:
            return "for decimal commas, write decimal: ',' and delimiter: ';' into the map"
        if len(cells) != len(self.names):
            of_commas = ", or its comma is a decimal one" if self._form.delimiter == "," else ""
            return (
                f"it has {len(cells)} cells under {len(self.names)} names; "
                f"check whether it was cut{of_commas}"
            )
        try:
            rows.read_dates([line])
        except ValueError as err:
            return str(err) if "expected" in str(err) or "zone" in str(err) else EXPECTED
        if self._form.decimal == "," and "." in line:
            return "numbers with a decimal comma have no points; write thousands without them"
        return (
            "write numbers there, leave it empty where there is no reading, list the text that "
            "means so (as invalid: ['---']), or delete a line that is no row"
        )

    @property
    def form(self) -> TableForm:
        """Return the notation of the text."""
        return self._form

    def cells(self, line: str) -> list[str]:
        """Return the cells of a line; ValueError if their number is not that of the names.

        A decimal comma, for example, adds a cell and would shift the others.
        """
        cells = self._cells(line)
        if len(cells) == len(self.names) + 1 and not cells[-1].strip():
            cells.pop()  # a delimiter at the end of each line
        if len(cells) != len(self.names):
            raise ValueError
        return cells


class _Rows:
    """Reads some columns of lines: those at ``places``, of which some are ``dates``."""

    def __init__(self, table: TextTable, places: list[int], dates: list[bool]) -> None:
        self._table, self._form = table, table.form
        self._places, self._dates = places, dates
        self._numeric = [p for p, date in zip(places, dates, strict=True) if not date]
        self._missing = frozenset(text.lower() for text in table.form.missing)

    def read(self, lines: list[str]) -> list[FloatArray]:
        """Return the columns, each (n,); ValueError for another number of cells or a text."""
        if not lines:
            return [np.empty(0) for _ in self._places]
        numbers = iter(self._read_numbers(lines).T if self._numeric else ())
        dates = iter(self.read_dates(lines))
        return [np.ascontiguousarray(next(dates if date else numbers)) for date in self._dates]

    def read_dates(self, lines: list[str]) -> list[FloatArray]:
        """Return the columns of dates; ValueError with the remedy for other texts."""
        found = [p for p, date in zip(self._places, self._dates, strict=True) if date]
        cells = [self._table.cells(line) for line in lines] if found else []
        return [seconds_since_1970([c[p] for c in cells], self._form.zone) for p in found]

    def _read_numbers(self, lines: list[str]) -> FloatArray:
        if self._form.decimal != ".":
            self._check_points(lines)
            lines = [line.replace(self._form.decimal, ".") for line in lines]
        mark = None if self._form.delimiter == " " else self._form.delimiter
        read = partial(
            rows_in,
            lines,
            str(self._table),
            "",
            cells=len(self._table.names),
            delimiter=mark,
            usecols=self._numeric,
            comments=self._form.comment or None,
        )
        try:
            return read()
        except ValueError:  # quotes, empty cells, texts that mean "no reading"
            return read(converters=self._number, encoding="utf-8")

    def _check_points(self, lines: list[str]) -> None:
        """Raise ValueError for points among decimal commas, where 1.234 is another number."""
        for line in lines:
            if "." in line:
                cells = self._table.cells(line)
                if any("." in cells[place] for place in self._numeric):
                    raise ValueError

    def _number(self, text: str) -> float:
        """Return a number of a table; an empty cell is a missing reading."""
        text = text.strip().strip('"').strip()
        if not text or text.lower() in self._missing:
            return float("nan")
        if "_" in text:
            raise ValueError  # Python would take 1_000 for a thousand
        return float(text)


def _is_number(text: str) -> bool:
    try:
        float(text.strip().strip('"').replace(",", "."))
    except ValueError:
        return False
    return True


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
        if mark and marks > 0 and line.count(mark) == marks:  # as nearly all are
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


PLAIN = TableForm(comment="#")
"""A table of our own documents: a first line of names, commas, decimal points."""

_ROWS = (
    "below the names stand numbers with decimal points, between commas, as many as there are "
    "names; delete other lines"
)


def load_columns(
    path: Path | str, names: tuple[str, ...], may_miss: Collection[str] = ()
) -> list[FloatArray]:
    """Read the columns ``names`` of a CSV file, each (n,) in the units of the file.

    may_miss: columns whose missing readings are NaN in the result

    Raises FileError for a file without these columns, or with invalid numbers.
    """
    table = TextTable(Path(path), PLAIN, _ROWS)
    for name in names:
        if table.names.count(name) != 1:
            place = table.place_of(names)
            hint = "name columns as that line does, each once"
            if place and place[1] != PLAIN.delimiter:
                hint = f"line {place[0] + 1} has them between {place[1]!r}: write commas, and "
                hint += "decimal points"
            elif place and place[0]:
                hint = f"line {place[0] + 1} has them: delete the lines above it"
            raise FileError(
                f"{table} has {table.names.count(name)} columns {shown(name)} in its first line "
                f"{shown(table.names)}; {hint}"
            )
    pieces = list(table.pieces(names, ()))
    columns = [np.concatenate([piece[name] for piece in pieces] or [np.empty(0)]) for name in names]
    if len(columns[0]) < 2:
        raise FileError(f"{table} has {len(columns[0])} lines of numbers; record more")
    for name, column in zip(names, columns, strict=True):
        gone = np.isnan(column)
        if name not in may_miss and np.any(gone):
            raise FileError(
                f"{table}: {name} has no reading in {int(np.sum(gone))} of {len(gone)} rows, "
                f"first in row {int(np.argmax(gone)) + 1}; cut the record there"
            )
        SIGNAL.checked_all(column[~gone], FileError, f"{table}: {name}")
    return columns
