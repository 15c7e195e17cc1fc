"""Report of one of the paper's experiments: results of the paper and of the twin, with figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from matplotlib.figure import Figure

from omsm_ros.core.calibration.verification import PathCheck
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.report import style
from omsm_ros.report.page_parts import Section, StudyPage, fill_study
from omsm_ros.report.tables import Table
from omsm_ros.report.verdict import PageVerdict
from omsm_ros.units import DEGREE_RAD, NANOMETRE_M


@dataclass(frozen=True)
class Compared:
    """A result of the paper and of the twin, as text, with a remark."""

    name: str
    paper: str
    ours: str
    remark: str = ""


@dataclass(frozen=True)
class ExperimentPage:
    """captions, figures: captions and PNG files by name;  narrow: figures placed three in a row"""

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
    comparison_table = Table("", ("the paper", "the twin", "remark"), rows, prose="remark")
    return fill_study(
        StudyPage(
            title=page.title,
            subtitle="on the digital twin",
            verdict=PageVerdict("unknown", "Result", (page.summary,)),
            sections=(
                Section("Comparison with the paper", tables=(comparison_table,)),
                Section("Measured", tuple(page.figures), page.tables),
            ),
            captions=page.captions,
            figures=page.figures,
            narrow=page.narrow,
            footer="Light: Advanced Manufacturing 2025, doi 10.37188/lam.2025.078. The twin has "
            "the dynamics of the paper's Eq. 12, corrected for a missing s.",
        )
    )


_WIDTH_IN = 9.2


def chirp(time: FloatArray, check: PathCheck, model_lag: FloatArray) -> Figure:
    """Draw Fig. 9b to d: error over time, its rms and lag by band; ``model_lag``: true [rad]."""
    made, axes = style.figure(_WIDTH_IN, 8.0, 3, 1)
    for values, colour, name in (
        (check.error_before, style.BEFORE, "before"),
        (check.error_after, style.AFTER, "after"),
    ):
        at, low, high = style.envelope(time, values / NANOMETRE_M)
        axes[0, 0].fill_between(at, low, high, color=colour, alpha=0.7, label=name, linewidth=0)
    style.label(axes[0, 0], x="time [s]", y="nm", title="Error on the free path")
    style.legend_above(axes[0, 0])
    style.logarithmic(axes[1, 0].yaxis)
    middle = np.array([(low + high) / 2 for low, high in check.excited])
    for errors, lags, colour, name in (
        (check.error_before, check.lag_before, style.BEFORE, "before"),
        (check.error_after, check.lag_after, style.AFTER, "after"),
    ):
        inside = [_inside(check, band) for band in check.excited]
        rms = [np.sqrt(np.mean(errors[k] ** 2)) / NANOMETRE_M for k in inside]
        lag = [np.mean(lags[k]) / DEGREE_RAD for k in inside]
        axes[1, 0].plot(middle, rms, "o-", color=colour, markersize=3.5, label=name)
        axes[2, 0].plot(middle, lag, "o-", color=colour, markersize=3.5, label=name)
    axes[2, 0].plot(middle, model_lag / DEGREE_RAD, "--", color=style.TRUTH, label="true response")
    style.label(axes[1, 0], x="frequency [Hz]", y="nm rms", title="Amplitude error by frequency")
    style.label(axes[2, 0], x="frequency [Hz]", y="degrees", title="Phase lag (Hilbert)")
    for one in axes[1:, 0]:
        style.legend_above(one)
    return made


def _inside(check: PathCheck, band: tuple[float, float]) -> np.ndarray:
    return np.asarray((check.frequency >= band[0]) & (check.frequency < band[1]))
