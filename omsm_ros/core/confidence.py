"""How well an identified response is known: covariance, band, and where trust ends."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import polynomial
from scipy import fft

from omsm_ros.core.output_error import Fit, Problem
from omsm_ros.core.records import FloatArray
from omsm_ros.core.transfer_function import ComplexArray, TransferFunction
from omsm_ros.units import DEGREE_RAD

# 95 % of a normal distribution.
COVERAGE_FACTOR = 1.959964
_MAX_NOISE_ORDER = 12
# Octaves from one trial frequency to the next.
_SHOWN_STEP = 1 / 24
# Directions of the parameter space this much weaker than the strongest are lost in rounding.
_RANK_TOLERANCE = 1e-11


@dataclass(frozen=True, slots=True)
class ResponseLimits:
    """Half-widths of the 95 % band within which a response is trusted: gain [1], phase [rad]."""

    gain: float = 0.005
    phase: float = 0.5 * DEGREE_RAD


@dataclass(frozen=True, eq=False)
class Band:
    """Standard uncertainty over ``frequency`` [Hz]: relative gain [1] and phase [rad], all (k,)."""

    frequency: FloatArray
    gain: FloatArray
    phase: FloatArray


def autoregression(
    residual: FloatArray, highest: int = _MAX_NOISE_ORDER
) -> tuple[FloatArray, float]:
    """Whitening filter [1, a1 …] of a residual (n,) and the variance it leaves.

    By Yule and Walker, order 0 to ``highest`` chosen by BIC; order 0 is white.
    """
    n = len(residual)
    size = fft.next_fast_len(2 * n, real=True)
    power = np.abs(fft.rfft(residual, size)) ** 2
    lags = fft.irfft(power, size)[: highest + 1] / n
    coefficients, variance = np.ones(1), float(lags[0])
    if variance <= 0:
        return coefficients, 0.0
    best = (n * np.log(variance), coefficients, variance)
    for order in range(1, min(highest, n - 1) + 1):
        # Levinson's recursion.
        reflection = -(coefficients @ lags[order:0:-1]) / variance
        padded = np.append(coefficients, 0.0)
        coefficients = padded + reflection * padded[::-1]
        variance *= 1 - reflection**2
        score = n * np.log(variance) + order * np.log(n)
        if score < best[0]:
            best = (score, coefficients, variance)
    return np.asarray(best[1]), best[2]


def noise_spectrum(residual: FloatArray, length: int) -> FloatArray:
    """Variance spectrum of the residual (n,) at ``length`` // 2 + 1 frequencies; white is flat."""
    coefficients, variance = autoregression(residual)
    return np.asarray(variance / np.abs(fft.rfft(coefficients, length)) ** 2)


def parameter_covariance(
    problem: Problem,
    columns: FloatArray,
    residual: FloatArray,
    passed: TransferFunction | None = None,
) -> FloatArray:
    """(q, q) covariance of the parameters of ``columns`` (k, q), coloured residual allowed.

    The sandwich (JᵀJ)⁻¹ Jᵀ R J (JᵀJ)⁻¹, with R the autocovariance of the residual.

    passed: through which the noise of the motion comes into the residual, None if it does not.
        A sharp resonance lifts it out of the probe's noise just where it is identified, in a
        line too narrow for the residual to show.
    """
    samples, size = columns.shape
    residual = residual * np.sqrt(samples / max(samples - size, 1))
    on_grid = np.zeros((len(problem.used), size))
    on_grid[problem.used] = columns
    length = fft.next_fast_len(len(on_grid) + _MAX_NOISE_ORDER, real=True)
    spectrum = fft.rfft(on_grid, length, axis=0)
    weight = np.full(len(spectrum), 2.0)
    weight[0] = 1.0
    if length % 2 == 0:
        weight[-1] = 1.0
    noise = noise_spectrum(residual, length)
    if passed is not None:
        came = _motion_noise_spectrum(problem, passed, length)
        noise = np.maximum(noise, np.mean(residual**2) - np.mean(came) + came)
    weighted = (weight * noise)[:, np.newaxis] * spectrum
    meat = np.real(np.conj(spectrum).T @ weighted) / length
    scale = np.linalg.norm(columns, axis=0)
    scale[scale == 0] = 1.0
    values, directions = np.linalg.eigh((columns / scale).T @ (columns / scale))
    least = _RANK_TOLERANCE * float(values[-1])
    strong, weak = directions[:, values > least], directions[:, values <= least]
    bread = strong / values[values > least] @ strong.T
    inside = bread @ (meat / np.outer(scale, scale)) @ bread
    # Of a weak direction the data know nothing: at least as little as of the weakest strong one.
    inside += weak @ weak.T * float(np.mean(residual**2)) / (least or 1.0)
    covariance = inside / np.outer(scale, scale)
    return np.asarray(0.5 * (covariance + covariance.T))


def gain_apart(problem: Problem, fitted: Fit) -> float:
    """Standard uncertainty of the gain, relative, if nothing is known of lag and curvature."""
    every = parameter_covariance(problem, problem.bent(fitted), fitted.residual)
    return float(np.sqrt(every[0, 0]) / abs(fitted.gain))


