"""The page of a campaign: what stands out, what drifts, and every measurement in a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from typing import Any

import numpy as np

from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.core.verification.trend import FEWEST, Trend, outliers, trend
from omsm_ros.readable import NOTHING, count, percent, quantity
from omsm_ros.report.common import style
from omsm_ros.report.common.tables import part
from omsm_ros.report.common.template import fill, picture
from omsm_ros.report.common.verdict import verdict_on_measurement
from omsm_ros.units import NANOMETRE_M, NANOSECONDS_PER_S

_DAY_S = 86_400.0


@dataclass(frozen=True, slots=True)
class Series:
    """A number that each measurement has: its name, and where its summary holds it [m]."""

    name: str
    place: tuple[str, ...]


SERIES = (
    Series("Deviation from nominal, rms by area", ("deviation", "corrected", "rms_area_weighted")),
    Series("Deviation, peak to valley", ("deviation", "corrected", "peak_to_valley")),
    Series("Dynamic error removed, rms", ("dynamic_error_before", "rms")),
    Series("Standard uncertainty, median", ("uncertainty", "median")),
    Series("Scatter beyond what is stated, rms", ("uncertainty_budget", "scan_scatter")),
)


@dataclass(frozen=True, slots=True)
class Measurement:
    """One bag of a campaign: its name, state, time [ns], link, and what its summary says.

    said: why there is no summary, if there is none
    """

    name: str
    state: str
    said: str
    recorded_ns: int | None
    link: str
    summary: Mapping[str, Any]


def render(title: str, measurements: Sequence[Measurement], calibration: Calibration) -> str:
    """Return the page as HTML; all text from outside is escaped."""
    judged = judge(measurements)
    return fill(
        "campaign.html",
        title=title,
        headlines=_headlines(measurements),
        remarks=remarks(measurements, judged),
        figure=picture(_figure(measurements, judged)) if judged else "",
        names=[series.name for series in SERIES],
        rows=[_row(i, m, judged, calibration) for i, m in enumerate(measurements)],
        calibration=calibration.id,
    )


@dataclass(frozen=True, slots=True)
class Judged:
    """A series over all measurements: values (n,) [m], which stand out (n,), how it drifts."""

    series: Series
    values: FloatArray
    outlying: Any
    drift: Trend | None


def judge(measurements: Sequence[Measurement]) -> list[Judged]:
    """Look for outliers and drift in each series that any measurement has."""
    times = _times(measurements)
    found = []
    for series in SERIES:
        values = np.array([_value(m, series) for m in measurements])
        if np.any(np.isfinite(values)):
            found.append(Judged(series, values, outliers(values), trend(times, values)))
    return found


def remarks(measurements: Sequence[Measurement], judged: Sequence[Judged]) -> list[str]:
    """Say what failed, what stands out and what drifts, each in a sentence."""
    found = [f"{m.name}: {m.state}, {m.said}" for m in measurements if m.state != "done"]
    for one in judged:
        for i in np.flatnonzero(one.outlying):
            usual = quantity(float(np.nanmedian(one.values)), "m")
            value = quantity(float(one.values[i]), "m")
            found.append(
                f"{measurements[i].name} stands out: {_low(one.series.name)} is {value}, where "
                f"{usual} is usual"
            )
        if one.drift is not None and one.drift.significant:
            low, high = (quantity(s * _DAY_S, "m") for s in (one.drift.low, one.drift.high))
            found.append(f"{one.series.name} drifts by {low} to {high} a day (95 %)")
    if sum(m.state == "done" for m in measurements) < FEWEST:
        found.append(f"outliers and drift: not evaluated, of fewer than {FEWEST} measurements")
    return found


def _low(name: str) -> str:
    return name[0].lower() + name[1:]


def _value(measurement: Measurement, series: Series) -> float:
    value = part(measurement.summary, *series.place)
    return float(value) if isinstance(value, int | float) else np.nan


def _times(measurements: Sequence[Measurement]) -> FloatArray:
    """Return the time of each recording [s], NaN where it has none."""
    unknown = np.nan
    return np.array(
        [
            unknown if m.recorded_ns is None else m.recorded_ns / NANOSECONDS_PER_S
            for m in measurements
        ]
    )


def _headlines(measurements: Sequence[Measurement]) -> list[tuple[str, str]]:
    states = [m.state for m in measurements]
    return [(state, count(states.count(state))) for state in ("done", "refused", "crashed")]


def _row(
    place: int, measurement: Measurement, judged: Sequence[Judged], calibration: Calibration
) -> dict[str, Any]:
    known = {one.series: one for one in judged}
    cells = []
    for series in SERIES:
        one = known.get(series)
        text = NOTHING if one is None else quantity(float(one.values[place]), "m")
        cells.append((text, one is not None and bool(one.outlying[place])))
    verdict = None
    if measurement.state == "done":
        verdict = verdict_on_measurement(measurement.summary, calibration)
    stream = part(measurement.summary, "samples", "distance") or {}
    received, corrected = stream.get("received", 0), stream.get("corrected", 0)
    return {
        "name": measurement.name,
        "link": measurement.link,
        "when": _date(measurement.recorded_ns),
        "verdict": verdict,
        "said": measurement.said,
        "state": measurement.state,
        "points": count(corrected) if received else NOTHING,
        "left_out": percent(1 - corrected / received) if received else NOTHING,
        "cells": cells,
    }


def _date(stamp_ns: int | None) -> str:
    if stamp_ns is None:
        return NOTHING
    when = datetime.fromtimestamp(stamp_ns / NANOSECONDS_PER_S, tz=timezone.utc)
    return f"{when:%Y-%m-%d %H:%M}"


def _figure(measurements: Sequence[Measurement], judged: Sequence[Judged]) -> bytes:
    """Return each series over time, or over the order of names where no time is known."""
    times = _times(measurements)
    timed = np.any(np.isfinite(times)) and np.nanmax(times) > np.nanmin(times)
    x = (times - np.nanmin(times)) / _DAY_S if timed else np.arange(len(measurements))
    made, axes = style.figure(10.0, 2.1 * len(judged) + 0.5, rows=len(judged), sharex=True)
    for one, panel in zip(judged, axes[:, 0], strict=True):
        usual = ~one.outlying
        panel.plot(x[usual], one.values[usual] / NANOMETRE_M, ".", color=style.AFTER, markersize=5)
        panel.plot(x[one.outlying], one.values[one.outlying] / NANOMETRE_M, "o", color=style.BEFORE)
        # A twentieth more than the largest, so that its dot is whole.
        panel.set_ylim(0, 1.05 * (float(np.nanmax(one.values)) / NANOMETRE_M or 1.0))
        if not timed:
            panel.xaxis.get_major_locator().set_params(integer=True)
        style.label(panel, y="nm", title=one.series.name)
    style.label(axes[-1, 0], x="days since the first recording" if timed else "measurement")
    return style.png(made, dpi=120)
