"""Structures of transfer functions and their parametrisation.

A structure is a number of zeros, a number of poles, and a delay or none. Its denominator is a
product of sections ``1 + e^α s + e^β s²``. Every parameter vector is therefore a stable G(s) with
G(0) = 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, reduce

import numpy as np

from omsm_ros.core.lti.transfer_function import ComplexArray, Structure, TransferFunction
from omsm_ros.core.streams.blocks import FloatArray

# Range of time constants in e-folds around the bandwidth of the motion, a factor of 9e6.
_LOG_RANGE = 16.0
# Frequencies over which the power of a response is averaged.
_LINES = 2000


@dataclass(frozen=True, slots=True, eq=False)
class ScaledStructure:
    """A structure with ``s`` in units of ``rate`` [rad/s], which keeps coefficients near 1.

    Its *nonlinear parameters* ψ (n + delay,) hold α of each section, β of each pair, and the
    delay. The numerator (m+1,) is not among them, for it enters a fit linearly.
    """

    structure: Structure
    rate: float

    @property
    def nonlinear_size(self) -> int:
        """Number of entries of ψ."""
        return self.structure.poles + self.structure.delay

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Return the box of ψ: any pole from far below to far above ``rate``; delay ≥ 0."""
        lower = np.full(self.nonlinear_size, -_LOG_RANGE)
        upper = np.full(self.nonlinear_size, _LOG_RANGE)
        if self.structure.delay:
            lower[-1], upper[-1] = 0.0, np.inf
        return lower, upper

    def sections(self, nonlinear: FloatArray) -> list[FloatArray]:
        """Return the ascending factors of the denominator, [1, d1, d2] for a pair or [1, d1]."""
        singles = self.structure.poles - self.structure.pairs
        alpha, beta = nonlinear[:singles], nonlinear[singles : self.structure.poles]
        return [
            np.exp(np.concatenate([np.zeros(1), alpha[i : i + 1], beta[i : i + 1]]))
            for i in range(len(alpha))
        ]

    def lag(self, nonlinear: FloatArray, s: ComplexArray) -> ComplexArray:
        """Return L = e^{-τs} / denominator at scaled ``s`` = jω (k,), (k,)."""
        denominator = np.ones_like(s)
        for section in self.sections(nonlinear):
            denominator *= _section_at(section, s)
        late = _delayed(s, float(nonlinear[-1])) if self.structure.delay else 1.0
        return np.asarray(late / denominator)

    def lag_slopes(self, nonlinear: FloatArray, s: ComplexArray) -> ComplexArray:
        """Return d ln L / dψ (len ψ, k) at scaled ``s`` (k,), see :meth:`lag`."""
        first, second = [], []
        for section in self.sections(nonlinear):
            value = _section_at(section, s)
            if len(section) == 3:
                second.append(-section[2] * s * s / value)
            first.append(-section[1] * s / value)
        tail = [-s] if self.structure.delay else []
        return np.array(first + second + tail, np.complex128).reshape(-1, len(s))

    def transfer_function(self, nonlinear: FloatArray, numerator: FloatArray) -> TransferFunction:
        """Return G(s) in SI units, from ψ and the scaled ascending ``numerator``."""
        denominator = reduce(np.convolve, [np.eye(1)[0], *self.sections(nonlinear)])
        return TransferFunction(
            numerator / self.rate ** np.arange(len(numerator)),
            denominator / self.rate ** np.arange(len(denominator)),
            float(nonlinear[-1]) / self.rate if self.structure.delay else 0.0,
        )

    def coefficient_jacobian(self, nonlinear: FloatArray) -> FloatArray:
        """Return d(numerator, denominator[1:], delay)/d(numerator[1:], ψ), SI over scaled.

        Shape (m+1 + n + 1, m + len ψ); the row of numerator[0] = 1 is zero.
        """
        zeros, poles = self.structure.zeros, self.structure.poles
        jacobian = np.zeros((zeros + poles + 2, zeros + self.nonlinear_size))
        jacobian[1 : zeros + 1, :zeros] = np.eye(zeros)
        sections = self.sections(nonlinear)
        for column in range(poles):
            pair, power = (column, 1) if column < len(sections) else (column - len(sections), 2)
            product = np.eye(3)[power, : power + 1] * sections[pair][power]
            product = reduce(np.convolve, [product, *sections[:pair], *sections[pair + 1 :]])
            jacobian[zeros + 1 : zeros + len(product), zeros + column] = product[1:]
        if self.structure.delay:
            jacobian[-1, -1] = 1.0
        powers = np.concatenate([np.arange(zeros + 1.0), np.arange(1.0, poles + 1), [1.0]])
        return self.rate ** -powers[:, np.newaxis] * jacobian

    def nonlinear_of(self, poles: ComplexArray, delay: float) -> FloatArray:
        """Return ψ of given stable scaled ``poles`` (n,), conjugates included, and ``delay``."""
        sections = [(-2 * p.real / abs(p) ** 2, abs(p) ** -2) for p in poles if p.imag > 0]
        real = sorted((p.real for p in poles if p.imag == 0), key=abs)
        while len(real) >= 2:
            p, q = real.pop(), real.pop()
            sections.append((-(p + q) / (p * q), 1 / (p * q)))
        firsts = [first for first, _ in sections] + [-1 / p for p in real]
        logs = np.log(np.concatenate([firsts, [second for _, second in sections]]))
        tail = [delay] if self.structure.delay else []
        return np.concatenate([np.clip(logs, -_LOG_RANGE, _LOG_RANGE), tail])


