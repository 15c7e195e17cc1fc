"""Choice of the order: numbers of poles and zeros, with a delay or without, and starting points.

The Bayesian information criterion finds the smallest adequate structure. It is still biased by
about one standard deviation, which no covariance shows. The chosen structure is therefore the best
with one parameter more: it trades that bias for variance, which the uncertainty band includes.
Alternatives that changed nothing are in ``docs/design/identification-ablation.md``.

A fit starts at two points, because the output error has local minima: at the best fit of a smaller
structure, so that a larger one never fits worse; and at a fit with two poles fewer, with a mode
added where it explains most of the rest, which finds resonances.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import signal

from omsm_ros.core.estimation.model_structure import Fit, ScaledStructure
from omsm_ros.core.estimation.optimisation import (
    CONVERGED,
    REFILLED,
    EvaluationBudget,
    Projection,
    descend,
)
from omsm_ros.core.estimation.output_error import CompressedProblem, Problem
from omsm_ros.core.lti.transfer_function import ComplexArray, Structure, TransferFunction
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import IdentificationError

# Most poles of the free choice; real machines have needed four in the band of a step test.
_FREE_POLES = 8
# Most poles on request: beyond, rounding destroys the coefficients of a polynomial.
MAX_POLES = 20
# A lag and its roll-off: with fewer, the band is three times too narrow for a pure delay.
_LEAST_PARAMETERS = 3
# Least damping ratio of a pole beyond half the sampling rate, where no sample shows it.
_DAMPED_BEYOND = 0.1
# Relative distance of a zero from a pole below which no data distinguish them.
_CANCELLING = 0.005


def structures(poles: int) -> list[Structure]:
    """Return the structures with ``poles`` and at most two zeros fewer, smallest first.

    Pairs of poles may have as many zeros: modes in addition to a motion that is followed rigidly.
    """
    if poles == 0:
        return [Structure(0, 0, True)]
    zeros = range(max(poles - 2, 0), poles + (poles % 2 == 0))
    every = [Structure(poles, m, delay) for m in zeros for delay in (False, True)]
    return sorted(every, key=lambda structure: (structure.size, structure.delay))


@dataclass(frozen=True, eq=False)
class Candidate:
    """A fit with its BIC; lower is better."""

    fit: Fit
    bic: float


def information(fit: Fit, colour: float = 1.0) -> float:
    """Return the Bayesian information criterion, -2 log likelihood + colour · size · log n.

    colour: power of the noise at low frequency over its mean. By chance a parameter of slow
        dynamics explains that much more of coloured noise, so its penalty is that much higher.
    """
    n = fit.samples
    floor = float(np.finfo(np.float64).tiny)
    return float(n * np.log(max(fit.sum_of_squares, floor) / n) + colour * fit.size * np.log(n))


def explore(
    fit_structure: Callable[[Structure, Sequence[Fit]], Fit],
    order: int = 0,
    colour_of: Callable[[Fit], float] = lambda fit: 1.0,
    budget: EvaluationBudget | None = None,
    least: int = 0,
) -> list[Candidate]:
    """Fit structures of rising order until two more poles in a row gain nothing.

    order: number of poles to go to in any case
    colour_of: returns that of the noise that a fit leaves, see :func:`information`; the best of
        each order gives it anew, because motion that a poor model leaves is no noise
    budget: of the fits; no order beyond ``least`` is tried once it is exhausted

    Raises IdentificationError for an order out of range.
    """
    if not 0 <= order <= MAX_POLES:
        raise IdentificationError("estimation.order", order=order, most=MAX_POLES)
    found: list[Candidate] = []
    fruitless, colour = 0, 1.0
    for poles in range(max(_FREE_POLES, order) + 1):
        before = min((c.bic for c in found), default=np.inf)
        for structure in _promising(poles, found, fit_structure, colour):
            fitted = fit_structure(structure, [c.fit for c in found])
            found.append(Candidate(fitted, information(fitted, colour)))
        fruitless = 0 if min(c.bic for c in found) < before else fruitless + 1
        colour = colour_of(min((c.fit for c in found), key=lambda fit: fit.sum_of_squares))
        found = [Candidate(c.fit, information(c.fit, colour)) for c in found]
        if poles < order:
            continue
        if fruitless >= 2 or (least <= poles < _FREE_POLES and budget and budget.stops()):
            break
    return found


def _promising(
    poles: int,
    found: list[Candidate],
    fit_structure: Callable[[Structure, Sequence[Fit]], Fit],
    colour: float,
) -> list[Structure]:
    """Return the structures with ``poles`` that can still have the lowest criterion.

    The largest one contains the others and bounds their gain. It is fitted first and added to
    ``found``, unless there are so few poles that all are fitted.
    """
    every = structures(poles)
    if poles < 3:
        return every
    largest = fit_structure(every[-1], [c.fit for c in found])
    best = min(c.bic for c in found)
    found.append(Candidate(largest, information(largest, colour)))
    spare = (best - information(largest, colour)) / (colour * np.log(largest.samples))
    return [s for s in every[:-1] if s.size < largest.structure.size + spare]


def choose(candidates: Sequence[Candidate]) -> Candidate:
    """Return the best structure that contains the best by BIC and has one parameter more.

    It has three parameters at least: with fewer, lag and roll-off are not independent. A
    structure whose zero cancels a pole does not count as larger, nor one with as many zeros as
    poles if the best has fewer.
    """
    smallest = min(candidates, key=lambda c: c.bic)
    wanted = max(smallest.fit.structure.size + 1, _LEAST_PARAMETERS)
    followed = smallest.fit.structure.zeros == smallest.fit.structure.poles > 0
    richer = [
        c
        for c in candidates
        if c.fit.structure.contains(smallest.fit.structure)
        and c.fit.structure.size >= wanted
        and not cancels(c.fit.dynamics)
        and (followed or c.fit.structure.zeros < c.fit.structure.poles)
    ]
    return min(richer, key=lambda c: (c.fit.structure.size, c.fit.sum_of_squares), default=smallest)


def identifiable(dynamics: TransferFunction, period: float, duration: float) -> bool:
    """Return True if samples every ``period`` [s] for ``duration`` [s] identify every pole.

    A pole that decays more slowly than the record lasts is a line of vibration or a drift. One that
    rings beyond half the sampling rate fits noise, and a filter made of it would ring.
    """
    poles = dynamics.poles()
    rate, decay = np.abs(poles), -poles.real
    lasting = decay * duration < 1
    ringing = (np.pi < rate * period) & (decay < _DAMPED_BEYOND * rate)
    return not bool(np.any(lasting | ringing))


def cancels(dynamics: TransferFunction) -> bool:
    """Return True if a zero nearly cancels a pole: their covariance has no meaning then."""
    poles, zeros = dynamics.poles(), dynamics.zeros()
    apart = np.abs(poles[:, np.newaxis] - zeros[np.newaxis])
    return bool(np.any(apart < _CANCELLING * np.abs(poles[:, np.newaxis])))


# Iterations from each start; held inputs need five (docs/design/identification-ablation.md).
_RACE_EVALUATIONS = 5
# Most iterations from the best start: it bounds fits along a flat valley, others converge.
_FINISH_EVALUATIONS = 60


def fit(
    problem: Problem,
    structure: Structure,
    starts: Sequence[FloatArray],
    *,
    budget: EvaluationBudget | None = None,
    part: CompressedProblem | None = None,
) -> Fit:
    """Improve each of ``starts``, ψ, by a few evaluations; return the minimum of the best of them.

    budget: counts the evaluations, if given
    part: the problem compressed, where the minimum is to be known to a fraction of the noise only
    """
    scaled = ScaledStructure(structure, problem.rate)
    box, lines = problem.box(scaled), part or problem.lines
    # Where the minimum is only explored, a gain within chance ends the search.
    size, least_gain = (len(part.target), 1.0) if part else (len(problem.used), CONVERGED)
    now: Problem | CompressedProblem = lines or problem

    def project(nonlinear: FloatArray) -> Projection:
        if budget is not None:
            budget.count(size, structure.poles)
        return now.project(scaled, nonlinear)

    def compared(at: Projection) -> Fit:
        found = problem.fit_at(scaled, at)
        return found if lines is None else problem.compared(found)

    ends = []
    for start in starts:
        now = lines or problem
        at = project(np.clip(start, *box))
        if lines is not None and part is None:
            now = lines.filled(compared(at))
            at = project(at.nonlinear)
        ends.append(descend(project, at, box, _RACE_EVALUATIONS))
    if part:  # all starts have the same sums, of few values
        first = min(ends, key=lambda end: float(end.residual @ end.residual))
        ends = [descend(project, first, box, _FINISH_EVALUATIONS)]
    best = min(map(compared, ends), key=lambda found: found.sum_of_squares)
    gain = part.sum_of_squares - best.sum_of_squares if part else np.inf
    evaluations = _FINISH_EVALUATIONS
    for _ in range(REFILLED):
        # The next one would gain at most the share of the period that is not compared.
        next_gain = gain * (1 - best.samples / problem.closed_length)
        if next_gain * best.samples < least_gain * best.sum_of_squares:
            break
        now = problem if lines is None else lines.filled(best)
        found = compared(descend(project, project(best.nonlinear), box, evaluations))
        gain, best = best.sum_of_squares - found.sum_of_squares, found
        if lines is None:
            break
        evaluations = _RACE_EVALUATIONS
    return best if lines is None or part else problem.evaluated(structure, best.nonlinear)


# Part of the lag that starts as a delay where there are poles too.
_KEPT_DELAY = 0.3
# Start of an added pole: fast enough to change little, slow enough to have a gradient.
_ADDED_POLE = -10.0
# An added mode, ζ = 0.1, and its frequencies over the bandwidth of the motion.
_MODE, _MODE_RATES = np.array([-0.1 - 1j, -0.1 + 1j]), np.geomspace(0.1, 10, 10)
# Half the sampling rate of a decimated problem over the bandwidth of the motion.
ABOVE_CONTENT = 1.25
# Anti-alias filter: taps on either side at the new rate, the middle of its edge over half the new
# rate, and Kaiser's shape; it attenuates to 3e-5 at half the new rate.
_HALF_TAPS, _PASSES, _STOPPING_SHAPE = 24, 0.88, 9.0


@dataclass(frozen=True, eq=False)
class StartingPoints:
    """Propose nonlinear parameters ψ for the structures of one problem.

    pure_delay: the fit of a delay alone
    """

    problem: Problem | CompressedProblem
    pure_delay: Fit

    def of(self, structure: Structure, smaller: Sequence[Fit]) -> list[FloatArray]:
        """Return ψ of ``structure``, given the fits made so far.

        A mode is added where it explains most of what the best fit with two poles fewer leaves;
        fast poles, which change little, to the best of all.
        """
        contained = sorted(
            (f for f in smaller if structure.contains(f.structure)), key=lambda f: f.sum_of_squares
        )
        mode = _MODE if structure.poles > 1 else -np.abs(_MODE[: structure.poles])
        fewer = [f for f in contained if 0 < f.structure.poles == structure.poles - len(mode)][:1]
        starts = [self._start(structure, fewer, rate * mode) for rate in _MODE_RATES]
        scaled = ScaledStructure(structure, self.problem.rate)
        left = [self.problem.project(scaled, start).residual for start in starts]
        found = [starts[int(np.argmin([each @ each for each in left]))]]
        return found + [self._start(structure, contained[:1], mode[:0])] * bool(contained)

    def _start(self, structure: Structure, base: Sequence[Fit], added: ComplexArray) -> FloatArray:
        """Return ψ with the poles of the fit in ``base``, if any, ``added`` ones and fast ones."""
        scaled = ScaledStructure(structure, self.problem.rate)
        delay = float(self.pure_delay.nonlinear[-1]) if self.pure_delay.structure.delay else 0.0
        own, tail = np.empty(0, np.complex128), _KEPT_DELAY * delay
        for fit in base:
            own = _stable(fit.dynamics.poles() / scaled.rate)
            tail = float(fit.nonlinear[-1]) if fit.structure.delay else 0.02 * delay
        fast = _ADDED_POLE * 1.5 ** np.arange(structure.poles - len(own) - len(added))
        return scaled.nonlinear_of(np.concatenate([own, added, fast]), tail)


def coarser(problem: Problem, every: int) -> Problem:
    """Return the problem decimated to one in ``every`` samples, all signals by the same low pass.

    The linear response is that of the original. Lost samples, and those between readings that are
    rarer than the samples of the axis, are interpolated linearly.
    """
    index = np.arange(len(problem.used))
    output = np.interp(index, index[problem.used], problem.output[problem.used])
    # A sample counts that a reading is near to.
    near = np.pad(problem.used, (every // 2, 0), "edge")[: len(index)]
    # A lightly damped mode beyond half the new rate would be aliased.
    low_pass = signal.firwin(
        2 * _HALF_TAPS * every + 1, _PASSES / every, window=("kaiser", _STOPPING_SHAPE)
    )

    def thinned(values: FloatArray) -> FloatArray:
        return np.asarray(signal.resample_poly(values, 1, every, window=low_pass, padtype="line"))

    return replace(
        problem,
        input=thinned(problem.input),
        further=np.array([thinned(motion) for motion in problem.further]),
        starts=tuple(start // every for start in problem.starts),
        output=thinned(output),
        used=np.logical_or.reduceat(near, np.arange(0, len(index), every)),
        period=problem.period * every,
        background=np.column_stack([thinned(column) for column in problem.background.T]),
        noise=problem.noise / np.sqrt(every),
        plateau=None,
        input_error=problem.input_error / every,
        errors_in_variables=None,
        recorded=None,
    )


def _stable(poles: ComplexArray) -> ComplexArray:
    """Return poles in conjugate pairs, reflected to the left half plane and kept off its border."""
    finite = poles[np.isfinite(poles)]
    upper = finite[finite.imag > 1e-9 * np.abs(finite)]
    real = finite[np.abs(finite.imag) <= 1e-9 * np.abs(finite)].real
    damped = -np.maximum(np.abs(upper.real), 1e-4 * np.abs(upper)) + 1j * upper.imag
    slow = -np.maximum(np.abs(real), 1e-3).astype(np.complex128)
    return np.asarray(np.concatenate([damped, np.conj(damped), slow]), np.complex128)
