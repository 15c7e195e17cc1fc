"""Figures of the identified dynamics: Bode plot and step response."""

from typing import Any, Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.lti.frequency_response import COVERAGE_FACTOR, response_band
from omsm_ros.core.lti.transfer_function import ComplexArray
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.report import style
from omsm_ros.units import DEGREE_RAD, MICROMETRE_M, MILLISECOND_S, NANOMETRE_M

_LOWEST_HZ = 0.1
# Limits the half width of the band in log gain, so that exp() does not overflow.
_WIDEST = 100.0
_NM_PER_UM = MICROMETRE_M / NANOMETRE_M
_SMALLEST_SHOWN_NM_PER_UM = 1e-4


class HasResponse(Protocol):
    """A system with a frequency response: a transfer function, the true response of the twin."""

    def response(self, frequency: FloatArray) -> ComplexArray:
        """Return G at ``frequency`` (n,) [Hz]."""
        ...


def bode(identified: Calibration, true: HasResponse | None, sample_period: float) -> Figure:
    """Draw gain and phase [deg], and the error of a motion before and after the correction.

    true: the twin's G_m, None if unknown
    sample_period: of the scan that is corrected [s]; its Nyquist frequency ends the axes
    """
    frequency = np.geomspace(_LOWEST_HZ, 0.5 / sample_period, 600)
    made, (gain, phase, error) = style.figure(
        6.1, 5.6, rows=3, sharex=True, height_ratios=(1, 1, 1.15)
    )
    draw_response(gain, phase, frequency, identified, true)
    _draw_error(error, frequency, identified, true)
    return made


def draw_response(
    gain: Axes, phase: Axes, frequency: FloatArray, identified: Calibration,
    true: HasResponse | None,
) -> None:  # fmt: skip
    """Draw |G_m| and its phase [deg] over ``frequency`` (n,) [Hz], each with its 95 % band."""
    fitted = identified.dynamics.response(frequency)
    band = response_band(identified.dynamics, identified.covariance, frequency)
    size, spread = np.abs(fitted), np.exp(np.minimum(COVERAGE_FACTOR * band.gain, _WIDEST))
    draw_band(gain, frequency, size / spread, size, size * spread)
    angle, off = _degrees(fitted), COVERAGE_FACTOR * band.phase / DEGREE_RAD
    draw_band(phase, frequency, angle - off, angle, angle + off)
    drawn = size
    if true is not None:
        known = true.response(frequency)
        look: dict[str, Any] = {"color": style.TRUTH, "linewidth": 1.0, "label": "true"}
        for ax, value in ((gain, np.abs(known)), (phase, _degrees(known))):
            ax.plot(frequency, value, linestyle=(0, (4, 2.5)), **look)
        drawn = np.append(size, np.abs(known))
    for ax, values, least in ((gain, drawn, 0.02), (phase, angle, 1.0)):
        _frequency_axis(ax, frequency, identified)
        room = 0.12 * max(float(np.ptp(values)), least)
        ax.set_ylim(values.min() - room, values.max() + room)
    if identified.valid_up_to < frequency[-1]:
        gain.annotate(
            "not valid", (1, 1), (-4, -4), "axes fraction", "offset points", ha="right",
            va="top", fontsize=style.TEXT_PT - 1, color=style.MUTED,
        )  # fmt: skip
    # The curve starts at 1, so the legend goes to the side with less of the curve.
    style.legend(gain, loc="upper left" if drawn.max() - 1 > 1 - drawn.min() else "lower left")
    style.label(gain, y="gain [1]", title="Response of the probe to the axis")
    style.label(phase, y="phase [deg]")


def _degrees(response: ComplexArray) -> FloatArray:
    return np.asarray(np.unwrap(np.angle(response)) / DEGREE_RAD)


