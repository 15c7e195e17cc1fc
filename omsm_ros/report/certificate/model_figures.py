"""Figures of a model between any two sampled quantities, in the units of the record."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from omsm_ros.core.dynamics.response_band import COVERAGE_FACTOR, Band, response_band
from omsm_ros.core.dynamics.transfer_function import ComplexArray
from omsm_ros.core.sampled.free_run import FreeRun
from omsm_ros.core.sampled.model import SampledModel
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.report.certificate.figures import draw_correlation
from omsm_ros.report.common import style
from omsm_ros.units import DEGREE_RAD

_LINES = 400
_LOWEST_SHARE = 1e-3
_SPAN: dict[str, Any] = {"color": style.AFTER, "alpha": 0.22, "linewidth": 0, "label": "95 % band"}


def response(model: SampledModel) -> Figure:
    """Draw gain and phase to half the sampling rate with their 95 % band; grey: not trusted."""
    frequency = np.geomspace(_LOWEST_SHARE, 1.0, _LINES) * 0.5 / model.sample_period
    value, band = response_of(model, frequency)
    made, axes = style.figure(7.4, 4.6, rows=2, sharex=True)
    upper, lower = axes[:, 0]
    gain, spread = np.abs(value), np.exp(COVERAGE_FACTOR * np.minimum(band.gain, 5.0))
    upper.fill_between(frequency, gain / spread, gain * spread, **_SPAN)
    upper.plot(frequency, gain, color=style.AFTER, linewidth=1.6, label="identified")
    style.logarithmic(upper.yaxis)
    # A band that is open somewhere must not flatten the curve.
    upper.set_ylim(0.3 * float(gain.min()), 3 * float(gain.max()))
    phase = np.unwrap(np.angle(value)) / DEGREE_RAD
    off = COVERAGE_FACTOR * np.minimum(band.phase, np.pi) / DEGREE_RAD
    lower.fill_between(frequency, phase - off, phase + off, **_SPAN)
    lower.plot(frequency, phase, color=style.AFTER, linewidth=1.6)
    for axes_ in (upper, lower):
        style.logarithmic(axes_.xaxis, every=(1.0, 2.0, 5.0))
        axes_.set_xlim(frequency[0], frequency[-1])
        for low, high in ((frequency[0], model.valid_from), (model.valid_up_to, frequency[-1])):
            if high > low:
                axes_.axvspan(low, high, color=style.MISSING, zorder=0)
    style.legend_above(upper)
    style.label(upper, y="gain [output/input]", title="Response")
    style.label(lower, x="frequency [Hz]", y="phase [deg]")
    return made


def response_of(model: SampledModel, frequency: FloatArray) -> tuple[ComplexArray, Band]:
    """Return the response of the model at ``frequency`` (k,) [Hz], and its band."""
    if model.discrete is not None:
        period = model.sample_period
        return model.discrete.response(frequency, period), model.discrete.band(frequency, period)
    assert model.continuous is not None  # a band-limited model has both
    assert model.covariance is not None
    return (
        model.continuous.response(frequency),
        response_band(model.continuous, model.covariance, frequency),
    )


def record(model: SampledModel, input: FloatArray, output: FloatArray, run: FreeRun) -> Figure:
    """Draw input, output beside the free run, and their difference over time."""
    made, axes = style.figure(7.4, 6.2, rows=3, sharex=True)
    given, both, left = axes[:, 0]
    time = model.sample_period * np.arange(len(input))
    _draw(given, time, input, style.MUTED, "input")
    _draw(both, time, output, style.BEFORE, "measured")
    _draw(both, time, run.output, style.AFTER, "free run")
    _draw(left, time, run.residual, style.AFTER, "")
    style.legend_above(both)
    style.label(given, y="input", title="Input")
    style.label(both, y="output", title="Output")
    style.label(left, x="time [s]", y="residual", title="Output less free run")
    return made


def _draw(axes: Axes, time: FloatArray, value: FloatArray, colour: str, label: str) -> None:
    known = np.isfinite(value)
    at, low, high = style.envelope(time[known], value[known])
    axes.fill_between(at, low, high, color=colour, linewidth=0.6, alpha=0.75, label=label or None)
    axes.margins(x=0.01)


def correlation(run: FreeRun) -> Figure:
    """Draw the autocorrelation of the residual."""
    made, axes = style.figure(7.4, 2.6)
    draw_correlation(axes[0, 0], run.residual)
    return made
