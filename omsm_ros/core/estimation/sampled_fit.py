"""Fit a rational H(z) to an input that is held between samples, such as a drive's command.

A linear system behind a zero-order or a first-order hold is exactly rational in z⁻¹, with the poles
of the system. Its initial state adds a polynomial over the same denominator, exactly. So the fit of
:mod:`output_error` is used with q = z⁻¹ for s. The denominator is a product of sections of
``w = (2/T) (1 - q)/(1 + q)``, so that every parameter vector is stable.

The G(s) of a sampled H(z): each pole p of H is exp(sT) of a pole of G, and its residue follows in
closed form. With a zero-order hold ``x' = s x + u`` gives ``x[k+1] = p x[k] + h u[k]``,
h = (p - 1)/s; with a first-order hold ``x[k+1] = p x[k] + h0 u[k] + h1 u[k+1]``,
h1 = (h/T - 1)/s, h0 = h - h1.

Starting points are poles by ARX, instrumental variables and a subspace method. ARX finds
well-damped responses in little noise, instrumental variables find them in coloured noise, and a
subspace method finds all modes of a high order at once.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.polynomial import polynomial
from scipy import fft, signal

from omsm_ros.core.estimation.model_structure import ScaledStructure, Structure
from omsm_ros.core.estimation.output_error import Fit, Problem
from omsm_ros.core.lti.transfer_function import ComplexArray, TransferFunction
from omsm_ros.core.streams.blocks import BoolArray, FloatArray
from omsm_ros.linear_algebra import least_squares

# w over the rate, per (1 - q)/(1 + q), and the rate in 1/T: the middle of the range of sampled
# poles.
_PER_BILINEAR = 4.0
RATE_SAMPLES = 0.5
# Least relative distance of a pole from the unit circle; at z = -1, w is infinite.
_OFF_BORDER = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class ScaledDiscreteStructure(ScaledStructure):
    """Sections in w of a denominator in q; numerators are polynomials in q."""

    def lag(self, nonlinear: FloatArray, s: ComplexArray) -> ComplexArray:
        """Return L = 1 / denominator at q = ``s`` (k,), (k,)."""
        denominator = np.ones_like(s)
        for value, _ in self._factors(nonlinear, s):
            denominator *= value
        return np.asarray(1 / denominator)

    def lag_slopes(self, nonlinear: FloatArray, s: ComplexArray) -> ComplexArray:
        """Return d ln L / dψ (len ψ, k) at q = ``s`` (k,), see :meth:`lag`."""
        first, second = [], []
        for value, (linear, *square) in self._factors(nonlinear, s):
            first.append(-linear / value)
            second += [-term / value for term in square]
        return np.array(first + second, np.complex128).reshape(-1, len(s))

    def _factors(
        self, nonlinear: FloatArray, s: ComplexArray
    ) -> Iterator[tuple[ComplexArray, list[ComplexArray]]]:
        """Yield each factor of the denominator at q = ``s``, and its terms beyond the first.

        They are not computed from coefficients in q, which cancel near q = 1 for a slow pole.
        """
        up, down = 1 + s, _PER_BILINEAR * (1 - s)
        for section in self.sections(nonlinear):
            if len(section) == 3:
                terms = [section[1] * down * up, section[2] * down * down]
                yield up * up + terms[0] + terms[1], terms
            else:
                linear = section[1] * down
                yield up + linear, [linear]

    def polynomials(self, nonlinear: FloatArray) -> list[FloatArray]:
        """Return the factors of the denominator, ascending in q."""
        up, down = np.array([1.0, 1.0]), _PER_BILINEAR * np.array([1.0, -1.0])
        found = []
        for section in self.sections(nonlinear):
            size = len(section) - 1
            terms = (
                value
                * polynomial.polymul(polynomial.polypow(down, i), polynomial.polypow(up, size - i))
                for i, value in enumerate(section)
            )
            found.append(np.asarray(sum(terms), np.float64))
        return found

    def of_discrete(self, poles: ComplexArray) -> FloatArray:
        """Return ψ of ``poles`` in z (n,), conjugates included; unstable ones are reflected."""
        inside = inside_unit_circle(poles) * (1 - _OFF_BORDER)
        bilinear = np.asarray(_PER_BILINEAR * (inside - 1) / (inside + 1), np.complex128)
        return self.nonlinear_of(bilinear, 0.0)


def inside_unit_circle(poles: ComplexArray) -> ComplexArray:
    """Return ``poles`` in z with those outside the unit circle reflected into it."""
    outside = np.abs(poles) > 1
    return np.where(outside, 1 / np.conj(np.where(outside, poles, 1.0)), poles)


class ZeroOrderHoldProblem(Problem):
    """A problem whose input is held between samples: ``s`` is q = z⁻¹, the rate is 0.5 / period."""

    @cached_property
    def closed_length(self) -> int:
        """Samples of the record: a held input needs no bridge back to its start."""
        return len(self.input)

    def closed_spectrum(self, values: FloatArray) -> ComplexArray:
        """Transform of ``values`` (n,) as they are, shape (k,)."""
        return np.asarray(fft.rfft(values), np.complex128)

    @cached_property
    def _spectrum(self) -> ComplexArray:
        return self.closed_spectrum(self.input)

    @cached_property
    def s(self) -> ComplexArray:
        """q = exp(-jωT) of the transform, (k,)."""
        angle = 2 * np.pi * fft.rfftfreq(self.closed_length)
        return np.asarray(np.exp(-1j * angle), np.complex128)

    def parametrised(self, structure: Structure) -> ScaledDiscreteStructure:
        """Return how ``structure`` is parametrised over q."""
        return ScaledDiscreteStructure(structure, self.rate)

    def drives(self, structure: Structure) -> list[tuple[ComplexArray, int]]:
        """Return the input and a pulse at the first sample, whose terms make any initial state.

        n terms do so from the second sample on; one more does so for the first sample.
        """
        pulse = np.ones(len(self.s), np.complex128)
        return [(self._spectrum, structure.zeros + 1), (pulse, structure.poles + 1)]

    def _driven(self, structure: Structure, lag: ComplexArray) -> ComplexArray:
        """Return columns without their mean, which is huge for an integrator; the offset has it."""
        spectra = super()._driven(structure, lag)
        spectra[:, 0] = 0.0
        return spectra

    def _moved(self, structure: Structure, lag: ComplexArray) -> FloatArray:
        """Return the linear columns where they are compared, (terms, k).

        Each is the one before, delayed by a sample; the period has no bridge, so the columns wrap.
        """
        rows = []
        for spectrum, count in self.drives(structure):
            base = lag * spectrum
            base[0] = 0.0
            first = fft.irfft(base, self.closed_length)
            rows += [np.take(first, self._places - late, mode="wrap") for late in range(count)]
        return np.array(rows)

    def _answer(
        self, structure: Structure, lag: ComplexArray, coefficients: FloatArray
    ) -> ComplexArray:
        """Return the spectrum of the linear columns times their ``coefficients`` (terms,), (k,)."""
        total, place = np.zeros_like(lag), 0
        for spectrum, count in self.drives(structure):
            # The values of a polynomial in q are the transform of its coefficients.
            part = coefficients[place : place + count]
            total += fft.rfft(part, self.closed_length) * spectrum
            place += count
        total[0] = 0.0
        return lag * total

    def columns(self, fitted: Fit) -> FloatArray:
        """Return d output / d(terms of the numerator, ψ, initial state, background), (k, …)."""
        driven = self._driven(fitted.structure, fitted.scaled.lag(fitted.nonlinear, self.s))
        terms = fitted.structure.zeros + 1
        slopes = fitted.scaled.lag_slopes(fitted.nonlinear, self.s)
        by_nonlinear = slopes * (fitted.driven @ driven)
        every = np.concatenate([driven[:terms], by_nonlinear, driven[terms:]])
        return np.column_stack([self._in_time(every).T, self._fixed])

    def free_run(self, fitted: Fit) -> FloatArray:
        """Return the output (n,) of ``fitted`` with initial state and offset fitted anew."""
        spectra = self._driven(fitted.structure, fitted.scaled.lag(fitted.nonlinear, self.s))
        terms = fitted.structure.zeros + 1
        columns = fft.irfft(spectra, self.closed_length)[:, : len(self.input)].T
        moved = columns[:, :terms] @ fitted.driven[:terms]
        free = np.column_stack([columns[:, terms:], self.background])
        state = least_squares(free[self.used], (self.output - moved)[self.used])
        return np.asarray(moved + free @ state)

    def residual(self, fitted: Fit) -> FloatArray:
        """Return the output less a free run, where it is used, (k,)."""
        return np.asarray((self.output - self.free_run(fitted))[self.used])


def coefficients(fitted: Fit) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return numerator (n+1,) and denominator (n+1,) in q, its first 1, and their derivatives.

    The derivatives (2n + 1, 2n + 1) are of numerator, denominator[1:] by the terms of the
    numerator, ψ, as :meth:`ZeroOrderHoldProblem.columns` orders them.
    """
    scaled, order = fitted.scaled, fitted.structure.poles
    assert isinstance(scaled, ScaledDiscreteStructure)
    factors = scaled.polynomials(fitted.nonlinear)
    whole = _product(factors)
    terms = fitted.driven[: order + 1]
    numerator, denominator = terms / whole[0], whole / whole[0]
    jacobian = np.zeros((2 * order + 1, 2 * order + 1))
    jacobian[: order + 1, : order + 1] = np.eye(order + 1) / whole[0]
    for column, changed in enumerate(_changes(scaled, fitted.nonlinear, factors)):
        jacobian[: order + 1, order + 1 + column] = -numerator * changed[0] / whole[0]
        moved = (changed - denominator * changed[0]) / whole[0]
        jacobian[order + 1 :, order + 1 + column] = moved[1:]
    return numerator, denominator, jacobian