def _draw_error(
    axes: Axes, frequency: FloatArray, identified: Calibration, true: HasResponse | None
) -> None:
    fitted = identified.dynamics.response(frequency)
    reference = fitted if true is None else true.response(frequency)
    band = response_band(identified.dynamics, identified.covariance, frequency)

    def shown(error: FloatArray) -> FloatArray:
        return np.maximum(error * _NM_PER_UM, _SMALLEST_SHOWN_NM_PER_UM)

    before = shown(np.abs(1 - reference))
    style.logarithmic(axes.yaxis)
    axes.plot(frequency, before, color=style.BEFORE, linewidth=1.4, label="uncorrected")
    bound = COVERAGE_FACTOR * np.hypot(band.gain, band.phase) * np.abs(fitted)
    if np.any(bound > 0):
        floor = np.full_like(frequency, _SMALLEST_SHOWN_NM_PER_UM)
        look: dict[str, Any] = {"color": style.AFTER, "alpha": 0.18, "linewidth": 0}
        label = "corrected, 95 % bound"
        axes.fill_between(frequency, floor, shown(bound), label=label, **look)
    if true is not None:
        rest = shown(np.abs(fitted - reference))
        axes.plot(frequency, rest, color=style.AFTER, linewidth=1.4, label="corrected, true")
    axes.set_ylim(_SMALLEST_SHOWN_NM_PER_UM, max(before.max() * 3, 1.0))
    _frequency_axis(axes, frequency, identified)
    style.legend_above(axes)
    style.label(axes, x="frequency of the motion [Hz]", y="error per motion [nm/µm]")


def draw_band(
    axes: Axes, frequency: FloatArray, low: FloatArray, middle: FloatArray, high: FloatArray
) -> None:
    """Draw a curve (n,) over frequency [Hz], and its band if there is any."""
    if np.any(high > low):
        axes.fill_between(
            frequency, low, high, color=style.AFTER, alpha=0.22, linewidth=0, label="95 % band"
        )
    axes.plot(frequency, middle, color=style.AFTER, linewidth=1.6, label="identified")


def _frequency_axis(axes: Axes, frequency: FloatArray, identified: Calibration) -> None:
    style.logarithmic(axes.xaxis, every=(1.0, 2.0, 5.0))
    axes.set_xlim(frequency[0], frequency[-1])
    if identified.valid_up_to < frequency[-1]:
        axes.axvspan(identified.valid_up_to, frequency[-1], color=style.MISSING, zorder=0)
        axes.axvline(identified.valid_up_to, color=style.MUTED, linewidth=0.8, linestyle=":")


def step_response(
    time: FloatArray, encoder: FloatArray, probe: FloatArray, predicted: FloatArray | None = None
) -> Figure:
    """Draw the steepest edge of a step test, the probe's motion, and their difference.

    Each array is of shape (n,), positions in [m].

    time: [s];  encoder: position of the axis
    probe: motion by the probe, -distance / static gain on a fixed target, with any offset
    predicted: encoder through the identified G_m
    """
    speed = np.abs(np.diff(encoder))
    middle = int(np.argmax(speed > 0.9 * speed.max()))
    period = float(np.median(np.diff(time)))
    before, after = round(30 * MILLISECOND_S / period), round(60 * MILLISECOND_S / period)
    window = slice(max(middle - before, 0), middle + after)
    made, (upper, lower) = style.figure(6.1, 5.6, rows=2, sharex=True, height_ratios=(1.25, 1))
    edge = encoder[window]
    begin = int(np.argmax(np.abs(edge - edge[0]) > 0.01 * np.ptp(edge)))
    since = (time[window] - time[window][begin]) / MILLISECOND_S
    seen = probe[window] - np.median(probe[window] - edge)

    def draw(where: Axes, value: FloatArray, colour: str, text: str, line: Any = "-") -> None:
        where.plot(since, value, color=colour, linewidth=1.3, linestyle=line, label=text)

    draw(upper, (edge - edge[0]) / MICROMETRE_M, style.MUTED, "axis (encoder)")
    draw(upper, (seen - edge[0]) / MICROMETRE_M, style.BEFORE, "probe")
    draw(lower, (seen - edge) / NANOMETRE_M, style.BEFORE, "probe − axis")
    if predicted is not None:
        model, name = predicted[window], "axis through $G_m$"
        draw(upper, (model - edge[0]) / MICROMETRE_M, style.AFTER, name, (0, (3, 2)))
        draw(lower, (seen - model) / NANOMETRE_M, style.AFTER, f"probe − {name}")
    style.label(upper, y="motion [µm]", title="Steepest move")
    style.label(lower, x="time since it began [ms]", y="error [nm]")
    style.legend_above(upper)
    style.legend_above(lower)
    return made
