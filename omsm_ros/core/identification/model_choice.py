"""Which model does a prepared problem support?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from omsm_ros.core.fitting.initial_condition import starts_ringing
from omsm_ros.core.fitting.model_structure import Structure
from omsm_ros.core.fitting.order_choice import Candidate, choose, explore, held_out_rms
from omsm_ros.core.fitting.order_estimate import OrderEstimate, estimate_order
from omsm_ros.core.fitting.output_error import Fit, fit
from omsm_ros.core.fitting.preparation import Prepared
from omsm_ros.core.fitting.starting_points import StartingPoints
from omsm_ros.core.fitting.steps import held_out
from omsm_ros.core.identification.residual_tests import noise_colour


@dataclass(frozen=True, eq=False)
class Model:
    """The chosen candidate among those tried, and the vote of the singular values."""

    chosen: Candidate
    candidates: Sequence[Candidate]
    vote: OrderEstimate


def choose_model(prepared: Prepared, order: int = 0) -> Model:
    """Fit structures to the prepared problem and choose among them; ``order`` poles, or 0."""
    problem = prepared.problem
    lag = fit(problem, Structure(0, 0, True), [np.array([0.1])])
    static = lag.gain * problem.input + problem.background @ lag.background
    deviation = (problem.output - static) / lag.gain
    vote = estimate_order(problem.input, deviation, problem.used, problem.period)
    points = StartingPoints(problem, lag, vote)

    def fit_structure(structure: Structure, smaller: Sequence[Fit]) -> Fit:
        return fit(problem, structure, points.of(structure, smaller))

    colour = noise_colour(problem, lag, prepared.steps)
    candidates = explore(fit_structure, vote.order, order, colour)
    held = held_out(prepared.steps, len(problem.input))
    chosen, candidates = choose(candidates, lambda f: held_out_rms(problem, f, held))
    return Model(chosen, candidates, vote)


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
