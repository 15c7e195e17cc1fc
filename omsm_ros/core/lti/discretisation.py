"""Discretisation of a continuous G(s) for smooth motions.

Between samples the motion is taken as the polynomial of ``order`` m through the newest m + 1
samples, over which the differential equation of G is integrated exactly:

``x[k] = exp(a) x[k-1] + Σ_j w_j u[k-j]``, ``y[k] = c x[k] + d u[k]``, j = 0 … m.

Poles are mapped by exp(pT): one far above the Nyquist frequency becomes a response within the
sample, while the bilinear transform would make it oscillate at Nyquist. The zeros are those of the
Rosenbrock pencil of this system. The state space is a series of sections of first and second
order, each scaled by its own frequency. A companion form would lose the digits of slow poles. The
delay is a Lagrange interpolator of the same order. At 0 Hz
the gain is G(0).
"""

from dataclasses import dataclass
from functools import cached_property
from math import factorial
from typing import NamedTuple

import numpy as np
import scipy  # whose parts are loaded when they are used
from numpy.polynomial import polynomial

from omsm_ros.core.lti.transfer_function import ComplexArray, TransferFunction
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import ConfigurationError, DataError
from omsm_ros.quantities import SAMPLE_PERIOD

# A zero beyond this is a constant factor to 1e-9 of the gain, or infinite but for rounding.
_FAR_ZERO = 1e9
# Default order: the error is below 1 pm on the motion in test_discretisation.py, with a noise gain
# of 1.03.
DEFAULT_ORDER = 3
# Radians a sample at which the gain is matched if G(0) = 0: slow, but not zero.
_MATCHED_RAD = 0.02
# Relative tolerance for slow motion. A first-order hold of typical dynamics is off by 4e-5, order 3
# by 1e-8; an aliased resonance or a lost root by much more.
_TOLERANCE = 1e-2
# Fewest samples of a motion: a window of ten per cent then fades six samples at each end.
MIN_SAMPLES = 64
# Share of the record over which the window fades at each end.
_FADE = 0.1
_FADED = ("tukey", 2 * _FADE)

# Share of the Nyquist band above which a motion is not resolved by its samples.
_RESOLVED_SHARE = 0.2


class _StateSpace(NamedTuple):
    """x' = a x + b u, y = c x + d u: a (n, n), b (n,), c (n,), d."""

    a: FloatArray
    b: FloatArray
    c: FloatArray
    d: float


def polynomial_hold_zeros(
    zeros: ComplexArray, poles: ComplexArray, order: int, dc_zeros: int = 0
) -> ComplexArray:
    """Return the zeros in the z plane of the system with these roots [rad/sample].

    dc_zeros: number of zeros at s = 0, which are set to z = 1 exactly, because coinciding
        eigenvalues are inaccurate
    """
    if not len(poles):
        return np.empty(0, np.complex128)
    system = _series(zeros, poles)
    n = len(system.a)
    # With a chain of integrators as input, one exponential contains ∫ e^{a(1-v)} b v^j/j! dv.
    chain = np.zeros((n + order + 1, n + order + 1))
    chain[:n, :n], chain[:n, n], chain[n:, n:] = system.a, system.b, np.eye(order + 1, k=1)
    exponential = scipy.linalg.expm(chain)
    monomials = exponential[:n, n:] * [factorial(j) for j in range(order + 1)]
    nodes = 1.0 - np.arange(order + 1)
    # exp(a), and the weights w_j (n, order + 1) of u[k], u[k-1], … from k-1 to k.
    step = exponential[:n, :n]
    weights = monomials @ np.linalg.inv(np.vander(nodes, increasing=True))
    # States (x[k-1], u[k-1] … u[k-m]).
    transition = np.block([[step, weights[:, 1:]], [np.zeros((order, n)), np.eye(order, k=-1)]])
    entry = np.concatenate([weights[:, 0], np.eye(order)[0]])
    leaving = np.concatenate([system.c @ step, system.c @ weights[:, 1:]])
    direct = np.array([float(system.c @ weights[:, 0] + system.d)])
    pencil = np.block([[transition, entry[:, np.newaxis]], [leaving, direct]])
    finite = np.diag(np.append(np.ones(n + order), 0.0))
    found = scipy.linalg.eigvals(pencil, finite)
    found = found[np.isfinite(found) & (abs(found) < _FAR_ZERO)]
    found = _with_exact_ones(found, dc_zeros)
    upper = found[found.imag > 0]
    return np.concatenate([upper, upper.conj(), found[found.imag == 0]])


