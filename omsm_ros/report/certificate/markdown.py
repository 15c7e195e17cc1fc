"""The certificate of a calibration in Markdown, with its plots as PNG files."""

from __future__ import annotations

import html
import re
from collections.abc import Iterator, Sequence

from omsm_ros.report.certificate.page import (
    BAND,
    CAPTIONS,
    CertificatePage,
    Section,
    headlines,
    sections,
    verdict_on_calibration,
)
from omsm_ros.report.tables import Table

# Characters that Markdown would interpret in a text from a file.
_SPECIAL = re.compile(r"([\\`*_{}\[\]#|~!$])")


def picture_name(figure: str) -> str:
    """Return the name of the file of ``figure``, in the folder of the Markdown."""
    return f"certificate_{figure}.png"


def text(value: str) -> str:
    """Return ``value`` on one line, every sign of it shown as it is."""
    one_line = html.escape(" ".join(value.split(" ")), quote=False).splitlines()
    return _SPECIAL.sub(r"\\\1", " ".join(one_line))


def render_markdown(certificate: CertificatePage) -> str:
    """Return the page as Markdown with GitHub's tables; all text from outside is escaped."""
    return "\n".join(_lines(certificate)).rstrip() + "\n"


def _lines(certificate: CertificatePage) -> Iterator[str]:
    verdict = verdict_on_calibration(certificate.calibration)
    yield "# Calibration certificate"
    yield ""
    yield text(certificate.issue)
    yield ""
    yield f"**{text(verdict.word)}**"
    yield ""
    yield from (f"- {text(reason)}" for reason in verdict.reasons)
    yield ""
    rows = [(h.name, h.value, h.detail) for h in headlines(certificate.calibration)]
    yield from _table(Table("", ("value", ""), rows))
    if BAND in certificate.figures:
        yield from _picture(BAND)
    for section in sections(certificate):
        yield from _section(section)


def _section(section: Section) -> Iterator[str]:
    yield f"## {text(section.title)}"
    yield ""
    for name in section.figures:
        yield from _picture(name)
    for table in section.tables:
        if table.title:
            yield f"### {text(table.title)}"
            yield ""
        yield from _table(table)
    if section.note:
        yield text(section.note)
        yield ""


def _picture(name: str) -> Iterator[str]:
    yield f"![{name}]({picture_name(name)})"
    yield ""
    yield f"*{text(CAPTIONS[name])}*"
    yield ""


def _table(table: Table) -> Iterator[str]:
    if all(len(row) == 1 for row in table.rows):
        yield from (f"- {text(row[0])}" for row in table.rows)
    else:
        width = len(table.rows[0])
        yield _row(("", *table.columns) if table.columns else ("",) * width)
        yield "|" + "---|" * width
        yield from (_row(row) for row in table.rows)
    yield ""


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(text(cell) for cell in cells) + " |"
