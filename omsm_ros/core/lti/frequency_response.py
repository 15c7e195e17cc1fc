"""Frequency responses: estimates without a model, uncertainty of a model, and valid band."""

from dataclasses import dataclass

import numpy as np
import scipy  # whose parts are loaded when they are used
from numpy.polynomial import polynomial

from omsm_ros.core.lti.transfer_function import ComplexArray, TransferFunction, slow_motion_jacobian
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.units import DEGREE_RAD


@dataclass(frozen=True, eq=False)
class FrequencyResponse:
    """A frequency response estimated without a model, arrays (k,).

    frequency: [Hz];  coherence: 0-1;  uncertainty: standard, relative
    """

    frequency: FloatArray
    response: ComplexArray
    coherence: FloatArray
    uncertainty: FloatArray


def frequency_response(
    motion: FloatArray, output: FloatArray, sample_period: float, segment: int
) -> FrequencyResponse:
    """Return H1 = S_yu / S_uu by Welch's method, on increments, in segments of ``segment`` samples.

    Increments make steps and offsets stationary and cancel in the ratio. The uncertainty is
    that of Bendat and Piersol, √((1 - γ²) / (2 γ² n)), with n independent segments.
    """
    samples, size = len(motion) - 1, min(segment, len(motion) - 1)
    window, view = (
        scipy.signal.windows.hann(size, sym=False),
        np.lib.stride_tricks.sliding_window_view,
    )
    # Segments overlap by half; scipy.signal.csd transforms them one by one.
    parts = (view(np.diff(each), size)[:: size - size // 2] for each in (motion, output))
    u, y = (np.fft.rfft(part * window) for part in parts)
    cross = np.sum(u.conj() * y, axis=0)
    inward, outward = (np.sum(np.abs(each) ** 2, axis=0) for each in (u, y))
    tiny = np.finfo(np.float64).tiny
    coherence = np.abs(cross) ** 2 / np.maximum(inward * outward, tiny)
    count = max(2 * samples / size - 1, 1.0)
    inside = np.clip(coherence, 1e-12, 1.0)
    uncertainty = np.sqrt((1 - inside) / (2 * inside * count))
    frequency = np.asarray(np.fft.rfftfreq(size, sample_period))
    return FrequencyResponse(
        frequency, np.asarray(cross / np.maximum(inward, tiny)), coherence, uncertainty
    )


# Coverage factor for 95 % of a normal distribution.
COVERAGE_FACTOR = 1.959964
# Frequencies of a logarithmic grid: over four decades, neighbours are 2.3 % apart.
GRID_POINTS = 400
# Step of the trial frequencies [octaves].
_SHOWN_STEP = 1 / 24


@dataclass(frozen=True, slots=True)
class ResponseLimits:
    """Largest half-widths of the 95 % band of a valid response: gain [1], phase [rad]."""

    gain: float = 0.005
    phase: float = 0.5 * DEGREE_RAD


@dataclass(frozen=True, eq=False)
class Band:
    """Standard uncertainty of relative gain [1] and phase [rad] at ``frequency`` [Hz], all (k,)."""

    frequency: FloatArray
    gain: FloatArray
    phase: FloatArray


def relative_response_jacobian(dynamics: TransferFunction, frequency: FloatArray) -> FloatArray:
    """Return d(ln|G|, arg G)/d(numerator, denominator[1:], delay), shape (2, k, p).

    frequency: (k,) [Hz]
    """
    s = 2j * np.pi * np.asarray(frequency, np.float64)[:, np.newaxis]
    up = s ** np.arange(len(dynamics.numerator)) / polynomial.polyval(s, dynamics.numerator)
    powers = np.arange(1, len(dynamics.denominator))
    down = -(s**powers) / polynomial.polyval(s, dynamics.denominator)
    both = np.concatenate([up, down, -s], axis=1)
    return np.stack([both.real, both.imag])


def spread_along(directions: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the standard deviation (…,) along ``directions`` (…, p) for ``covariance`` (p, p).

    Parameters with the same effect, such as a delay and a pole far above the band, have large
    variances that cancel. Where they cancel to less than rounding, the rounding is returned.
    """
    variance = np.einsum("...p,pq,...q->...", directions, covariance, directions)
    size = np.abs(directions)
    rounding = np.finfo(float).eps * np.sum((size @ np.abs(covariance)) * size, axis=-1)
    return np.asarray(np.sqrt(np.maximum(variance, rounding)))


def response_band(
    dynamics: TransferFunction, covariance: FloatArray, frequency: FloatArray
) -> Band:
    """Return the standard uncertainty of gain and phase from the ``covariance`` (p, p) of G."""
    gain, phase = spread_along(relative_response_jacobian(dynamics, frequency), covariance)
    return Band(np.asarray(frequency, np.float64), gain, phase)


def low_frequency_delay_uncertainty(dynamics: TransferFunction, covariance: FloatArray) -> float:
    """Return the standard uncertainty of the low-frequency delay τ + d1 - n1/n0 [s].

    covariance: (p, p), order numerator, denominator[1:], delay
    """
    return float(spread_along(slow_motion_jacobian(dynamics)[0], covariance))


def widening(band: Band, other: Band, apart: ComplexArray) -> float:
    """Return the least factor, at least 1, by which ``band`` must grow to include ``other``.

    apart: ln of the other's response over that of ``band``, at the same frequencies (k,)
    """
    parts = ((band.gain, other.gain, apart.real), (band.phase, other.phase, apart.imag))
    factors = [
        (np.abs(off) / COVERAGE_FACTOR + theirs)[own > 0] / own[own > 0]
        for own, theirs, off in parts
    ]
    return float(np.max(np.concatenate([[1.0], *factors])))


def trusted_up_to(band: Band, limits: ResponseLimits, other: Band | None = None) -> float:
    """Return the frequency [Hz] up to which the 95 % band stays inside ``limits``; 0 if nowhere.

    other: further error at the same frequencies, added to the half-width, or None
    """
    gain, phase = COVERAGE_FACTOR * band.gain, COVERAGE_FACTOR * band.phase
    if other is not None:
        gain, phase = gain + other.gain, phase + other.phase
    outside = np.flatnonzero((gain > limits.gain) | (phase > limits.phase))
    if len(outside) == 0:
        return float(band.frequency[-1])
    return float(band.frequency[outside[0] - 1]) if outside[0] else 0.0


def excited_up_to(
    frequency: FloatArray, answer: ComplexArray, noise: FloatArray, limits: ResponseLimits
) -> float:
    """Return the highest frequency [Hz] at which the data show a response error of ``limits``.

    frequency: (k,) [Hz], evenly spaced from 0;  answer: transform of the output of the motion, (k,)
    noise: mean square of the transform of the probe's noise, (k,)

    It is 0 if they do not show it at any frequency. Beyond it the model extrapolates, and residuals
    do not show its errors. Within a third of an octave a deviation δ of G adds δ · answer, so that
    its best estimate has the variance Σ noise |answer|² / (2 (Σ |answer|²)²) in gain and in phase.
    """
    centres = frequency[-1] * 2 ** (-np.arange(0.0, np.log2(len(frequency)), _SHOWN_STEP))
    power, allowed = np.abs(answer) ** 2, min(limits.gain, limits.phase) / COVERAGE_FACTOR
    edges = np.outer([2 ** (-1 / 6), 2 ** (1 / 6)], centres)
    first = np.searchsorted(frequency, edges[0])
    # At low frequency there may be no line within a third of an octave; the next one is taken.
    last = np.maximum(np.searchsorted(frequency, edges[1], side="right"), first + 1)
    near = [slice(*ends) for ends in zip(first, last, strict=True)]
    energy = np.array([np.sum(power[part]) for part in near])
    disturbed = np.array([power[part] @ noise[part] for part in near])
    found = np.flatnonzero(energy * allowed > np.sqrt(0.5 * disturbed))
    return float(centres[found[0]]) if len(found) else 0.0
