"""Lag, static gain and form of each machine over months."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter

from omsm_ros.report.common import style
from omsm_ros.units import MICROSECOND_S, NANOMETRE_M

_COLOURS = (style.AFTER, style.BEFORE, "#009E73", "#CC79A7", "#E69F00", "#56B4E9")


class History(Protocol):
    """A machine and its rows of the catalogue."""

    machine: str
    calibrations: list[dict[str, Any]]
    measurements: list[dict[str, Any]]


def draw(machines: Sequence[History]) -> bytes:
    """Return a figure (PNG) with one colour a machine; rejected calibrations as crosses."""
    made, axes = style.figure(10.0, 7.0, rows=3)
    lag, gain, form = axes[:, 0]
    for i, machine in enumerate(machines):
        colour = _COLOURS[i % len(_COLOURS)]
        for rejected, mark in ((False, "o"), (True, "x")):
            rows = [r for r in machine.calibrations if (r["verdict"] == "rejected") == rejected]
            _points(lag, rows, "delay", "delay_uncertainty", MICROSECOND_S, colour, mark)
            _points(gain, rows, "static_gain", "static_gain_uncertainty", 1.0, colour, mark)
        _points(form, machine.measurements, "deviation_rms", "", NANOMETRE_M, colour, ".")
        lag.plot([], [], "o", color=colour, label=style.named(machine.machine) or "not named")
    style.label(lag, y="µs", title="Lag of slow motion, k = 2")
    style.label(gain, title="Static gain, k = 2")
    style.label(form, y="nm", title="Deviation from nominal, rms by area", x="recorded (UTC)")
    for panel in (lag, gain, form):
        locator = AutoDateLocator()
        panel.xaxis.set_major_locator(locator)
        panel.xaxis.set_major_formatter(ConciseDateFormatter(locator))
    if machines:
        style.legend_above(lag)
    return style.png(made, dpi=120)


def _points(
    panel: Any, rows: Sequence[Mapping[str, Any]], name: str, spread: str, unit: float,
    colour: str, mark: str,
) -> None:  # fmt: skip
    known = [row for row in rows if row[name] is not None]
    if not known:
        return
    when = [row["recorded_at"] or row["added_at"] for row in known]
    values = np.array([row[name] for row in known]) / unit
    bars = np.array([2 * (row[spread] or 0.0) / unit for row in known]) if spread else None
    panel.errorbar(when, values, bars, fmt=mark, color=colour, markersize=4, linewidth=0.8)
