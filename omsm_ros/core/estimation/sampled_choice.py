"""Choose the order of a sampled model by cross-validation.

Models of each order are fitted to the first part of the record and simulated over the rest. The
best few are then compared on several held-out parts, once as they are and once with a whitened
residual, which is efficient only for a model of all the dynamics. The
simplest of equally good models is taken, because superfluous poles would follow a drift.

To fit every order to every held-out part of a long record takes minutes. A few thousand samples
determine the order as well, except for dynamics slower than they last or too weak for them. So the
order is chosen on the most exciting part; the lowest orders, and two poles more, are fitted to the
whole record too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import signal

from omsm_ros.core.estimation.covariance import autoregression
from omsm_ros.core.estimation.model_order import MAX_POLES
from omsm_ros.core.estimation.model_structure import Structure
from omsm_ros.core.estimation.output_error import Fit, fit
from omsm_ros.core.estimation.sampled_fit import (
    RATE_SAMPLES,
    DiscreteStarts,
    ScaledDiscreteStructure,
    ZeroOrderHoldProblem,
    grown_starts,
    with_fast_pole,
)
from omsm_ros.core.streams.blocks import BoolArray, FloatArray
from omsm_ros.errors import IdentificationError

# Parts of the used samples: all but the first are held out in turn, and the last ones together.
_PARTS = 6
# Share of the used samples to which every order is fitted first.
_FIRST_PART = 0.75
# Orders compared on every held-out part: the best over the last part, and the lowest orders within
# this factor of the least error. One part alone is uncertain by about this factor.
_FINALISTS = 3
_EQUIVALENT = 2.0
# Orders in a row without a better prediction that end the search.
_FRUITLESS = 5
# Standard errors by which a model must predict better than another. With disturbances, a pole too
# few costs more than one too many (docs/design/identification-ablation.md).
_IMPROVES_BY = 0.5
# Order of the model by which the delay is chosen.
_DELAY_ORDER = 3
# Samples per parameter: with fewer, an order is not tried.
_LEAST_SAMPLES_EACH = 3
# Sixty columns and their spectra then take a third of a gigabyte.
_MOST_SAMPLES = 200_000
# Iterations without a held-out part, from the minimum over all parts: more would gain less than the
# uncertainty of one part, and beyond order ten would take most of the time.
_HELD_OUT_EVALUATIONS = 5
# Directions weaker than this part of the power of the strongest are rounding of six digits.
_UNEXCITED = 1e-12


@dataclass(frozen=True, eq=False)
class SampledCandidate:
    """A fit to all used samples, and how it predicts.

    order: poles;  whitened: fitted with its residual made white
    held_out: mean square error of free runs over each held-out part (folds,), empty if not compared
    """

    problem: ZeroOrderHoldProblem
    fit: Fit
    order: int
    whitened: bool
    held_out: FloatArray


@dataclass(frozen=True, eq=False)
class SampledChoice:
    """The chosen model, and the free choice.

    chosen: of the order asked for, or the free choice;  free: the free choice
    delay: whole samples;  by_order: mean square error [unit²] over the last part, of each order
    """

    chosen: SampledCandidate
    free: SampledCandidate
    delay: int
    by_order: FloatArray


def parameters(order: int) -> int:
    """Return the number of parameters: denominator, numerator, initial state and offset."""
    return 3 * order + 3


def choose_sampled(
    input: FloatArray,
    output: FloatArray,
    used: BoolArray,
    period: float,
    *,
    order: int = 0,
    max_delay: int = 0,
) -> SampledChoice:
    """Fit sampled models of ``input`` to ``output`` (n,) where ``used`` (n,), and choose.

    order: number of poles, 0 to choose;  max_delay: whole samples to try

    Raises IdentificationError for too few samples or frequencies of the input, for an order beyond
    MAX_POLES, or where a value is not finite.
    """
    most = check_record(input, output, used, order)
    centred = np.where(used, output - np.mean(output[used]), 0.0)
    delay = _best_delay(input, centred, used, period, max_delay)
    problem = delayed(input, centred, used, period, delay)
    part = parts(problem.used)
    early = replace(problem, used=problem.used & (part < _FIRST_PART * _PARTS))
    late = problem.used & ~early.used
    fits, by_order = _explored(early, late, most, order)
    finalists = _finalists(by_order, order)
    tried = [
        SampledCandidate(problem, refit(problem, fits[n], white), n, white, np.empty(0))
        for n in finalists
        for white in ((False, True) if n else (False,))
    ]
    judged = [replace(c, held_out=held_out_errors(c, part)) for c in tried]
    starts = DiscreteStarts(problem.input, problem.output, problem.used, most)
    free = _finished(simplest_undominated(judged), starts)
    chosen = free
    if order and order != free.order:
        chosen = _finished(simplest_undominated([c for c in judged if c.order == order]), starts)
    return SampledChoice(chosen, free, delay, by_order)


def check_record(input: FloatArray, output: FloatArray, used: BoolArray, order: int) -> int:
    """Return the highest order that a record determines; raise as :func:`choose_sampled` does."""
    most = _highest_order(int(np.sum(used)), order)
    if np.ptp(input) == 0:
        raise IdentificationError("estimation.constant_input")
    if not (np.all(np.isfinite(input)) and np.all(np.isfinite(output[used]))):
        raise IdentificationError("estimation.not_finite")
    return _most_excited(input, most, order)


def _finished(candidate: SampledCandidate, starts: DiscreteStarts) -> SampledCandidate:
    """Return the candidate at the best minimum from starts of all used samples."""
    if candidate.order == 0 or candidate.whitened:
        return candidate
    every = [candidate.fit.nonlinear, *proposed_starts(candidate.problem, candidate.order, starts)]
    return replace(candidate, fit=fit(candidate.problem, candidate.fit.structure, every))


def proposed_starts(
    problem: ZeroOrderHoldProblem, order: int, starts: DiscreteStarts
) -> list[FloatArray]:
    """Return ψ of what ``starts`` propose for ``order``, as far as they are any."""
    scaled = ScaledDiscreteStructure(Structure(order, order, False), problem.rate)
    every = [scaled.of_discrete(poles) for poles in starts.poles(order)]
    return [p for p in every if len(p) == order and np.all(np.isfinite(p))]


def _highest_order(samples: int, order: int) -> int:
    if not 0 <= order <= MAX_POLES:
        raise IdentificationError("estimation.order", order=order, most=MAX_POLES)
    if samples > _MOST_SAMPLES:
        raise IdentificationError(
            "estimation.too_many_samples", samples=samples, most=_MOST_SAMPLES
        )
    needed = _LEAST_SAMPLES_EACH * parameters(max(order, 1))
    if samples < needed:
        raise IdentificationError(
            "estimation.too_few_samples", samples=samples, least=needed, order=max(order, 1)
        )
    return min(MAX_POLES, (samples // _LEAST_SAMPLES_EACH - 3) // 3)


def excited_parameters(input: FloatArray, most: int) -> int:
    """Return the number of parameters that ``input`` (n,) determines, at most ``most``.

    That is its order of persistent excitation with a constant (Ljung 1999, ch. 13): the rank of
    all its windows of ``most`` samples. Each sine gives two, noise gives all.
    """
    windows = np.lib.stride_tricks.sliding_window_view(input, most)
    varied = windows - np.mean(windows, axis=0)
    power = np.linalg.eigvalsh(varied.T @ varied)
    return int(np.sum(power > _UNEXCITED * power[-1]))


def _most_excited(input: FloatArray, most: int, order: int) -> int:
    """Return the highest order, at most ``most``, whose parameters the input determines."""
    excited = excited_parameters(input, min(2 * most + 1, len(input)))
    needed = 2 * max(order, 1) + 1
    if excited < needed:
        raise IdentificationError(
            "estimation.few_frequencies", excited=excited, needed=needed, order=max(order, 1)
        )
    return min(most, (excited - 1) // 2)


def parts(used: BoolArray) -> FloatArray:
    """Return the place of each used sample in parts, 0 to _PARTS, fractional; -1 elsewhere."""
    place = np.cumsum(used) - 1.0
    return np.asarray(np.where(used, place * _PARTS / max(float(np.sum(used)), 1.0), -1.0))


def delayed(
    input: FloatArray, output: FloatArray, used: BoolArray, period: float, delay: int
) -> ZeroOrderHoldProblem:
    """Return the problem with ``input`` (n,) delayed by ``delay`` samples."""
    late = np.roll(input, delay)
    return ZeroOrderHoldProblem(
        input=late - np.mean(late),
        output=output,
        used=used & (np.arange(len(used)) >= delay),
        period=period,
        background=np.ones((len(output), 1)),
        rate=RATE_SAMPLES / period,
    )


def _best_delay(
    input: FloatArray, output: FloatArray, used: BoolArray, period: float, most: int
) -> int:
    """Return the delay [samples] at which a small model fits best."""
    if most == 0:
        return 0
    same = used & (np.arange(len(used)) >= most)
    sums = []
    for delay in range(most + 1):
        problem = delayed(input, output, same, period, delay)
        starts = DiscreteStarts(problem.input, problem.output, problem.used, _DELAY_ORDER)
        fits: list[Fit] = []
        for _ in range(_DELAY_ORDER + 1):
            fits.append(next_order(problem, fits, starts))
        sums.append(fits[-1].sum_of_squares)
    return int(np.argmin(sums))


def _explored(
    early: ZeroOrderHoldProblem, late: BoolArray, most: int, at_least: int
) -> tuple[list[Fit], FloatArray]:
    """Return fits of rising order and their errors over ``late``, until they stop to improve.

    at_least: order to go to in any case
    """
    fits: list[Fit] = []
    errors: list[float] = []
    starts = DiscreteStarts(early.input, early.output, early.used, most)
    for order in range(most + 1):
        fits.append(next_order(early, fits, starts))
        errors.append(_missed(early, fits[-1], late))
        if order - int(np.argmin(errors)) >= _FRUITLESS and order >= at_least:
            break
    return fits, np.array(errors)


def next_order(
    problem: ZeroOrderHoldProblem, smaller: Sequence[Fit], starts: DiscreteStarts
) -> Fit:
    """Return the best fit with as many poles as there are ``smaller`` fits."""
    order = len(smaller)
    structure = Structure(order, order, False)
    if order == 0:
        return fit(problem, structure, [np.empty(0)])
    larger = grown_starts([f.nonlinear for f in smaller], len(problem.output))
    return fit(problem, structure, proposed_starts(problem, order, starts) + larger)


def refit(problem: ZeroOrderHoldProblem, start: Fit, whitened: bool, *evaluations: int) -> Fit:
    """Fit the structure of ``start`` to ``problem``, its residual made white if ``whitened``.

    evaluations: of a fit, as of :func:`fit` if not given
    """
    found = fit(problem, start.structure, [start.nonlinear], *evaluations)
    if not whitened:
        return found
    whitener, _ = autoregression(found.residual)
    if len(whitener) == 1:
        return found
    apart = np.arange(len(problem.used)) >= len(whitener)
    lost = np.convolve(~problem.used, np.ones(len(whitener)))[: len(problem.used)] > 0.5
    white = replace(
        problem,
        input=signal.lfilter(whitener, 1.0, problem.input),
        output=signal.lfilter(whitener, 1.0, problem.output),
        used=problem.used & apart & ~lost,
    )
    return fit(white, start.structure, [found.nonlinear], *evaluations)


def _missed(problem: ZeroOrderHoldProblem, fitted: Fit, held_out: BoolArray) -> float:
    """Return the mean square error of a free run over samples that are not used in ``problem``."""
    missed = (problem.output - problem.free_run(fitted))[held_out]
    value = float(np.mean(missed**2))
    return value if np.isfinite(value) else np.inf


def _finalists(by_order: FloatArray, order: int) -> list[int]:
    """Return the orders to compare: the best, the lowest of similar error, 0, 1 and ``order``."""
    best = np.argsort(by_order, kind="stable")[:_FINALISTS]
    about_as_good = np.flatnonzero(by_order <= _EQUIVALENT * np.min(by_order))[:_FINALISTS]
    return sorted({0, 1, order, *best.tolist(), *about_as_good.tolist()})


def held_out_errors(
    candidate: SampledCandidate, part: FloatArray, evaluations: int = _HELD_OUT_EVALUATIONS
) -> FloatArray:
    """Return the mean square error over each held-out part, the candidate fitted without it.

    part: of each sample, see :func:`parts`;  evaluations: of that fit

    Some parts lie inside the record, others reach to its end. Parts inside alone would favour
    models of a drift, because the data constrain the model on both sides.
    """
    problem, number = candidate.problem, np.floor(part)
    held_out = [number == i for i in range(1, _PARTS)]
    held_out += [number >= i for i in range(_PARTS // 2, _PARTS - 1)]
    errors = []
    for samples in held_out:
        rest = replace(problem, used=problem.used & ~samples)
        found = refit(rest, candidate.fit, candidate.whitened, evaluations)
        errors.append(_missed(rest, found, samples))
    return np.array(errors)


def simplest_undominated(judged: Sequence[SampledCandidate]) -> SampledCandidate:
    """Return the simplest candidate that no other dominates: not whitened, then fewest poles.

    A candidate dominates if its mean error is lower by more than half a standard error of their
    paired difference (after Breiman et al. 1984).
    """
    errors = np.array([c.held_out for c in judged])
    with np.errstate(invalid="ignore"):
        worse = errors[:, np.newaxis] - errors[np.newaxis]
        allowed = _IMPROVES_BY * np.std(worse, axis=2, ddof=1) / np.sqrt(errors.shape[1])
        unbeaten = np.all(np.mean(worse, axis=2) <= allowed, axis=1)
    best = int(np.argmin(np.mean(errors, axis=1)))
    every = {best, *np.flatnonzero(unbeaten).tolist()}
    return judged[min(every, key=lambda i: (judged[i].whitened, judged[i].order))]


# Used samples on which the order is chosen: eighty per parameter of the highest order.
CHOSEN_ON = 5000
# Parts whose excitation is compared.
_MOST_PARTS = 16
# Highest of the lowest orders, which are fitted to the whole record: for slow dynamics.
_LOWEST = 2
# Poles more than chosen on the part, fitted to the whole record: for weak dynamics.
_POLES_MORE = 2
# Iterations without a held-out part: in a long record it hardly changes the model.
_HELD_OUT_EVALUATIONS_LONG_RECORD = 2


def choose_sampled_long(
    input: FloatArray,
    output: FloatArray,
    used: BoolArray,
    period: float,
    *,
    order: int = 0,
    max_delay: int = 0,
) -> SampledChoice:
    """Choose a model as :func:`choose_sampled` does, quickly for a long record too."""
    check_record(input, output, used, order)
    if int(np.sum(used)) <= CHOSEN_ON:
        return choose_sampled(input, output, used, period, order=order, max_delay=max_delay)
    part = most_exciting_part(input, used)
    try:
        choice = choose_sampled(
            input[part], output[part], used[part], period, order=order, max_delay=max_delay
        )
    except IdentificationError:
        # No part excites as much as the whole record.
        return choose_sampled(input, output, used, period, order=order, max_delay=max_delay)
    centred = np.where(used, output - np.mean(output[used]), 0.0)
    return _on_full_record(delayed(input, centred, used, period, choice.delay), choice)


def most_exciting_part(input: FloatArray, used: BoolArray) -> slice:
    """Return the part with CHOSEN_ON samples ``used`` (n,) in which ``input`` (n,) excites most."""
    places = np.flatnonzero(used)
    count = len(places) // CHOSEN_ON
    tried = np.unique(np.linspace(0, count - 1, min(count, _MOST_PARTS)).astype(int))
    every = [
        slice(int(places[i * CHOSEN_ON]), int(places[(i + 1) * CHOSEN_ON - 1]) + 1) for i in tried
    ]

    def information(part: slice) -> tuple[int, float]:
        varied = input[part]
        excited = excited_parameters(varied, 2 * MAX_POLES + 1) if np.ptp(varied) > 0 else 0
        return excited, float(np.var(varied))

    return max(every, key=information)


def _on_full_record(problem: ZeroOrderHoldProblem, choice: SampledChoice) -> SampledChoice:
    part = parts(problem.used)
    starts = DiscreteStarts(problem.input, problem.output, problem.used, MAX_POLES)
    lowest: list[Fit] = []
    while len(lowest) <= _LOWEST:
        lowest.append(next_order(problem, lowest, starts))
    tried = [SampledCandidate(problem, f, f.structure.poles, False, np.empty(0)) for f in lowest]
    free = _refit_on_full_record(problem, choice.free)
    tried += [free, *_with_further_poles(problem, free, starts)]
    judged = [
        replace(c, held_out=held_out_errors(c, part, _HELD_OUT_EVALUATIONS_LONG_RECORD))
        for c in tried
    ]
    best = simplest_undominated(judged)
    if choice.chosen is choice.free:
        return replace(choice, chosen=best, free=best)
    asked = _refit_on_full_record(problem, choice.chosen)
    asked = replace(asked, held_out=held_out_errors(asked, part, _HELD_OUT_EVALUATIONS_LONG_RECORD))
    return replace(choice, chosen=asked, free=best)


def _refit_on_full_record(
    problem: ZeroOrderHoldProblem, found: SampledCandidate
) -> SampledCandidate:
    """Return the candidate ``found`` on a part, fitted to the whole ``problem``."""
    return replace(found, problem=problem, fit=refit(problem, found.fit, found.whitened))


def _with_further_poles(
    problem: ZeroOrderHoldProblem, found: SampledCandidate, starts: DiscreteStarts
) -> list[SampledCandidate]:
    order = found.order + _POLES_MORE
    if order > MAX_POLES:
        return []
    grown = found.fit.nonlinear
    for _ in range(_POLES_MORE):
        grown = with_fast_pole(grown)
    larger = fit(
        problem, Structure(order, order, False), [*proposed_starts(problem, order, starts), grown]
    )
    return [replace(found, fit=larger, order=order, whitened=False)]
