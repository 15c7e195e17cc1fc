"""A page of a study: verdict, then sections of figures and tables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from omsm_ros.report.common.page_parts import Section, present
from omsm_ros.report.common.template import fill, picture
from omsm_ros.report.common.verdict import Verdict


@dataclass(frozen=True, slots=True)
class StudyPage:
    """captions, figures: PNG files and what is to be read under them, by name

    narrow: of the figures, those that stand three in a line
    """

    title: str
    subtitle: str
    verdict: Verdict
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
