"""Cramér-Rao bound of the response for a known structure.

It follows from the true system alone: the Fisher information of the true coefficients, the gain,
an offset and a drift, in white noise. No unbiased method has a smaller error; a method that must
find the structure has a larger one.
"""

from __future__ import annotations

import numpy as np

from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.blocks import FloatArray

# Unit of s that makes the columns similar in size [rad/s].
_RATE = 1e3


def response_bounds(
    truth: TransferFunction,
    gain: float,
    input_: FloatArray,
    sample_period: float,
    noise: float,
    frequency: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return bounds of relative gain [1] and phase [rad] at ``frequency`` (f,) [Hz], k = 1.

    truth: with G(0) = 1;  gain: static gain of the probe
    input_: (n,) [m] without noise, which ends where it began, so that it is periodic
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
    """Return d ln G / d(numerator[1:], denominator[1:], delay if any), (p, f), scaled."""
    powers = (s / _RATE) ** np.arange(1, len(truth.denominator))[:, np.newaxis]
    top = np.polyval(truth.numerator[::-1], s)
    bottom = np.polyval(truth.denominator[::-1], s)
    every = [*(powers[: len(truth.numerator) - 1] / top), *(-powers / bottom)]
    if truth.delay:
        every.append(-s / _RATE)
    return np.array(every)
