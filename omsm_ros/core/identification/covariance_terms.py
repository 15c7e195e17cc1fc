"""What makes the response less certain than the noise of the probe does?

A term is a source of error that the data cannot show. It adds to the covariance of the
coefficients, and its finding stands in the certificate. To add one, write a function of the same
signature as :func:`inter_sample_motion` and append it to :data:`COVARIANCE_TERMS`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from omsm_ros.core.calibration.finding import Finding
from omsm_ros.core.estimation.covariance import inter_sample_motion_covariance
from omsm_ros.core.estimation.output_error import Fit
from omsm_ros.core.estimation.preparation import Prepared
from omsm_ros.core.estimation.steps import LEAST_SAMPLES, Steps
from omsm_ros.core.lti.frequency_response import low_frequency_delay_uncertainty
from omsm_ros.core.model_errors.residual_diagnostics import (
    FALSE_ALARM,
    HALVES,
    SIZES,
    UP_DOWN,
    Contrast,
    ResidualDiagnostics,
    contrasts,
)
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.streams.motion_record import MotionRecord
from omsm_ros.linear_algebra import unit_columns
from omsm_ros.readable import p_value_text, percent, quantity

# Bound the bias of the lag from motion that an edge hides between samples.
#
# Motion beyond half the sampling rate folds into the samples. Edges locked to the sample clock fold
# alike every time: the fit then finds a lag that is not there, with white residuals. The data
# cannot show it, but the encoder's content near half the sampling rate bounds it.

# How much stronger than the motion itself the probe may answer beyond half the rate.
_GREATEST_GAIN_BEYOND = 5.0
# Band of the encoder's spectrum, in parts of the sampling rate, from which to extrapolate.
_TOP_BAND = (0.35, 0.5)
# Of rest beside an edge: it begins and ends at nothing, so that its spectrum has no leakage.
_MARGIN_SAMPLES = 20


def inter_sample_delay_bound(motion: FloatArray, steps: Steps, sample_period: float) -> float:
    """Return a bound on the bias of the low-frequency delay [s] by motion hidden between samples.

    With U the spectrum of an edge of height A, what folds onto low frequencies is U at the
    sampling rate on both sides, so the lag shifts by up to ``2 |U(f_s)| (1 + |G|) / A``.
    U(f_s) is extrapolated from the content below f_s / 2 at the rate at which an edge with
    finite acceleration falls, 1/f³. A motion without edges is taken as one long edge.
    """
    increments = np.diff(motion)
    pieces = [
        increments[max(edge.start - _MARGIN_SAMPLES, 0) : edge.stop + _MARGIN_SAMPLES]
        for edge in steps.edges
    ] or [increments * np.hanning(len(increments))]
    energy = sum(_top_energy(piece, steps.noise) for piece in pieces)
    height = sum(float(np.sum(np.abs(piece))) ** 2 for piece in pieces)
    if energy <= 0:
        return 0.0
    # |ΔU| = |1 - exp(-jωT)| |U| is nearly 2 |U| / T at the top.
    at_top = 0.5 * sample_period * np.sqrt(energy / height)
    at_rate = at_top * (0.5 * sum(_TOP_BAND)) ** 3
    return float(2 * at_rate * (1 + _GREATEST_GAIN_BEYOND))


def _top_energy(increments: FloatArray, noise: float) -> float:
    """Return mean |FFT of the increments|² in the top band [m²], less what encoder noise gives."""
    power = np.abs(np.fft.rfft(increments)) ** 2
    frequency = np.fft.rfftfreq(len(increments))
    band = (frequency >= _TOP_BAND[0]) & (frequency <= _TOP_BAND[1])
    doubled = np.abs(1 - np.exp(-2j * np.pi * frequency[band])) ** 2
    return float(np.mean(power[band] - len(increments) * noise**2 * doubled))


# How late is a reference sensor against the encoder that watches the same motion?


@dataclass(frozen=True, slots=True)
class ReferenceLag:
    """Lag of the reference behind the encoder [s] and its standard uncertainty [s]."""

    value: float
    uncertainty: float


def reference_lag(record: MotionRecord) -> ReferenceLag | None:
    """Return the lag of the reference; None where too little of both was recorded.

    To first order of the lag, ``reference = gain · (z - lag · dz/dt) + offset + drift``.
    """
    if record.reference is None:
        return None
    known = np.isfinite(record.reference)
    if record.z_lost is not None:
        known &= ~record.z_lost
    if np.sum(known) < LEAST_SAMPLES:
        return None
    columns = np.column_stack(
        [
            record.z - np.mean(record.z),
            -np.gradient(record.z, record.sample_period),
            np.ones(len(record)),
            np.linspace(-1.0, 1.0, len(record)),
        ]
    )[known]
    unit, scale = unit_columns(columns)
    inverse = np.linalg.pinv(unit)
    found = inverse @ record.reference[known]
    residual = record.reference[known] - unit @ found
    spread = float(np.sqrt(residual @ residual / (len(residual) - 4) * (inverse[1] @ inverse[1])))
    gain = float(found[0] / scale[0])
    if gain == 0:
        return None
    return ReferenceLag(float(found[1] / scale[1]) / gain, abs(spread / scale[1] / gain))


HARMLESS_DELAY_S = 7e-6
"""Five nanometres on the paper's scan, whose Z moves at 0.7 mm/s (rms)."""

# A nanometre and a half on the paper's scan, whose Z moves at 0.7 mm/s (rms).
_GREATEST_REFERENCE_LAG_S = 2e-6
# Standard uncertainties beyond which a lag is no chance.
_CLEARLY = 5.0


