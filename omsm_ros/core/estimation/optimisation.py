"""Bounded Levenberg-Marquardt minimisation, and the budget of evaluations of a model search."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from omsm_ros.core.streams.blocks import FloatArray

# Recommended for a fair start by Madsen, Nielsen and Tingleff (2004).
_FIRST_DAMPING = 1e-3
# A parameter of a smaller relative sensitivity is not identifiable.
_INSENSITIVE = 1e-10
# Relative to 1 + |ψ|: smaller steps change no printed digit of a coefficient.
_SMALLEST_STEP = 1e-9
# In ψ, the logarithm of a coefficient: a factor of 20, beyond which no quadratic model holds.
_LONGEST_STEP = 3.0
# Part of the decrease of χ² that one parameter makes by chance.
CONVERGED = 1e-4
# Most times that what is not compared is filled in anew; where it is a tenth, some need thirty.
REFILLED = 40
# All accepted of 270 disturbed step tests needed at most 1200 evaluations before their last round,
# half of them fewer than 250. 1500 of 20 s at 1 kHz take five seconds; most evaluations of a long
# record use a part of it, and 300 all of it.
_MOST_SAMPLES, _MOST_EVALUATIONS = 24_000_000, 300


@dataclass(eq=False)
class EvaluationBudget:
    """Count the evaluations of a model search and limit them: counted work, never elapsed time.

    evaluations, samples, longest: used so far; longest is the most samples of one evaluation
    incomplete: a search was cut short because the budget was exhausted
    watch: called at each evaluation with the poles of its model and ``evaluations``; what it
        raises ends the search
    """

    evaluations: int = 0
    samples: int = 0
    longest: int = 0
    incomplete: bool = False
    watch: Callable[[int, int], object] = lambda poles, evaluations: None

    def count(self, samples: int, poles: int = 0) -> None:
        """Count an evaluation of ``samples`` samples of a model with ``poles``."""
        self.longest = max(self.longest, samples)
        self.samples += samples
        self.evaluations += 1
        self.watch(poles, self.evaluations)

    @property
    def exhausted(self) -> bool:
        """Return True if no further order and no further model error is to be tried."""
        return self.samples > _MOST_SAMPLES + _MOST_EVALUATIONS * self.longest

    def stops(self) -> bool:
        """Return ``exhausted``, and note that the search is incomplete where it is."""
        self.incomplete |= self.exhausted
        return self.exhausted


@dataclass(frozen=True, eq=False)
class Projection:
    """The residual (k,) at one ψ, ``nonlinear``, and the linear parameters (m + 1 + q,) there.

    normal: returns half the slope of the sum of squares (len ψ,) and its curvature
    """

    nonlinear: FloatArray
    residual: FloatArray
    linear: FloatArray
    normal: Callable[[], tuple[FloatArray, FloatArray]]


Project = Callable[[FloatArray], Projection]
Box = tuple[FloatArray, FloatArray]


def descend(project: Project, start: Projection, box: Box, evaluations: int) -> Projection:
    """Minimise the sum of squares inside ``box`` (Levenberg-Marquardt, damping of Nielsen 1999).

    project: residual at any ψ;  box: lower and upper bounds of ψ;  evaluations: at most

    It solves scaled normal equations of a few parameters. A general solver factorises the whole
    jacobian at each step, which takes ten times as long.
    """
    at = start
    if not len(at.nonlinear):
        return at
    lower, upper = box
    damping, growth = _FIRST_DAMPING, 2.0
    cost, moved = float(at.residual @ at.residual), True
    for _ in range(evaluations):
        nonlinear = at.nonlinear
        if moved:
            slope, curvature = at.normal()
            moved = False
        # A parameter at its bound whose step would leave the box is fixed.
        free = ~(((nonlinear <= lower) & (slope > 0)) | ((nonlinear >= upper) & (slope < 0)))
        scale = np.sqrt(np.maximum(curvature.diagonal(), 0.0))
        free &= scale > _INSENSITIVE * np.max(scale)
        if not np.any(free):
            break
        unit, step = scale[free], np.zeros_like(slope)
        damped = curvature[free][:, free] / np.multiply.outer(unit, unit)
        damped.flat[:: len(unit) + 1] += damping
        step[free] = -np.linalg.solve(damped, slope[free] / unit) / unit
        step = np.minimum(np.maximum(step, -_LONGEST_STEP), _LONGEST_STEP)
        tried = project(np.minimum(np.maximum(nonlinear + step, lower), upper))
        new_cost = float(tried.residual @ tried.residual)
        if not new_cost < cost:
            way = np.abs(tried.nonlinear - nonlinear)
            if np.all(way <= _SMALLEST_STEP * (1 + np.abs(nonlinear))):
                break
            damping, growth = damping * growth, growth * 2
            continue
        gained, promised = cost - new_cost, -float(step @ (2 * slope + curvature @ step))
        at, cost, moved = tried, new_cost, True
        ratio = gained / promised if promised > 0 else 1.0
        damping, growth = damping * max(1 / 3, 1 - (2 * ratio - 1) ** 3), 2.0
        if gained <= CONVERGED * cost / len(at.residual) and damping < 1:
            break
    return at
