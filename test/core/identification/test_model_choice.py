"""Test what is kept of a choice where the problem has changed or the budget is exhausted."""

from dataclasses import replace

import numpy as np
import pytest

from omsm_ros.core.estimation.model_order import Candidate, StartingPoints, information
from omsm_ros.core.estimation.optimisation import EvaluationBudget
from omsm_ros.core.estimation.output_error import fit
from omsm_ros.core.estimation.preparation import prepare
from omsm_ros.core.identification.model_choice import ChosenModel, rechosen
from omsm_ros.core.lti.transfer_function import Structure

from .recorded_motions import record_of, recorded


@pytest.fixture(scope="module")
def fitted():
    """A problem, its fit by a delay alone, and by a structure with its roll-off."""
    problem = prepare(record_of(recorded()), "encoder").problem
    lag = fit(problem, Structure(0, 0, True), [np.array([0.1])])
    two = Structure(2, 1, False)
    return problem, lag, fit(problem, two, StartingPoints(problem, lag).of(two, [lag]))


def among(lag, two):
    """The choice of ``two`` among both."""
    candidates = [Candidate(each, information(each)) for each in (lag, two)]
    return ChosenModel(candidates[1], candidates)


def test_what_all_candidates_lack_alike_leaves_the_choice(fitted):
    """A line that no candidate describes changes the sum of squares of all of them alike."""
    problem, _, two = fitted
    three = fit(problem, Structure(2, 1, True), [np.append(two.nonlinear, 0.01)])
    line = 3e-9 * np.sin(2 * np.pi * 40.0 * problem.period * np.arange(len(problem.used)))
    quieter = replace(problem, output=problem.output - line)
    kept = rechosen(quieter, among(three, two), EvaluationBudget())
    again = fit(quieter, two.structure, [two.nonlinear])
    assert kept.chosen.fit.sum_of_squares == pytest.approx(again.sum_of_squares, rel=1e-9, abs=0)
    assert kept.chosen in kept.candidates
    for candidate in kept.candidates:
        assert candidate.bic == pytest.approx(information(candidate.fit), rel=1e-9)
        assert len(candidate.fit.residual) == len(two.residual)


def test_what_one_candidate_gains_more_by_asks_for_another_choice(fitted):
    """The output of one candidate without its noise: the delay alone does not improve."""
    problem, lag, two = fitted
    exact = replace(
        problem, output=problem.modelled(two) + 0.1 * (problem.output - problem.modelled(two))
    )
    assert rechosen(exact, among(two, lag), EvaluationBudget()) is None
    assert rechosen(problem, among(two, lag), EvaluationBudget()) is not None


def test_of_an_order_that_was_asked_for_the_free_choice_is_made_anew(fitted):
    problem, lag, two = fitted
    asked = replace(among(lag, two), free=among(lag, two))
    assert rechosen(problem, asked, EvaluationBudget()) is None
