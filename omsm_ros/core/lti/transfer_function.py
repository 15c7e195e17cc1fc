"""A continuous transfer function G(s), its roots and low-frequency behaviour.

``G(s) = (n_0 + n_1 s + … ) / (1 + d_1 s + …) · exp(-s·delay)``, the paper's Eq. 11
with a pure delay; coefficients in ascending powers of s, SI units.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import ArrayLike, NDArray

from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import ConfigurationError, DataError

if TYPE_CHECKING:
    import control

ComplexArray: TypeAlias = NDArray[np.complex128]


@dataclass(frozen=True, slots=True, order=True)
class Structure:
    """Number of poles and of zeros, at most as many, and whether there is a delay."""

    poles: int
    zeros: int
    delay: bool

    @property
    def size(self) -> int:
        """Number of free parameters."""
        return self.poles + self.zeros + self.delay

    @property
    def pairs(self) -> int:
        """Number of second-order sections; an odd pole has a section of its own."""
        return self.poles // 2

    def contains(self, other: Structure) -> bool:
        """Return True if ``other`` is a smaller special case of this one."""
        return (
            other.size < self.size
            and other.poles <= self.poles
            and other.zeros <= self.zeros
            and other.delay <= self.delay
        )


@dataclass(frozen=True, eq=False)
class TransferFunction:
    """G(s) with ascending ``numerator`` (m+1,), ``denominator`` (n+1,), m ≤ n, and ``delay`` [s].

    ``denominator[0]`` is 1 exactly; use :meth:`from_ascending` to have it scaled.
    Raises DataError for coefficients that are not finite, a denominator that ends in 0, or an
    improper ratio.
    """

    numerator: FloatArray
    denominator: FloatArray
    delay: float = 0.0

    def __post_init__(self) -> None:
        for name in ("numerator", "denominator"):
            values = np.array(getattr(self, name), dtype=np.float64)
            if values.ndim != 1 or not len(values) or not np.all(np.isfinite(values)):
                raise DataError("lti.coefficients", name=name, values=values)
            values.flags.writeable = False
            object.__setattr__(self, name, values)
        if self.denominator[0] != 1.0:
            raise DataError("lti.denominator", value=float(self.denominator[0]))
        if self.denominator[-1] == 0:
            raise DataError("lti.last_coefficient")
        if len(self.numerator) > len(self.denominator):
            raise DataError(
                "lti.improper",
                numerator=len(self.numerator) - 1,
                denominator=len(self.denominator) - 1,
            )
        if not (np.isfinite(self.delay) and self.delay >= 0):
            raise DataError("lti.delay", delay=self.delay)

    @classmethod
    def from_ascending(
        cls, numerator: ArrayLike, denominator: ArrayLike, delay: float = 0.0
    ) -> TransferFunction:
        """Return the ratio scaled so that the constant term of the denominator is 1."""
        den = np.asarray(denominator, np.float64)
        return cls(np.asarray(numerator, np.float64) / den[0], den / den[0], delay)

    @property
    def dc_gain(self) -> float:
        """G(0)."""
        return float(self.numerator[0])

    @property
    def low_frequency_delay(self) -> float:
        """Group delay -dφ/dω at ω = 0 [s]."""
        num = np.append(self.numerator, 0.0)
        den = np.append(self.denominator, 0.0)
        return float(self.delay + den[1] - num[1] / num[0])

    def normalised(self) -> TransferFunction:
        """Return the same dynamics with G(0) = 1."""
        if self.dc_gain == 0:
            raise DataError("lti.no_gain")
        return TransferFunction(self.numerator / self.dc_gain, self.denominator, self.delay)

    def response(self, frequency: ArrayLike) -> ComplexArray:
        """Return G(2πjf) at ``frequency`` [Hz], of the same shape."""
        return self.at(np.asarray(2j * np.pi * np.asarray(frequency, np.float64), np.complex128))

    def at(self, s: ComplexArray) -> ComplexArray:
        """Return G at complex ``s`` [rad/s], of the same shape."""
        ratio = polynomial.polyval(s, self.numerator) / polynomial.polyval(s, self.denominator)
        return np.asarray(ratio * np.exp(-self.delay * s), np.complex128)

    def poles(self) -> ComplexArray:
        """Return the roots of the denominator [rad/s], shape (n,)."""
        return ascending_roots(self.denominator)

    def zeros(self) -> ComplexArray:
        """Return the roots of the numerator [rad/s], shape (m,)."""
        return ascending_roots(self.numerator)

    @property
    def is_stable(self) -> bool:
        """True if all poles lie in the open left half plane."""
        return bool(np.all(self.poles().real < 0))


def ascending_roots(coefficients: FloatArray) -> ComplexArray:
    """Return the roots of a polynomial in ascending powers, trailing zeros ignored.

    The coefficients in s span ten decades or more, so the variable is scaled to bring the roots
    near 1.
    """
    trimmed = np.trim_zeros(np.asarray(coefficients, np.float64), "b")
    degree = len(trimmed) - 1
    if degree < 1:
        return np.empty(0, np.complex128)
    nonzero = np.flatnonzero(trimmed)[0]
    span = max(degree - nonzero, 1)
    scale = float(abs(trimmed[nonzero] / trimmed[-1]) ** (1 / span))
    scaled = trimmed * scale ** np.arange(degree + 1)
    return np.asarray(np.roots(scaled[::-1] / scaled[-1]) * scale, np.complex128)


def slow_motion_jacobian(dynamics: TransferFunction) -> FloatArray:
    """Return d(L, k)/d(numerator, denominator[1:], delay), shape (2, p) [s, s²].

    Lag L and curvature k describe slow motion: ``ln G = -L s + k s² + …``. The derivatives
    ``∂ln G/∂n_i = s^i/N`` and ``∂ln G/∂d_i = -s^i/D`` are expanded to s².
    """
    columns: list[FloatArray] = []
    for sign, values, first in ((1.0, dynamics.numerator, 0), (-1.0, dynamics.denominator, 1)):
        c0, c1, c2 = np.append(values, np.zeros(2))[:3]
        inverse = sign * np.array([1.0 / c0, -c1 / c0**2, c1**2 / c0**3 - c2 / c0**2])
        columns += [np.append(np.zeros(i), inverse)[:3] for i in range(first, len(values))]
    _, slope, bend = np.array([*columns, [0.0, -1.0, 0.0]]).T
    return np.stack([-slope, bend])


def to_control(dynamics: TransferFunction, delay_order: int = 3) -> control.TransferFunction:
    """Return ``dynamics`` as a ``control.TransferFunction`` in rad/s.

    A delay becomes a Padé approximant of ``delay_order``, accurate up to about
    ``delay_order / delay`` rad/s, because python-control has no delays.
    Raises ConfigurationError for a delay_order that is not positive.
    """
    import control  # imported here, because it takes a second to load

    if delay_order < 1:
        raise ConfigurationError("lti.delay_order", order=delay_order)
    rational = control.TransferFunction(dynamics.numerator[::-1], dynamics.denominator[::-1])
    if dynamics.delay == 0:
        return rational
    numerator, denominator = control.pade(dynamics.delay, delay_order)
    return rational * control.TransferFunction(np.asarray(numerator), np.asarray(denominator))
