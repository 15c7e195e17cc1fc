"""Parts of a page: headlines, sections of figures and tables, and the line of issue."""

import re
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import jinja2

from omsm_ros.report.tables import Table
from omsm_ros.report.verdict import PageVerdict

_SPACE = "\N{NARROW NO-BREAK SPACE}"
# A hyphen that is a minus sign: it does not follow a letter or a digit, as in 1e-9 or a date.
_MINUS = re.compile(r"(?<![\w.\-])-(?=\d)")
_UNITS = r"(?:[nµmkM]?(?:m|s|Hz|rad|g|N/m|N·s/m)(?:/√?s²?)?|ppm|%|°|rpm|·)"
# Spaces that must not break, as in "12.5 nm", "254 000" and "k = 2".
_JOINED = re.compile(
    rf"(?<=\d) (?=(?:{_UNITS}|\d{{3}})(?![\w/]))|(?<=k) (?== \d)|(?<=k =) (?=\d)|(?<=·) (?=10)"
)


_ENVIRONMENT = jinja2.Environment(  # it keeps the templates that it has compiled
    loader=jinja2.PackageLoader("omsm_ros.report"),
    autoescape=True,
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    finalize=lambda value: typeset(value) if type(value) is str else value,
)


def fill(template: str, **content: object) -> str:
    """Return the template filled with ``content``, texts escaped; raise for an undefined name."""
    return _ENVIRONMENT.get_template(template).render(**content)


_ORIGINS = (
    "part", "drawing", "customer", "machine", "probe", "probe_serial_number", "target",
    "temperature_c", "operator", "laboratory", "method", "traceability",
)  # fmt: skip


def title_block(origin: Mapping[str, object], *more: tuple[str, str]) -> list[tuple[str, str]]:
    """Return the entries of a title block with their names, and ``more`` after them.

    origin: as ``--origin`` gives it, without what is None
    """
    named = [(name, origin[name]) for name in _ORIGINS if origin.get(name) is not None]
    rows = [(name.removesuffix("_c").replace("_", " "), name, value) for name, value in named]
    return [*((text, f"{v} °C" if n == "temperature_c" else str(v)) for text, n, v in rows), *more]


def picture(png: bytes) -> str:
    """Return a PNG file as base64 text."""
    return b64encode(png).decode()


def typeset(text: str) -> str:
    """Return ``text`` with narrow spaces that do not break before units, and true minus signs."""
    return _JOINED.sub(_SPACE, _MINUS.sub("−", text))


@dataclass(frozen=True, slots=True)
class Headline:
    """One main result at the top of a page."""

    name: str
    value: str
    detail: str


@dataclass(frozen=True, slots=True)
class Section:
    """A section of a page: figures, by their names, then tables, then a ``note``."""

    title: str
    figures: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    note: str = ""


def present(sections: Sequence[Section], figures: Mapping[str, bytes]) -> list[Section]:
    """Return ``sections`` with available figures and non-empty tables, without empty sections."""
    cut = [
        replace(
            section,
            figures=tuple(name for name in section.figures if name in figures),
            tables=tuple(table for table in section.tables if table.rows),
        )
        for section in sections
    ]
    return [section for section in cut if section.figures or section.tables]


@dataclass(frozen=True, kw_only=True)
class Issue:
    """Issue of a certificate or of the page of a model.

    date: as printed;  source: name of the recording;  version: of the software
    figures: PNG files by name
    """

    date: str
    source: str = ""
    version: str = ""
    figures: Mapping[str, bytes] = field(default_factory=dict)

    def line(self, identity: str = "") -> str:
        """Return recording, date and identity on one line."""
        return " · ".join(p for p in (self.source, f"issued {self.date}", identity) if p)


def fill_study(
    title: str, subtitle: str, verdict: PageVerdict, sections: Sequence[Section],
    captions: Mapping[str, str], figures: Mapping[str, bytes], **more: object,
) -> str:  # fmt: skip
    """Return the page of a study as HTML: verdict, then sections of figures and tables.

    captions, figures: captions and PNG files by name
    more: ``narrow``, figures placed three in a row; ``block``, entries of the title block; and
        ``footer``

    All text from outside is escaped.
    """
    return fill(
        "study.html",
        title=title,
        subtitle=subtitle,
        verdict=verdict,
        sections=present(sections, figures),
        captions=captions,
        picture=lambda name: picture(figures[name]),
        **{"narrow": (), "block": (), "footer": "", **more},
    )
