"""Responses of one output to several inputs, as a sum of sections of first and second order.

``H_j = exp(-s τ_j) (direct_j + Σ_i (b0_ji + b1_ji w)/(1 + d1_i w + d2_i w²))``: the inputs j share
the poles. For a band-limited input w = s. For an input that is held between samples
``w = (2/T)(z - 1)/(z + 1)``, so H is rational in z, and a pole is stable in w where it is in z.
A product of 40 poles has no accurate coefficients; a sum of sections has.

The G(s) of a held H(z): each pole p of H is exp(sT) of a pole of G, and its residue follows in
closed form. With a zero-order hold ``x' = s x + u`` gives ``x[k+1] = p x[k] + h u[k]``,
h = (p - 1)/s; with a first-order hold ``x[k+1] = p x[k] + h0 u[k] + h1 u[k+1]``,
h1 = (h/T - 1)/s, h0 = h - h1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
from numpy.polynomial import polynomial
from scipy import fft, linalg

from omsm_ros.core.kinematics.trajectories import s_curve
from omsm_ros.core.lti.frequency_response import Band
from omsm_ros.core.lti.transfer_function import ComplexArray, TransferFunction
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.linear_algebra import inverse_gram, sosfilt

BAND_LIMITED, ZERO_ORDER, FIRST_ORDER = "band-limited", "zero-order", "first-order"
HOLDS = (BAND_LIMITED, ZERO_ORDER, FIRST_ORDER)
# Duration of the bridge: across the whole travel it adds nothing near the fastest motion.
_BRIDGE_S = 0.3
# Least length of the bridge, so that it is smooth at a low sampling rate too.
_MIN_BRIDGE_SAMPLES = 64
# Rest after the bridge, in which a lightly damped mode decays.
STATIONARY_S = 1.0
# Most rest per duration: a record of milliseconds shows no mode that rings for a second.
_PLATEAU_SHARE = 4.0
# Sampling period for which the durations of ``close_period`` are made.
_NOMINAL_PERIOD_S = 1e-3
# The variable w at half the sampling rate of a held input, in rad/sample: infinite, here large.
_INFINITE = 1e7
# A pole nearer to z = 0 or to the negative axis has no equivalent in s.
_NO_EQUIVALENT = 1e-6
# Residues of poles nearer to each other than this are lost in rounding.
_APART = 1e-9


@dataclass(frozen=True, eq=False, kw_only=True)
class ParallelSections:
    """The sections of all inputs.

    hold: one of HOLDS;  period: [s]
    denominators: (k, 2), d1 [s] > 0 and d2 [s²], 0 for a single pole
    numerators: (m, k, 2), b0 and b1 [s];  direct: (m,);  delays: (m,) [s]
    covariance: (p, p), order direct and numerators of each input, denominators, delays; or None
    """

    hold: str
    period: float
    denominators: FloatArray
    numerators: FloatArray
    direct: FloatArray
    delays: FloatArray
    covariance: FloatArray | None = None

    @property
    def order(self) -> int:
        """Return the number of poles."""
        return int(np.count_nonzero(self.denominators))

    @property
    def inputs(self) -> int:
        """Return the number of inputs."""
        return len(self.direct)

    def variable(self, frequency: FloatArray) -> ComplexArray:
        """Return w at ``frequency`` (f,) [Hz]."""
        cycles = np.asarray(frequency, np.float64) * self.period
        return np.asarray(variable(self.hold, cycles) / self.period)

    def response(self, frequency: FloatArray) -> ComplexArray:
        """Return H of each input at ``frequency`` (f,) [Hz], (m, f)."""
        w, every = self.variable(frequency), []
        basis = self._basis(w)
        for direct, up, delay in zip(self.direct, self.numerators, self.delays, strict=True):
            value = direct + np.sum((up[:, :1] + up[:, 1:] * w) * basis, axis=0)
            every.append(value * np.exp(-2j * np.pi * np.asarray(frequency) * delay))
        return np.asarray(every, np.complex128)

    def _basis(self, w: ComplexArray) -> ComplexArray:
        d1, d2 = self.denominators.T[:, :, np.newaxis]
        return np.asarray(1 / (1 + d1 * w + d2 * w * w), np.complex128)

    def band(self, frequency: FloatArray, input: int = 0) -> Band:
        """Return the standard uncertainty of gain and phase of one input at ``frequency`` [Hz]."""
        frequency = np.asarray(frequency, np.float64)
        if self.covariance is None:
            return Band(frequency, np.full(len(frequency), np.inf), np.full(len(frequency), np.inf))
        w, omega = self.variable(frequency), 2 * np.pi * frequency
        late, basis = np.exp(-1j * omega * self.delays[input]), self._basis(w)
        up = self.numerators[input]
        part = (up[:, :1] + up[:, 1:] * w) * basis
        value = self.response(frequency)[input]
        each = 1 + 2 * len(self.denominators)
        jacobian = np.zeros((self.inputs * (each + 1) + each - 1, len(w)), np.complex128)
        ups, downs = jacobian[input * each :][:each], jacobian[self.inputs * each :][: each - 1]
        ups[0], ups[1::2], ups[2::2] = late, late * basis, late * basis * w
        downs[::2], downs[1::2] = -late * part * basis * w, -late * part * basis * w * w
        jacobian[input - self.inputs] = -1j * omega * value
        jacobian /= np.where(value == 0, np.finfo(float).tiny, value)
        gain, phase = (
            np.sqrt(np.maximum(np.einsum("pk,pq,qk->k", j, self.covariance, j), 0.0))
            for j in (jacobian.real, jacobian.imag)
        )
        return Band(frequency, gain, phase)

    def roots(self) -> ComplexArray:
        """Return the poles in w [1/s], (n,), conjugates included."""
        found = [_roots(d1, d2) for d1, d2 in self.denominators]
        return np.asarray(np.concatenate([np.empty(0), *found]), np.complex128)

    def poles(self) -> ComplexArray:
        """Return the poles in s [rad/s], (n,); of a held input log z / T."""
        if self.hold == BAND_LIMITED:
            return self.roots()
        half = 0.5 * self.period * self.roots()
        return np.asarray(np.log((1 + half) / (1 - half)) / self.period, np.complex128)

    def driven(self, inputs: FloatArray) -> FloatArray:
        """Return the output (n,) for ``inputs`` (n, m), as if they repeated for ever.

        The difference from another past is a sum of :meth:`decays`.
        """
        closed = closed_inputs(inputs, self.hold)
        frequency = fft.rfftfreq(closed.shape[1], self.period)
        spectrum = np.sum(self.response(frequency) * fft.rfft(closed), axis=0)
        return np.asarray(fft.irfft(spectrum, closed.shape[1])[: len(inputs)])

    def decays(self, samples: int) -> FloatArray:
        """Return the responses (states, samples) to any past and to the first samples."""
        late = int(np.ceil(np.max(self.delays, initial=0.0) / self.period - 1e-6))
        pulses = np.eye(min(late + (self.hold != BAND_LIMITED), samples), samples)
        down = [recursion(d1, d2, self.hold, self.period) for d1, d2 in self.denominators]
        rows = orthogonal_decays(down, max(samples - late, 1))
        return np.concatenate([np.pad(rows, ((0, 0), (samples - rows.shape[1], 0))), pulses])

    def equivalent(self) -> ParallelSections | None:
        """Return G(s) of which this is the sampled form; None where there is no such G.

        A pole at z ≤ 0 has none, nor have two poles of one section that agree.
        """
        if self.hold == BAND_LIMITED:
            return self
        direct, sections, ups = self.direct.copy(), [], []
        for (d1, d2), up in zip(self.denominators, np.moveaxis(self.numerators, 1, 0), strict=True):
            w = _roots(d1, d2)
            z = (1 + 0.5 * self.period * w) / (1 - 0.5 * self.period * w)
            apart = np.abs(z[0] - z[-1]) > _APART or len(z) == 1
            off = np.abs(z.imag) > _NO_EQUIVALENT
            if not apart or np.any(~off & (z.real <= _NO_EQUIVALENT)) or np.any(abs(z - 1) < 1e-12):
                return None
            there, poles, residues = self._residues(w, z, up, d1, d2)
            direct = direct + there
            sections.append(_polynomial_of(poles))
            ups.append([_numerator_of(poles, each) for each in residues])
        return replace(
            self,
            hold=BAND_LIMITED,
            direct=direct,
            denominators=np.reshape(sections, (-1, 2)),
            numerators=np.moveaxis(np.reshape(ups, (-1, self.inputs, 2)), 0, 1),
            covariance=None,
        )

    def _residues(
        self, w: ComplexArray, z: ComplexArray, up: FloatArray, d1: float, d2: float
    ) -> tuple[FloatArray, ComplexArray, ComplexArray]:
        """Return what a section adds to the direct terms (m,), its poles (1 or 2,) and residues."""
        slope = d1 + 2 * d2 * w
        factor = (up[:, :1] + up[:, 1:] * w) / slope / (2 / self.period - w)
        direct, residues = np.sum(factor, axis=1).real, factor * (1 + z)
        s = np.asarray(np.log(z.astype(np.complex128)) / self.period, np.complex128)
        held = (z - 1) / s
        if self.hold == ZERO_ORDER:
            return np.asarray(direct), s, np.asarray(residues / held, np.complex128)
        now = (held / self.period - 1) / s
        scaled = np.asarray(residues / (held - now + z * now), np.complex128)
        return np.asarray(direct - np.sum(scaled * now, axis=1).real), s, scaled

    def transfer_function(self, input: int = 0) -> TransferFunction:
        """Return one response of a band-limited model as a ratio of two polynomials in s.

        Its coefficients lose digits with every pole: see ``continuous_error`` in the certificate.
        """
        factors = [np.trim_zeros(np.array([1.0, *d]), "b") for d in self.denominators]
        down = reduce(np.convolve, [np.ones(1), *factors])
        up = self.direct[input] * down
        for place, section in enumerate(self.numerators[input]):
            others = reduce(np.convolve, [np.ones(1), *factors[:place], *factors[place + 1 :]])
            up = polynomial.polyadd(up, polynomial.polymul(np.trim_zeros(section, "b"), others))
        up = np.trim_zeros(up, "b")
        return TransferFunction(up if len(up) else np.zeros(1), down, float(self.delays[input]))


def variable(hold: str, frequency: FloatArray) -> ComplexArray:
    """Return w [rad/sample] at ``frequency`` (f,) in cycles a sample."""
    if hold == BAND_LIMITED:
        return np.asarray(2j * np.pi * frequency, np.complex128)
    with np.errstate(over="ignore"):
        return np.asarray(2j * np.clip(np.tan(np.pi * frequency), None, _INFINITE), np.complex128)


def close_period(motion: FloatArray, period: float) -> FloatArray:
    """Return ``motion`` (n,) closed to a period by a smooth bridge to its start and a rest.

    The rest lets modes decay before the period repeats; the length suits the FFT.
    """
    duration = len(motion) * period
    bridge = max(round(min(_BRIDGE_S, duration) / period), _MIN_BRIDGE_SAMPLES)
    rest = round(min(STATIONARY_S, _PLATEAU_SHARE * duration) / period)
    total = fft.next_fast_len(len(motion) + bridge + rest, real=True)
    phase = np.arange(1, total - len(motion) + 1) / bridge
    way_back = motion[-1] + (motion[0] - motion[-1]) * s_curve(np.asarray(phase))
    return np.concatenate([motion, way_back])


def closed_inputs(inputs: FloatArray, hold: str) -> FloatArray:
    """Return ``inputs`` (n, m) as rows of a period, (m, N); smooth ones with a bridge."""
    if hold != BAND_LIMITED:
        return np.ascontiguousarray(inputs.T)
    return np.array([close_period(column, _NOMINAL_PERIOD_S) for column in inputs.T])


def recursion(d1: float, d2: float, hold: str, period: float) -> FloatArray:
    """Return the denominator in z⁻¹ (2 or 3,) of the section 1 + d1 w + d2 w², its first 1."""
    if hold == BAND_LIMITED and d2 > 0:
        mean, apart = np.exp(-0.5 * d1 / d2 * period), d1 * d1 - 4 * d2
        turn = 0.5 * np.sqrt(abs(apart)) / d2 * period
        if apart < 0:
            return np.array([1.0, -2 * mean * np.cos(turn), mean**2])
        ends = np.exp((-0.5 * d1 / d2) * period + np.array([turn, -turn]))
        return np.array([1.0, -float(np.sum(ends)), mean**2])
    if hold == BAND_LIMITED:
        return np.array([1.0, -np.exp(-period / d1)])
    first, second = 2 * d1 / period, 4 * d2 / period**2
    if d2 > 0:
        found = np.array([1 + first + second, 2 * (1 - second), 1 - first + second])
    else:
        found = np.array([1 + first, 1 - first])
    return np.asarray(found / found[0])


def _roots(d1: float, d2: float) -> ComplexArray:
    """Return the roots (1 or 2,) of 1 + d1 w + d2 w², the smaller one without cancellation."""
    if d2 == 0:
        return np.array([-1 / d1 + 0j])
    apart = np.sqrt(complex(d1 * d1 - 4 * d2))
    far = -0.5 * (d1 + apart) / d2
    return np.array([far, 1 / (d2 * far)])


def orthogonal_decays(downs: list[FloatArray], samples: int) -> FloatArray:
    """Return functions (states, samples) that span the free responses of all recursions ``downs``.

    Those of Takenaka and Malmquist (Ninness and Gustafsson 1997): each section is driven by the
    all-passes of those before. They are orthogonal over an endless record, so their products are
    well conditioned, where those of the decays of neighbouring poles are not.
    """
    rows, place = np.zeros((sum(len(down) - 1 for down in downs), samples)), 0
    pulse = np.zeros(samples)
    pulse[:1] = 1.0
    for down in downs:
        now = sosfilt(np.array([[1.0, 0.0, 0.0, *down, 0.0][:6]]), pulse, np.zeros((1, 2)))
        rows[place] = now
        # The all-pass of the section has its denominator in the reverse order above it.
        pulse = down[-1] * now
        for late, factor in enumerate(down[-2::-1], 1):
            pulse[late:] += factor * now[:-late]
        if len(down) == 3:
            # Sum and difference of neighbours are orthogonal, too.
            rows[place + 1] = now
            rows[place, 1:] += now[:-1]
            rows[place + 1, 1:] -= now[:-1]
        place += len(down) - 1
    return rows


def basis_of(sections: FloatArray, w: ComplexArray) -> ComplexArray:
    """Return 1, then 1/S and w/S of each section S at ``w`` (k,), (1 + n, k).

    There is no w/S of a single pole.
    """
    found, place = np.empty((1 + int(np.count_nonzero(sections)), len(w)), np.complex128), 1
    found[0] = 1.0
    for d1, d2 in sections:
        np.divide(1.0, 1.0 + w * (d1 + d2 * w), out=found[place])
        if d2 > 0:
            np.multiply(w, found[place], out=found[place + 1])
        place += 1 + (d2 > 0)
    return found


def _polynomial_of(poles: ComplexArray) -> list[float]:
    if len(poles) == 1:
        return [float((-1 / poles[0]).real), 0.0]
    product = poles[0] * poles[1]
    return [float((-(poles[0] + poles[1]) / product).real), float((1 / product).real)]


def _numerator_of(poles: ComplexArray, residues: ComplexArray) -> list[float]:
    """Return b0, b1 of Σ r/(s - p) over the denominator of :func:`_polynomial_of`."""
    if len(poles) == 1:
        return [float((-residues[0] / poles[0]).real), 0.0]
    product = poles[0] * poles[1]
    b0 = -(residues[0] * poles[1] + residues[1] * poles[0]) / product
    return [float(b0.real), float((np.sum(residues) / product).real)]


# Least damping ratio that a start may have, and range of its |poles|.
_LEAST_DAMPING, _SLOWEST, _FASTEST = 1e-5, 1e-6, 1e4


def relocated(
    poles: ComplexArray, data: Sequence[tuple[ComplexArray, ComplexArray, ComplexArray]]
) -> ComplexArray:
    """Return the zeros of σ with σ Y ≈ Σ_j N_j U_j + transients, all over ``poles`` (n,).

    data: of each record w (k,), inputs (m, k) and output (k,). The zeros are reflected into the
    left half plane, and kept within the range of a start.
    """
    upper, real = poles[poles.imag > 0], poles[poles.imag == 0].real
    grams = []
    for w, inputs, output in data:
        pairs = [np.array([1 / (w - p), 1 / (w - np.conj(p))]) for p in upper]
        basis = [b for one, other in pairs for b in (one + other, 1j * (one - other))]
        fractions = np.reshape([*basis, *(1 / (w - p) for p in real)], (-1, len(w)))
        direct = np.concatenate([fractions, np.ones((1, len(w)))])
        free, driven = [*direct, w], (direct * inputs[:, np.newaxis]).reshape(-1, len(w))
        rows = stacked(np.concatenate([free, driven, -fractions * output, output[np.newaxis]]))
        (own, cross), (_, shared) = (
            np.split(p, [len(free)], 1) for p in np.split(rows @ rows.T, [len(free)])
        )
        grams.append(shared - cross.T @ inverse_gram(own) @ cross)
    gram = np.sum(grams, axis=0)
    solved = inverse_gram(gram[:-1, :-1]) @ gram[:-1, -1]
    blocks = [[[p.real, p.imag], [-p.imag, p.real]] for p in upper]
    a = linalg.block_diag(*blocks, *([[p]] for p in real))
    b = np.concatenate([np.tile([2.0, 0.0], len(upper)), np.ones(len(real))])
    found = np.asarray(np.linalg.eigvals(a - np.outer(b, solved[-len(poles) :])), np.complex128)
    size = np.clip(np.abs(found), _SLOWEST, _FASTEST)
    found = found * size / np.maximum(np.abs(found), np.finfo(float).tiny)
    real = found.imag == 0
    decay = np.maximum(np.abs(found.real), _LEAST_DAMPING * size)
    return np.where(real, -size, -decay + 1j * found.imag)


def stacked(values: ComplexArray) -> FloatArray:
    """Return real and imaginary parts of ``values`` (q, k) side by side, (q, 2k)."""
    return np.concatenate([values.real, values.imag], axis=1)


def sections_of(nonlinear: FloatArray, order: int) -> FloatArray:
    """Return d1, d2 (k, 2) of the nonlinear parameters; d2 is 0 for a single pole."""
    pairs = order // 2
    count = order - pairs
    found = np.zeros((count, 2))
    found[:, 0] = np.exp(nonlinear[:count])
    found[:pairs, 1] = np.exp(nonlinear[count:order])
    return found


def slowed(nonlinear: FloatArray, order: int, fastest: float) -> FloatArray:
    """Return nonlinear parameters whose pairs of real poles are at most ``fastest``."""
    found, (first, second) = nonlinear.copy(), sections_of(nonlinear, order)[: order // 2].T
    real = np.flatnonzero(first**2 > 4 * second)
    slow = first[real] / 2 + np.sqrt(first[real] ** 2 / 4 - second[real])
    slow, fast = (np.maximum(lag, 1 / fastest) for lag in (slow, second[real] / slow))
    found[real], found[order - order // 2 + real] = np.log(slow + fast), np.log(slow * fast)
    return found
