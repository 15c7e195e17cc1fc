"""Test which structures are tried and chosen, on steps through systems of known order."""

import math
from functools import lru_cache

import numpy as np
import pytest

from benchmarks.step_test import StepTest
from benchmarks.twin_motions import respond
from omsm_ros.core.estimation.model_order import (
    Candidate,
    StartingPoints,
    cancels,
    choose,
    explore,
    fit,
    identifiable,
    information,
    structures,
)
from omsm_ros.core.estimation.optimisation import EvaluationBudget
from omsm_ros.core.estimation.output_error import Problem
from omsm_ros.core.lti.transfer_function import Structure, TransferFunction
from omsm_ros.errors import IdentificationError
from omsm_ros.twin.plant import Plant

NOISE = 1e-8
FIRST_ORDER = TransferFunction.from_ascending([1.0], [1.0, 3e-3])
OMEGA = 2 * np.pi * 40.0
PAIR = TransferFunction.from_ascending([1.0], [1.0, 0.2 / OMEGA, OMEGA**-2])
PAIR_AND_POLE = TransferFunction.from_ascending(
    [1.0], np.polynomial.polynomial.polymul([1.0, 0.2 / OMEGA, OMEGA**-2], [1.0, 8e-3])
)


@lru_cache(maxsize=8)
def problem_of(dynamics, seed=1):
    motion = StepTest(count=2, dwell=0.3)
    moved = respond(Plant(dynamics), motion, round(motion.duration / 1e-3), 1e-3)
    n = len(moved.probe)
    seen = moved.probe + np.random.default_rng(seed).normal(0.0, NOISE, n)
    return Problem(moved.slide, seen, np.ones(n, bool), 1e-3, np.ones((n, 1)), 300.0)


def fitter(problem):
    """How one structure is fitted to ``problem``, given the smaller ones."""
    lag = fit(problem, Structure(0, 0, True), [np.array([0.1])])
    points = StartingPoints(problem, lag)
    return lambda structure, smaller: fit(problem, structure, points.of(structure, smaller))


@lru_cache(maxsize=8)
def explored(dynamics, order=0):
    return explore(fitter(problem_of(dynamics)), order)


def best(candidates):
    return min(candidates, key=lambda c: c.bic)


def distance(found, truth):
    """Greatest relative difference of the responses up to 60 Hz."""
    frequency = np.linspace(0.5, 60.0, 50)
    return np.max(np.abs(found.response(frequency) / truth.response(frequency) - 1))


def test_at_most_two_zeros_are_fewer_and_pairs_may_have_as_many_the_smallest_first():
    assert structures(0) == [Structure(0, 0, True)]
    for poles in range(2, 7):
        tried = structures(poles)
        zeros = range(poles - 2, poles + (1 if poles % 2 == 0 else 0))
        expected = {(number, delay) for number in zeros for delay in (False, True)}
        assert {(s.zeros, s.delay) for s in tried} == expected
        assert len(tried) == len(expected)
        assert [s.size for s in tried] == sorted(s.size for s in tried)


def test_a_mode_of_a_rigid_machine_needs_no_poles_that_make_it_roll_off():
    """1 + a (M - 1) with a delay: two zeros for its two poles, and one parameter more."""
    numerator = np.array([1.0, 0.2 / OMEGA, 0.85 * OMEGA**-2])
    rigid = TransferFunction.from_ascending(numerator, [1.0, 0.2 / OMEGA, OMEGA**-2], 1.5e-3)
    candidates = explored(rigid)
    assert best(candidates).fit.structure == Structure(2, 2, True)
    assert choose(candidates).fit.structure.poles <= 3
    assert distance(choose(candidates).fit.dynamics, rigid) < 0.02


def test_no_order_is_begun_once_enough_was_tried():
    fit_structure = fitter(problem_of(PAIR))
    for order in (0, 3):
        budget = EvaluationBudget(samples=10**9)
        found = explore(fit_structure, order, budget=budget)
        assert max(c.fit.structure.poles for c in found) == order
        assert budget.incomplete
    again = explore(fit_structure, 0, budget=EvaluationBudget(samples=10**9), least=2)
    assert max(c.fit.structure.poles for c in again) == 2
    assert max(c.fit.structure.poles for c in explored(PAIR)) > 0


@pytest.mark.parametrize("order", [-1, 21, 1000])
def test_an_order_that_no_polynomial_has_digits_for_is_refused(order):
    with pytest.raises(IdentificationError, match=r"expected 0 \(choose\) to 20"):
        explore(fitter(problem_of(FIRST_ORDER)), order)


def test_information_is_minus_twice_the_log_likelihood_and_log_n_a_parameter():
    """Check against the normal likelihood of the residuals, up to a constant of n."""
    small, *_, large = (c.fit for c in explored(PAIR))
    n = small.samples
    assert small.size < large.size

    def likelihood(found):
        variance = np.mean(found.residual**2)
        density = -(found.residual**2) / (2 * variance) - 0.5 * np.log(2 * np.pi * variance)
        return float(np.sum(density))

    expected = 2 * (likelihood(small) - likelihood(large))
    expected += (large.size - small.size) * math.log(n)
    assert information(large) - information(small) == pytest.approx(expected, rel=1e-9)
    dearer = information(large, 2.5) - information(small, 2.5)
    charge = 1.5 * (large.size - small.size) * math.log(n)
    assert dearer == pytest.approx(expected + charge, rel=1e-9)


