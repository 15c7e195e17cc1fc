"""Test the minimisation against linear algebra and scipy, its bounds, and the budget."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import optimize

from omsm_ros.core.estimation.optimisation import EvaluationBudget, Projection, descend
from omsm_ros.core.streams.blocks import FloatArray

Function = Callable[[FloatArray], FloatArray]
BROAD = 1e3


class Watched:
    """A residual function with its jacobian; it remembers where it was asked."""

    def __init__(self, residual: Function, jacobian: Function) -> None:
        self._residual, self._jacobian = residual, jacobian
        self.asked: list[FloatArray] = []

    def __call__(self, psi: FloatArray) -> Projection:
        self.asked.append(psi.copy())
        residual = self._residual(psi)

        def normal() -> tuple[FloatArray, FloatArray]:
            jacobian = self._jacobian(psi)
            return jacobian.T @ residual, jacobian.T @ jacobian

        return Projection(psi, residual, np.zeros(0), normal)

    def down(
        self, start: list[float], lower: FloatArray, upper: FloatArray, evaluations: int = 200
    ) -> Projection:
        return descend(self, self(np.array(start, np.float64)), (lower, upper), evaluations)


def open_box(size: int) -> tuple[FloatArray, FloatArray]:
    return np.full(size, -BROAD), np.full(size, BROAD)


def cost(at: Projection) -> float:
    return float(at.residual @ at.residual)


RANDOM = np.random.default_rng(17)
A = RANDOM.normal(size=(40, 3)) * [1.0, 30.0, 0.01]
B = RANDOM.normal(size=40)


def straight(columns: FloatArray = A, wanted: FloatArray = B) -> Watched:
    return Watched(lambda psi: columns @ psi - wanted, lambda _: columns)


TIME = np.linspace(0.0, 4.0, 60)


def decay(noise: float = 0.0, seed: int = 0) -> Watched:
    """exp(-t e^ψ0) + exp(-t e^ψ1) against rates of 0.5 and 4: logarithms, as fits have them."""
    seen = np.exp(-0.5 * TIME) + np.exp(-4.0 * TIME)
    seen = seen + np.random.default_rng(seed).normal(0, noise, len(TIME))

    def jacobian(psi: FloatArray) -> FloatArray:
        rates = np.exp(psi)
        return np.stack([-TIME * r * np.exp(-TIME * r) for r in rates], axis=1)

    return Watched(lambda psi: np.exp(-np.outer(TIME, np.exp(psi))).sum(axis=1) - seen, jacobian)


def test_of_a_straight_problem_the_end_is_the_least_squares() -> None:
    found = straight().down([0.0, 0.0, 0.0], *open_box(3))
    expected, *_ = np.linalg.lstsq(A, B, rcond=None)
    # Converged to a ten-thousandth of what a parameter gains by chance.
    left, best = cost(found), float(np.sum((A @ expected - B) ** 2))
    assert left == pytest.approx(best, rel=1e-4 / len(B) * 10)
    assert found.nonlinear[:2] == pytest.approx(expected[:2], rel=0.02, abs=0.02)


def test_a_problem_without_noise_is_solved_to_its_digits() -> None:
    found = decay().down([0.0, 1.0], *open_box(2))
    assert np.sort(np.exp(found.nonlinear)) == pytest.approx([0.5, 4.0], rel=1e-4)
    assert cost(found) < 1e-8


@pytest.mark.parametrize("seed", range(4))
def test_noise_leads_where_scipy_ends(seed: int) -> None:
    problem = decay(0.01, seed)
    found = problem.down([0.0, 1.0], *open_box(2))
    peer = optimize.least_squares(lambda p: problem(p).residual, [0.0, 1.0], xtol=1e-12)
    assert cost(found) == pytest.approx(2 * peer.cost, rel=1e-4)
    assert np.sort(found.nonlinear) == pytest.approx(np.sort(peer.x), abs=0.01)


def test_a_banana_is_followed_to_its_end() -> None:
    """Rosenbrock's, from where textbooks start."""
    problem = Watched(
        lambda p: np.array([10 * (p[1] - p[0] ** 2), 1 - p[0]]),
        lambda p: np.array([[-20 * p[0], 10.0], [-1.0, 0.0]]),
    )
    found = problem.down([-1.2, 1.0], *open_box(2))
    assert found.nonlinear == pytest.approx([1.0, 1.0], abs=1e-3)


