"""The page of a campaign: outliers, drift, and a table of all measurements."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.calibration.repeatability import FEWEST, LinearTrend, outliers, trend
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.readable import NOTHING, count, date_text_of_stamp, days, percent, quantity
from omsm_ros.report import style
from omsm_ros.report.page_parts import fill, picture
from omsm_ros.report.tables import part
from omsm_ros.report.verdict import verdict_on_measurement
from omsm_ros.units import DAY_S, MICROSECOND_S, NANOMETRE_M, NANOSECONDS_PER_S

# Relative differences that three digits do not show are not reported.
_VISIBLE_CHANGE = 0.005
# Names that fit on the axis of a figure without times, and their last characters.
_MOST_NAMES, _LONGEST_NAME = 6, 20


@dataclass(frozen=True, slots=True)
class Series:
    """A quantity of each measurement.

    place: path to its value in the summary;  judged: True to test it for outliers and drift
    """

    name: str
    place: tuple[str, ...]
    unit: str = "m"
    judged: bool = True

    @property
    def drawn(self) -> tuple[float, str]:
        """Unit of the figure in units of the summary, and its name."""
        return {"m": (NANOMETRE_M, "nm"), "s": (DAY_S, "d")}.get(self.unit, (1.0, self.unit))

    def formatted(self, value: float) -> str:
        """Return a value as text."""
        return days(value) if self.unit == "s" else quantity(value, self.unit)


TEMPERATURE = Series("Temperature", ("conditions", "temperature", "mean"), "°C")
SERIES = (
    Series("Form deviation, rms", ("figures", "rms", "value")),
    Series("u of the rms (k = 1)", ("figures", "rms", "standard_uncertainty"), judged=False),
    Series("Form deviation, PV", ("figures", "peak_to_valley", "value")),
    Series(
        "u of the PV (k = 1)", ("figures", "peak_to_valley", "standard_uncertainty"), judged=False
    ),
    Series("Dynamic error removed, rms", ("dynamic_error_before", "rms")),
    Series("Standard uncertainty, median", ("uncertainty", "median")),
    Series("Scatter beyond what is stated, rms", ("uncertainty_budget", "scan_scatter")),
    TEMPERATURE,
    # The age always increases, so it is not tested.
    Series("Age of the calibration", ("conditions", "calibration_age"), "s", judged=False),
)


@dataclass(frozen=True, slots=True)
class CampaignEntry:
    """One bag of a campaign: name, state, time [ns], link to its report, and summary.

    said: why there is no summary; empty if there is one
    """

    name: str
    state: str
    said: str
    recorded_ns: int | None
    link: str
    summary: Mapping[str, Any]


def render(title: str, measurements: Sequence[CampaignEntry], calibration: Calibration) -> str:
    """Return the page as HTML; all text from outside is escaped."""
    judged, states = judge(measurements), [m.state for m in measurements]
    return fill(
        "campaign.html",
        title=title,
        headlines=[(s, count(states.count(s))) for s in ("done", "refused", "crashed")],
        remarks=remarks(measurements, judged),
        figure=picture(_figure(measurements, judged)) if judged else "",
        names=[series.name for series in SERIES],
        rows=[_row(i, m, judged) for i, m in enumerate(measurements)],
        calibration=calibration.id,
    )


@dataclass(frozen=True, slots=True)
class JudgedSeries:
    """A series over all measurements: values (n,), outliers (n,) and drift."""

    series: Series
    values: FloatArray
    outlying: Any
    drift: LinearTrend | None


def judge(measurements: Sequence[CampaignEntry]) -> list[JudgedSeries]:
    """Test each series that any measurement has for outliers and drift."""
    times = _times(measurements)
    found = []
    for series in SERIES:
        stated = [part(m.summary, *series.place) for m in measurements]
        values = np.array([v if isinstance(v, int | float) else np.nan for v in stated], float)
        if np.any(np.isfinite(values)):
            drift = trend(times, values) if series.judged else None
            usual = np.nanmedian(values)
            differs = np.abs(values - usual) > _VISIBLE_CHANGE * abs(usual)
            outlying = outliers(values) & differs & series.judged
            found.append(JudgedSeries(series, values, outlying, _seen(drift, times, values)))
    return found


def _seen(slope: LinearTrend | None, over: FloatArray, values: FloatArray) -> LinearTrend | None:
    """Return the trend if its change over all measurements is visible at three digits."""
    if slope is None:
        return None
    change = slope.slope * np.ptp(over[np.isfinite(over)])
    return slope if abs(change) > _VISIBLE_CHANGE * abs(np.nanmedian(values)) else None


def remarks(measurements: Sequence[CampaignEntry], judged: Sequence[JudgedSeries]) -> list[str]:
    """Return failures, outliers and drifts, each as a sentence."""
    found = [f"{m.name}: {m.state}, {m.said}" for m in measurements if m.state != "done"]
    for one in judged:
        for i in np.flatnonzero(one.outlying):
            usual = one.series.formatted(float(np.nanmedian(one.values)))
            value = one.series.formatted(float(one.values[i]))
            name = one.series.name[0].lower() + one.series.name[1:]
            found.append(
                f"{measurements[i].name} is an outlier: {name} is {value}, the median is {usual}"
            )
        if one.drift is not None and one.drift.significant:
            unit = "K" if one.series is TEMPERATURE else one.series.unit
            low, high = (quantity(s * DAY_S, unit) for s in (one.drift.low, one.drift.high))
            found.append(f"{one.series.name} drifts by {low} to {high} per day (95 %)")
    warm = next((one.values for one in judged if one.series is TEMPERATURE), None)
    for one in judged:
        if warm is None or one.series is TEMPERATURE or not one.series.judged:
            continue
        slope = _seen(trend(warm, one.values), warm, one.values)
        if slope is not None and slope.significant:
            low, high = (quantity(s, one.series.unit) for s in (slope.low, slope.high))
            found.append(
                f"{one.series.name} depends on the temperature, {low} to {high} per kelvin (95 %)"
            )
    if sum(m.state == "done" for m in measurements) < FEWEST:
        found.append(f"outliers and drift: not evaluated, fewer than {FEWEST} measurements")
    return found


def _times(measurements: Sequence[CampaignEntry]) -> FloatArray:
    """Return the time of each recording [s], NaN if unknown."""
    return np.array([m.recorded_ns for m in measurements], np.float64) / NANOSECONDS_PER_S


def _row(place: int, measurement: CampaignEntry, judged: Sequence[JudgedSeries]) -> dict[str, Any]:
    known = {one.series: one for one in judged}
    cells = []
    for series in SERIES:
        one = known.get(series)
        text = NOTHING if one is None else series.formatted(float(one.values[place]))
        cells.append((text, one is not None and bool(one.outlying[place])))
    verdict = None
    if measurement.state == "done":
        verdict = verdict_on_measurement(measurement.summary)
    stream = part(measurement.summary, "samples", "distance") or {}
    received, corrected = stream.get("received", 0), stream.get("corrected", 0)
    return {
        "name": measurement.name,
        "link": measurement.link,
        "when": date_text_of_stamp(measurement.recorded_ns),
        "verdict": verdict,
        "said": measurement.said,
        "state": measurement.state,
        "points": count(corrected) if received else NOTHING,
        "left_out": percent(1 - corrected / received) if received else NOTHING,
        "cells": cells,
    }


def _figure(measurements: Sequence[CampaignEntry], judged: Sequence[JudgedSeries]) -> bytes:
    """Draw each series over time, or over the names of the bags if times are unknown."""
    times = _times(measurements)
    timed = np.any(np.isfinite(times)) and np.nanmax(times) > np.nanmin(times)
    x = (times - np.nanmin(times)) / DAY_S if timed else np.arange(len(measurements))
    made, axes = style.figure(10.0, 2.1 * len(judged) + 0.5, rows=len(judged), sharex=True)
    for one, panel in zip(judged, axes, strict=True):
        usual = ~one.outlying
        per_unit, unit = one.series.drawn
        values = one.values / per_unit
        panel.plot(x[usual], values[usual], ".", color=style.AFTER, markersize=5)
        panel.plot(x[one.outlying], values[one.outlying], "o", color=style.BEFORE)
        if one.series is not TEMPERATURE:
            # 5 % above the largest value, so that its dot is not clipped.
            panel.set_ylim(
                min(0.0, float(np.nanmin(values))), 1.05 * (float(np.nanmax(values)) or 1.0)
            )
        style.label(panel, y=unit, title=one.series.name)
    style.label(axes[-1], x="days since the first recording" if timed else "")
    if not timed:
        shown = range(0, len(measurements), 1 + (len(measurements) - 1) // _MOST_NAMES)
        names = [style.named(measurements[i].name)[-_LONGEST_NAME:] for i in shown]
        axes[-1].set_xticks(shown, names)
    return style.png(made, dpi=120)


_COLOURS = (style.AFTER, style.BEFORE, "#009E73", "#CC79A7", "#E69F00", "#56B4E9")


def draw(machines: Sequence[Mapping[str, Any]]) -> bytes:
    """Draw lag, gain and form over time (PNG), a colour per machine; crosses are rejected."""
    made, (lag, gain, form) = style.figure(10.0, 7.0, rows=3, sharex=True)
    for i, machine in enumerate(machines):
        colour = _COLOURS[i % len(_COLOURS)]
        for rejected, mark in ((False, "o"), (True, "x")):
            rows = [r for r in machine["calibrations"] if (r["verdict"] == "rejected") == rejected]
            _points(lag, rows, "delay", "delay_uncertainty", MICROSECOND_S, colour, mark)
            _points(gain, rows, "static_gain", "static_gain_uncertainty", 1.0, colour, mark)
        rms, spread = "deviation_rms", "deviation_rms_uncertainty"
        _points(form, machine["measurements"], rms, spread, NANOMETRE_M, colour, ".")
        lag.plot([], [], "o", color=colour, label=style.named(machine["machine"]) or "not named")
    style.label(lag, y="µs", title="Low-frequency delay, k = 2")
    style.label(gain, title="Static gain, k = 2")
    style.label(form, y="nm", title="Form deviation, rms, k = 2", x="recorded (UTC)")
    bare = [panel for panel in made.axes if not panel.containers]
    for panel in bare:
        panel.set_yticks([])
        panel.text(0.5, 0.5, "none recorded", transform=panel.transAxes, ha="center")
    if len(bare) == len(made.axes):
        form.set_xticks([])  # without a date the axis would begin in 1970
    else:
        locator = AutoDateLocator()
        form.xaxis.set(major_locator=locator, major_formatter=ConciseDateFormatter(locator))
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
    bars = np.array([2 * (row[spread] or 0.0) / unit for row in known])
    panel.errorbar(when, values, bars, fmt=mark, color=colour, markersize=4, linewidth=0.8)
