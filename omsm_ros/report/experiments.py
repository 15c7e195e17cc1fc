"""Report of one of the paper's experiments: results of the paper and of the twin, with figures."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from omsm_ros.core.ripple.density import density
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.readable import count, plain, quantity
from omsm_ros.report import style
from omsm_ros.report.page_parts import Section, fill_study
from omsm_ros.report.tables import Table
from omsm_ros.report.verdict import PageVerdict


class Compared(NamedTuple):
    """A figure of the paper and of the twin as text, their ratio ours : paper, and a remark."""

    name: str
    paper: str
    ours: str
    ratio: str = ""
    remark: str = ""


def compared(
    name: str, paper: str, value: float | None, ours: float | None, unit: str, remark: str = ""
) -> Compared:
    """Return a row with its ratio; ``value``: the paper's figure in SI units, None if it has none.

    unit: of both, empty for a count
    """
    text = count(round(ours)) if not unit and ours is not None else quantity(ours, unit, 4)
    ratio = plain(ours / value, 3) if value and ours is not None else ""
    return Compared(name, paper, text, ratio, remark)


class Done(NamedTuple):
    """Facts of an experiment, its rows against the paper, and its page."""

    facts: dict[str, Any]
    rows: Sequence[Compared]
    page: str


def done(
    title: str, summary: str, rows: Sequence[Compared], facts: dict[str, Any],
    figures: Mapping[str, tuple[str, bytes | Figure]], tables: tuple[Table, ...] = (),
    narrow: tuple[str, ...] = (),
) -> Done:  # fmt: skip
    """Return an experiment with its page; ``figures``: caption, and PNG or figure, by name."""
    first = Table("", ("the paper", "the twin", "ratio", "remark"), rows, prose="remark")
    page = fill_study(
        title=title,
        subtitle="on the digital twin",
        verdict=PageVerdict("neutral", "Result", (summary,)),
        sections=(
            Section("Comparison with the paper", tables=(first,)),
            Section("Measured", tuple(figures), tables),
        ),
        captions={name: caption for name, (caption, _) in figures.items()},
        figures={
            n: made if isinstance(made, bytes) else style.png(made)
            for n, (_, made) in figures.items()
        },
        narrow=narrow,
        footer="Light: Advanced Manufacturing 2025, doi 10.37188/lam.2025.078. The twin has "
        "the dynamics of the paper's Eq. 12, corrected for a missing s.",
    )
    return Done(facts, rows, page)


def psd(values: FloatArray, period: float) -> tuple[FloatArray, FloatArray]:
    """Return frequency [Hz] and power spectral density of ``values`` every ``period`` [s]."""
    found = density(values - values.mean(), period)
    return found.frequency[1:], found.density[1:]