@dataclass(frozen=True, eq=False)
class CovarianceTerm:
    """covariance: (p, p), order numerator, denominator[1:], delay;  finding: on its cause"""

    covariance: FloatArray
    finding: Finding = field(default_factory=Finding)


def inter_sample_motion(prepared: Prepared, fit: Fit, from_noise: FloatArray) -> CovarianceTerm:
    """Return the term of motion that an edge may hide between two samples.

    from_noise: (p, p) covariance of the coefficients from the noise of probe and encoder
    """
    problem = prepared.problem
    bound = inter_sample_delay_bound(problem.input, prepared.steps, problem.period)
    delay_noise = low_frequency_delay_uncertainty(fit.dynamics, from_noise)
    return CovarianceTerm(
        inter_sample_motion_covariance(fit.dynamics, bound, problem.period),
        inter_sample_motion_finding(bound, delay_noise),
    )


def inter_sample_motion_finding(bound: float, delay_noise: float) -> Finding:
    """Reject edges whose bound on the bias of the delay [s] exceeds its noise [s]."""
    reasons: tuple[str, ...] = ()
    if bound > max(delay_noise, HARMLESS_DELAY_S):
        reasons = (
            f"motion between samples may shift the lag by {quantity(bound, 's')}: the edges are "
            "too sharp for the sampling; use jerk-limited or dithered edges, or sample faster",
        )
    return Finding({"inter_sample_delay_bound_s": bound}, reasons=reasons)


def reference_delay(record: MotionRecord, fit: Fit) -> CovarianceTerm:
    """Return the term of the lag of the reference sensor, where it was the input.

    A correction filters the encoder, so the lag of the reference would be missing from it.
    """
    size = len(fit.dynamics.numerator) + len(fit.dynamics.denominator)
    covariance, lag = np.zeros((size, size)), reference_lag(record)
    if lag is None:
        return CovarianceTerm(covariance)
    covariance[-1, -1] = lag.value**2 + lag.uncertainty**2
    return CovarianceTerm(covariance, reference_finding(lag))


def reference_finding(lag: ReferenceLag) -> Finding:
    """Reject a reference that is clearly late, or early, against the encoder."""
    entries = {"reference_lag_s": lag.value, "reference_lag_uncertainty_s": lag.uncertainty}
    if abs(lag.value) <= max(_CLEARLY * lag.uncertainty, _GREATEST_REFERENCE_LAG_S):
        return Finding(entries)
    word = "late" if lag.value > 0 else "early"
    return Finding(
        entries,
        {"reference_lag_greatest_s": _GREATEST_REFERENCE_LAG_S},
        reasons=(
            f"the reference sensor is {quantity(abs(lag.value), 's')} {word} against the encoder "
            f"(u = {quantity(lag.uncertainty, 's', 2)}), and a correction filters the encoder: "
            "identify with input 'encoder', or remove the filter or averaging of the reference",
        ),
    )


COVARIANCE_TERMS: tuple[Callable[[Prepared, Fit, FloatArray], CovarianceTerm], ...] = (
    inter_sample_motion,
)


# Where the parts of a step test contradict each other, the band holds what they differ by.

_REMEDY = {
    UP_DOWN: "look for what is loose or rubs, or is clamped on one side only",
    HALVES: "let the machine warm up and settle before the test",
    SIZES: "make steps as small as the deflections of a scan, and look for what is loose or rubs",
}


def consistency(diagnostics: ResidualDiagnostics) -> CovarianceTerm:
    """Return the term of parts that differ, and its finding; nothing is added where none do.

    The whole difference counts as a standard uncertainty: nothing says that a scan, which moves
    less than a step, lies between the two.
    """
    found = contrasts(diagnostics)
    fitted = diagnostics.fitted
    gain = np.concatenate([fitted.dynamics.numerator, np.zeros(len(fitted.dynamics.denominator))])
    lag = np.zeros_like(gain)
    lag[-1] = 1.0
    rows = [row for c in found if c.significant for row in (c.gain * gain, c.lag * lag)]
    return CovarianceTerm(_outer(rows, len(gain)), consistency_finding(found))


def _outer(rows: Sequence[FloatArray], size: int) -> FloatArray:
    stacked = np.asarray(rows).reshape(-1, size)
    return np.asarray(stacked.T @ stacked)


def consistency_finding(found: Sequence[Contrast]) -> Finding:
    """Reserve a test whose parts differ by more than chance."""
    return Finding(
        {"consistency": [_entry(contrast) for contrast in found]},
        {"consistency_p_least": FALSE_ALARM} if found else {},
        reservations=tuple(_contrast_text(contrast) for contrast in found if contrast.significant),
    )


def _entry(contrast: Contrast) -> dict[str, object]:
    known = {
        "gain_difference": contrast.gain,
        "gain_difference_uncertainty": contrast.gain_uncertainty,
        "lag_difference_s": contrast.lag,
        "lag_difference_uncertainty_s": contrast.lag_uncertainty,
    }
    finite = {name: value if np.isfinite(value) else None for name, value in known.items()}
    return {"parts": contrast.parts, **finite, "p": contrast.p}


def _contrast_text(contrast: Contrast) -> str:
    first, second = contrast.parts.split(" against ")
    return (
        f"{first} and {second} differ by {quantity(contrast.lag, 's', 2)} in lag and "
        f"{percent(contrast.gain)} in gain (by chance: {p_value_text(contrast.p)}), and the band holds "
        f"that: {_REMEDY[contrast.parts]}, and repeat the test"
    )