def _with_exact_ones(found: ComplexArray, count: int) -> ComplexArray:
    """Return the zeros with the ``count`` ones nearest to 1 set to 1.

    Rounding may turn one of them and a slow zero into a conjugate pair. The slow zero then follows
    from the sum of the pair, which is accurate.
    """
    nearest = found[np.argsort(abs(found - 1))]
    taken, others = nearest[:count], nearest[count:]
    if np.sum(taken.imag > 0) != np.sum(taken.imag < 0):
        partner = int(np.argmin(abs(others - np.conj(taken[-1]))))
        others[partner] = 2 * taken[-1].real - 1
    return np.asarray(np.append(np.ones(len(taken)), others), np.complex128)


def _series(zeros: ComplexArray, poles: ComplexArray) -> _StateSpace:
    whole = _StateSpace(np.empty((0, 0)), np.empty(0), np.empty(0), 1.0)
    pairs, reals = _split(zeros)
    of_poles, real = _split(poles)
    # Real poles by two, the last alone where there is one more.
    for group in [*of_poles, *(real[i : i + 2] for i in range(0, len(real), 2))]:
        if len(group) == 2 and pairs:
            taken = pairs.pop(0)
        else:
            taken, reals = reals[: len(group)], reals[len(group) :]
        part = _section(_expanded(taken), _expanded(group))
        corner = np.zeros((len(whole.a), len(part.a)))
        whole = _StateSpace(
            np.block([[whole.a, corner], [np.outer(part.b, whole.c), part.a]]),
            np.concatenate([whole.b, part.b * whole.d]),
            np.concatenate([part.d * whole.c, part.c]),
            part.d * whole.d,
        )
    return whole


def _split(roots: ComplexArray) -> tuple[list[ComplexArray], ComplexArray]:
    """Return conjugate pairs and real roots, the smallest first."""
    ordered = roots[np.argsort(abs(roots))]
    pairs = [np.array([root, np.conj(root)]) for root in ordered if root.imag > 0]
    return pairs, ordered[ordered.imag == 0]


def _expanded(roots: ComplexArray) -> FloatArray:
    if len(roots) == 2 and roots[0].imag:
        return np.array([abs(roots[0]) ** 2, -2 * roots[0].real, 1.0])
    return np.asarray(polynomial.polyfromroots(roots.real), np.float64)


def _section(numerator: FloatArray, denominator: FloatArray) -> _StateSpace:
    """Return the state space of a ratio of first or second order with states y and y'/ω."""
    n = len(denominator) - 1
    omega = abs(denominator[0]) ** (1 / n)
    powers = omega ** np.arange(n + 1)
    padded = np.append(numerator, np.zeros(n + 1 - len(numerator))) * powers
    padded /= max(abs(padded))
    direct = float(padded[n])
    # In units of ω the denominator is 1 + … + 1, monic at both ends.
    monic = denominator * powers / powers[n]
    c = padded[:n] - direct * monic[:n]
    a = omega * np.eye(n, k=1)
    a[-1] = -omega * monic[:n]
    return _StateSpace(a, omega * np.eye(n)[-1], c, direct)


