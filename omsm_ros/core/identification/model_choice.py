"""Which model does a prepared problem support?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from omsm_ros.core.estimation.model_order import (
    Candidate,
    StartingPoints,
    choose,
    explore,
    identifiable,
    information,
)
from omsm_ros.core.estimation.model_structure import Structure
from omsm_ros.core.estimation.optimisation import EvaluationBudget
from omsm_ros.core.estimation.output_error import Fit, Problem, evaluated, fit
from omsm_ros.core.estimation.preparation import Prepared
from omsm_ros.core.identification.residual_tests import follows_beyond, noise_colour
from omsm_ros.linear_algebra import triangle

# Does the record start while the machine still rings from an earlier motion?
#
# The motion before the first sample is unknown, but its response since then is a sum of decays at
# the poles of G. Fast ones are over before the first sample that counts. A lightly damped mode may
# ring for a second, and a fit that takes its ringing for a response to the motion is biased.

# χ² a column must explain to be taken: four sigma.
_CLEARLY_SHOWN = 16.0
# A decay by e to this power is over.
_OVER = 10.0
# Directions this much weaker than the strongest are rounding.
_SPANNED = 1e-6


def has_initial_response(
    problem: Problem, fitted: Fit, colour: float = 1.0, *, at_rest: bool = True
) -> bool:
    """Return whether decays at the poles of ``fitted`` reach into the samples that count.

    at_rest: the axis rests at the start; then the decays have to show clearly in the residual
    colour: power of the noise at low frequency over its mean, see ``information``
    """
    counted = np.flatnonzero(problem.used)
    if problem.fits_initial_condition or fitted.structure.poles == 0 or len(counted) == 0:
        return False
    first = float(counted[0]) * problem.period
    if float(np.min(-fitted.dynamics.poles().real)) * first > _OVER:
        return False
    if not at_rest:
        return True
    columns = problem.initial_condition_response(fitted)[problem.used]
    # The fit has already taken of a decay what the parameters of the model can imitate.
    known = problem.sensitivity(fitted)
    lengths = [np.sqrt(np.einsum("kq,kq->q", part, part)) for part in (columns, known)]
    scale = np.concatenate([*lengths, np.ones(1)])
    scale[scale == 0] = 1.0
    factor = triangle(columns, known, fitted.residual[:, np.newaxis]) / scale
    left, values, _ = np.linalg.svd(factor[:-1, :-1])
    spanned = left[:, values > _SPANNED * values[0]]
    explained = float(np.sum((spanned.T @ factor[:-1, -1]) ** 2))
    rest = fitted.sum_of_squares - explained
    size = spanned.shape[1] - known.shape[1]
    return bool(explained * fitted.samples > colour * _CLEARLY_SHOWN * max(size, 1) * rest)


# Of what is worse by so much on fewer samples none is chosen on all of them; a structure is chosen
# within one parameter of the best, at 14 at most.
_MAY_BE_CHOSEN_BIC = 30.0
# "Not worth more than a bare mention" (Kass and Raftery 1995).
_ALIKE_BIC = 2.0
# Beyond the first ones, of a fit that starts at the minimum over fewer samples.
_NEARLY_EVALUATIONS = 2
# Probability by chance below which what moves faster than fewer samples show tells more.
_NO_FURTHER_GAIN = 0.01


@dataclass(frozen=True, eq=False)
class ChosenModel:
    """The chosen candidate among those of its kind that were tried.

    free: the choice without asking, where an order was asked for; else None
    """

    chosen: Candidate
    candidates: Sequence[Candidate]
    free: ChosenModel | None = None


def choose_model(
    prepared: Prepared, budget: EvaluationBudget | None = None, order: int = 0
) -> ChosenModel:
    """Fit structures to the prepared problem and choose one.

    budget: of the evaluations; None for a budget of its own
    order: number of poles, 0 to choose it. The free choice is made in any case.
    """
    problem = prepared.problem
    budget = budget or EvaluationBudget()
    lag = fit(problem, Structure(0, 0, True), [np.array([0.1])], budget=budget)
    points, before = StartingPoints(problem, lag, budget), None
    if points.coarser is not None:
        model = _chosen_on_subset(prepared, points.coarser, lag, budget, order)
        before = model.chosen.fit
        if follows_beyond(problem, before, points.coarser.problem) > _NO_FURTHER_GAIN:
            return model
        if budget.stops():
            return model

    def fit_structure(structure: Structure, smaller: Sequence[Fit]) -> Fit:
        return fit(problem, structure, points.of(structure, smaller), budget=budget)

    colour = noise_colour(problem, lag, prepared.steps)
    found = _model(problem, explore(fit_structure, order, colour, budget), order)
    return found if before is None else keep_better(problem, found, before, budget)


def keep_better(
    problem: Problem, found: ChosenModel, before: Fit, budget: EvaluationBudget
) -> ChosenModel:
    """Return ``found``, or the structure of ``before`` where ``found`` was cut short and is worse.

    before: fitted to the problem as it was. Where the budget is exhausted, its structure may not be
        among those tried for ``found``.
    """
    if not budget.exhausted:
        return found
    again = fit(problem, before.structure, [before.nonlinear], budget=budget)
    candidate = Candidate(again, information(again))
    better = candidate.bic < information(found.chosen.fit)
    if not better or not _identifiable(problem, [candidate]):
        return found
    return replace(found, chosen=candidate, candidates=[*found.candidates, candidate])


def rechosen(problem: Problem, before: ChosenModel, budget: EvaluationBudget) -> ChosenModel | None:
    """Return ``before``, which was chosen while the problem was another, fitted to it as it is.

    None where the change lets some candidates describe more than others: then a structure that
    was not tried may describe more too. None also where an order was asked for.
    """
    if before.free is not None:
        return None
    best = min(c.bic for c in before.candidates)
    changes, candidates = [], []
    for known in before.candidates:
        now = evaluated(problem, known.fit.structure, known.fit.nonlinear)
        change = information(now) - information(known.fit)
        if known.bic < best + _MAY_BE_CHOSEN_BIC:
            changes.append(change)
        candidates.append(Candidate(now, known.bic + change))
    if max(changes) - min(changes) > _ALIKE_BIC:
        return None
    fitted, nonlinear = before.chosen.fit, before.chosen.fit.nonlinear
    again = fit(problem, fitted.structure, [nonlinear], budget=budget)
    chosen = Candidate(again, before.chosen.bic + information(again) - information(fitted))
    others = [c for c in candidates if c.fit.structure != fitted.structure]
    return replace(before, chosen=chosen, candidates=[*others, chosen])


def _model(problem: Problem, explored: Sequence[Candidate], order: int) -> ChosenModel:
    candidates = _identifiable(problem, explored)
    free = ChosenModel(choose(candidates), candidates)
    if not order:
        return free
    asked = [c for c in explored if c.fit.structure.poles == order]
    return ChosenModel(choose(asked), asked, free)


def _chosen_on_subset(
    prepared: Prepared, points: StartingPoints, lag: Fit, budget: EvaluationBudget, order: int
) -> ChosenModel:
    """Explore structures at the samples of ``points``; fit to all those that may be chosen.

    lag: the fit of a delay alone to all samples
    A structure that is far from the best there is compared with all samples where it was best.
    """
    problem, coarse = prepared.problem, points.problem
    every = round(coarse.period / problem.period)
    steps = replace(prepared.steps, moving=prepared.steps.moving[::every])
    delay = fit(coarse, lag.structure, [lag.nonlinear], budget=budget)
    fewer = replace(points, pure_delay=delay)

    def fit_structure(structure: Structure, smaller: Sequence[Fit]) -> Fit:
        return fit(coarse, structure, fewer.of(structure, smaller), budget=budget)

    colour = noise_colour(coarse, fewer.pure_delay, steps)
    found = explore(fit_structure, order, colour, budget)
    best = min(c.bic for c in found)
    price = noise_colour(problem, lag, prepared.steps)

    def candidate(fitted: Fit) -> Candidate:
        return Candidate(fitted, information(fitted, price))

    explored = [
        candidate(
            fit(problem, c.fit.structure, [c.fit.nonlinear], _NEARLY_EVALUATIONS, budget=budget)
            if c.bic < best + _MAY_BE_CHOSEN_BIC
            else evaluated(problem, c.fit.structure, c.fit.nonlinear)
        )
        for c in found
    ]
    finished: set[Structure] = set()
    while True:
        model = _model(problem, explored, order)
        chosen = {m.chosen.fit.structure for m in (model, model.free) if m is not None}
        if chosen <= finished:
            return model
        explored = [
            candidate(fit(problem, c.fit.structure, [c.fit.nonlinear], budget=budget))
            if c.fit.structure in chosen - finished
            else c
            for c in explored
        ]
        finished |= chosen


def _identifiable(problem: Problem, candidates: Sequence[Candidate]) -> Sequence[Candidate]:
    """Return those whose poles are identifiable; a delay alone has none."""
    duration = len(problem.input) * problem.period
    return [c for c in candidates if identifiable(c.fit.dynamics, problem.period, duration)]


def model_from_start(
    prepared: Prepared, budget: EvaluationBudget | None = None, order: int = 0
) -> tuple[Prepared, ChosenModel]:
    """Choose a model, with the initial-condition response fitted where the record begins in it.

    Returns the problem as it was fitted, and the model.
    """
    budget = budget or EvaluationBudget()
    model = choose_model(prepared, budget, order)
    colour = noise_colour(prepared.problem, model.chosen.fit, prepared.steps)
    at_rest = not prepared.steps.moving[0]
    if not has_initial_response(prepared.problem, model.chosen.fit, colour, at_rest=at_rest):
        return prepared, model
    prepared = replace(prepared, problem=replace(prepared.problem, fits_initial_condition=True))
    return prepared, choose_model(prepared, budget, order)