boxes = st.tuples(st.floats(-2.0, 2.0), st.floats(0.1, 3.0))


@settings(max_examples=40)
@given(box=st.lists(boxes, min_size=2, max_size=2), seed=st.integers(0, 20))
def test_the_box_is_never_left_and_its_best_place_is_found(
    box: list[tuple[float, float]], seed: int
) -> None:
    random = np.random.default_rng(seed)
    columns, wanted = random.normal(size=(20, 2)), random.normal(size=20)
    lower = np.array([low for low, _ in box])
    upper = lower + np.array([width for _, width in box])
    problem = straight(columns, wanted)
    found = problem.down(list((lower + upper) / 2), lower, upper)
    asked = np.array(problem.asked)
    assert np.all(asked >= lower)
    assert np.all(asked <= upper)
    peer = optimize.lsq_linear(columns, wanted, (lower, upper))
    assert cost(found) <= 2 * peer.cost * (1 + 1e-3)


def test_what_is_pushed_against_its_bound_stays_and_the_rest_goes_on() -> None:
    columns = np.array([[1.0, 0.5], [0.0, 1.0], [1.0, -1.0]])
    wanted = columns @ np.array([5.0, -2.0])
    found = straight(columns, wanted).down([1.0, 0.0], np.array([-1.0, -9.0]), np.array([1.0, 9.0]))
    # With the first at 1, the second is the least squares of what is left.
    second = columns[:, 1] @ (wanted - columns[:, 0]) / (columns[:, 1] @ columns[:, 1])
    assert found.nonlinear == pytest.approx([1.0, second], rel=1e-3)


def test_a_parameter_that_does_nothing_stays_where_it_was() -> None:
    idle = np.column_stack([A, np.zeros(len(B))])
    with_idle = straight(idle).down([0.0, 0.0, 0.0, 0.7], *open_box(4))
    without = straight().down([0.0, 0.0, 0.0], *open_box(3))
    assert with_idle.nonlinear[3] == 0.7
    assert with_idle.nonlinear[:3] == pytest.approx(without.nonlinear, rel=1e-9)


def test_nothing_can_be_gained_where_no_parameter_does_anything() -> None:
    problem = straight(np.zeros((5, 2)), np.ones(5))
    found = problem.down([0.3, 0.4], *open_box(2))
    assert found.nonlinear.tolist() == [0.3, 0.4]
    assert len(problem.asked) == 1


def test_without_parameters_or_tries_the_start_is_the_end() -> None:
    problem = straight(np.zeros((5, 0)), np.ones(5))
    assert len(problem.down([], *open_box(0)).nonlinear) == 0
    still = straight()
    found = still.down([0.1, 0.2, 0.3], *open_box(3), evaluations=0)
    assert found.nonlinear.tolist() == [0.1, 0.2, 0.3]
    assert len(still.asked) == 1


@pytest.mark.parametrize("evaluations", [1, 2, 5])
def test_no_more_is_tried_than_allowed_and_never_for_the_worse(evaluations: int) -> None:
    problem = decay(0.01)
    start = cost(problem(np.array([0.0, 1.0])))
    problem.asked.clear()
    found = problem.down([0.0, 1.0], *open_box(2), evaluations=evaluations)
    assert len(problem.asked) <= 1 + evaluations
    assert cost(found) < start


def test_more_tries_are_never_worse() -> None:
    left = [cost(decay(0.01).down([0.0, 3.0], *open_box(2), k)) for k in range(12)]
    assert all(later <= before for before, later in pairwise(left))


def test_a_step_that_makes_it_worse_is_not_taken() -> None:
    """Newton's method on an arcus tangent goes from 3 to -9 and on, ever further out."""
    curved = Watched(
        lambda p: np.arctan(10 * p), lambda p: np.array([10 / (1 + (10 * p) ** 2)]).reshape(1, 1)
    )
    left = [cost(curved.down([0.3], *open_box(1), k)) for k in range(15)]
    assert all(later <= before for before, later in pairwise(left))
    assert left[-1] < 1e-6 * left[0]