@dataclass(frozen=True, eq=False)
class DigitalFilter:
    """Second-order ``sections`` (k, 6) as in scipy, for samples every ``sample_period`` [s]."""

    sections: FloatArray
    sample_period: float

    def response(self, frequency: FloatArray) -> ComplexArray:
        """Return H at ``frequency`` [Hz], of the same shape."""
        late = np.exp(-2j * np.pi * np.asarray(frequency) * self.sample_period)
        found = np.ones(late.shape, np.complex128)
        for b0, b1, b2, a0, a1, a2 in self.sections:  # thousands for a long delay
            found *= (b0 + late * (b1 + late * b2)) / (a0 + late * (a1 + late * a2))
        return found

    @cached_property
    def poles(self) -> ComplexArray:
        """Poles in the z plane, shape (2k,)."""
        return np.concatenate([np.roots(section[3:]) for section in self.sections])

    def settling_samples(self, tolerance: float) -> int:
        """Return the samples after which a wrong initial state has decayed to ``tolerance``."""
        slowest = float(max(abs(self.poles)))
        recursive = np.log(tolerance) / np.log(slowest) if slowest > 0 else 0.0
        return int(np.ceil(recursive)) + 2 * len(self.sections)

    @cached_property
    def noise_gain(self) -> float:
        """Ratio of the standard deviations of output and input for white noise."""
        pulse = scipy.signal.unit_impulse(self.settling_samples(1e-9) + 1)
        return float(np.linalg.norm(scipy.signal.sosfilt(self.sections, pulse)))


def discretise(
    dynamics: TransferFunction,
    sample_period: float,
    order: int = DEFAULT_ORDER,
    poles: ComplexArray | None = None,
) -> DigitalFilter:
    """Return the digital filter of ``dynamics`` for motions that are smooth to ``order``.

    poles: of ``dynamics`` [rad/s], if known better than from its coefficients

    Raises ConfigurationError for an order outside 1 to 7 or an implausible sample period. Raises
    DataError for dynamics that cannot be represented at this sample period.
    """
    if not 1 <= order <= 7:
        raise ConfigurationError("lti.order", order=order)
    SAMPLE_PERIOD.checked(sample_period, ConfigurationError, "sample_period")
    continuous = (dynamics.poles() if poles is None else poles) * sample_period
    dc_zeros = min(int(np.flatnonzero(dynamics.numerator)[0]), order + 1)
    zeros = polynomial_hold_zeros(dynamics.zeros() * sample_period, continuous, order, dc_zeros)
    discrete = np.append(np.exp(continuous), np.zeros(order if len(continuous) else 0))
    late, delay_zeros = _lagrange_delay(dynamics.delay / sample_period, order)
    late += len(discrete) - len(zeros)
    zeros = np.concatenate([zeros, delay_zeros])
    discrete = np.append(discrete, np.zeros(len(delay_zeros)))
    gain = _gain(dynamics, sample_period, zeros, discrete, late)
    digital = DigitalFilter(_sections(zeros, discrete, gain, late), sample_period)
    # H differs from G at slow motion by aliasing or rounding.
    slow = np.array([0.5, 1.0]) * _MATCHED_RAD / (2 * np.pi * sample_period)
    if not np.allclose(digital.response(slow), dynamics.response(slow), rtol=_TOLERANCE, atol=0.0):
        raise DataError(
            "lti.not_sampled", period=sample_period, poles=dynamics.poles(), tolerance=_TOLERANCE
        )
    return digital


def _gain(
    dynamics: TransferFunction,
    sample_period: float,
    zeros: ComplexArray,
    poles: ComplexArray,
    late: int,
) -> float:
    angle = 0.0 if dynamics.dc_gain != 0 else _MATCHED_RAD
    z = np.exp(1j * angle)
    monic = np.prod(1 - zeros / z) / np.prod(1 - poles / z) * z**-late
    wanted = dynamics.response(np.array([angle / (2 * np.pi * sample_period)]))[0]
    return float(np.real(wanted / monic))


def _sections(zeros: ComplexArray, poles: ComplexArray, gain: float, late: int) -> FloatArray:
    pairs, single = divmod(late, 2)
    delays = [[0.0, 0.0, 1.0, 1.0, 0.0, 0.0]] * pairs + [[0.0, 1.0, 0.0, 1.0, 0.0, 0.0]] * single
    rational = scipy.signal.zpk2sos(zeros, poles, gain)
    return np.vstack([rational, *np.reshape(delays, (-1, 1, 6))])


