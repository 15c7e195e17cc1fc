"""The modes of a response, Eq. 8, and how well they are known of an identified one.

G without its delay is a sum over its poles. A conjugate pair adds, up to a part in s,
``residue / (s² + 2 ζ ω s + ω²)``; the print lacks the s behind 2 ζ ω.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import ArrayLike

from omsm_ros.core.dynamics.response_band import spread_along
from omsm_ros.core.dynamics.transfer_function import ComplexArray, TransferFunction
from omsm_ros.core.samples.blocks import FloatArray

# Evenly up to the highest frequency: the terms are compared with the response at each.
_LINES = 400


@dataclass(frozen=True, slots=True)
class ModalTerm:
    """One term of Eq. 8: residue α/m [1/s²], undamped frequency [Hz], damping ratio."""

    residue: float
    frequency: float
    damping: float


def modal_sum(terms: Sequence[ModalTerm], frequency: ArrayLike) -> ComplexArray:
    """Return the response of Eq. 8 at ``frequency`` [Hz], of the same shape; not normalised."""
    s = np.asarray(2j * np.pi * np.asarray(frequency, np.float64), np.complex128)
    response = np.zeros_like(s)
    for term in terms:
        omega = 2 * np.pi * term.frequency
        response = response + term.residue / (s**2 + 2 * term.damping * omega * s + omega**2)
    return response


@dataclass(frozen=True, slots=True)
class KnownMode:
    """A pole or a conjugate pair, with standard uncertainties.

    frequency: undamped [Hz];  damping: ratio [1];  residue: of Eq. 8 where G(0) = 1 [1/s²]
    The damping of a real pole is 1 by definition, its uncertainty 0; it has no residue.
    Of poles that coincide the uncertainties are infinite.
    """

    frequency: float
    frequency_uncertainty: float
    damping: float
    damping_uncertainty: float
    residue: float | None
    residue_uncertainty: float | None

    def term(self) -> ModalTerm | None:
        """Return its term of Eq. 8, None for a real pole."""
        if self.residue is None:
            return None
        return ModalTerm(self.residue, self.frequency, self.damping)


def known_modes(dynamics: TransferFunction, covariance: FloatArray) -> tuple[KnownMode, ...]:
    """Return the modes of G, slowest first, with uncertainties linear in those of the coefficients.

    covariance: (p, p), order numerator, denominator[1:], delay

    Of poles that nearly coincide the linear uncertainty is large without bound, and says
    no more than that.
    """
    upper = sorted((pole for pole in dynamics.poles() if pole.imag >= 0), key=abs)
    # Where poles coincide, D'(p) = 0.
    with np.errstate(divide="ignore", invalid="ignore"):
        return tuple(_known(dynamics, complex(pole), covariance) for pole in upper)


def mode_entries(dynamics: TransferFunction, covariance: FloatArray) -> list[dict[str, object]]:
    """Return the modes as JSON values with units, for a certificate; what is not finite as None."""
    return [
        {
            "frequency_hz": mode.frequency,
            "frequency_uncertainty_hz": _finite(mode.frequency_uncertainty),
            "damping": mode.damping,
            "damping_uncertainty": _finite(mode.damping_uncertainty),
            "residue_per_s2": _finite(mode.residue),
            "residue_uncertainty_per_s2": _finite(mode.residue_uncertainty),
        }
        for mode in known_modes(dynamics, covariance)
    ]


def _finite(value: float | None) -> float | None:
    return value if value is not None and np.isfinite(value) else None


def modal_remainder(dynamics: TransferFunction, up_to: float) -> float | None:
    """Return max ``|G - Eq. 8|`` over max ``|G|`` below ``up_to`` [Hz], without the delay.

    What the terms do not say: real poles and the parts in s. None where nothing oscillates.
    """
    size = len(dynamics.numerator) + len(dynamics.denominator)
    modes = known_modes(dynamics, np.zeros((size, size)))
    terms = [term for term in (mode.term() for mode in modes) if term is not None]
    if not terms:
        return None
    lines = np.linspace(0.0, up_to, _LINES)
    whole = replace(dynamics, delay=0.0).normalised().response(lines)
    return float(np.max(np.abs(whole - modal_sum(terms, lines))) / np.max(np.abs(whole)))


def _known(dynamics: TransferFunction, pole: complex, covariance: FloatArray) -> KnownMode:
    moved = _pole_jacobian(dynamics, pole)
    size, damping = abs(pole), -pole.real / abs(pole)
    # d ln p = d ln|p| + j d arg p, and damping = -cos(arg p).
    relative = moved / pole
    by_angle = relative.imag * np.sqrt(max(1 - damping**2, 0.0))
    residue, by_residue = _residue(dynamics, pole, moved) if pole.imag else (None, None)
    return KnownMode(
        frequency=size / (2 * np.pi),
        frequency_uncertainty=size / (2 * np.pi) * _spread(relative.real, covariance),
        damping=damping,
        damping_uncertainty=_spread(by_angle, covariance),
        residue=residue,
        residue_uncertainty=None if by_residue is None else _spread(by_residue, covariance),
    )


def _pole_jacobian(dynamics: TransferFunction, pole: complex) -> ComplexArray:
    """Return dp/d(numerator, denominator[1:], delay), (p,); dp/dd_i = -p^i / D'(p), as D(p) = 0."""
    powers = np.arange(1, len(dynamics.denominator))
    slope = polynomial.polyval(pole, polynomial.polyder(dynamics.denominator))
    zeros = np.zeros(len(dynamics.numerator))
    return np.concatenate([zeros, -(pole**powers) / slope, [0.0]])


def _residue(
    dynamics: TransferFunction, pole: complex, moved: ComplexArray
) -> tuple[float, FloatArray]:
    """Return the residue of Eq. 8 and its derivative by the coefficients, (p,).

    The partial fractions ``r/(s-p) + r*/(s-p*)``, r = N(p) / (N(0) D'(p)), have the value
    ``-2 Re(r p*) / |p|²`` at s = 0; the term of Eq. 8 with that value has -2 Re(r p*).
    """
    numerator, denominator = dynamics.numerator, dynamics.denominator
    first, second = (polynomial.polyder(denominator, k) for k in (1, 2))
    slope, bend = (polynomial.polyval(pole, d) for d in (first, second))
    residue = polynomial.polyval(pole, numerator) / (numerator[0] * slope)
    up, down = np.arange(len(numerator)), np.arange(1, len(denominator))
    by_numerator = pole**up / (numerator[0] * slope)
    by_numerator[0] -= residue / numerator[0]
    by_coefficient = np.concatenate(
        [by_numerator, -residue * down * pole ** (down - 1) / slope, [0.0]]
    )
    steepness = polynomial.polyval(pole, polynomial.polyder(numerator)) / (numerator[0] * slope)
    by_pole = steepness - residue * bend / slope
    change = by_coefficient + by_pole * moved
    derivative = -2 * np.real(change * np.conj(pole) + residue * np.conj(moved))
    return float(-2 * np.real(residue * np.conj(pole))), np.asarray(derivative, np.float64)


def _spread(direction: FloatArray, covariance: FloatArray) -> float:
    spread = float(spread_along(direction, covariance))
    return spread if np.isfinite(spread) else np.inf