def test_no_step_leaps() -> None:
    """A step of a logarithm is at most 3, however far the quadratic model would go."""
    flat = Watched(lambda p: np.array([1e-3 * p[0] - 1.0]), lambda _: np.array([[1e-3]]))
    flat.down([0.0], *open_box(1), evaluations=1)
    assert flat.asked[-1][0] == pytest.approx(3.0)


def test_order_and_unit_of_the_residuals_do_not_matter() -> None:
    order = RANDOM.permutation(len(B))
    plain = straight().down([0.0] * 3, *open_box(3)).nonlinear
    mixed = straight(A[order], B[order]).down([0.0] * 3, *open_box(3)).nonlinear
    scaled = straight(1e-6 * A, 1e-6 * B).down([0.0] * 3, *open_box(3)).nonlinear
    assert mixed == pytest.approx(plain, rel=1e-6, abs=1e-9)
    assert scaled == pytest.approx(plain, rel=1e-6, abs=1e-9)


def test_order_of_the_parameters_does_not_matter() -> None:
    turn = np.array([2, 0, 1])
    plain = straight().down([0.1, 0.2, 0.3], *open_box(3)).nonlinear
    turned = straight(A[:, turn]).down([0.3, 0.1, 0.2], *open_box(3)).nonlinear
    assert turned == pytest.approx(plain[turn], rel=1e-6)


def test_a_jacobian_is_made_once_and_only_where_a_step_starts() -> None:
    made = []

    def jacobian(psi: FloatArray) -> FloatArray:
        made.append(psi.copy())
        return A

    problem = Watched(lambda psi: A @ psi - B, jacobian)
    problem.down([0.0, 0.0, 0.0], *open_box(3))
    assert len(made) <= len(problem.asked)
    assert len({tuple(psi) for psi in made}) == len(made)


def test_half_the_slope_and_the_curvature_are_those_of_the_sum_of_squares() -> None:
    problem, psi = decay(), np.array([0.1, 0.9])
    slope, curvature = problem(psi).normal()
    step = 1e-5
    by_steps = [
        (cost(problem(psi + step * axis)) - cost(problem(psi - step * axis))) / (2 * step)
        for axis in np.eye(2)
    ]
    assert 2 * slope == pytest.approx(by_steps, rel=1e-6)
    # Gauss-Newton: without the second derivatives of the residual, which vanish at the truth.
    truth = np.log([0.5, 4.0])
    _, curvature = problem(truth).normal()
    bend = [
        (cost(problem(truth + 1e-3 * a)) + cost(problem(truth - 1e-3 * a))) / 1e-6
        for a in np.eye(2)
    ]
    assert 2 * np.diag(curvature) == pytest.approx(bend, rel=1e-3)


def used(samples: int, times: int, budget: EvaluationBudget) -> EvaluationBudget:
    for _ in range(times):
        budget.count(samples)
    return budget


def test_a_budget_allows_1500_evaluations_of_twenty_seconds() -> None:
    budget = used(20_000, 1500, EvaluationBudget())
    assert not budget.stops()
    assert not budget.incomplete
    assert used(20_000, 1, budget).stops()
    assert budget.incomplete


def test_evaluations_with_fewer_samples_count_their_samples() -> None:
    """A long record: hundreds of evaluations with all of it, thousands with a tenth."""
    budget = used(200_000, 200, EvaluationBudget())
    assert not used(20_000, 2000, budget).exhausted
    assert budget.evaluations == 2200
    assert used(20_000, 1000, budget).exhausted


def test_longer_records_are_evaluated_less_often() -> None:
    most = []
    for samples in (20_000, 40_000, 400_000):
        budget = EvaluationBudget()
        while not budget.exhausted:
            budget.count(samples)
        most.append(budget.evaluations)
    assert most == sorted(most, reverse=True)
    assert most[-1] > 300