def _product(factors: list[FloatArray]) -> FloatArray:
    product: FloatArray = np.ones(1)
    for factor in factors:
        product = np.asarray(polynomial.polymul(product, factor), np.float64)
    return product


def _changes(
    scaled: ScaledDiscreteStructure, nonlinear: FloatArray, factors: list[FloatArray]
) -> list[FloatArray]:
    """Return the derivatives of the product of ``factors`` by each of ψ, ascending in q."""
    up, down = np.array([1.0, 1.0]), _PER_BILINEAR * np.array([1.0, -1.0])
    first, second = [], []
    for place, section in enumerate(scaled.sections(nonlinear)):
        others = _product(factors[:place] + factors[place + 1 :])
        if len(section) == 3:
            linear = section[1] * polynomial.polymul(down, up)
            square = section[2] * polynomial.polymul(down, down)
            second.append(np.asarray(polynomial.polymul(square, others), np.float64))
        else:
            linear = section[1] * down
        first.append(np.asarray(polynomial.polymul(linear, others), np.float64))
    return first + second


ZERO_ORDER, FIRST_ORDER = "zero-order", "first-order"
# Residues of poles nearer to each other than this are lost in rounding.
_APART = 1e-6
# A pole nearer to z = 0 than this is a delay, one nearer to 1 an integrator.
_LEAST = 1e-9


