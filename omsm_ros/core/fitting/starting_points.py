"""Where a fit starts: several places, because the output error has local minima.

From the best fit of a smaller structure, so that a larger one never fits worse; from iterated
linear least squares, which finds a resonance that no guess would; and from a simple guess.
Of a period of many samples all of them are tried on fewer, where the motion has content; the best
of these minima is the start.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import signal

from omsm_ros.core.dynamics.transfer_function import ComplexArray, ascending_roots
from omsm_ros.core.fitting.model_structure import Scaled, Structure
from omsm_ros.core.fitting.output_error import Fit, Problem, fit
from omsm_ros.core.samples.blocks import BoolArray, FloatArray
from omsm_ros.least_squares import least_squares

# Guess of the slowest pole, in units of the rate at which the motion has its content.
_GUESSED_RATE = 3.0
# From the positive real axis [rad]: a damping of 0.42.
_GUESSED_ANGLE = 2.0
# Of the whole lag, the part first given to a delay where there are poles too.
_KEPT_DELAY = 0.3
# Sanathanan and Koerner (1963): it has converged, or will not.
_LINEAR_ITERATIONS = 8
# An added pole begins fast enough not to be seen, and slow enough to have a gradient.
_ADDED_POLE = -10.0
# Samples of a period; of two such a fit is started on one. A step test at 1 kHz has 20 000.
ENOUGH_SAMPLES = 20_000
# Half the sampling rate of a coarse problem over the rate at which the motion has its content.
ABOVE_CONTENT = 1.25
# Samples of the new rate on either side over which a low pass reaches, the middle of its edge over
# the new half rate, and Kaiser's shape: at the new half rate it leaves 3e-5 of an amplitude.
_HALF_TAPS, _PASSES, _STOPPING_SHAPE = 24, 0.88, 9.0


@dataclass(frozen=True, eq=False)
class StartingPoints:
    """Propose nonlinear parameters ψ for the structures of one problem.

    pure_delay: the fit of a delay alone
    """

    problem: Problem
    pure_delay: Fit

    def of(self, structure: Structure, smaller: Sequence[Fit]) -> list[FloatArray]:
        """Return ψ of ``structure``, given the fits made so far."""
        if self.coarser is not None and structure.poles:
            coarse = self.coarser
            return [fit(coarse.problem, structure, coarse.of(structure, smaller)).nonlinear]
        scaled = Scaled(structure, self.problem.rate)
        delay = float(self.pure_delay.nonlinear[-1]) if self.pure_delay.structure.delay else 0.0
        if structure.poles == 0:
            return [self.pure_delay.nonlinear]
        kept = _KEPT_DELAY * delay if structure.delay else 0.0
        found = [_guess(scaled, kept), scaled.nonlinear_of(self._linear(structure, kept), kept)]
        contained = [f for f in smaller if structure.contains(f.structure)]
        if contained:
            found.append(_grown(scaled, min(contained, key=lambda f: f.sum_of_squares), delay))
        return found

    @cached_property
    def coarser(self) -> StartingPoints | None:
        """Those of the problem with fewer samples, if it has many more than its motion needs."""
        problem = self.problem
        per_content = np.pi / (problem.rate * problem.period) / ABOVE_CONTENT
        every = int(min(problem.closed_length / ENOUGH_SAMPLES, per_content))
        if every <= 1:
            return None
        return replace(self, problem=coarser(problem, every))

    @cached_property
    def _probe(self) -> ComplexArray:
        """Spectrum of the output without background, lost samples taken from the motion."""
        problem, lag = self.problem, self.pure_delay
        output = problem.output - problem.background @ lag.background
        filled = np.where(problem.used, output, lag.gain * problem.input)
        return problem.closed_spectrum(np.asarray(filled))

    def _linear(self, structure: Structure, delay: float) -> ComplexArray:
        """Return the poles (n,) by iterated linear least squares (Sanathanan and Koerner 1963)."""
        # At s = 0 only the background is decided; there, and at the end, s may be extreme.
        inside = slice(1, max(len(self.problem.s) - 1, 2))
        s, probe = self.problem.s[inside, np.newaxis], self._probe[inside]
        powers = np.vander(s[:, 0], structure.poles + 1, increasing=True)
        downs = -powers[:, 1:] * probe[:, np.newaxis]
        ups = [
            powers[:, :count] * (spectrum[inside, np.newaxis] * np.exp(-delay * s))
            for spectrum, count in self.problem.drives(structure)
        ]
        every = np.concatenate([downs, *ups], axis=1)
        poles = np.full(structure.poles, -1.0, np.complex128)
        for _ in range(_LINEAR_ITERATIONS):
            weight = 1 / np.abs(np.prod(1 - s / poles, axis=1))
            columns = every * weight[:, np.newaxis]
            columns = np.concatenate([columns.real, columns.imag])
            target = np.concatenate([(probe * weight).real, (probe * weight).imag])
            solved = least_squares(columns, target)
            denominator = np.concatenate([np.ones(1), solved[: structure.poles]])
            found = _stable(ascending_roots(denominator))
            if len(found) != structure.poles:
                break
            poles = found
        return poles


def coarser(problem: Problem, every: int) -> Problem:
    """Return the problem at every so many samples, all of it filtered by the same low pass.

    A linear response of one is that of the other. Lost samples are bridged by a straight line, and
    so is what lies between readings that are rarer than the samples of the axis.
    """
    index = np.arange(len(problem.used))
    output = np.interp(index, index[problem.used], problem.output[problem.used])

    # A light mode beyond the new half rate would fold to where the response is another.
    low_pass = signal.firwin(
        2 * _HALF_TAPS * every + 1, _PASSES / every, window=("kaiser", _STOPPING_SHAPE)
    )

    def thinned(values: FloatArray) -> FloatArray:
        return np.asarray(signal.resample_poly(values, 1, every, window=low_pass, padtype="line"))

    return replace(
        problem,
        input=thinned(problem.input),
        output=thinned(output),
        used=_bridged(problem.used, every),
        period=problem.period * every,
        background=np.column_stack([thinned(column) for column in problem.background.T]),
        noise=problem.noise / np.sqrt(every),
        plateau=None,
        unfollowed=None,
    )


def _bridged(used: BoolArray, every: int) -> BoolArray:
    """Return, of every so many samples, which are used or lie in a bridge that hides nothing.

    Such a bridge is no longer than a new sample, or than the readings are apart anyhow: where every
    second sample holds a reading, those picked may all lie between them.
    """
    picked, places = np.arange(0, len(used), every), np.flatnonzero(used)
    apart = np.diff(places)
    after = np.searchsorted(places, picked)
    inside = (after > 0) & (after < len(places))
    short = apart <= max(every, int(np.median(apart)))
    return np.asarray(used[picked] | (inside & short[np.where(inside, after - 1, 0)]))


def _guess(scaled: Scaled, delay: float) -> FloatArray:
    poles: list[complex] = []
    for index in range(scaled.structure.pairs):
        upper = complex((index + 1) * _GUESSED_RATE * np.exp(1j * _GUESSED_ANGLE))
        poles += [upper, upper.conjugate()]
    if scaled.structure.poles % 2:
        poles.append(complex(-2.0 * _GUESSED_RATE))
    return scaled.nonlinear_of(np.array(poles, np.complex128), delay)


def _stable(poles: ComplexArray) -> ComplexArray:
    """Return poles in conjugate pairs, reflected to the left half plane and kept off its border."""
    finite = poles[np.isfinite(poles)]
    upper = finite[finite.imag > 1e-9 * np.abs(finite)]
    real = finite[np.abs(finite.imag) <= 1e-9 * np.abs(finite)].real
    damped = -np.maximum(np.abs(upper.real), 1e-4 * np.abs(upper)) + 1j * upper.imag
    slow = -np.maximum(np.abs(real), 1e-3).astype(np.complex128)
    return np.asarray(np.concatenate([damped, np.conj(damped), slow]), np.complex128)


def _grown(scaled: Scaled, fit: Fit, delay: float) -> FloatArray:
    """Return the smaller fit with fast poles added; their zeros follow linearly."""
    added = _ADDED_POLE * 1.5 ** np.arange(scaled.structure.poles - fit.structure.poles)
    own = _stable(fit.dynamics.poles() / scaled.rate)
    tail = float(fit.nonlinear[-1]) if fit.structure.delay else 0.02 * delay
    return scaled.nonlinear_of(np.concatenate([own, added.astype(np.complex128)]), tail)
