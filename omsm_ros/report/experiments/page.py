"""One page an experiment: the paper's figures in one column, ours in the next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from omsm_ros.report.common.page_parts import Section
from omsm_ros.report.common.study_page import StudyPage, fill_study
from omsm_ros.report.common.tables import Table
from omsm_ros.report.common.verdict import Verdict


@dataclass(frozen=True)
class Compared:
    """A figure as the paper has it and as the twin gives it, ready to be read; and a remark."""

    name: str
    paper: str
    ours: str
    remark: str = ""


@dataclass(frozen=True)
class ExperimentPage:
    """captions, figures: by name, PNG files;  narrow: those that stand three in a line"""

    title: str
    summary: str
    rows: Sequence[Compared]
    tables: tuple[Table, ...] = ()
    captions: Mapping[str, str] = field(default_factory=dict)
    figures: Mapping[str, bytes] = field(default_factory=dict)
    narrow: tuple[str, ...] = ()


def render(page: ExperimentPage) -> str:
    """Return the page as HTML."""
    rows = [(row.name, row.paper, row.ours, row.remark) for row in page.rows]
    beside = Table("", ("the paper", "the twin", "remark"), rows, prose="remark")
    return fill_study(
        StudyPage(
            title=page.title,
            subtitle="on the digital twin",
            verdict=Verdict("unknown", "Side by side", (page.summary,)),
            sections=(
                Section("The paper's figures beside ours", tables=(beside,)),
                Section("Measured", tuple(page.figures), page.tables),
            ),
            captions=page.captions,
            figures=page.figures,
            narrow=page.narrow,
            footer="Light: Advanced Manufacturing 2025, doi 10.37188/lam.2025.078. The twin has "
            "the paper's Eq. 12 with the s that its print lacks; its truth is known.",
        )
    )
