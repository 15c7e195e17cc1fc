"""How well could anybody know the response, who knows its true structure?

The bound of Cramér and Rao from the truth alone, with no part of the package in it: Fisher's
information of the true coefficients, the gain, an offset and a drift, in white noise. No
unbiased method has a smaller error. A method that does not know the structure has to find it,
and pays for it.
"""

from __future__ import annotations

import numpy as np

from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.blocks import FloatArray

# Unit of s in the columns, which are alike in size then [rad/s].
_RATE = 1e3


def response_bounds(
    truth: TransferFunction,
    gain: float,
    input_: FloatArray,
    sample_period: float,
    noise: float,
    frequency: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Least standard deviations of relative gain [1] and phase [rad] at ``frequency`` (f,) [Hz].

    truth: with G(0) = 1;  gain: of the probe per travel at rest
    input_: (n,) [m] without noise, which ends where it began, so that its period closes
    noise: standard deviation of a reading [m]
    """
    s = 2j * np.pi * np.fft.rfftfreq(len(input_), sample_period)
    moved = np.fft.rfft(input_ - np.mean(input_)) * truth.response(s.imag / (2 * np.pi))
    ramp = np.linspace(-1.0, 1.0, len(input_))
    # d output / d coefficient is the output through d ln G / d coefficient.
    spectra = gain * _logarithmic_derivatives(truth, s) * moved
    columns = [np.fft.irfft(spectrum, len(input_)) for spectrum in spectra]
    columns += [np.fft.irfft(moved, len(input_)), np.ones(len(input_)), ramp]
    scale = np.array([np.linalg.norm(column) for column in columns])
    unit = np.column_stack(columns) / scale
    covariance = noise**2 * np.linalg.inv(unit.T @ unit) / np.outer(scale, scale)
    asked = _logarithmic_derivatives(truth, 2j * np.pi * frequency)
    own = covariance[: len(asked), : len(asked)]
    of_gain, of_phase = (
        np.sqrt(np.einsum("if,ij,jf->f", part, own, part)) for part in (asked.real, asked.imag)
    )
    return np.asarray(of_gain), np.asarray(of_phase)


def _logarithmic_derivatives(truth: TransferFunction, s: np.ndarray) -> np.ndarray:
    """d ln G / d(numerator[1:], denominator[1:], delay where there is one), (p, f), scaled."""
    powers = (s / _RATE) ** np.arange(1, len(truth.denominator))[:, np.newaxis]
    top = np.polyval(truth.numerator[::-1], s)
    bottom = np.polyval(truth.denominator[::-1], s)
    every = [*(powers[: len(truth.numerator) - 1] / top), *(-powers / bottom)]
    if truth.delay:
        every.append(-s / _RATE)
    return np.array(every)
