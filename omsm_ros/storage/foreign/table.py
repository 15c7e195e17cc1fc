"""What every recording of another program is, once it is opened: named columns of numbers."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.errors import FileError
from omsm_ros.foreign_units import DATE, UNITS

MAX_ROWS = 200_000_000
PIECE_ROWS = 100_000


_IN_NAME = re.compile(r".*[\[(]\s*([^\[\]()/\s]+)\s*[\])]?\s*")
# Without brackets a word may be no unit: log/V is a channel, y_in an input.
_AFTER_NAME = re.compile(r".*[_\s/]([^\[\]()/\s_]+)\s*")


_SURE = frozenset[str]().union(*UNITS.values()) - {DATE, "1"}


@dataclass(frozen=True, slots=True)
class TableForm:
    """What a map says of how a table is written.

    delimiter: between columns of a text, " " = any run of blanks;  decimal: before the fraction
    lines_before: before the line of names;  lines_after: between it and the first numbers
    named: whether a text has a line of names; without one its columns are [0], [1], …
    missing: texts that mean "no reading";  zone: of dates that state none, "Z" or "+01:00"
    """

    delimiter: str = ","
    decimal: str = "."
    lines_before: int = 0
    lines_after: int = 0
    named: bool = True
    missing: tuple[str, ...] = ()
    zone: str = ""


class ForeignTable(ABC):
    """Columns by name: ``names`` of all, ``units`` that the file itself states of some.

    repeated_names: lines met so far that repeat the line of names, and hold no numbers
    passed_over: messages met so far that hold none of the columns
    sample_period: that the file itself states [s], None if it does not
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
        """Return what people call it."""
        return str(self.path)

    def pieces(self, names: Sequence[str], dates: Sequence[str]) -> Iterator[dict[str, FloatArray]]:
        """Yield the columns ``names`` in pieces of rows, each (n,) in the units of the file.

        dates: those of them that hold dates, given in seconds since 1970

        Raises FileError for what is no number or date, naming the row.
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
        """Say that the columns ``names`` will be read; FileError where they do not fit together."""

    def close(self) -> None:
        """Let go of the file."""
        self._opened.close()

    def hint(self, names: Sequence[str]) -> str:
        """Return what may help where columns ``names`` are not there; empty if nothing is seen."""
        return ""


def stated_unit(table: ForeignTable, name: str) -> str:
    """Return the unit that a file states of a column, as in "Z [mm]" or z_mm too; empty if none."""
    if name in table.units:
        return table.units[name].strip()
    if not table.units_in_names:
        return ""
    if found := _IN_NAME.fullmatch(name):
        return found[1]
    found = _AFTER_NAME.fullmatch(name)
    return found[1] if found and found[1] in _SURE else ""
