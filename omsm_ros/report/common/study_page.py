"""A page of a study: verdict, then sections of figures and tables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from omsm_ros.report.common.tables import Table
from omsm_ros.report.common.template import fill, picture
from omsm_ros.report.common.verdict import Verdict


@dataclass(frozen=True, slots=True)
class StudySection:
    """Figures, by their names, above tables; what is empty is left out."""

    title: str
    tables: tuple[Table, ...] = ()
    figures: tuple[str, ...] = ()
    note: str = ""


@dataclass(frozen=True, slots=True)
class StudyPage:
    """captions, figures: PNG files and what is to be read under them, by name"""

    title: str
    subtitle: str
    verdict: Verdict
    sections: tuple[StudySection, ...]
    captions: Mapping[str, str] = field(default_factory=dict)
    figures: Mapping[str, bytes] = field(default_factory=dict)
    footer: str = ""


def fill_study(page: StudyPage) -> str:
    """Return the page as HTML; all text from outside is escaped."""
    sections = [_present(section, page.figures) for section in page.sections]
    return fill(
        "study.html",
        page=page,
        sections=[s for s in sections if s.tables or s.figures],
        picture=lambda name: picture(page.figures[name]),
    )


def _present(section: StudySection, figures: Mapping[str, bytes]) -> StudySection:
    return StudySection(
        section.title,
        tuple(table for table in section.tables if table.rows),
        tuple(name for name in section.figures if name in figures),
        section.note,
    )
