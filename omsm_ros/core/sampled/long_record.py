"""The model of a long record: chosen on the part that tells most, fitted and judged on the whole.

To fit every order to every hidden part of a long record takes minutes, and tells of the order what
a few thousand samples tell. What they do not is what is slower than they last, and what is too weak
to show in them: so the lowest orders, and two poles more, are fitted to the whole as well.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from omsm_ros.core.fitting.discrete_starts import DiscreteStarts, with_fast_pole
from omsm_ros.core.fitting.free_run_choice import (
    MAX_ORDER,
    SampledCandidate,
    SampledChoice,
    check_record,
    choose_sampled,
    delayed,
    excited_parameters,
    hidden_errors,
    next_order,
    parts,
    plainest,
    proposed,
    refitted,
)
from omsm_ros.core.fitting.held_problem import HeldProblem
from omsm_ros.core.fitting.model_structure import Structure
from omsm_ros.core.fitting.output_error import Fit, fit
from omsm_ros.core.samples.blocks import BoolArray, FloatArray
from omsm_ros.errors import IdentificationError

# Samples that are used, on which is chosen: eighty for each parameter of the highest order.
CHOSEN_ON = 5000
# Parts that are compared in how much they tell.
_MOST_PARTS = 16
# Fitted to the whole in any case: what is slower than a part.
_LOWEST = 2
# and what is too weak for it.
_POLES_MORE = 2
# Without a part of a long record a model hardly moves.
_HIDDEN_EVALUATIONS = 2


def choose_of_any_length(
    input: FloatArray,
    output: FloatArray,
    used: BoolArray,
    period: float,
    *,
    order: int = 0,
    max_delay: int = 0,
) -> SampledChoice:
    """Fit sampled models and choose, as :func:`choose_sampled` does, whatever the length."""
    check_record(input, output, used, order)
    if int(np.sum(used)) <= CHOSEN_ON:
        return choose_sampled(input, output, used, period, order=order, max_delay=max_delay)
    part = telling_part(input, used)
    try:
        choice = choose_sampled(
            input[part], output[part], used[part], period, order=order, max_delay=max_delay
        )
    except IdentificationError:
        # No part excites as much as the whole does.
        return choose_sampled(input, output, used, period, order=order, max_delay=max_delay)
    centred = np.where(used, output - np.mean(output[used]), 0.0)
    return _on_the_whole(delayed(input, centred, used, period, choice.delay), choice)


def telling_part(input: FloatArray, used: BoolArray) -> slice:
    """Return the part with CHOSEN_ON samples ``used`` (n,) in which ``input`` (n,) excites most."""
    places = np.flatnonzero(used)
    count = len(places) // CHOSEN_ON
    tried = np.unique(np.linspace(0, count - 1, min(count, _MOST_PARTS)).astype(int))
    every = [
        slice(int(places[i * CHOSEN_ON]), int(places[(i + 1) * CHOSEN_ON - 1]) + 1) for i in tried
    ]

    def told(part: slice) -> tuple[int, float]:
        varied = input[part]
        excited = excited_parameters(varied, 2 * MAX_ORDER + 1) if np.ptp(varied) > 0 else 0
        return excited, float(np.var(varied))

    return max(every, key=told)


def _on_the_whole(problem: HeldProblem, choice: SampledChoice) -> SampledChoice:
    part = parts(problem.used)
    starts = DiscreteStarts(problem.input, problem.output, problem.used, MAX_ORDER)
    lowest: list[Fit] = []
    while len(lowest) <= _LOWEST:
        lowest.append(next_order(problem, lowest, starts))
    tried = [SampledCandidate(problem, f, f.structure.poles, False, np.empty(0)) for f in lowest]
    free = _of_part(problem, choice.free)
    tried += [free, *_with_poles_more(problem, free, starts)]
    judged = [replace(c, hidden=hidden_errors(c, part, _HIDDEN_EVALUATIONS)) for c in tried]
    best = plainest(judged)
    if choice.chosen is choice.free:
        return replace(choice, chosen=best, free=best)
    asked = _of_part(problem, choice.chosen)
    asked = replace(asked, hidden=hidden_errors(asked, part, _HIDDEN_EVALUATIONS))
    return replace(choice, chosen=asked, free=best)


def _of_part(problem: HeldProblem, found: SampledCandidate) -> SampledCandidate:
    """Return the candidate that was ``found`` on a part, fitted to the whole ``problem``."""
    return replace(found, problem=problem, fit=refitted(problem, found.fit, found.whitened))


def _with_poles_more(
    problem: HeldProblem, found: SampledCandidate, starts: DiscreteStarts
) -> list[SampledCandidate]:
    order = found.order + _POLES_MORE
    if order > MAX_ORDER:
        return []
    grown = found.fit.nonlinear
    for _ in range(_POLES_MORE):
        grown = with_fast_pole(grown)
    larger = fit(
        problem, Structure(order, order, False), [*proposed(problem, order, starts), grown]
    )
    return [replace(found, fit=larger, order=order, whitened=False)]
