"""Test what is kept of a choice where the problem has changed or the budget is exhausted."""

from dataclasses import replace

import numpy as np
import pytest

from omsm_ros.core.estimation.optimisation import EvaluationBudget
from omsm_ros.core.estimation.preparation import prepare
from omsm_ros.core.identification.model_choice import choose_model

from .recorded_motions import record_of, recorded


def test_what_was_chosen_for_nearly_the_same_problem_is_where_fits_start():
    """A line that no candidate describes leaves the choice, in a fraction of the evaluations."""
    prepared = prepare(record_of(recorded()), "encoder")
    problem, first, again = prepared.problem, EvaluationBudget(), EvaluationBudget()
    before = choose_model(prepared, first)
    line = 3e-9 * np.sin(2 * np.pi * 40.0 * problem.period * np.arange(len(problem.used)))
    quieter = replace(prepared, problem=replace(problem, output=problem.output - line))
    kept, anew = choose_model(quieter, again, before=before), choose_model(quieter)
    assert kept.chosen.fit.structure == anew.chosen.fit.structure
    assert kept.chosen.bic == pytest.approx(anew.chosen.bic, abs=0.1)
    assert again.evaluations < 0.4 * first.evaluations


@pytest.mark.parametrize("left", [0, 100])
def test_a_budget_that_ends_during_a_search_does_not_lower_the_order(left):
    """The second search of a record is left ``left`` evaluations, after the first one."""
    prepared = prepare(record_of(recorded()), "encoder")
    first = choose_model(prepared)
    samples, budget = len(prepared.problem.used), EvaluationBudget()
    while not budget.exhausted:
        budget.count(samples)
    budget.samples -= left * samples
    again = choose_model(prepared, budget, kept=first)
    assert budget.incomplete
    assert again.chosen.fit.structure.poles == first.chosen.fit.structure.poles > 1
    assert again.chosen.fit.sum_of_squares <= 1.0001 * first.chosen.fit.sum_of_squares
