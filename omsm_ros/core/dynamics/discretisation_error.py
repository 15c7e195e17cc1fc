"""How many nanometres does the discretisation cost on this very motion?

The error of H against G is weighed with the spectrum of the motion's velocity, whose window
leaks far less than that of millimetres of travel. Above the band nothing is claimed: there
the samples hold the encoder's noise rather than the motion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft, signal

from omsm_ros.core.dynamics.discretisation import DigitalFilter, bilinear, discretise
from omsm_ros.core.dynamics.transfer_function import ComplexArray, TransferFunction
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.errors import DataError

MIN_SAMPLES = 64
# Share of the record that the window fades at either end.
_FADE = 0.1
# A motion that fills more of the Nyquist band is not resolved by its samples.
_RESOLVED_SHARE = 0.2
ORDERS = (1, 2, 3, 4, 5, 7)


@dataclass(frozen=True)
class Audit:
    """One way to discretise, judged on a motion.

    method: "bilinear" or "polynomial k";  order: k, None for bilinear
    rms, peak_to_valley: of (H - G) z within the band [m];  noise_gain: of H for white noise [1]
    """

    method: str
    order: int | None
    rms: float
    peak_to_valley: float
    noise_gain: float


def checked_motion(z: FloatArray) -> FloatArray:
    """``z`` (n,) as float64; raises DataError if it is too short or not finite."""
    motion = np.asarray(z, np.float64)
    if motion.ndim != 1 or len(motion) < MIN_SAMPLES:
        raise DataError(f"motion of shape {motion.shape!r}, expected {MIN_SAMPLES} samples or more")
    if not np.all(np.isfinite(motion)):
        lost = int(np.count_nonzero(~np.isfinite(motion)))
        raise DataError(f"motion holds {lost!r} values that are not finite; leave them out")
    return motion


def velocity_spectrum(
    z: FloatArray, sample_period: float, window: str | tuple[str, float] = "blackmanharris"
) -> tuple[FloatArray, ComplexArray]:
    """Frequencies [Hz] (k,) and the windowed velocity's spectrum [m/s] (k,).

    Half the sum of |V|² is the mean square velocity. The velocity is a difference quotient,
    restored to a derivative; its mean, a drift, is left in.
    """
    velocity = np.diff(checked_motion(z)) / sample_period
    weights = signal.get_window(window, len(velocity))
    frequency = fft.rfftfreq(len(velocity), sample_period)
    spectrum = fft.rfft(velocity * weights) / np.sinc(frequency * sample_period)
    scale = np.full(len(frequency), 2.0)
    scale[0] = np.sqrt(2.0)
    if len(velocity) % 2 == 0:
        scale[-1] = np.sqrt(2.0)
    norm = np.sqrt(len(velocity) * np.sum(weights**2))
    return frequency, np.asarray(scale * spectrum / norm, np.complex128)


def discretisation_error(
    dynamics: TransferFunction, digital: DigitalFilter, z: FloatArray, up_to: float
) -> tuple[float, float]:
    """Root mean square and peak to valley of (H - G) z [m] within 0 … ``up_to`` [Hz]."""
    period = digital.sample_period
    frequency, velocity = velocity_spectrum(z, period, ("tukey", 2 * _FADE))
    band = (frequency > 0) & (frequency <= min(up_to, _RESOLVED_SHARE * 0.5 / period))
    difference = np.zeros(len(frequency), np.complex128)
    inside = frequency[band]
    difference[band] = (digital.response(inside) - dynamics.response(inside)) / (
        2j * np.pi * inside
    )
    error = difference * velocity
    rms = float(np.sqrt(np.sum(abs(error) ** 2) / 2))
    samples = len(z) - 1
    weights = signal.get_window(("tukey", 2 * _FADE), samples)
    amplitude = np.sqrt(samples * np.sum(weights**2)) / 2
    over_time = fft.irfft(error * amplitude, samples)
    fade = int(_FADE * samples) + 1
    return rms, float(np.ptp(over_time[fade:-fade]))


def audit(
    dynamics: TransferFunction, sample_period: float, z: FloatArray, up_to: float
) -> tuple[Audit, ...]:
    """Every method judged on the motion ``z`` (n,) [m], the least error first."""
    filters: list[tuple[str, int | None, DigitalFilter]] = [
        (f"polynomial {order}", order, discretise(dynamics, sample_period, order))
        for order in ORDERS
    ]
    if dynamics.delay == 0:
        trapezoid = bilinear(dynamics, sample_period)
        filters.append(("bilinear", None, trapezoid))
    judged = [
        Audit(name, order, *discretisation_error(dynamics, digital, z, up_to), digital.noise_gain)
        for name, order, digital in filters
    ]
    return tuple(sorted(judged, key=lambda a: a.rms))


def choose_order(
    dynamics: TransferFunction,
    sample_period: float,
    z: FloatArray,
    up_to: float,
    encoder_noise: float = 0.0,
) -> Audit:
    """The polynomial with the least error and filtered ``encoder_noise`` [m] together."""
    judged = audit(dynamics, sample_period, z, up_to)
    polynomials = [a for a in judged if a.order is not None]
    return min(polynomials, key=lambda a: np.hypot(a.rms, a.noise_gain * encoder_noise))