def _section_at(section: FloatArray, s: ComplexArray) -> ComplexArray:
    """Return 1 + d1 s + d2 s² at ``s`` = jω (k,); complex products take twice as long."""
    found, omega = np.ones_like(s), s.imag
    found.imag = omega * section[1]
    if len(section) == 3:
        found.real -= omega * (omega * section[2])
    return found


def _delayed(s: ComplexArray, delay: float) -> ComplexArray:
    """Return e^{-τs} at ``s`` (k,); of lines evenly from 0 as products of √k values each."""
    size, last = int(np.sqrt(len(s))) + 1, len(s) - 1
    if last < 1 or s[0] != 0 or abs(s[last] - last * s[1]) > 1e-9 * abs(s[last]):
        return np.asarray(np.exp(-delay * s))
    whole = np.exp(-delay * s[1] * size * np.arange(size))
    return np.outer(whole, np.exp(-delay * s[:size])).ravel()[: len(s)]


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted structure.

    nonlinear: ψ;  driven: coefficients of the driven terms, scaled, those of the numerator first
    background: coefficients (q,);  residual: (k,) [m]
    """

    scaled: ScaledStructure
    nonlinear: FloatArray
    driven: FloatArray
    background: FloatArray
    residual: FloatArray

    @property
    def structure(self) -> Structure:
        """Poles, zeros and delay that were fitted."""
        return self.scaled.structure

    @property
    def gain(self) -> float:
        """Static gain, motion of the probe per motion of the axis."""
        return float(self.driven[0])

    @property
    def numerator(self) -> FloatArray:
        """Scaled numerator (m+1,), numerator[0] = 1."""
        return np.asarray(self.driven[: self.structure.zeros + 1] / self.driven[0])

    @property
    def size(self) -> int:
        """Number of free parameters: of the structure, and of further drives."""
        return self.structure.size + len(self.driven) - len(self.numerator)

    @property
    def samples(self) -> int:
        """Number of samples compared."""
        return len(self.residual)

    @cached_property
    def sum_of_squares(self) -> float:
        """Sum of the squared residual [m²]."""
        return float(self.residual @ self.residual)

    @property
    def rms(self) -> float:
        """Root mean square of the residual [m]."""
        return float(np.sqrt(self.sum_of_squares / self.samples))

    @cached_property
    def dynamics(self) -> TransferFunction:
        """G(s) with G(0) = 1."""
        return self.scaled.transfer_function(self.nonlinear, self.numerator)

    def mean_power(self, period: float) -> float:
        """Return the mean square of gain times |G| up to half the sampling rate, 1 / 2 period."""
        lines = np.linspace(0, 0.5 / period, _LINES)
        return float(np.mean(np.abs(self.gain * self.dynamics.response(lines)) ** 2))