def _motion_noise_spectrum(problem: Problem, passed: TransferFunction, length: int) -> FloatArray:
    """Variance spectrum of what ``passed`` makes of the noise of the motion, as far as it moves."""
    frequency = fft.rfftfreq(length, problem.period)
    moves = 2 * np.pi * frequency <= problem.rate * np.max(np.abs(problem.s))
    power = np.abs(passed.response(frequency)) ** 2 * problem.noise**2
    return np.asarray(np.where(moves, power, 0.0))


def hidden_motion_covariance(
    dynamics: TransferFunction, delay_bound: float, sample_period: float
) -> FloatArray:
    """Covariance (p, p) of the coefficients due to motion hidden between samples.

    Folded motion shifts the lag by up to ``delay_bound`` [s], and bends the response by a
    term in s² as the folded content varies over a tenth of the sampling rate around it.
    Either is a bound, taken as a uniform distribution: its standard deviation is 1/√3 of it.
    """
    zeros, poles = len(dynamics.numerator) - 1, len(dynamics.denominator) - 1
    directions = np.zeros((2, zeros + poles + 2))
    bend = delay_bound * sample_period / (2 * np.pi * 0.1)
    for row, (power, size) in enumerate(((1, delay_bound), (2, bend))):
        if poles >= power:
            directions[row, zeros + power] = size / np.sqrt(3)
        elif power == 1:
            directions[row, -1] = size / np.sqrt(3)
    return directions.T @ directions


def relative_response_jacobian(dynamics: TransferFunction, frequency: FloatArray) -> FloatArray:
    """d(ln|G|, arg G)/d(numerator, denominator[1:], delay), shape (2, k, p).

    frequency: (k,) [Hz]
    """
    s = 2j * np.pi * np.asarray(frequency, np.float64)[:, np.newaxis]
    up = s ** np.arange(len(dynamics.numerator)) / polynomial.polyval(s, dynamics.numerator)
    powers = np.arange(1, len(dynamics.denominator))
    down = -(s**powers) / polynomial.polyval(s, dynamics.denominator)
    both = np.concatenate([up, down, -s], axis=1)
    return np.stack([both.real, both.imag])


def response_band(
    dynamics: TransferFunction, covariance: FloatArray, frequency: FloatArray
) -> Band:
    """Standard uncertainty of gain and phase from the covariance of the coefficients (p, p)."""
    jacobian = relative_response_jacobian(dynamics, frequency)
    variance = np.einsum("akp,pq,akq->ak", jacobian, covariance, jacobian)
    gain, phase = np.sqrt(np.maximum(variance, 0.0))
    return Band(np.asarray(frequency, np.float64), gain, phase)


def widening(band: Band, other: Band, apart: ComplexArray) -> float:
    """Least factor, not below 1, by which ``band`` has to grow to hold the whole of ``other``.

    apart: ln of the other's response over that of ``band``, at the same frequencies (k,)
    """
    parts = ((band.gain, other.gain, apart.real), (band.phase, other.phase, apart.imag))
    factors = [
        (np.abs(off) / COVERAGE_FACTOR + theirs)[own > 0] / own[own > 0]
        for own, theirs, off in parts
    ]
    return float(np.max(np.concatenate([[1.0], *factors])))


def trusted_up_to(band: Band, limits: ResponseLimits, other: Band | None = None) -> float:
    """Highest frequency [Hz] below which the 95 % band stays inside ``limits``; 0 if nowhere.

    other: further error at the same frequencies, added to the half-width, or None
    """
    gain, phase = COVERAGE_FACTOR * band.gain, COVERAGE_FACTOR * band.phase
    if other is not None:
        gain, phase = gain + other.gain, phase + other.phase
    outside = np.flatnonzero((gain > limits.gain) | (phase > limits.phase))
    if len(outside) == 0:
        return float(band.frequency[-1])
    return float(band.frequency[outside[0] - 1]) if outside[0] else 0.0


def shown_up_to(
    frequency: FloatArray, answer: ComplexArray, noise: FloatArray, limits: ResponseLimits
) -> float:
    """Highest frequency [Hz] at which the data alone would show a response off by ``limits``.

    frequency: (k,) [Hz], evenly spaced from 0;  answer: transform of what the motion gave, (k,)
    noise: mean square of the transform of the probe's noise, (k,)
    A model extrapolates beyond it, and what it misses there shows in no residual. Taken
    over a third of an octave: a deviation δ of G adds δ · answer, so its best estimate has
    the variance Σ noise |answer|² / (2 (Σ |answer|²)²) in gain and in phase.
    """
    power, allowed = np.abs(answer) ** 2, min(limits.gain, limits.phase) / COVERAGE_FACTOR
    for centre in frequency[-1] * 2 ** (-np.arange(0.0, np.log2(len(frequency)), _SHOWN_STEP)):
        near = np.abs(np.log2(np.maximum(frequency, 1e-3 * centre) / centre)) <= 1 / 6
        energy = float(np.sum(power[near]))
        if energy * allowed > np.sqrt(0.5 * float(power[near] @ noise[near])):
            return float(centre)
    return 0.0
