"""Figures of a certificate, with captions: the response with its band, the residual, the order.

Every function returns a matplotlib Figure that belongs to the caller; all arguments are SI.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.calibration.certificate import CandidateFit
from omsm_ros.core.estimation.sampled_model import FreeRun, SampledModel
from omsm_ros.core.identification.fitted_record import (
    EdgeMean,
    FittedRecord,
    autocorrelation,
    mean_at_edges,
)
from omsm_ros.core.lti.frequency_response import COVERAGE_FACTOR, FrequencyResponse
from omsm_ros.core.lti.transfer_function import Structure
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.readable import quantity
from omsm_ros.report import style
from omsm_ros.report.response_figures import bode, draw_band, step_response
from omsm_ros.units import DEGREE_RAD, MILLISECOND_S, NANOMETRE_M

_COHERENT = 0.5
# Points on a logarithmic axis: more than these a decade would be a smear.
_POINTS_PER_DECADE = 12
_LAGS = 25
_LIMIT: dict[str, Any] = {"color": style.TRUTH, "linewidth": 0.8, "linestyle": (0, (4, 2))}
_SPAN: dict[str, Any] = {"color": style.AFTER, "alpha": 0.18, "linewidth": 0}
_BEFORE_EDGE_S, _AFTER_EDGE_S = 30e-3, 60e-3

BAND = "band"
CAPTIONS = {
    BAND: (
        "Gain, phase, and the error of a sinusoidal motion before and after the correction. "
        "Grey: outside of the valid range."
    ),
    "step": "The steepest move: input, output, and the residual of the model.",
    "residual": (
        "The residual over the whole recording, its mean over all edges (downward ones inverted), "
        "and its autocorrelation."
    ),
    "order": ("Each candidate is a structure that was fitted to the same samples."),
}
RECORD, CORRELATION = "record", "correlation"
CAPTIONS_OF_MODEL = {
    BAND: "Gain and phase with their 95 % band. Grey: not known within the limits.",
    RECORD: (
        "The record, and the free run of the model from the input alone; its initial state is "
        "fitted."
    ),
    CORRELATION: "From sample to sample: outside the shade the residual is not white.",
}


def response_with_band(calibration: Calibration, seen: FrequencyResponse | None = None) -> Figure:
    """Draw a Bode plot with its 95 % band, and the points of an estimate without a model."""
    made = bode(calibration, None, calibration.sample_period)
    made.set_size_inches(7.4, 5.45)
    gain, phase, _ = made.get_axes()
    style.label(gain, title="Response")
    if seen is not None:
        _draw_points(gain, phase, thinned(seen))
    style.legend_above(gain)
    if calibration.valid_up_to < gain.get_xlim()[1]:
        phase.annotate(
            quantity(calibration.valid_up_to, "Hz"), (calibration.valid_up_to, 0), (-3, 3),
            ("data", "axes fraction"), "offset points", ha="right", va="bottom",
            fontsize=style.TEXT_PT, color=style.MUTED,
        )  # fmt: skip
    return made


def _draw_points(gain: Axes, phase: Axes, seen: FrequencyResponse) -> None:
    size, spread = np.abs(seen.response), COVERAGE_FACTOR * seen.uncertainty
    angle = np.angle(seen.response) / DEGREE_RAD
    # An angle is known to a whole turn only: on that of the curve.
    curve = np.interp(seen.frequency, *phase.get_lines()[0].get_data())
    angle += 360.0 * np.round((curve - angle) / 360.0)
    look: dict[str, Any] = {
        "fmt": "o", "markersize": 2.6, "color": style.BEFORE, "elinewidth": 0.8, "alpha": 0.8,
    }  # fmt: skip
    # An estimate that scatters far outside must not flatten the identified curve.
    for axes in (gain, phase):
        axes.set_autoscaley_on(False)
    gain.errorbar(seen.frequency, size, size * spread, label="without a model, 95 %", **look)
    phase.errorbar(seen.frequency, angle, spread / DEGREE_RAD, **look)


def thinned(seen: FrequencyResponse) -> FrequencyResponse:
    """Return coherent lines above zero frequency, those close together averaged by their weight."""
    good = (seen.frequency > 0) & (seen.coherence > _COHERENT)
    frequency = seen.frequency[good]
    group = np.floor(_POINTS_PER_DECADE * np.log10(np.maximum(frequency, 1e-12)))
    _, place = np.unique(group, return_inverse=True)
    weight = 1 / np.maximum(seen.uncertainty[good], 1e-9) ** 2
    total = np.bincount(place, weight)

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(place, weight * values) / total)

    response = seen.response[good]
    return FrequencyResponse(
        mean(frequency),
        mean(response.real) + 1j * mean(response.imag),
        mean(seen.coherence[good]),
        1 / np.sqrt(total),
    )


def residual(fitted: FittedRecord, noise: float | None) -> Figure:
    """Draw the residual: over the recording, at the mean edge, and its correlation.

    noise: standard deviation of a reading [m], for comparison, or None
    """
    at_edges = mean_at_edges(fitted, _BEFORE_EDGE_S, _AFTER_EDGE_S)
    made, axes = style.figure(6.1, 5.6, rows=2 + (at_edges is not None))
    _draw_over_time(axes[0], fitted, noise)
    if at_edges is not None:
        _draw_at_edges(axes[1], at_edges, noise)
    draw_correlation(axes[-1], fitted.residual)
    return made


def _draw_over_time(axes: Axes, fitted: FittedRecord, noise: float | None) -> None:
    level = fitted.residual / NANOMETRE_M
    style.draw_envelope(axes, fitted.time, level, style.AFTER, linewidth=0.5)
    if noise is not None:
        for sign in (-1, 1):
            label = "±2 × stationary noise" if sign > 0 else None
            axes.axhline(2 * sign * noise / NANOMETRE_M, label=label, **_LIMIT)
        style.legend_above(axes)
    style.label(axes, x="time [s]", y="residual [nm]", title="Residual")


def _draw_at_edges(axes: Axes, mean: EdgeMean, noise: float | None) -> None:
    time = mean.time / MILLISECOND_S
    if noise is not None:
        bound = COVERAGE_FACTOR * noise / np.sqrt(mean.edges) / NANOMETRE_M
        axes.axhspan(-bound, bound, label="95 % of noise", **_SPAN)
        style.legend_above(axes)
    axes.plot(time, mean.mean / NANOMETRE_M, color=style.AFTER, linewidth=1.2)
    axes.axhline(0.0, color=style.MUTED, linewidth=0.6)
    axes.margins(x=0.01)
    count = f"{mean.edges} edges" if mean.edges > 1 else "one edge"
    style.label(
        axes, x="time since the middle of the edge [ms]", y="residual [nm]",
        title=f"Mean of {count}",
    )  # fmt: skip


def draw_correlation(axes: Axes, left: FloatArray) -> None:
    """Draw the correlation of ``left`` (n,) with itself, without NaN, and white noise's bound."""
    lags = np.arange(1, _LAGS + 1)
    bound = COVERAGE_FACTOR / np.sqrt(max(int(np.sum(np.isfinite(left))), 1))
    axes.axhspan(-bound, bound, label="95 % if white", **_SPAN)
    correlation = autocorrelation(left, _LAGS)
    axes.vlines(lags, 0, correlation, color=style.AFTER, linewidth=1.4)
    axes.plot(lags, correlation, "o", color=style.AFTER, markersize=3)
    axes.axhline(0.0, color=style.MUTED, linewidth=0.6)
    largest = 1.25 * max(float(np.max(np.abs(correlation))), 1.5 * bound)
    axes.set_ylim(-largest, largest)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    style.legend_above(axes)
    style.label(axes, x="lag [samples]", y="correlation [1]", title="Its autocorrelation")