def zero_order_hold_equivalent(
    numerator: FloatArray, denominator: FloatArray, period: float, hold: str
) -> TransferFunction | None:
    """Return G(s) of which ``numerator``/``denominator``, ascending in z⁻¹, is the sampled form.

    period: [s];  hold: "zero-order" or "first-order"

    Return None where there is no such G: for a pole on the negative real axis, at 0 or at 1, or for
    multiple poles.
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


# Iterations after Steiglitz and McBride (1965): by then they have converged, or will not.
_ITERATIONS = 8
# Rows of past and of future beyond the highest order.
_SPARE_ROWS = 5
# Most columns: thirty times the rows at the highest order; more only cost time.
_MAX_COLUMNS = 5000
# Logarithm of the time constant of an added pole: too fast to matter, but with a gradient.
_FAST = float(np.log(0.1))


@dataclass(frozen=True, eq=False)
class DiscreteStarts:
    """Propose poles in z for a record ``input``, ``output`` (n,), compared where ``used`` (n,).

    order: the highest one needed
    """

    input: FloatArray
    output: FloatArray
    used: BoolArray
    order: int

    def poles(self, order: int) -> list[ComplexArray]:
        """Return proposals of ``order`` poles each, conjugates included."""
        found = [self.arx(order), *self._iterated(order)]
        subspace = self._subspace(order)
        return found if subspace is None else [*found, subspace]

    @cached_property
    def _filled(self) -> FloatArray:
        index = np.arange(len(self.used))
        return np.asarray(np.interp(index, index[self.used], self.output[self.used]))

    def _rows(self, order: int) -> BoolArray:
        """Return True where the sample and ``order`` before it are all used, shape (n - order,)."""
        return np.asarray(np.all(sliding_window_view(self.used, order + 1), axis=1))

    def _regressors(
        self, u: FloatArray, y: FloatArray, order: int
    ) -> tuple[FloatArray, FloatArray]:
        """Return columns -y[k-1] … -y[k-n], u[k] … u[k-n], 1 and target y[k], if all are used."""
        rows = self._rows(order)
        past = sliding_window_view(y, order + 1)[rows][:, ::-1]
        drive = sliding_window_view(u, order + 1)[rows][:, ::-1]
        return np.column_stack([-past[:, 1:], drive, np.ones(len(drive))]), past[:, 0]

    def arx(self, order: int) -> ComplexArray:
        """Return the poles in z (``order``,) of the equation-error fit, ARX."""
        columns, target = self._regressors(self.input, self._filled, order)
        return _poles(least_squares(columns, target)[:order])

    def _iterated(self, order: int) -> list[ComplexArray]:
        """Return poles by instrumental variables, then by Steiglitz and McBride's iteration."""
        columns, target = self._regressors(self.input, self._filled, order)
        found = least_squares(columns, target)
        try:
            simulated = signal.lfilter(
                found[order:-1], np.poly(inside_unit_circle(_poles(found[:order]))).real, self.input
            )
            instruments, _ = self._regressors(self.input, simulated, order)
            by_instruments = np.asarray(
                np.linalg.solve(instruments.T @ columns, instruments.T @ target), np.float64
            )
        except np.linalg.LinAlgError:
            return []
        poles = _poles(by_instruments[:order])
        return [p for p in (poles, self._prefiltered(order, poles)) if len(p) == order]

    def _prefiltered(self, order: int, poles: ComplexArray) -> ComplexArray:
        for _ in range(_ITERATIONS):
            denominator = np.poly(inside_unit_circle(poles)).real
            u, y = (
                signal.lfilter([1.0], denominator, values) for values in (self.input, self._filled)
            )
            columns, target = self._regressors(u, y, order)
            if not np.all(np.isfinite(columns)):
                break
            poles = _poles(least_squares(columns, target)[:order])
        return poles

    @cached_property
    def _observability(self) -> tuple[FloatArray, FloatArray] | None:
        """Singular vectors and values of the future output, past as instrument (PO-MOESP)."""
        rows = self.order + _SPARE_ROWS
        if len(self.used) < 4 * rows:
            return None
        places = np.flatnonzero(np.all(sliding_window_view(self.used, 2 * rows), axis=1))
        if len(places) < 6 * rows:
            return None
        places = places[:: -(-len(places) // _MAX_COLUMNS)]
        u, y = (sliding_window_view(v, 2 * rows)[places] for v in (self.input, self._filled))
        stacked = np.concatenate([u[:, rows:], u[:, :rows], y[:, :rows], y[:, rows:]], axis=1)
        lower = np.asarray(np.linalg.qr(stacked - np.mean(stacked, axis=0), mode="r")).T
        left, values, _ = np.linalg.svd(lower[3 * rows :, rows : 3 * rows])
        return left, values

    def _subspace(self, order: int) -> ComplexArray | None:
        found = self._observability
        if found is None:
            return None
        basis = found[0][:, :order] * np.sqrt(found[1][:order])
        return np.asarray(np.linalg.eigvals(np.linalg.lstsq(basis[:-1], basis[1:], rcond=None)[0]))


def _poles(coefficients: FloatArray) -> ComplexArray:
    """Return the poles in z of 1 + a1 q + … + an q^n."""
    if not np.all(np.isfinite(coefficients)):
        return np.empty(0, np.complex128)
    return np.asarray(np.roots(np.concatenate([[1.0], coefficients])), np.complex128)


def grown_starts(smaller: Sequence[FloatArray], samples: int) -> list[FloatArray]:
    """Return the starts for one pole more than the last of ``smaller``.

    One adds a pole too fast to matter, so that a larger model never fits worse. The other adds two
    as slow as the record is long: from other starts a fit does not reach a pair of integrators.
    """
    slow = np.log(samples / 2)
    fast = [with_fast_pole(smaller[-1])]
    return fast + [_with_pole(_with_pole(found, slow), slow) for found in smaller[-2:-1]]


def with_fast_pole(nonlinear: FloatArray) -> FloatArray:
    """Return ψ (n+1,) of ``nonlinear`` (n,) with a pole too fast to matter."""
    return _with_pole(nonlinear, _FAST)


def _with_pole(nonlinear: FloatArray, log_time: float) -> FloatArray:
    """Return ψ (n+1,) of the denominator of ``nonlinear`` (n,) times 1 + e^log_time w."""
    pairs, odd = divmod(len(nonlinear), 2)
    first, second = nonlinear[:pairs], nonlinear[pairs + odd :]
    if not odd:
        return np.concatenate([first, [log_time], second])
    merged = np.logaddexp(nonlinear[pairs], log_time)
    return np.concatenate([first, [merged], second, [nonlinear[pairs] + log_time]])