def bilinear(
    dynamics: TransferFunction, sample_period: float, poles: ComplexArray | None = None
) -> DigitalFilter:
    """Return the bilinear transform of G without its delay; ``poles`` as in :func:`discretise`."""
    roots = dynamics.poles() if poles is None else poles
    leading = np.trim_zeros(dynamics.numerator, "b")[-1] / dynamics.denominator[-1]
    mapped = scipy.signal.bilinear_zpk(dynamics.zeros(), roots, leading, 1 / sample_period)
    return DigitalFilter(scipy.signal.zpk2sos(*mapped), sample_period)


def _lagrange_delay(delay: float, order: int) -> tuple[int, ComplexArray]:
    """Return whole samples and zeros of the interpolator for a delay of ``delay`` samples."""
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


def checked_motion(z: FloatArray) -> FloatArray:
    """Return ``z`` (n,) as float64; raise DataError if it is too short or not finite."""
    motion = np.asarray(z, np.float64)
    if motion.ndim != 1 or len(motion) < MIN_SAMPLES:
        raise DataError("lti.short_motion", shape=motion.shape, least=MIN_SAMPLES)
    if not np.all(np.isfinite(motion)):
        lost = int(np.count_nonzero(~np.isfinite(motion)))
        raise DataError("lti.lost_motion", values=lost)
    return motion


def velocity_spectrum(
    z: FloatArray, sample_period: float, faded: bool = False
) -> tuple[FloatArray, ComplexArray]:
    """Return frequencies [Hz] (k,) and the spectrum of the windowed velocity [m/s] (k,).

    faded: use a Tukey window instead of a Blackman-Harris window

    Half the sum of |V|² is the mean square velocity. The velocity is a difference quotient,
    corrected to a derivative, and includes its mean. The record is zero-padded to a length with a
    fast transform. Velocity is used because it leaks less than millimetres of travel.
    """
    velocity = np.diff(checked_motion(z)) / sample_period
    window = _FADED if faded else "blackmanharris"
    weights = scipy.signal.get_window(window, len(velocity))
    samples = scipy.fft.next_fast_len(len(velocity), real=True)
    frequency = np.fft.rfftfreq(samples, sample_period)
    spectrum = np.fft.rfft(velocity * weights, samples) / np.sinc(frequency * sample_period)
    scale = np.full(len(frequency), 2.0)
    scale[0] = np.sqrt(2.0)
    if samples % 2 == 0:
        scale[-1] = np.sqrt(2.0)
    norm = np.sqrt(samples * np.sum(weights**2))
    velocities = np.asarray(scale * spectrum / norm, np.complex128)
    return np.asarray(frequency, np.float64), velocities


def discretisation_error(
    dynamics: TransferFunction, digital: DigitalFilter, z: FloatArray, up_to: float
) -> tuple[float, float]:
    """Return rms and peak to valley of (H - G) z [m] for the motion within 0 … ``up_to`` [Hz]."""
    period = digital.sample_period
    frequency, velocity = velocity_spectrum(z, period, faded=True)
    band = (frequency > 0) & (frequency <= min(up_to, _RESOLVED_SHARE * 0.5 / period))
    difference = np.zeros(len(frequency), np.complex128)
    inside = frequency[band]
    difference[band] = (digital.response(inside) - dynamics.response(inside)) / (
        2j * np.pi * inside
    )
    error = difference * velocity
    rms = float(np.sqrt(np.sum(abs(error) ** 2) / 2))
    samples = len(z) - 1
    padded = scipy.fft.next_fast_len(samples, real=True)
    amplitude = np.sqrt(padded * np.sum(scipy.signal.get_window(_FADED, samples) ** 2)) / 2
    over_time = np.fft.irfft(error * amplitude, padded)[:samples]
    fade = int(_FADE * samples) + 1
    return rms, float(np.ptp(over_time[fade:-fade]))
