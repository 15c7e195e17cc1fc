"""Choose a model for a prepared problem.

The motion before the first sample is unknown. Its response after it is a sum of decays at the poles
of G. Fast ones are over before the first compared sample; a lightly damped mode may ring for a
second, and would bias a fit that takes it for a response to the motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from omsm_ros.core.estimation.model_order import (
    Candidate,
    StartingPoints,
    choose,
    explore,
    fit,
    identifiable,
    information,
)
from omsm_ros.core.estimation.model_structure import Fit
from omsm_ros.core.estimation.optimisation import EvaluationBudget
from omsm_ros.core.estimation.output_error import Problem
from omsm_ros.core.estimation.preparation import Prepared
from omsm_ros.core.identification.residual_tests import noise_colour
from omsm_ros.core.lti.transfer_function import Structure, TransferFunction
from omsm_ros.core.model_errors.families import FASTEST_CREEP_S
from omsm_ros.linear_algebra import inverse_root

# χ² that each column must explain to be significant: four sigma.
_CLEARLY_SHOWN = 16.0
# Decay times after which a response is over.
OVER = 10.0


def has_initial_response(
    problem: Problem, fitted: Fit, colour: float = 1.0, *, at_rest: bool = True
) -> bool:
    """Return True if decays at the poles of ``fitted`` reach into the compared samples.

    at_rest: the axis is stationary at the start; then the decays must be significant
    colour: power of the noise at low frequency over its mean, see ``information``
    """
    counted = np.flatnonzero(problem.used)
    if problem.fits_initial_condition or fitted.structure.poles == 0 or len(counted) == 0:
        return False
    first = float(counted[0]) * problem.period
    if float(np.min(-fitted.dynamics.poles().real)) * first > OVER:
        return False
    if not at_rest:
        return True
    # The fit already contains the part of a decay that is collinear with its parameters.
    known = problem.sensitivity(fitted)
    columns = np.column_stack([problem.initial_condition_response(fitted)[problem.used], known])
    root = inverse_root(columns.T @ columns)
    explained = float(np.sum(((fitted.residual @ columns) @ root) ** 2))
    rest = fitted.sum_of_squares - explained
    size = root.shape[1] - known.shape[1]
    return bool(explained * fitted.samples > colour * _CLEARLY_SHOWN * max(size, 1) * rest)


@dataclass(frozen=True, eq=False)
class ChosenModel:
    """The chosen candidate and those that were tried.

    free: the free choice, where an order was asked for; else None
    explored: all fits, with those that the samples cannot identify
    """

    chosen: Candidate
    candidates: Sequence[Candidate]
    free: ChosenModel | None = None
    explored: Sequence[Candidate] = ()


def choose_model(
    prepared: Prepared,
    budget: EvaluationBudget | None = None,
    order: int = 0,
    before: ChosenModel | None = None,
    kept: ChosenModel | None = None,
) -> ChosenModel:
    """Fit structures to the prepared problem and choose one.

    budget: of the evaluations; None for a budget of its own
    order: number of poles, 0 to choose it. The free choice is made in any case.
    before: chosen for nearly the same problem; structures start from its fits, up to its order
    kept: chosen before, with fewer columns: its fit is a start too, which more columns can only
        improve, and an exhausted ``budget`` ends the search at no lower order
    """
    problem, budget = prepared.problem, budget or EvaluationBudget()
    part, earlier = problem.sums, before or kept
    lag = fit(problem, Structure(0, 0, True), [np.array([0.1])], budget=budget, part=part)
    known = {c.fit.structure: c.fit for c in earlier.explored} if earlier else {}
    lines = part or problem.lines
    # Structures in a row often start from the lines that the same fit has filled.
    refilled = lru_cache(maxsize=1)(lines.filled) if lines else None

    def fit_structure(structure: Structure, smaller: Sequence[Fit]) -> Fit:
        if structure == lag.structure:
            return lag
        same = known.get(structure) if before or budget.exhausted else None
        best = min(smaller, key=lambda fit: fit.sum_of_squares, default=lag)
        filled = refilled and refilled(best)
        points = StartingPoints(filled or problem, lag)
        starts = points.of(structure, smaller) if same is None else [same.nonlinear]
        if kept and structure == kept.chosen.fit.structure:
            starts.append(kept.chosen.fit.nonlinear)
        return fit(problem, structure, starts, budget=budget, part=filled if part else None)

    colour_of = lru_cache(maxsize=1)(lambda fit: noise_colour(problem, fit, prepared.steps))
    least = (earlier.free or earlier).chosen.fit.structure.poles if earlier else 0
    explored = explore(fit_structure, max(order, least * bool(before)), colour_of, budget, least)
    colour = colour_of(min((c.fit for c in explored), key=lambda fit: fit.sum_of_squares))
    duration = len(problem.input) * problem.period
    candidates = [
        c
        for c in explored
        if identifiable(c.fit.dynamics, problem.period, duration) and not _relaxes(c.fit.dynamics)
    ]

    def chosen(among: list[Candidate], free: ChosenModel | None = None) -> ChosenModel:
        best = choose(among)
        if part is not None:
            exact = fit(problem, best.fit.structure, [best.fit.nonlinear], budget=budget)
            finished = Candidate(exact, information(exact, colour))
            best, among = finished, [finished if c is best else c for c in among]
        return ChosenModel(best, among, free, explored)

    free = chosen(candidates)
    if not order:
        return free
    return chosen([c for c in explored if c.fit.structure.poles == order], free)


def _relaxes(dynamics: TransferFunction) -> bool:
    """Return True if a zero nearly cancels a slow pole that does not ring.

    It describes creep or a drift of the machine: the search for model errors tells them apart.
    """
    poles = dynamics.poles()
    slow = poles[(-poles.real * FASTEST_CREEP_S < 1) & (np.abs(poles.imag) < -poles.real)]
    apart = np.abs(slow[:, np.newaxis] - dynamics.zeros())
    return bool(np.any(apart < 0.5 * np.abs(slow[:, np.newaxis])))


def model_from_start(
    prepared: Prepared,
    budget: EvaluationBudget | None = None,
    order: int = 0,
    **earlier: ChosenModel,
) -> tuple[Prepared, ChosenModel]:
    """Choose a model, with the initial-condition response where the record starts during one.

    Returns the problem as it was fitted, and the model; ``earlier``: see :func:`choose_model`.
    """
    budget = budget or EvaluationBudget()
    model = choose_model(prepared, budget, order, **earlier)
    colour = noise_colour(prepared.problem, model.chosen.fit, prepared.steps)
    at_rest = not prepared.steps.moving[0]
    if not has_initial_response(prepared.problem, model.chosen.fit, colour, at_rest=at_rest):
        return prepared, model
    prepared = replace(prepared, problem=replace(prepared.problem, fits_initial_condition=True))
    return prepared, choose_model(prepared, budget, order, kept=model)