def order(candidates: Sequence[CandidateFit], chosen: Structure | None) -> Figure:
    """Draw the residual of each candidate over its number of parameters."""
    made, (axes,) = style.figure(6.1, 2.7)
    size = np.asarray([c.structure.size for c in candidates])
    rms = np.asarray([c.rms_m for c in candidates]) / NANOMETRE_M
    if rms.max() > 3 * rms.min() > 0:
        style.logarithmic(axes.yaxis, every=(1.0, 2.0, 5.0))
    axes.plot(size, rms, "o", color=style.MUTED, markersize=4, label="tried")
    best = int(np.argmin([c.bic for c in candidates]))
    axes.plot(
        size[best], rms[best], "o", markersize=9, markerfacecolor="none",
        markeredgecolor=style.TRUTH, label="lowest BIC",
    )  # fmt: skip
    for at, candidate in enumerate(candidates):
        if candidate.structure == chosen:
            axes.plot(size[at], rms[at], "o", color=style.AFTER, markersize=6, label="chosen")
            break
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    style.legend_above(axes)
    style.label(axes, x="parameters of the dynamics", y="residual rms [nm]", title="Candidates")
    return made


# Figures of a model between any two sampled quantities, in the units of the record.

_LINES = 400
_LOWEST_SHARE = 1e-3


