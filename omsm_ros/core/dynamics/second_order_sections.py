"""In which order are the roots of a digital filter multiplied, so that few digits are lost?

As :func:`scipy.signal.zpk2sos` does, without loading ``scipy.signal``: the poles nearest to the
unit circle, which amplify most, get the zeros nearest to them and come last.
"""

from __future__ import annotations

import numpy as np

from omsm_ros.core.dynamics.transfer_function import ComplexArray
from omsm_ros.core.samples.blocks import FloatArray


def second_order_sections(zeros: ComplexArray, poles: ComplexArray, gain: float) -> FloatArray:
    """Return sections (k, 6) as in scipy of ``gain · Π(1 - z_i/z) / Π(1 - p_i/z)``.

    zeros, poles: in the z plane, complex ones with their conjugates
    """
    # A root at the origin is a factor of 1.
    longest = max(len(zeros), len(poles), 1)
    count = longest + longest % 2
    padded = [np.append(r, np.zeros(count - len(r))) for r in (zeros, poles)]
    remaining = list(padded[0])
    sections = []
    for pair in sorted(_pairs(padded[1]), key=_amplification, reverse=True):
        sections.append([*_monic(_nearest(pair[0], remaining)), *_monic(pair)])
    ordered = np.array(sections[::-1], np.float64)
    ordered[0, :3] *= gain
    return ordered


def bilinear_roots(
    zeros: ComplexArray, poles: ComplexArray, gain: float, sample_period: float
) -> tuple[ComplexArray, ComplexArray, float]:
    """Map roots [rad/s] and gain of a proper ratio by ``s = 2 (z - 1) / (T (z + 1))``."""
    rate = 2 / sample_period
    mapped = gain * np.prod(rate - zeros) / np.prod(rate - poles)
    at_nyquist = -np.ones(len(poles) - len(zeros))
    digital_zeros = np.append((rate + zeros) / (rate - zeros), at_nyquist)
    return digital_zeros, (rate + poles) / (rate - poles), float(np.real(mapped))


def _pairs(roots: ComplexArray) -> list[tuple[complex, complex]]:
    real = sorted((r for r in roots if r.imag == 0), key=abs, reverse=True)
    conjugate = [(r, np.conj(r)) for r in roots if r.imag > 0]
    return conjugate + list(zip(real[::2], real[1::2], strict=True))


def _amplification(pair: tuple[complex, complex]) -> float:
    return float(max(abs(pair[0]), abs(pair[1])))


def _nearest(pole: complex, zeros: list[complex]) -> tuple[complex, complex]:
    """Take out of ``zeros`` the pair nearest to ``pole``: conjugate, or two real ones."""
    first = min(zeros, key=lambda zero: abs(zero - pole))
    zeros.remove(first)
    if first.imag:
        second = np.conj(first)
    else:
        second = min((z for z in zeros if z.imag == 0), key=lambda zero: abs(zero - pole))
    zeros.remove(second)
    return first, second


def _monic(pair: tuple[complex, complex]) -> list[float]:
    """Return the coefficients of (1 - r/z)(1 - s/z), ascending in 1/z."""
    return [1.0, float(np.real(-pair[0] - pair[1])), float(np.real(pair[0] * pair[1]))]
