"""Which G(s) makes a sampled H(z), when its input is held between the samples?

Each pole p of H is exp(sT) of one of G, and its residue follows in closed form. With a
zero-order hold ``x' = s x + u`` gives ``x[k+1] = p x[k] + h u[k]``, h = (p - 1)/s; with a
first-order hold ``x[k+1] = p x[k] + h0 u[k] + h1 u[k+1]``, h1 = (h/T - 1)/s, h0 = h - h1.
"""

from __future__ import annotations

import numpy as np
from numpy.polynomial import polynomial

from omsm_ros.core.dynamics.transfer_function import ComplexArray, TransferFunction
from omsm_ros.core.samples.blocks import FloatArray

ZERO_ORDER, FIRST_ORDER = "zero-order", "first-order"
# Poles nearer to each other than this, relative, have no residues that rounding would leave.
_APART = 1e-6
# A pole this near to z = 0 is a delay, and one this near to 1 an integrator.
_LEAST = 1e-9


def held_equivalent(
    numerator: FloatArray, denominator: FloatArray, period: float, hold: str
) -> TransferFunction | None:
    """Return G(s) of which ``numerator``/``denominator``, ascending in z⁻¹, is the sampled form.

    period: [s];  hold: "zero-order" or "first-order"

    None where there is no such G: a pole on the negative real axis, at 0 or at 1, or several
    in one place.
    """
    n = len(denominator) - 1
    b = np.pad(numerator, (0, max(n + 1 - len(numerator), 0)))
    if len(b) > n + 1:
        return None
    poles = np.asarray(np.roots(denominator), np.complex128)
    if n == 0:
        return TransferFunction(b[:1] / denominator[0], np.ones(1))
    if _without_equivalent(poles):
        return None
    direct, residues = _fractions(b, denominator, poles)
    s = np.log(poles) / period
    held = (poles - 1) / s
    if hold == FIRST_ORDER:
        now = (held / period - 1) / s
        scaled = residues / (held - now + poles * now)
        direct = direct - float(np.sum(scaled * now).real)
    else:
        scaled = residues / held
    down = polynomial.polyfromroots(s)
    up = direct * down
    for i, residue in enumerate(scaled):
        term = residue * polynomial.polyfromroots(np.delete(s, i))
        up = polynomial.polyadd(up, term)
    return TransferFunction.from_ascending(np.real(up), np.real(down))


def _without_equivalent(poles: ComplexArray) -> bool:
    near_negative = (poles.real <= _LEAST) & (np.abs(poles.imag) <= _LEAST)
    distances = np.abs(poles[:, np.newaxis] - poles) + np.eye(len(poles))
    return bool(
        np.any(near_negative) or np.any(np.abs(poles - 1) < _LEAST) or np.min(distances) < _APART
    )


def _fractions(b: FloatArray, a: FloatArray, poles: ComplexArray) -> tuple[float, ComplexArray]:
    """Return d and r of H(z) = d + Σ r_i / (z - p_i)."""
    descending, monic = b / a[0], a / a[0]
    direct = float(descending[0])
    rest = descending - direct * monic
    values = np.polyval(rest, poles)
    slopes = np.array([np.prod(p - np.delete(poles, i)) for i, p in enumerate(poles)])
    return direct, np.asarray(values / slopes, np.complex128)