def response(model: SampledModel) -> Figure:
    """Draw gain and phase to half the sampling rate with their 95 % band; grey: not valid."""
    frequency = np.geomspace(_LOWEST_SHARE, 1.0, _LINES) * 0.5 / model.sections.period
    value, band = model.sections.response(frequency)[0], model.sections.band(frequency)
    made, (upper, lower) = style.figure(7.4, 4.6, rows=2, sharex=True)
    gain, spread = np.abs(value), np.exp(COVERAGE_FACTOR * np.minimum(band.gain, 5.0))
    draw_band(upper, frequency, gain / spread, gain, gain * spread)
    style.logarithmic(upper.yaxis)
    # A band that is open somewhere must not flatten the curve.
    upper.set_ylim(0.3 * float(gain.min()), 3 * float(gain.max()))
    phase = np.unwrap(np.angle(value)) / DEGREE_RAD
    off = COVERAGE_FACTOR * np.minimum(band.phase, np.pi) / DEGREE_RAD
    draw_band(lower, frequency, phase - off, phase, phase + off)
    low, high = model.valid[0]
    for axes_ in (upper, lower):
        style.logarithmic(axes_.xaxis, every=(1.0, 2.0, 5.0))
        axes_.set_xlim(frequency[0], frequency[-1])
        for start, end in ((frequency[0], low), (high, frequency[-1])):
            if end > start:
                axes_.axvspan(start, end, color=style.MISSING, zorder=0)
    style.legend_above(upper)
    style.label(upper, y="gain [output/input]", title="Response")
    style.label(lower, x="frequency [Hz]", y="phase [deg]")
    return made


def record(model: SampledModel, inputs: FloatArray, output: FloatArray, run: FreeRun) -> Figure:
    """Draw the inputs, the output with the free run, and their difference over time."""
    made, (given, both, left) = style.figure(7.4, 6.2, rows=3, sharex=True)
    inputs = inputs.reshape(len(inputs), -1)
    time = model.sections.period * np.arange(len(inputs))
    for column in inputs.T:
        style.draw_envelope(given, time, column, style.MUTED, alpha=0.75)
    style.draw_envelope(both, time, output, style.BEFORE, alpha=0.75, label="measured")
    style.draw_envelope(both, time, run.output, style.AFTER, alpha=0.75, label="free run")
    style.draw_envelope(left, time, run.residual, style.AFTER, alpha=0.75)
    style.legend_above(both)
    style.label(given, y="input", title="Input")
    style.label(both, y="output", title="Output")
    style.label(left, x="time [s]", y="residual", title="Output less free run")
    return made


def certificate_figures_of(calibration: Calibration, fitted: FittedRecord) -> dict[str, bytes]:
    """Return PNG files for the page."""
    certificate = calibration.certificate
    # Matplotlib leaves gaps at NaN, an edge's median does not.
    bridged = np.where(np.isfinite(fitted.output), fitted.output, fitted.modelled)
    made = {
        BAND: response_with_band(calibration, fitted.measured),
        "step": step_response(fitted.time, fitted.input, bridged, fitted.modelled),
        "residual": residual(fitted, certificate.residual.noise_m),
    }
    if certificate.candidates:
        made["order"] = order(certificate.candidates, certificate.structure)
    return {name: style.png(figure) for name, figure in made.items()}


def model_figures_of(
    model: SampledModel, inputs: FloatArray, output: FloatArray, run: FreeRun
) -> dict[str, bytes]:
    """Return PNG files for the page."""
    correlation, axes = style.figure(7.4, 2.6)
    draw_correlation(axes[0], run.residual)
    made = {
        BAND: response(model),
        RECORD: record(model, inputs, output, run),
        CORRELATION: correlation,
    }
    return {name: style.png(figure) for name, figure in made.items()}
