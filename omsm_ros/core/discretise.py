"""How does a continuous G(s) act on samples?

Between samples the encoder's motion is smooth, so it is taken as the polynomial through
the newest ``order + 1`` samples, and the differential equation of G is integrated exactly
over it. Poles are mapped by exp(pT): one far above the Nyquist frequency becomes a
response within the sample, where the bilinear transform would make it ring at Nyquist.
The pure delay is a Lagrange interpolator of the same order. At 0 Hz the gain is G(0).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import factorial

import numpy as np
from numpy.polynomial import polynomial
from scipy import linalg, signal

from omsm_ros.core.records import FloatArray
from omsm_ros.core.transfer_function import ComplexArray, TransferFunction
from omsm_ros.errors import ConfigurationError

DEFAULT_ORDER = 3
# Radians a sample at which the gain of a response without DC is matched: slow, yet not nothing.
_MATCHED_RAD = 0.02
# A zero this far out is a constant factor to 1e-9 of the gain, or infinity after rounding.
_FAR_ZERO = 1e9


@dataclass(frozen=True, eq=False)
class DigitalFilter:
    """Second-order ``sections`` (k, 6) as in scipy, for samples every ``sample_period`` [s]."""

    sections: FloatArray
    sample_period: float

    def response(self, frequency: FloatArray) -> ComplexArray:
        """H at ``frequency`` [Hz], of the same shape."""
        backward = np.exp(-2j * np.pi * np.asarray(frequency) * self.sample_period)
        result = np.ones_like(backward)
        for section in self.sections:
            result = result * polynomial.polyval(backward, section[:3])
            result = result / polynomial.polyval(backward, section[3:])
        return np.asarray(result, np.complex128)

    @cached_property
    def poles(self) -> ComplexArray:
        """Poles in the z plane, shape (2k,)."""
        return np.concatenate([np.roots(section[3:]) for section in self.sections])

    def settling_samples(self, tolerance: float) -> int:
        """Samples until a wrong start is forgotten to ``tolerance`` of itself."""
        slowest = float(max(abs(self.poles)))
        recursive = np.log(tolerance) / np.log(slowest) if slowest > 0 else 0.0
        return int(np.ceil(recursive)) + 2 * len(self.sections)

    @cached_property
    def noise_gain(self) -> float:
        """Standard deviation out per standard deviation in, for white noise."""
        pulse = np.zeros(self.settling_samples(1e-9) + 1)
        pulse[0] = 1.0
        return float(np.linalg.norm(signal.sosfilt(self.sections, pulse)))


def discretise(
    dynamics: TransferFunction, sample_period: float, order: int = DEFAULT_ORDER
) -> DigitalFilter:
    """Integrate ``dynamics`` over the polynomial of ``order`` through the newest samples.

    Raises ConfigurationError for an order outside 1 to 7 or a sample_period that is not positive.
    """
    if not 1 <= order <= 7:
        raise ConfigurationError(f"interpolation order {order!r}, expected 1 to 7")
    if not (np.isfinite(sample_period) and sample_period > 0):
        raise ConfigurationError(f"sample_period {sample_period!r} s, expected a positive number")
    poles = np.exp(dynamics.poles() * sample_period)
    zeros = _sampled_zeros(dynamics, sample_period, order)
    if len(poles):
        poles = np.append(poles, np.zeros(order))
    late, delay_zeros = _lagrange_delay(dynamics.delay / sample_period, order)
    late += len(poles) - len(zeros)
    zeros = np.concatenate([zeros, delay_zeros])
    poles = np.append(poles, np.zeros(len(delay_zeros)))
    gain = _gain(dynamics, sample_period, zeros, poles, late)
    return DigitalFilter(_sections(zeros, poles, gain, late), sample_period)


def _gain(
    dynamics: TransferFunction,
    sample_period: float,
    zeros: ComplexArray,
    poles: ComplexArray,
    late: int,
) -> float:
    """The factor that makes H equal to G at 0 Hz, or close to 0 where G(0) = 0."""
    angle = 0.0 if dynamics.dc_gain != 0 else _MATCHED_RAD
    z = np.exp(1j * angle)
    monic = np.prod(1 - zeros / z) / np.prod(1 - poles / z) * z**-late
    wanted = dynamics.response(np.array([angle / (2 * np.pi * sample_period)]))[0]
    return float(np.real(wanted / monic))


def _sections(zeros: ComplexArray, poles: ComplexArray, gain: float, late: int) -> FloatArray:
    """Second-order sections of ``late`` whole samples of delay and Π(1 - z_i/z) / Π(1 - p_i/z)."""
    pairs, single = divmod(late, 2)
    delays = [[0.0, 0.0, 1.0, 1.0, 0.0, 0.0]] * pairs + [[0.0, 1.0, 0.0, 1.0, 0.0, 0.0]] * single
    # zpk2sos counts zeros and poles alike: what it pads lies at the origin, a factor of 1 here.
    return np.vstack([signal.zpk2sos(zeros, poles, gain), *np.reshape(delays, (-1, 1, 6))])


def bilinear(dynamics: TransferFunction, sample_period: float) -> DigitalFilter:
    """The bilinear transform of G without its delay."""
    leading = np.trim_zeros(dynamics.numerator, "b")[-1] / dynamics.denominator[-1]
    zpk = signal.bilinear_zpk(dynamics.zeros(), dynamics.poles(), leading, 1 / sample_period)
    return DigitalFilter(np.asarray(signal.zpk2sos(*zpk)), sample_period)


def _sampled_zeros(dynamics: TransferFunction, sample_period: float, order: int) -> ComplexArray:
    """Zeros of the sampled system, from the Rosenbrock pencil of its state space.

    With the time in sample periods and states (x[k-1], u[k-1] … u[k-order]):
    ``x[k] = exp(a) x[k-1] + Σ_j w_j u[k-j]``, ``y[k] = c x[k] + d u[k]``.
    """
    a, b, c, d = _state_space(dynamics, 1 / sample_period)
    if not len(a):
        return np.empty(0, np.complex128)
    step, weights = _held_integrals(a, b, order)
    n = len(a)
    shift = np.eye(order, k=-1)
    system = np.block([[step, weights[:, 1:]], [np.zeros((order, n)), shift]])
    entry = np.concatenate([weights[:, 0], np.eye(order)[0]])
    exit_row = np.concatenate([c @ step, c @ weights[:, 1:]])
    direct = float(c @ weights[:, 0] + d)
    pencil = np.block([[system, entry[:, np.newaxis]], [exit_row, np.array([direct])]])
    mass = linalg.block_diag(np.eye(n + order), 0.0)
    zeros = linalg.eigvals(pencil, mass)
    zeros = zeros[np.isfinite(zeros) & (abs(zeros) < _FAR_ZERO)]
    # What G takes the derivative of, interpolation keeps: those zeros are at 1 exactly, but
    # eigenvalues that coincide are computed to a few digits only.
    at_rest = min(int(np.flatnonzero(dynamics.numerator)[0]), order + 1)
    zeros[np.argsort(abs(zeros - 1))[:at_rest]] = 1.0
    return np.asarray(zeros, np.complex128)


def _state_space(
    dynamics: TransferFunction, rate: float
) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Controllable canonical form with the time in units of 1/rate: a (n, n), b (n,), c (n,), d."""
    denominator = np.trim_zeros(dynamics.denominator, "b")
    order = len(denominator) - 1
    powers = rate ** np.arange(order + 1, dtype=np.float64)
    leading = denominator[-1] * powers[-1]
    monic = denominator * powers / leading
    numerator = np.zeros(order + 1)
    used = np.trim_zeros(dynamics.numerator, "b")
    numerator[: len(used)] = used * powers[: len(used)] / leading
    a = np.eye(order, k=1)
    if order:
        a[-1] = -monic[:-1]
    direct = float(numerator[-1])
    return (
        a,
        np.eye(order)[:, -1] if order else np.empty(0),
        numerator[:-1] - direct * monic[:-1],
        direct,
    )


