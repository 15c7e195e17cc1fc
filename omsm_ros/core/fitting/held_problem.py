"""Fit a rational H(z) to an input that is held between samples, such as a drive's command.

A linear system behind a zero-order or a first-order hold is exactly rational in z⁻¹, with as
many poles as the system has, and from its initial state on it is known exactly too: that
adds a polynomial over the same denominator. So the fit of :mod:`output_error` serves with
q = z⁻¹ for s. The denominator is a product of sections of
``w = (2/T) (1 - q)/(1 + q)``, so every parameter vector is stable.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial import polynomial
from scipy import fft

from omsm_ros.core.dynamics.transfer_function import ComplexArray
from omsm_ros.core.fitting.model_structure import Scaled, Structure
from omsm_ros.core.fitting.output_error import Fit, Problem
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.least_squares import least_squares

# w over the rate of a section, per (1 - q)/(1 + q), where the rate is half the sampling rate:
# half way between the slowest and the fastest that a sampled pole can be.
_PER_BILINEAR = 4.0
RATE_SAMPLES = 0.5
# A pole is kept this far inside the unit circle and off z = -1, where w is infinite.
_OFF_BORDER = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class DiscreteScaled(Scaled):
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

        Not from its coefficients in q: near q = 1 those of a slow pole cancel.
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


class HeldProblem(Problem):
    """A problem whose input is held between samples; ``s`` is q = z⁻¹, the rate 0.5 / period."""

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

    def parametrised(self, structure: Structure) -> DiscreteScaled:
        """Return how ``structure`` is parametrised over q."""
        return DiscreteScaled(structure, self.rate)

    def drives(self, structure: Structure) -> list[tuple[ComplexArray, int]]:
        """Return the input, and a pulse at the first sample whose terms make any initial state.

        n terms do so from the second sample on; one more frees the first sample.
        """
        pulse = np.ones(len(self.s), np.complex128)
        return [(self._spectrum, structure.zeros + 1), (pulse, structure.poles + 1)]

    def _driven(self, structure: Structure, lag: ComplexArray) -> ComplexArray:
        """Return columns without their mean: the offset stands for it; an integrator's is vast."""
        spectra = super()._driven(structure, lag)
        spectra[:, 0] = 0.0
        return spectra

    def _moved(self, structure: Structure, lag: ComplexArray) -> FloatArray:
        """Return the linear columns where they are compared, (terms, k).

        Each is the one before, a sample later: the period has no bridge, so it turns round.
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
            # A polynomial in q at every line is the transform of its coefficients.
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
    numerator, ψ, as :meth:`HeldProblem.columns` orders them.
    """
    scaled, order = fitted.scaled, fitted.structure.poles
    assert isinstance(scaled, DiscreteScaled)
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
    scaled: DiscreteScaled, nonlinear: FloatArray, factors: list[FloatArray]
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
