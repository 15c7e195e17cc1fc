"""How many nanometres does the discretisation cost on this very motion?

The error of H against G is weighed with the spectrum of the motion's velocity, whose window
leaks far less than that of millimetres of travel. Above the band nothing is claimed: there
the samples hold the encoder's noise rather than the motion.
"""

from __future__ import annotations

import numpy as np

from omsm_ros.core.dynamics.discretisation import DigitalFilter
from omsm_ros.core.dynamics.transfer_function import ComplexArray, TransferFunction
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.errors import DataError

# A window of ten per cent fades six samples at either end.
MIN_SAMPLES = 64
# Share of the record that the window fades at either end.
_FADE = 0.1
BLACKMAN_HARRIS = (0.35875, -0.48829, 0.14128, -0.01168)
"""Terms of a window whose side lobes are below -92 dB (Harris, Proc. IEEE 66, 1978)."""

# A motion that fills more of the Nyquist band is not resolved by its samples.
_RESOLVED_SHARE = 0.2


def checked_motion(z: FloatArray) -> FloatArray:
    """Return ``z`` (n,) as float64; raises DataError if it is too short or not finite."""
    motion = np.asarray(z, np.float64)
    if motion.ndim != 1 or len(motion) < MIN_SAMPLES:
        raise DataError(
            f"motion of shape {motion.shape!r}, expected {MIN_SAMPLES} samples or more; "
            "give a longer one"
        )
    if not np.all(np.isfinite(motion)):
        lost = int(np.count_nonzero(~np.isfinite(motion)))
        raise DataError(f"motion holds {lost!r} values that are not finite; leave them out")
    return motion


def velocity_spectrum(
    z: FloatArray, sample_period: float, faded: bool = False
) -> tuple[FloatArray, ComplexArray]:
    """Return the frequencies [Hz] (k,) and the windowed velocity's spectrum [m/s] (k,).

    faded: a window that fades only the ends, instead of one that leaks least

    Half the sum of |V|² is the mean square velocity. The velocity is a difference quotient,
    restored to a derivative; its mean, a drift, is left in. Zeros are appended up to a length
    that transforms fast.
    """
    velocity = np.diff(checked_motion(z)) / sample_period
    weights = _fading(len(velocity)) if faded else _leaking_least(len(velocity))
    samples = fast_length(len(velocity))
    frequency = np.fft.rfftfreq(samples, sample_period)
    spectrum = np.fft.rfft(velocity * weights, samples) / np.sinc(frequency * sample_period)
    scale = np.full(len(frequency), 2.0)
    scale[0] = np.sqrt(2.0)
    if samples % 2 == 0:
        scale[-1] = np.sqrt(2.0)
    norm = np.sqrt(samples * np.sum(weights**2))
    velocities = np.asarray(scale * spectrum / norm, np.complex128)
    return np.asarray(frequency, np.float64), velocities


def fast_length(samples: int) -> int:
    """Return the least 2^k, 3·2^k, 5·2^k or 9·2^k that is not below ``samples``."""
    return min(
        factor << max((-(-samples // factor) - 1).bit_length(), 0) for factor in (1, 3, 5, 9)
    )


def _leaking_least(samples: int) -> FloatArray:
    # cos kx as polynomials of cos x: one cosine instead of three.
    a0, a1, a2, a3 = BLACKMAN_HARRIS
    cosine = np.cos(2 * np.pi / samples * np.arange(samples))
    return np.asarray(a0 - a2 + cosine * (a1 - 3 * a3 + cosine * (2 * a2 + cosine * 4 * a3)))


def _fading(samples: int) -> FloatArray:
    """Return a Tukey window that rises and falls over ``_FADE`` of the samples each."""
    weights = np.ones(samples)
    length = _FADE * samples
    rising = 0.5 - 0.5 * np.cos(np.pi * np.arange(int(length) + 1) / length)
    weights[: len(rising)] = rising
    weights[samples - len(rising) + 1 :] = rising[:0:-1]
    return weights


def discretisation_error(
    dynamics: TransferFunction, digital: DigitalFilter, z: FloatArray, up_to: float
) -> tuple[float, float]:
    """Return the root mean square and peak to valley of (H - G) z [m] within 0 … ``up_to`` [Hz]."""
    period = digital.sample_period
    frequency, velocity = velocity_spectrum(z, period, faded=True)
    band = (frequency > 0) & (frequency <= min(up_to, _RESOLVED_SHARE * 0.5 / period))
    difference = np.zeros(len(frequency), np.complex128)
    inside = frequency[band]
    difference[band] = (digital.response(inside) - dynamics.response(inside)) / (
        2j * np.pi * inside
    )
    error = difference * velocity
    rms = float(np.sqrt(np.sum(abs(error) ** 2) / 2))
    samples = len(z) - 1
    padded = fast_length(samples)
    amplitude = np.sqrt(padded * np.sum(_fading(samples) ** 2)) / 2
    over_time = np.fft.irfft(error * amplitude, padded)[:samples]
    fade = int(_FADE * samples) + 1
    return rms, float(np.ptp(over_time[fade:-fade]))
