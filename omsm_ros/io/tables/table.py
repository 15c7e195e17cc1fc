"""The base of tables of other programs, and the map of their columns."""

import re
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.streams.imported_columns import CHANNELS, Column, ColumnMap
from omsm_ros.errors import DataError, FileError, named_errors
from omsm_ros.io.files import load_object
from omsm_ros.io.json_and_yaml import NUMBER, form
from omsm_ros.quantities import SIGNAL, shown
from omsm_ros.units import COUNT, DATE, UNITS

MAX_ROWS = 200_000_000
PIECE_ROWS = 100_000


_IN_NAME = re.compile(r".*[\[(]\s*([^\[\]()/\s]+)\s*[\])]?\s*")
# Without brackets the word may not be a unit: log/V is a channel, y_in an input.
_AFTER_NAME = re.compile(r".*[_\s/]([^\[\]()/\s_]+)\s*")


_SURE = frozenset[str]().union(*UNITS.values()) - {DATE, "1"}


@dataclass(frozen=True, slots=True)
class TableForm:
    """The notation of a table, as stated by a map.

    delimiter: of columns, " " = any blanks;  decimal: the decimal sign
    lines_before: before the line of names;  lines_after: between it and the first numbers
    named: whether a text has a line of names; without one its columns are [0], [1], …
    missing: texts that mean "no reading";  zone: of dates without one, "Z" or "+01:00"
    comment: beginning of lines that are left out, empty = no line is
    """

    delimiter: str = ","
    decimal: str = "."
    lines_before: int = 0
    lines_after: int = 0
    named: bool = True
    missing: tuple[str, ...] = ()
    zone: str = ""
    comment: str = ""


class ForeignTable(ABC):
    """Columns by name: ``names`` of all, ``units`` that the file states of some.

    repeated_names: lines so far that repeat the line of names
    passed_over: messages so far that have none of the columns
    sample_period: stated by the file [s], else None
    units_in_names: whether names of columns may hold units
    """

    sample_period: float | None = None
    units_in_names = True

    def __init__(self, path: Path) -> None:
        self.path = path
        self.names: list[str] = []
        self.units: dict[str, str] = {}
        self.repeated_names = self.passed_over = 0
        self._opened = ExitStack()

    def __str__(self) -> str:
        return f"table {str(self.path)!r}"

    @property
    def label(self) -> str:
        """Return the name for people."""
        return str(self.path)

    def pieces(self, names: Sequence[str], dates: Sequence[str]) -> Iterator[dict[str, FloatArray]]:
        """Yield the columns ``names`` in pieces of rows, each (n,) in the units of the file.

        dates: those of them with dates, returned in seconds since 1970

        Raises FileError for a value that is no number or date, with its row.
        """
        rows = self.repeated_names = self.passed_over = 0
        for piece in self._pieces(names, frozenset(dates)):
            rows += len(piece[names[0]])
            if rows > MAX_ROWS:
                raise FileError(f"{self} has more than {MAX_ROWS} rows; split it")
            yield piece

    @abstractmethod
    def _pieces(
        self, names: Sequence[str], dates: frozenset[str]
    ) -> Iterator[dict[str, FloatArray]]:
        """Yield pieces of some rows."""

    def used(self, names: Sequence[str]) -> None:  # noqa: B027
        """Prepare to read the columns ``names``; FileError if they do not belong together."""

    def close(self) -> None:
        """Close the file."""
        self._opened.close()

    def hint(self, names: Sequence[str]) -> str:
        """Return a hint why columns ``names`` are missing; empty without one."""
        return ""


def micro_sign(name: str) -> str:
    """Return ``name`` with a Greek mu as the micro sign, which looks the same."""
    return name.replace("\u03bc", "\u00b5")


def stated_unit(table: ForeignTable, name: str) -> str:
    """Return the unit that a file states of a column, also as "Z [mm]" or z_mm; empty if none."""
    if name in table.units:
        return table.units[name].strip()
    if not table.units_in_names:
        return ""
    if found := _IN_NAME.fullmatch(name):
        return found[1]
    found = _AFTER_NAME.fullmatch(name)
    return found[1] if found and found[1] in _SURE else ""


