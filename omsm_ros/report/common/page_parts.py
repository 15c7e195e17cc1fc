"""What is a page made of? Headlines, sections of figures and tables, and a line of its issue."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

from omsm_ros.report.common.tables import Table
from omsm_ros.report.common.template import check_places


@dataclass(frozen=True, slots=True)
class Headline:
    """A number that a reader looks for first."""

    name: str
    value: str
    detail: str


@dataclass(frozen=True, slots=True)
class Section:
    """Figures, by their names, then tables; ``note`` is for the reader."""

    title: str
    figures: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    note: str = ""


def present(sections: Sequence[Section], figures: Mapping[str, bytes]) -> list[Section]:
    """Return ``sections`` with the figures that there are and tables that have rows.

    Those that have neither are left out.
    """
    cut = [
        Section(
            section.title,
            tuple(name for name in section.figures if name in figures),
            tuple(table for table in section.tables if table.rows),
            section.note,
        )
        for section in sections
    ]
    return [section for section in cut if section.figures or section.tables]


@dataclass(frozen=True, kw_only=True)
class IssuedPage:
    """What pages have that are issued to be filed.

    date: of issue, as it is to be printed;  source: the recording, for a reader
    version: of the software;  figures: PNG files by the names in ``captions``

    Raises ConfigurationError for a figure of another name.
    """

    captions: ClassVar[Mapping[str, str]]
    date: str
    source: str = ""
    version: str = ""
    figures: Mapping[str, bytes] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_places(self.figures, self.captions)

    def issued(self, identity: str = "") -> str:
        """Return recording, date and identity on one line."""
        return " · ".join(p for p in (self.source, f"issued {self.date}", identity) if p)
