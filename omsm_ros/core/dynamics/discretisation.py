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

import numpy as np
from numpy.polynomial import polynomial

from omsm_ros.core.dynamics.polynomial_hold import held_zeros
from omsm_ros.core.dynamics.second_order_sections import bilinear_roots, second_order_sections
from omsm_ros.core.dynamics.transfer_function import ComplexArray, TransferFunction
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.errors import ConfigurationError, DataError
from omsm_ros.quantities import SAMPLE_PERIOD
from omsm_ros.scipy_parts import sosfilt

# Below 1 pm on the paper's motion (test_discretisation.py), with a noise gain of 1.03.
DEFAULT_ORDER = 3
# Radians a sample at which the gain of a response without DC is matched: slow, yet not nothing.
_MATCHED_RAD = 0.02
# Of the slow response. A first-order hold of the paper's dynamics is off by 4e-5, a third-order one
# by 1e-8; a resonance that folds here, or a lost root, by much more.
_TOLERANCE = 1e-2


@dataclass(frozen=True, eq=False)
class DigitalFilter:
    """Second-order ``sections`` (k, 6) as in scipy, for samples every ``sample_period`` [s]."""

    sections: FloatArray
    sample_period: float

    def response(self, frequency: FloatArray) -> ComplexArray:
        """Return H at ``frequency`` [Hz], of the same shape."""
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
        """Return the samples until a wrong start is forgotten to ``tolerance`` of itself."""
        slowest = float(max(abs(self.poles)))
        recursive = np.log(tolerance) / np.log(slowest) if slowest > 0 else 0.0
        return int(np.ceil(recursive)) + 2 * len(self.sections)

    @cached_property
    def noise_gain(self) -> float:
        """Standard deviation out per standard deviation in, for white noise."""
        pulse = np.zeros(self.settling_samples(1e-9) + 1)
        pulse[0] = 1.0
        at_rest = np.zeros((len(self.sections), 2))
        return float(np.linalg.norm(sosfilt(self.sections, pulse, at_rest)))


def discretise(
    dynamics: TransferFunction,
    sample_period: float,
    order: int = DEFAULT_ORDER,
    poles: ComplexArray | None = None,
) -> DigitalFilter:
    """Integrate ``dynamics`` over the polynomial of ``order`` through the newest samples.

    poles: of ``dynamics`` [rad/s], where they are known better than from its coefficients

    Raises ConfigurationError for an order outside 1 to 7 or a sample_period that is not
    positive, DataError for dynamics that samples this far apart cannot represent.
    """
    if not 1 <= order <= 7:
        raise ConfigurationError(f"interpolation order {order!r}, expected 1 to 7")
    SAMPLE_PERIOD.checked(sample_period, ConfigurationError, "sample_period")
    continuous = (dynamics.poles() if poles is None else poles) * sample_period
    at_rest = min(int(np.flatnonzero(dynamics.numerator)[0]), order + 1)
    zeros = held_zeros(dynamics.zeros() * sample_period, continuous, order, at_rest)
    discrete = np.append(np.exp(continuous), np.zeros(order if len(continuous) else 0))
    late, delay_zeros = _lagrange_delay(dynamics.delay / sample_period, order)
    late += len(discrete) - len(zeros)
    zeros = np.concatenate([zeros, delay_zeros])
    discrete = np.append(discrete, np.zeros(len(delay_zeros)))
    gain = _gain(dynamics, sample_period, zeros, discrete, late)
    digital = DigitalFilter(_sections(zeros, discrete, gain, late), sample_period)
    return _checked(digital, dynamics)


def _checked(digital: DigitalFilter, dynamics: TransferFunction) -> DigitalFilter:
    """Raise DataError where H misses G at slow motion: folded resonances, or roots ill rounded."""
    slow = np.array([0.5, 1.0]) * _MATCHED_RAD / (2 * np.pi * digital.sample_period)
    if not np.allclose(digital.response(slow), dynamics.response(slow), rtol=_TOLERANCE, atol=0.0):
        raise DataError(
            f"sampled every {digital.sample_period!r} s, a transfer function with poles "
            f"{dynamics.poles()!r} rad/s would be off by more than {_TOLERANCE:.0%} even for slow "
            "motion; sample faster or identify a lower order"
        )
    return digital


def _gain(
    dynamics: TransferFunction,
    sample_period: float,
    zeros: ComplexArray,
    poles: ComplexArray,
    late: int,
) -> float:
    """Return the factor that makes H equal to G at 0 Hz, or close to 0 where G(0) = 0."""
    angle = 0.0 if dynamics.dc_gain != 0 else _MATCHED_RAD
    z = np.exp(1j * angle)
    monic = np.prod(1 - zeros / z) / np.prod(1 - poles / z) * z**-late
    wanted = dynamics.response(np.array([angle / (2 * np.pi * sample_period)]))[0]
    return float(np.real(wanted / monic))


def _sections(zeros: ComplexArray, poles: ComplexArray, gain: float, late: int) -> FloatArray:
    """Return the sections of z^-late Π(1 - z_i/z) / Π(1 - p_i/z), scaled by ``gain``."""
    pairs, single = divmod(late, 2)
    delays = [[0.0, 0.0, 1.0, 1.0, 0.0, 0.0]] * pairs + [[0.0, 1.0, 0.0, 1.0, 0.0, 0.0]] * single
    rational = second_order_sections(zeros, poles, gain)
    return np.vstack([rational, *np.reshape(delays, (-1, 1, 6))])


def bilinear(
    dynamics: TransferFunction, sample_period: float, poles: ComplexArray | None = None
) -> DigitalFilter:
    """Return the bilinear transform of G without its delay; ``poles`` as in :func:`discretise`."""
    leading = np.trim_zeros(dynamics.numerator, "b")[-1] / dynamics.denominator[-1]
    roots = dynamics.poles() if poles is None else poles
    zeros, digital, gain = bilinear_roots(dynamics.zeros(), roots, leading, sample_period)
    return DigitalFilter(second_order_sections(zeros, digital, gain), sample_period)


def _lagrange_delay(delay: float, order: int) -> tuple[int, ComplexArray]:
    """Return a delay of ``delay`` samples: leading whole samples, and zeros of the interpolator."""
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