# ``MAP.yaml`` assigns the columns of a recording to channels, with their units.

_MAX_BYTES = 100_000
_BY_POSITION = re.compile(r"\[\d{1,4}\]")

_TEXT = {"type": "string", "minLength": 1}
_LINES = {"type": "integer", "minimum": 0, "maximum": 1000}
_COLUMN = form(
    {"name": _TEXT, "unit": _TEXT, COUNT: NUMBER, "sign": {"enum": [1, -1]}, "constant": NUMBER}, ()
)
_MAP = form(
    {
        "columns": form(dict.fromkeys(CHANNELS, _COLUMN), ()),
        "sample_period": NUMBER,
        "start": NUMBER,
        "invalid": {"type": "array", "items": {"anyOf": [NUMBER, _TEXT]}, "maxItems": 100},
        "delimiter": {"type": "string", "minLength": 1, "maxLength": 1},
        "decimal": {"enum": [".", ","]},
        "zone": {"type": "string", "pattern": r"^(Z|[+-](0\d|1[0-4]):[0-5]\d)$"},
        "lines_before_names": _LINES,
        "lines_after_names": _LINES,
    },
    ("columns",),
)


def load_column_map(path: Path | str) -> tuple[ColumnMap, TableForm]:
    """Read ``MAP.yaml``; FileError if it is ambiguous, such as without a unit."""
    what = f"map {str(path)!r}"
    content = load_object(path, "map", _MAX_BYTES, _MAP, yaml=True)
    invalid = content.get("invalid", ())
    with named_errors(FileError, what, DataError):
        mapped = ColumnMap(
            {c: _column(c, given) for c, given in content["columns"].items()},
            content.get("sample_period"),
            float(content.get("start", 0.0)),
            tuple(float(value) for value in invalid if not isinstance(value, str)),
        )
    names = mapped.names(CHANNELS)
    written = TableForm(
        content.get("delimiter", ","),
        content.get("decimal", "."),
        content.get("lines_before_names", 0),
        content.get("lines_after_names", 0),
        # Without a line of names all columns are [0], [1], …
        not names or not all(_BY_POSITION.fullmatch(name) for name in names),
        tuple(text for text in invalid if isinstance(text, str)),
        content.get("zone", ""),
    )
    if written.delimiter == written.decimal:
        raise FileError(
            f"{what}: {written.decimal!r} is both delimiter and decimal sign; "
            "write delimiter: ';' or what the file has"
        )
    return mapped, written


def _column(channel: str, given: Mapping[str, Any]) -> Column:
    if ("name" in given) == ("constant" in given):
        raise DataError(f"{channel} needs a column's name, or a constant; give one of them")
    sign = float(given.get("sign", 1))
    if "constant" in given:
        if channel in ("trigger", "time"):
            raise DataError(
                f"{channel} is constant, which tells no sample from another; name its column, or "
                "leave it out"
            )
        constant = SIGNAL.checked(float(given["constant"]), DataError, f"{channel}: constant")
        return Column("", constant=constant and constant * _factor(channel, given, sign))
    return Column(
        micro_sign(given["name"]), _factor(channel, given, sign), unit=given.get("unit", "")
    )


def _factor(channel: str, given: Mapping[str, Any], sign: float) -> float:
    units = UNITS[channel]
    if channel == "trigger":
        return 1.0
    unit = given.get("unit", "")
    if unit == COUNT:
        if COUNT not in given:
            raise DataError(
                f"{channel}: the value of one count in SI is missing; write it into the map, as "
                "count: 1e-9"
            )
        value = float(given[COUNT])
        if not 1e-15 <= abs(value) <= 1.0:
            raise DataError(
                f"{channel}: one count is {value:g} in SI, expected 1e-15 to 1 m or rad"
            )
        return value * sign
    if unit not in units:
        said = "has no unit" if not unit else f"has the unit {shown(unit)}"
        raise DataError(f"{channel} {said}; write one of {[*units, COUNT]}")
    return units[unit] * sign
