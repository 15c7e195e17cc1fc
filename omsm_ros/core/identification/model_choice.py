"""Which model does a prepared problem support?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from omsm_ros.core.fitting.initial_condition import starts_ringing
from omsm_ros.core.fitting.model_structure import Structure
from omsm_ros.core.fitting.order_choice import Candidate, choose, explore, identifiable
from omsm_ros.core.fitting.output_error import Fit, Problem, fit
from omsm_ros.core.fitting.preparation import Prepared
from omsm_ros.core.fitting.starting_points import StartingPoints
from omsm_ros.core.identification.residual_tests import noise_colour


@dataclass(frozen=True, eq=False)
class Model:
    """The chosen candidate among those of its kind that were tried.

    free: the choice without asking, where an order was asked for; else None
    """

    chosen: Candidate
    candidates: Sequence[Candidate]
    free: Model | None = None


def choose_model(prepared: Prepared, order: int = 0) -> Model:
    """Fit structures to the prepared problem and choose among them; ``order`` poles, or 0.

    The free choice is made in any case; an order that is asked for is picked beside it.
    """
    problem = prepared.problem
    lag = fit(problem, Structure(0, 0, True), [np.array([0.1])])
    points = StartingPoints(problem, lag)

    def fit_structure(structure: Structure, smaller: Sequence[Fit]) -> Fit:
        return fit(problem, structure, points.of(structure, smaller))

    colour = noise_colour(problem, lag, prepared.steps)
    explored = explore(fit_structure, order, colour, problem.effort)
    candidates = _identifiable(problem, explored)
    free = Model(choose(candidates), candidates)
    if not order:
        return free
    asked = [c for c in explored if c.fit.structure.poles == order]
    return Model(choose(asked), asked, free)


def _identifiable(problem: Problem, candidates: Sequence[Candidate]) -> Sequence[Candidate]:
    """Return those whose poles are identifiable; a delay alone has none."""
    duration = len(problem.input) * problem.period
    return [c for c in candidates if identifiable(c.fit.dynamics, problem.period, duration)]


def model_from_start(prepared: Prepared, order: int = 0) -> tuple[Prepared, Model]:
    """Choose a model, with the initial-condition response fitted where the record begins in it.

    Returns the problem as it was fitted, and the model.
    """
    model = choose_model(prepared, order)
    colour = noise_colour(prepared.problem, model.chosen.fit, prepared.steps)
    at_rest = not prepared.steps.moving[0]
    if not starts_ringing(prepared.problem, model.chosen.fit, colour, at_rest=at_rest):
        return prepared, model
    prepared = replace(prepared, problem=replace(prepared.problem, fits_initial_condition=True))
    return prepared, choose_model(prepared, order)