def _held_integrals(a: FloatArray, b: FloatArray, order: int) -> tuple[FloatArray, FloatArray]:
    """exp(a) and the weights w_j (n, order + 1) of u[k], u[k-1] … in the step from k-1 to k."""
    n = len(a)
    # Driving states by a chain of integrators makes one exponential hold ∫ e^{a(1-v)} b v^j/j! dv.
    chain = np.zeros((n + order + 1, n + order + 1))
    chain[:n, :n] = a
    chain[:n, n] = b
    chain[n:, n:] = np.eye(order + 1, k=1)
    exponential = linalg.expm(chain)
    monomials = exponential[:n, n:] * [factorial(j) for j in range(order + 1)]
    nodes = 1.0 - np.arange(order + 1)
    coefficients = np.linalg.inv(np.vander(nodes, increasing=True))
    return exponential[:n, :n], np.asarray(monomials @ coefficients)


def _lagrange_delay(delay: float, order: int) -> tuple[int, ComplexArray]:
    """A delay of ``delay`` samples: leading whole samples, and zeros of the interpolator."""
    if delay == 0:
        return 0, np.empty(0, np.complex128)
    whole = max(int(np.floor(delay)) - (order - 1) // 2, 0)
    nodes = np.arange(order + 1)
    taps = np.array(
        [np.prod([(delay - whole - k) / (j - k) for k in nodes if k != j]) for j in nodes]
    )
    taps = np.where(abs(taps) < 1e-12, 0.0, taps)
    first = int(np.flatnonzero(taps)[0])
    return whole + first, np.asarray(np.roots(np.trim_zeros(taps)), np.complex128)