@pytest.mark.parametrize(
    ("frequency", "damping", "reported"),
    [
        (50.0, 0.01, True),
        (50.0, 1e-4, False),  # decays to 1/e in 32 s, the record takes ten
        (700.0, 0.05, False),  # rings beyond 500 Hz
        (700.0, 0.5, True),
        (7e6, 1.0, True),  # too fast to be seen, and harmless
    ],
)
def test_a_pole_is_identified_from_samples_in_which_it_is_visible(frequency, damping, reported):
    omega = 2 * np.pi * frequency
    pair = TransferFunction.from_ascending([1.0], [1.0, 2 * damping / omega, omega**-2])
    assert identifiable(pair, 1e-3, 10.0) is reported


@pytest.mark.parametrize(("truth", "poles"), [(FIRST_ORDER, 1), (PAIR, 2), (PAIR_AND_POLE, 3)])
def test_the_data_insist_on_as_many_poles_as_there_are(truth, poles):
    smallest = best(explored(truth)).fit
    assert smallest.structure.poles == poles
    assert distance(smallest.dynamics, truth) < 0.01


@pytest.mark.parametrize("zeros", [[1.0, 2e-3], [1.0, 4e-4, (2 * np.pi * 90.0) ** -2]])
def test_the_data_insist_on_zeros_and_delay_too(zeros):
    """The largest structure of three poles, and the one that is tried last below it."""
    truth = TransferFunction(zeros, PAIR_AND_POLE.denominator, delay=1.7e-3)
    smallest = best(explored(truth)).fit
    assert smallest.structure == Structure(3, len(zeros) - 1, True)
    assert distance(smallest.dynamics, truth) < 0.01


@pytest.mark.parametrize("truth", [FIRST_ORDER, PAIR, PAIR_AND_POLE])
def test_the_chosen_one_contains_the_smallest_and_is_richer(truth):
    candidates = explored(truth)
    smallest = best(candidates).fit.structure
    chosen = choose(candidates)
    assert chosen.fit.structure.contains(smallest)
    assert chosen.fit.structure.size == max(smallest.size + 1, 3)
    assert distance(chosen.fit.dynamics, truth) < 0.01


def test_a_zero_on_a_pole_is_no_richer():
    """A richer candidate is passed over once its zero cancels a pole."""
    candidates = explored(FIRST_ORDER)
    chosen = choose(candidates)
    scaled = chosen.fit.scaled
    dipole = TransferFunction([1.0, 1.0001e-2], [1.0, 1.1e-2, 1e-5])
    assert cancels(dipole)

    class Cancelling(type(chosen.fit)):
        dynamics = dipole

    spoiled = Cancelling(
        scaled, chosen.fit.nonlinear, chosen.fit.driven, chosen.fit.background, chosen.fit.residual
    )
    others = [Candidate(spoiled, c.bic) if c.fit is chosen.fit else c for c in candidates]
    again = choose(others)
    assert again.fit is not spoiled


@pytest.mark.parametrize(("apart", "cancelling"), [(1e-4, True), (0.05, False)])
def test_a_zero_cancels_a_pole_that_no_data_could_tell_from_it(apart, cancelling):
    """Test either pole, with the other one slower or faster."""
    for pole, other in ((100.0, 1e4), (1e4, 100.0)):
        poles = np.polynomial.polynomial.polymul([1.0, 1 / pole], [1.0, 1 / other])
        zero = [1.0, 1 / (pole * (1 + apart))]
        assert cancels(TransferFunction(np.array(zero), poles)) is cancelling


def test_where_there_are_no_zeros_none_cancels():
    assert not cancels(TransferFunction([1.0], [1.0, 1.1e-2, 1e-5]))


@pytest.mark.parametrize(("truth", "poles"), [(FIRST_ORDER, 1), (PAIR, 2), (PAIR_AND_POLE, 3)])
def test_the_search_stops_two_poles_after_the_last_gain(truth, poles):
    assert max(c.fit.structure.poles for c in explored(truth)) == poles + 2


def test_the_search_goes_as_far_as_the_order_asked_for_and_tries_all_below():
    tried = explored(FIRST_ORDER, 5)
    assert {c.fit.structure.poles for c in tried} == {0, 1, 2, 3, 4, 5}
    assert best(tried).fit.structure == best(explored(FIRST_ORDER)).fit.structure


def test_hopeless_structures_are_not_fitted():
    """The largest structure of four poles gains nothing, so no smaller one of four can."""
    tried = explored(FIRST_ORDER, 4)
    assert sum(c.fit.structure.poles == 4 for c in tried) == 1


def test_of_the_structures_fitted_none_that_could_win_is_left_out():
    """Against fitting every structure there is."""
    problem = problem_of(PAIR_AND_POLE)
    fit_structure = fitter(problem)
    every = []
    for poles in range(5):
        for structure in structures(poles):
            every.append(fit_structure(structure, list(every)))
    least = min(every, key=information)
    assert best(explored(PAIR_AND_POLE)).fit.structure == least.structure
