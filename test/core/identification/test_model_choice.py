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
