"""Fit G(s) to an input and an output by the error of the output.

The motion is closed to a period by a smooth bridge, and filtered by its spectrum,
``Y(jω) = G(jω) U(jω)``. This takes the motion between samples as band-limited, which is exact for
any G and any delay as long as the motion has no content beyond half the sampling rate;
:mod:`~omsm_ros.core.identification.response_uncertainty` bounds the error where it has. Model and
data are compared in time, so a missing sample is simply not compared. Gain, offset and drift enter
linearly and are eliminated (variable projection, Golub and Pereyra 1973, with Kaufman's
simplification of the derivative).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.polynomial import polynomial
from scipy import fft, ndimage

from omsm_ros.core.estimation.model_structure import Fit, ScaledStructure
from omsm_ros.core.estimation.optimisation import Projection
from omsm_ros.core.estimation.parallel_sections import close_period
from omsm_ros.core.lti.transfer_function import ComplexArray, Structure
from omsm_ros.core.streams.blocks import BoolArray, FloatArray, IntArray
from omsm_ros.linear_algebra import BLOCK_VALUES, basis_and_inverse, inverse_gram, without_copy

# Lines over which power is averaged: it is then known to 10 %.
_SMOOTHING_BINS = 101


def denoised(spectrum: ComplexArray, noise_power: float) -> ComplexArray:
    """Return ``spectrum`` (k,) without lines of noise, up to its last frequency above the noise.

    Where the encoder reads only its own noise, a fit that took it for motion would be biased
    towards a response that vanishes there. A Wiener filter would also shrink the motion near that
    frequency, and the residual would follow what it took.
    """
    if noise_power <= 0:
        return spectrum
    width = min(_SMOOTHING_BINS, len(spectrum))
    power = np.abs(spectrum) ** 2
    smooth = ndimage.uniform_filter1d(power, width, mode="nearest")
    # The mean of m exponential variables has the relative deviation 1/√m; none exceeds 5 of them.
    moved = smooth > (1 + 5 / np.sqrt(width)) * noise_power
    last = int(np.flatnonzero(moved)[-1]) if np.any(moved) else 0
    return np.asarray(np.where(moved, spectrum, 0.0)[: last + 1], np.complex128)


# Linear columns weaker than this part of the strongest are rounding.
_RANK_TOLERANCE = 1e-12
# Largest share of a period that is not compared where products are summed over lines.
_FEW_MISSING = 0.25
# Slow model errors thin records of twice as many samples; a step test at 1 kHz has 20 000.
ENOUGH_SAMPLES = 20_000
# Frequency over the width of a sum over lines: four in the width of a mode of ζ = 0.002.
_SUMS = 1000
# Exponent of e to which the pulse before a record has decayed where its band ends.
_PULSE_END = 14.0


# Radians a sample, thirty times half the sampling rate: a faster pole would be no other model.
_FASTEST = 100.0


def _driven(
    drives: Sequence[tuple[ComplexArray, int]], s: ComplexArray, lag: ComplexArray
) -> ComplexArray:
    """Return the spectra of the linear columns, s^i · lag · drive, shape (terms, k)."""
    terms = np.empty((sum(count for _, count in drives), len(s)), np.complex128)
    rows = iter(terms)
    for spectrum, count in drives:
        term, factor = lag, spectrum
        # Repeated products are faster than powers of complex numbers.
        for _ in range(count):
            term, factor = np.multiply(term, factor, out=next(rows)), s
    return terms


@dataclass(frozen=True, eq=False)
class Problem:
    """A fit of ``output`` (n,), where ``used`` (n,), by ``input`` (n,) and ``background``.

    background: (n, q) columns added to the output, independent of G (offset, drift …)
    rate: [rad/s] unit of s inside the fit
    noise: standard deviation of a sample of the motion [m]
    fits_initial_condition: fit the response to the unknown motion before each recording too
    further: motions (m, n) of further axes that reach the probe, about their means
    starts: first sample of each recording
    plateau: number of the plateau of a sample, (n,), -1 elsewhere; or None
    shared: variance of the rounding error that the readings of a plateau share [m²]
    input_error: variance of the error of the input while it moves [m²]: rounding, and noise
    input_shared: variance of the rounding error that its readings of a plateau share [m²]
    errors_in_variables: noise that was taken out of the input and that the probe does not follow,
        (n,) [m]; or None
    recorded: the input as it was, (n,) [m], where noise was taken out of it
    """

    input: FloatArray
    output: FloatArray
    used: BoolArray
    period: float
    background: FloatArray
    rate: float
    noise: float = 0.0
    fits_initial_condition: bool = False
    further: FloatArray | tuple[()] = ()
    starts: tuple[int, ...] = (0,)
    plateau: IntArray | None = None
    shared: float = 0.0
    input_error: float = 0.0
    input_shared: float = 0.0
    errors_in_variables: FloatArray | None = None
    recorded: FloatArray | None = None
    _last: list[Any] = field(default_factory=list, init=False)

    @property
    def recordings(self) -> list[slice]:
        """Return the samples of each recording, with the rest that follows it."""
        return [slice(a, b) for a, b in pairwise([*self.starts, len(self.used)])]

    @cached_property
    def closed_length(self) -> int:
        """Samples of one period."""
        return len(close_period(self.input, self.period))

    @cached_property
    def _spectrum(self) -> ComplexArray:
        closed = np.asarray(fft.rfft(close_period(self.input, self.period)), np.complex128)
        moved = denoised(closed, len(self.input) * self.noise**2)
        # The initial-condition response, or a further axis, may be faster than the motion.
        whole = self.fits_initial_condition or len(self.further) > 0
        return np.pad(moved, (0, self.closed_length // 2 + 1 - len(moved))) if whole else moved

    @cached_property
    def motion(self) -> FloatArray:
        """The input (n,) as far as it is above its noise, which is what a model is driven by."""
        return np.asarray(fft.irfft(self._spectrum, self.closed_length)[: len(self.input)])

    @cached_property
    def s(self) -> ComplexArray:
        """jω / rate of the transform of the closed motion, up to its last content, (k,)."""
        omega = 2 * np.pi * fft.rfftfreq(self.closed_length, self.period)
        return np.asarray(1j * omega[: len(self._spectrum)] / self.rate, np.complex128)

    def drives(self, structure: Structure) -> list[tuple[ComplexArray, int]]:
        """Return the inputs: spectra (k,), each with its number of numerator terms."""
        pulses = self._pulses if self.fits_initial_condition else []
        return [
            (self._spectrum, structure.zeros + 1),
            *((motion, structure.poles + 1) for motion in self._further),
            *((pulse, structure.poles) for pulse in pulses),
        ]

    @cached_property
    def _further(self) -> list[ComplexArray]:
        closed = (close_period(motion, self.period) for motion in self.further)
        return [np.asarray(fft.rfft(motion))[: len(self.s)] for motion in closed]

    @cached_property
    def _pulses(self) -> list[ComplexArray]:
        """Spectra (k,) of Gaussian pulses that have decayed before each recording starts.

        Through n poles, the pulse and its derivatives make any initial-condition response.
        """
        angle = self.s.imag * self.rate
        width = np.sqrt(2 * _PULSE_END) / max(float(angle[-1]), np.finfo(np.float64).tiny)
        before = np.sqrt(2 * _PULSE_END) * width
        return [
            np.exp(-0.5 * (angle * width) ** 2 - 1j * angle * (start * self.period - before))
            for start in self.starts
        ]

    def initial_condition_response(self, fitted: Fit) -> FloatArray:
        """Return the decays (n, …) at the poles of ``fitted`` from before each recording."""
        lag = fitted.scaled.lag(fitted.nonlinear, self.s)
        powers = self.s ** np.arange(fitted.structure.poles)[:, np.newaxis]
        every = np.concatenate([powers * (lag * pulse) for pulse in self._pulses])
        return np.asarray(fft.irfft(every, self.closed_length)[:, : len(self.input)].T)

    def box(self, scaled: ScaledStructure) -> tuple[FloatArray, FloatArray]:
        """Return the bounds of ψ: no pole is faster than the samples can show."""
        lower, upper = scaled.bounds()
        poles, pairs = scaled.structure.poles, scaled.structure.pairs
        fastest = np.log(self.rate * self.period / _FASTEST)
        lower[: poles - pairs], lower[poles - pairs : poles] = fastest, 2 * fastest
        return lower, upper

    @cached_property
    def target(self) -> FloatArray:
        """The compared samples of the output, (k,)."""
        return self.output[self.kept]

    @cached_property
    def kept(self) -> slice | IntArray:
        """Places of the compared samples, without a copy where no sample between them is lost."""
        return without_copy(np.flatnonzero(self.used))

    @cached_property
    def _fixed(self) -> FloatArray:
        return self.background[self.kept]

    def _in_time(self, spectra: ComplexArray) -> FloatArray:
        found = np.empty((len(spectra), len(self.target)))
        # In blocks: all at once would double the memory of a long record.
        step = max(BLOCK_VALUES // self.closed_length, 1)
        for first in range(0, len(spectra), step):
            part = slice(first, first + step)
            found[part] = fft.irfft(spectra[part], self.closed_length, axis=-1)[:, self.kept]
        return found

    def _driven(self, scaled: ScaledStructure, nonlinear: FloatArray) -> ComplexArray:
        """Return the spectra of the linear columns, shape (terms, k)."""
        return _driven(self.drives(scaled.structure), self.s, scaled.lag(nonlinear, self.s))

    def project(self, scaled: ScaledStructure, nonlinear: FloatArray) -> Projection:
        """Return the residual at one ψ after the linear parameters are eliminated."""
        driven = self._driven(scaled, nonlinear)
        moved = self._in_time(driven)
        columns = np.concatenate([moved, self._fixed.T]).T
        basis, parameters = basis_and_inverse(columns, _RANK_TOLERANCE)
        linear = parameters @ (basis.T @ self.target)
        residual = self.target - columns @ linear

        def normal() -> tuple[FloatArray, FloatArray]:
            answer = linear[: len(moved)] @ driven
            slopes = self._in_time(scaled.lag_slopes(nonlinear, self.s) * answer).T
            jacobian = basis @ (basis.T @ slopes) - slopes
            return jacobian.T @ residual, jacobian.T @ jacobian

        return Projection(nonlinear, residual, linear, normal)

    @cached_property
    def weights(self) -> FloatArray:
        """Factors (k,) on lines with which their products sum as those in time do."""
        weights = np.full(len(self.s), np.sqrt(2 / self.closed_length))
        weights[0] /= np.sqrt(2)
        # One line at half the sampling rate, which is real, is left out.
        weights[self.closed_length // 2 :] = 0.0
        return weights

    def compared_lines(self, values: FloatArray) -> ComplexArray:
        """Return the weighted spectrum (k,) of ``values`` of the compared samples, 0 elsewhere."""
        spectrum = fft.rfft(self.on_grid(values, 0.0), self.closed_length)
        return np.asarray(self.weights * spectrum[: len(self.s)])

    @cached_property
    def lines(self) -> CompressedProblem | None:
        """The problem by lines of spectra, with the static gain where nothing is compared.

        None where more than a quarter of the period is not compared, or the response to what was
        before the record is fitted, which is largest there.
        """
        compared = len(self.target) > (1 - _FEW_MISSING) * self.closed_length
        possible = compared and not self.fits_initial_condition
        return CompressedProblem.of(self) if possible else None

    @cached_property
    def sums(self) -> CompressedProblem | None:
        """A long problem by sums over lines, in which orders are explored; None for a short one."""
        long = len(self.used) > 2 * ENOUGH_SAMPLES and not self.fits_initial_condition
        return CompressedProblem.of(self, _SUMS) if long else None

    def on_grid(self, values: FloatArray, elsewhere: float) -> FloatArray:
        """Return ``values`` (k,) of the compared samples at their places, (n,)."""
        grid = np.full(len(self.used), elsewhere)
        grid[self.used] = values
        return grid

    def further_numerators(self, fitted: Fit) -> list[slice]:
        """Return the places of the numerator of each further axis in ``fitted.driven``."""
        first, count = fitted.structure.zeros + 1, fitted.structure.poles + 1
        return [slice(first + i * count, first + (i + 1) * count) for i in range(len(self.further))]

    def response(self, fitted: Fit) -> FloatArray:
        """Return the motion through the G of ``fitted``, G(0) = 1, at every sample, (n,)."""
        spectrum = self.output_spectrum(fitted) / fitted.gain
        return np.asarray(fft.irfft(spectrum, self.closed_length)[: len(self.input)])

    def output_spectrum(self, fitted: Fit) -> ComplexArray:
        """Return the spectrum of the motion through G and gain of ``fitted``, at ``s``, (k,)."""
        return self._through(fitted, self.drives(fitted.structure)[:1])

    def driven_spectrum(self, fitted: Fit) -> ComplexArray:
        """Return the spectrum of the output of ``fitted`` without background, at ``s``, (k,)."""
        last = self._last  # it is often asked for again
        if not last or last[0] is not fitted.nonlinear or last[1] is not fitted.driven:
            through = self._through(fitted, self.drives(fitted.structure))
            last[:] = fitted.nonlinear, fitted.driven, through
        return np.asarray(last[2], np.complex128)

    def _through(self, fitted: Fit, drives: Sequence[tuple[ComplexArray, int]]) -> ComplexArray:
        ends = np.cumsum([count for _, count in drives])
        parts = zip(drives, np.split(fitted.driven[: ends[-1]], ends[:-1]), strict=True)
        moved = sum(each[0] * polynomial.polyval(self.s, part) for each, part in parts if len(part))
        return np.asarray(fitted.scaled.lag(fitted.nonlinear, self.s) * moved, np.complex128)

    def modelled(self, fitted: Fit) -> FloatArray:
        """Return the output (n,) of the fitted model at every sample."""
        moved = fft.irfft(self.driven_spectrum(fitted), self.closed_length)[: len(self.input)]
        return np.asarray(moved + self.background @ fitted.background)

    def fit_at(self, scaled: ScaledStructure, at: Projection) -> Fit:
        """Return the fit of a projection."""
        terms = sum(count for _, count in self.drives(scaled.structure))
        return Fit(scaled, at.nonlinear, at.linear[:terms], at.linear[terms:], at.residual)

    def evaluated(self, structure: Structure, nonlinear: FloatArray) -> Fit:
        """Return ``structure`` at the given ψ; only the linear parameters are fitted."""
        scaled = ScaledStructure(structure, self.rate)
        return self.fit_at(scaled, self.project(scaled, nonlinear))

    def compared(self, fitted: Fit) -> Fit:
        """Return a fit to other samples, with its parameters, and the residual here."""
        return replace(fitted, residual=self.target - self.modelled(fitted)[self.kept])

    def sensitivity(self, fitted: Fit) -> FloatArray:
        """Return d output / d(numerator[1:], ψ, gain, further drives, background), shape (k, …)."""
        driven = self._driven(fitted.scaled, fitted.nonlinear)
        terms = len(fitted.numerator)
        by_numerator = fitted.gain * driven[1:terms]
        slopes = fitted.scaled.lag_slopes(fitted.nonlinear, self.s)
        by_nonlinear = slopes * (fitted.driven @ driven)
        by_gain = (fitted.numerator @ driven[:terms])[np.newaxis]
        return self._with_background_columns([by_numerator, by_nonlinear, by_gain, driven[terms:]])

    def _with_background_columns(self, spectra: Sequence[ComplexArray]) -> FloatArray:
        """Return columns (k, …) of all ``spectra`` (…, k), then those of the background."""
        count = sum(map(len, spectra))
        rows = np.empty((count + self.background.shape[1], len(self.target)))
        rows[count:] = self._fixed.T
        first = 0
        for part in spectra:
            rows[first : first + len(part)] = self._in_time(part)
            first += len(part)
        return rows.T

    def low_order_sensitivity(self, fitted: Fit) -> FloatArray:
        """Return d output / d(gain, lag, curvature, further drives, background), (k, …).

        Those are the coefficients of 1, s and s² as factors of the response.
        """
        driven = self._driven(fitted.scaled, fitted.nonlinear)
        terms = len(fitted.numerator)
        bends = self.s ** np.arange(3)[:, np.newaxis] * (fitted.numerator @ driven[:terms])
        return self._with_background_columns([bends, driven[terms:]])


@dataclass(frozen=True, eq=False)
class CompressedProblem:
    """A problem by lines of its spectra, or by sums over neighbouring lines for a long record.

    Over a few lines G is constant, so that of every signal it needs the part along the input there,
    one number. The background explains the same part of the rest for every model.

    inputs: of each input (m, k) at s (k,);  fixed: of the background, (q, 2k + q + 1)
    target: of the output, (2k + q + 1,); the last q + 1 are of the rest
    filled: returns it with the output as another fit has it where it is not compared
    sum_of_squares: of the residual of the fit with which it is filled
    """

    rate: float
    s: ComplexArray
    inputs: ComplexArray
    fixed: FloatArray
    target: FloatArray
    filled: Callable[[Fit], CompressedProblem]
    sum_of_squares: float

    @classmethod
    def of(cls, problem: Problem, narrow: int = 0) -> CompressedProblem:
        """Return ``problem`` by each line if 0 or for several inputs, or by sums.

        narrow: frequency of a sum over its width

        Samples that are not compared are filled in with the output of a model (expectation
        maximisation, Dempster et al. 1977), here with the static gain.
        """
        static, weights = problem.evaluated(Structure(0, 0, False), np.empty(0)), problem.weights
        columns = np.column_stack([problem.background[problem.used], problem.target])
        background = np.array([problem.compared_lines(column) for column in columns[:, :-1].T])
        inputs = np.array([weights * drive for drive, _ in problem.drives(static.structure)])
        alone = len(inputs) == 1
        along = inputs[0] if alone else np.ones_like(inputs[0])
        starts = np.arange(len(along))
        if narrow and alone:  # a mode is as wide, over its frequency, as it is damped
            _, starts = np.unique((narrow * np.log1p(starts / narrow)).astype(int), True)
        power = np.add.reduceat(np.abs(along) ** 2, starts)
        excited = power > 0

        def seen(signals: ComplexArray) -> ComplexArray:
            sums = np.add.reduceat(along.conj() * signals, starts, axis=-1)
            return np.ascontiguousarray(sums[..., excited] / np.sqrt(power[excited]))

        s = np.add.reduceat(np.abs(along) ** 2 * problem.s, starts)[excited] / power[excited]
        fixed, products = seen(background).view(np.float64), columns.T @ columns
        scale, coordinates = np.sqrt(np.diag(products)), seen(inputs)
        scale[scale == 0] = 1.0

        def filled(fitted: Fit) -> CompressedProblem:
            moved = weights * problem.driven_spectrum(fitted)
            left = problem.compared_lines(fitted.residual) + fitted.background @ background
            every = np.vstack([fixed, seen(moved + left).view(np.float64)])
            rest = products - every @ every.T
            inside = problem.target - columns[:, :-1] @ fitted.background - fitted.residual
            rest[-1, -1] += np.vdot(moved, moved).real - inside @ inside
            values, turn = np.linalg.eigh(rest / np.outer(scale, scale))
            rest = scale[:, np.newaxis] * turn * np.sqrt(np.maximum(values, 0.0))
            every = np.column_stack([every, rest])
            known = fitted.sum_of_squares
            return cls(problem.rate, s, coordinates, every[:-1], every[-1], filled, known)

        return filled(static)

    def drives(self, structure: Structure) -> list[tuple[ComplexArray, int]]:
        """Return the inputs, as :meth:`Problem.drives`."""
        counts = [structure.zeros + 1] + (len(self.inputs) - 1) * [structure.poles + 1]
        return list(zip(self.inputs, counts, strict=True))

    def project(self, scaled: ScaledStructure, nonlinear: FloatArray) -> Projection:
        """Return the residual at one ψ after the linear parameters are eliminated."""
        lag, lines = scaled.lag(nonlinear, self.s), 2 * len(self.s)
        rows = _driven(self.drives(scaled.structure), self.s, lag).view(np.float64)
        terms = len(rows)
        every = np.concatenate([np.zeros((terms, len(self.target))), self.fixed])
        every[:terms, :lines] = rows
        inverse = inverse_gram(every @ every.T)
        linear = inverse @ (every @ self.target)
        # Refined once, because the inverse has the squared condition of the columns.
        linear += inverse @ (every @ (self.target - linear @ every))
        residual = self.target - linear @ every

        def normal() -> tuple[FloatArray, FloatArray]:
            answer = (linear[:terms] @ rows).view(np.complex128)
            slopes = (scaled.lag_slopes(nonlinear, self.s) * answer).view(np.float64)
            free = (slopes @ every[:, :lines].T) @ inverse @ every
            free[:, :lines] -= slopes
            return free @ residual, free @ free.T

        return Projection(nonlinear, residual, linear, normal)
