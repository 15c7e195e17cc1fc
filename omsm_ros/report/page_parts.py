"""What is a page made of? Headlines, sections of figures and tables, and a line of its issue."""

from __future__ import annotations

import re
from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import jinja2

from omsm_ros.errors import ConfigurationError
from omsm_ros.report.tables import Table
from omsm_ros.report.verdict import PageVerdict

# A page from its template: text from outside escaped, numbers set as in print.

_SPACE = "\N{NARROW NO-BREAK SPACE}"
# A sign, not a hyphen: not behind a letter or a digit, so neither 1e-9 nor a date.
_MINUS = re.compile(r"(?<![\w.\-])-(?=\d)")
_UNITS = r"(?:[nµmkM]?(?:m|s|Hz|rad|g|N/m|N·s/m)(?:/s²?)?|ppm|%|°|rpm|·)"
# "12.5 nm", "254 000"
_JOINED = re.compile(rf"(?<=\d) (?=(?:{_UNITS}|\d{{3}})(?![\w/]))")


def fill(template: str, **content: object) -> str:
    """Return the template of that name with ``content`` in it; raise for a name left open."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("omsm_ros.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=lambda value: typeset(value) if type(value) is str else value,
    )
    return environment.get_template(template).render(**content)


def check_places(figures: Iterable[str], places: Iterable[str]) -> None:
    """Raise ConfigurationError for a figure whose name is none of ``places`` on a page."""
    unknown = sorted(set(figures) - set(places))
    if unknown:
        raise ConfigurationError(
            f"figures {unknown!r} have no place on the page, expected one of {[*places]}"
        )


def picture(png: bytes) -> str:
    """Return a PNG file as text for the address of an image."""
    return b64encode(png).decode()


def typeset(text: str) -> str:
    """Return ``text`` with narrow spaces that do not break before units, and true minus signs."""
    return _JOINED.sub(_SPACE, _MINUS.sub("−", text))


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


# A page of a study: verdict, then sections of figures and tables.


@dataclass(frozen=True, slots=True)
class StudyPage:
    """captions, figures: PNG files and what is to be read under them, by name

    narrow: of the figures, those that stand three in a line
    """

    title: str
    subtitle: str
    verdict: PageVerdict
    sections: tuple[Section, ...]
    captions: Mapping[str, str] = field(default_factory=dict)
    figures: Mapping[str, bytes] = field(default_factory=dict)
    narrow: tuple[str, ...] = ()
    footer: str = ""


def fill_study(page: StudyPage) -> str:
    """Return the page as HTML; all text from outside is escaped."""
    return fill(
        "study.html",
        page=page,
        sections=present(page.sections, page.figures),
        picture=lambda name: picture(page.figures[name]),
    )
