"""Fit G(s) to an input and an output by the error of the output.

The motion is closed to a period by a smooth bridge, and filtered by its spectrum,
``Y(jω) = G(jω) U(jω)``. This takes the motion between samples as band-limited, which is exact for
any G and any delay as long as the motion has no content beyond half the sampling rate;
:mod:`~omsm_ros.core.identification.covariance_terms` bounds the error where it has. Model and data
are compared in time, so a missing sample is simply not compared. Gain, offset and drift enter
linearly and are eliminated (variable projection, Golub and Pereyra 1973, with Kaufman's
simplification of the derivative).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.polynomial import polynomial
from scipy import fft, linalg, ndimage

from omsm_ros.core.estimation.model_structure import ScaledStructure
from omsm_ros.core.estimation.optimisation import EvaluationBudget, Project, Projection, descend
from omsm_ros.core.kinematics.trajectories import s_curve
from omsm_ros.core.lti.transfer_function import ComplexArray, Structure, TransferFunction
from omsm_ros.core.streams.blocks import BoolArray, FloatArray, IntArray
from omsm_ros.linear_algebra import BLOCK_VALUES, inverse_gram, least_squares

# Duration of the bridge: across the whole travel it adds nothing near the fastest motion.
_BRIDGE_S = 0.3
# Least length of the bridge, so that it is smooth at a low sampling rate too.
_MIN_BRIDGE_SAMPLES = 64
# Rest after the bridge, in which a lightly damped mode decays.
STATIONARY_S = 1.0
# Most rest per duration: a record of milliseconds shows no mode that rings for a second.
_PLATEAU_SHARE = 4.0
# Lines over which power is averaged: it is then known to 10 %.
_SMOOTHING_BINS = 101


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
# Block size of LAPACK.
_BLOCK = 32
# Iterations from each start; held inputs need five (docs/design/identification-ablation.md).
_RACE_EVALUATIONS = 5
# Most iterations from the best start: it bounds fits along a flat valley, others converge.
_FINISH_EVALUATIONS = 60
# Radians a sample, thirty times half the sampling rate: a faster pole would be no other model.
_FASTEST = 100.0
# Largest share of a period that is not compared where products are summed over lines.
_FEW_MISSING = 0.25
# Exponent of e to which the pulse before a record has decayed where its band ends.
_PULSE_END = 14.0


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

    @property
    def recordings(self) -> list[slice]:
        """Return the samples of each recording, with the rest that follows it."""
        return [slice(a, b) for a, b in pairwise([*self.starts, len(self.used)])]

    @cached_property
    def closed_length(self) -> int:
        """Samples of one period."""
        return len(close_period(self.input, self.period))

    def closed_spectrum(self, values: FloatArray) -> ComplexArray:
        """Transform of ``values`` (n,), closed to a period, at ``s``, shape (k,)."""
        return np.asarray(fft.rfft(close_period(values, self.period)))[: len(self.s)]

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
        return [self.closed_spectrum(motion) for motion in self.further]

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
    def _target(self) -> FloatArray:
        return self.output[self._kept]

    @cached_property
    def _kept(self) -> slice | IntArray:
        """Places of the compared samples, without a copy where no sample between them is lost."""
        places = np.flatnonzero(self.used)
        whole = len(places) > 0 and places[-1] - places[0] < len(places)
        return slice(int(places[0]), int(places[-1]) + 1) if whole else places

    @cached_property
    def _fixed(self) -> FloatArray:
        return self.background[self._kept]

    def _in_time(self, spectra: ComplexArray) -> FloatArray:
        found = np.empty((len(spectra), len(self._target)))
        # In blocks: all at once would double the memory of a long record.
        step = max(BLOCK_VALUES // self.closed_length, 1)
        for first in range(0, len(spectra), step):
            part = slice(first, first + step)
            found[part] = fft.irfft(spectra[part], self.closed_length, axis=-1)[:, self._kept]
        return found

    def project(self, scaled: ScaledStructure, nonlinear: FloatArray) -> Projection:
        """Return the residual at one ψ after the linear parameters are eliminated."""
        structure, lag = scaled.structure, scaled.lag(nonlinear, self.s)
        moved = self._in_time(self._driven(structure, lag))
        # In the memory order of LAPACK: in that of numpy it takes five times as long.
        columns = np.concatenate([moved, self._fixed.T, self._target[np.newaxis]]).T
        size = columns.shape[1] - 1
        # With the target as the last column, its part in their basis is in the triangle.
        (packed, factors), triangle = linalg.qr(columns, mode="raw", check_finite=False)
        linear = least_squares(triangle[:size, :size], triangle[:size, size], _RANK_TOLERANCE)
        residual = self._target - columns[:, :size] @ linear

        def normal() -> tuple[FloatArray, FloatArray]:
            basis = linalg.lapack.dorgqr(packed[:, :size], factors[:size], lwork=_BLOCK * size)[0]
            answer = self._answer(structure, lag, linear[: len(moved)])
            slopes = self._in_time(scaled.lag_slopes(nonlinear, self.s) * answer).T
            jacobian = basis @ (basis.T @ slopes) - slopes
            return jacobian.T @ residual, jacobian.T @ jacobian

        return Projection(nonlinear, residual, linear, normal)

    @cached_property
    def _weights(self) -> FloatArray:
        """Roots of the weights (k,) of lines by which their products sum as those in time do."""
        weights = np.full(len(self.s), np.sqrt(2 / self.closed_length))
        weights[0] /= np.sqrt(2)
        # One line at half the sampling rate, which is real, is left out.
        weights[self.closed_length // 2 :] = 0.0
        return weights

    def _lines(self, spectra: ComplexArray) -> FloatArray:
        """Return ``spectra`` (…, k), real and imaginary parts side by side, weighted (…, 2k)."""
        return np.asarray((spectra * self._weights).view(np.float64))

    def _compared_lines(self, values: FloatArray) -> FloatArray:
        """Return ``values`` (k,) of the compared samples, 0 elsewhere, as :meth:`_lines`."""
        padded = fft.rfft(self.on_grid(values, 0.0), self.closed_length)
        return self._lines(np.asarray(padded)[: len(self.s)])

    @cached_property
    def _background_lines(self) -> FloatArray:
        return np.array([self._compared_lines(column) for column in self._fixed.T])

    @cached_property
    def _filled(self) -> FloatArray:
        """Lines of the output where it is compared, and of the motion times the gain elsewhere."""
        moved = self.motion[self._kept]
        gain = least_squares(np.column_stack([moved, self._fixed]), self._target)[0]
        left = self._compared_lines(self._target - gain * moved)
        return np.asarray(left + gain * self._lines(self._spectrum))

    def by_lines(self, scaled: ScaledStructure) -> Project:
        """Return a projection as :meth:`project` whose products are sums over lines of spectra.

        Samples not compared are filled in with the last model a step started from (expectation
        maximisation, Dempster et al. 1977): the sum of squares is exact, the linear parameters are
        the best ones once the descent has come to rest. The first model is the static gain.
        """
        structure, filled = scaled.structure, self._filled
        gram_fixed, fixed_target = (self._fixed.T @ v for v in (self._fixed, self._target))
        terms = sum(count for _, count in self.drives(structure))

        def project(nonlinear: FloatArray) -> Projection:
            lag = scaled.lag(nonlinear, self.s)
            rows = self._lines(self._driven(structure, lag))
            cross = rows @ self._background_lines.T
            gram = np.block([[rows @ rows.T, cross], [cross.T, gram_fixed]])
            inverse = inverse_gram(gram)
            linear = inverse @ np.concatenate([rows @ filled, fixed_target])
            answer = self._answer(structure, lag, linear[:terms])
            moved = self._in_time(answer[np.newaxis])[0]
            residual = self._target - self._fixed @ linear[terms:] - moved

            def normal() -> tuple[FloatArray, FloatArray]:
                nonlocal filled
                left = self._compared_lines(residual)
                filled = left + linear[:terms] @ rows + linear[terms:] @ self._background_lines
                slopes = self._lines(scaled.lag_slopes(nonlinear, self.s) * answer)
                taken = np.hstack([slopes @ rows.T, slopes @ self._background_lines.T]) @ inverse
                missed = np.concatenate([rows @ left, self._fixed.T @ residual])
                curvature = slopes @ slopes.T - taken @ gram @ taken.T
                return taken @ missed - slopes @ left, curvature

            return Projection(nonlinear, residual, linear, normal)

        return project

    def _answer(
        self, structure: Structure, lag: ComplexArray, coefficients: FloatArray
    ) -> ComplexArray:
        """Return the spectrum of the linear columns times their ``coefficients`` (terms,), (k,)."""
        total, place = np.zeros_like(lag), 0
        for spectrum, count in self.drives(structure):
            # Without a pole, the pulse before the record has no term.
            part = np.append(coefficients[place : place + count], 0.0)
            total += polynomial.polyval(self.s, part) * spectrum
            place += count
        return lag * total

    def _driven(self, structure: Structure, lag: ComplexArray) -> ComplexArray:
        """Return the spectra of the linear columns, s^i · lag · drive, shape (terms, k)."""
        terms = []
        for spectrum, count in self.drives(structure):
            term = lag * spectrum
            # Repeated products are faster than powers of complex numbers.
            for _ in range(count):
                terms.append(term)
                term = term * self.s
        return np.array(terms)

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
        lag = fitted.scaled.lag(fitted.nonlinear, self.s)
        driven = self._driven(fitted.structure, lag)[: len(fitted.numerator)]
        return np.asarray(fitted.driven[: len(driven)] @ driven, np.complex128)

    def modelled(self, fitted: Fit) -> FloatArray:
        """Return the output (n,) of the fitted model at every sample."""
        lag = fitted.scaled.lag(fitted.nonlinear, self.s)
        driven = fitted.driven @ self._driven(fitted.structure, lag)
        moved = fft.irfft(driven, self.closed_length)[: len(self.input)]
        return np.asarray(moved + self.background @ fitted.background)

    def sensitivity(self, fitted: Fit) -> FloatArray:
        """Return d output / d(numerator[1:], ψ, gain, further drives, background), shape (k, …)."""
        driven = self._driven(fitted.structure, fitted.scaled.lag(fitted.nonlinear, self.s))
        terms = len(fitted.numerator)
        by_numerator = fitted.gain * driven[1:terms]
        slopes = fitted.scaled.lag_slopes(fitted.nonlinear, self.s)
        by_nonlinear = slopes * (fitted.driven @ driven)
        by_gain = (fitted.numerator @ driven[:terms])[np.newaxis]
        return self._with_background_columns([by_numerator, by_nonlinear, by_gain, driven[terms:]])

    def _with_background_columns(self, spectra: Sequence[ComplexArray]) -> FloatArray:
        """Return columns (k, …) of all ``spectra`` (…, k), then those of the background."""
        count = sum(map(len, spectra))
        rows = np.empty((count + self.background.shape[1], len(self._target)))
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
        lag = fitted.scaled.lag(fitted.nonlinear, self.s)
        driven = self._driven(fitted.structure, lag)
        terms = len(fitted.numerator)
        bends = self.s ** np.arange(3)[:, np.newaxis] * (fitted.numerator @ driven[:terms])
        return self._with_background_columns([bends, driven[terms:]])


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

    @property
    def sum_of_squares(self) -> float:
        """Sum of the squared residual [m²]."""
        return float(self.residual @ self.residual)

    @property
    def rms(self) -> float:
        """Root mean square of the residual [m]."""
        return float(np.sqrt(self.sum_of_squares / self.samples))

    @property
    def dynamics(self) -> TransferFunction:
        """G(s) with G(0) = 1."""
        return self.scaled.transfer_function(self.nonlinear, self.numerator)


def fit(
    problem: Problem,
    structure: Structure,
    starts: Sequence[FloatArray],
    evaluations: int = _FINISH_EVALUATIONS,
    *,
    budget: EvaluationBudget | None = None,
) -> Fit:
    """Improve each of ``starts``, ψ, by a few evaluations; return the minimum of the best of them.

    evaluations: most iterations to that minimum
    budget: counts the evaluations, if given
    """
    scaled = ScaledStructure(structure, problem.rate)
    box = problem.box(scaled)

    def project(nonlinear: FloatArray) -> Projection:
        if budget is not None:
            budget.count(int(np.count_nonzero(problem.used)), structure.poles)
        return by_lines(nonlinear) if by_lines else problem.project(scaled, nonlinear)

    best, least = None, np.inf
    compared = np.sum(problem.used) > (1 - _FEW_MISSING) * problem.closed_length
    # A response to what was before the record is largest where nothing is compared.
    by_lines = None if problem.fits_initial_condition or not compared else problem.by_lines(scaled)
    for start in starts:
        found = descend(project, project(np.clip(start, *box)), box, _RACE_EVALUATIONS)
        cost = float(np.sum(found.residual**2))
        if best is None or cost < least:
            best, least = found, cost
    if best is None:
        raise ValueError("no start to fit from, expected one or more")
    return evaluated(problem, structure, descend(project, best, box, evaluations).nonlinear)


def evaluated(problem: Problem, structure: Structure, nonlinear: FloatArray) -> Fit:
    """Return ``structure`` at the given ψ; only the linear parameters are fitted."""
    scaled = ScaledStructure(structure, problem.rate)
    at = problem.project(scaled, nonlinear)
    terms = len(at.linear) - problem.background.shape[1]
    return Fit(scaled, at.nonlinear, at.linear[:terms], at.linear[terms:], at.residual)
