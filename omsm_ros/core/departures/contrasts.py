"""Do the parts of one step test agree? Steps up and down, small and large, early and late.

A linear, steady response has one lag and one gain. Each contrast lets them differ between two
parts of the test by ``±d`` and asks what the residual says of d.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from omsm_ros.core.departures.residual_space import Score
from omsm_ros.core.departures.survey import FALSE_ALARM, Survey
from omsm_ros.core.fitting.steps import Steps, segments
from omsm_ros.core.samples.blocks import FloatArray

UP_DOWN = "steps up against steps down"
HALVES = "first half against second"
SIZES = "small steps against large"
# Two of a kind show how far they scatter.
_LEAST_EDGES = 4
# Of heights that are meant to be different.
_TWO_SIZES = 1.5


@dataclass(frozen=True, eq=False)
class Contrast:
    """What differs between two parts of a test, the first one less the second.

    parts: their names;  gain: relative [1], lag: [s], each with standard uncertainty
    p: probability of such differences by chance
    """

    parts: str
    gain: float
    gain_uncertainty: float
    lag: float
    lag_uncertainty: float
    p: float

    @property
    def significant(self) -> bool:
        """Return whether chance is less likely than FALSE_ALARM."""
        return self.p < FALSE_ALARM


def contrasts(survey: Survey) -> list[Contrast]:
    """Return the contrasts that the steps of this test allow."""
    samples = len(survey.problem.input)
    return [_of(survey, name, weight) for name, weight in _weights(survey.steps, samples)]


def _weights(steps: Steps, samples: int) -> Iterator[tuple[str, FloatArray]]:
    """Yield 1 in the first part and -1 in the second, (n,), for each pair of parts."""
    if len(steps.edges) < _LEAST_EDGES:
        return
    heights = np.array([edge.height for edge in steps.edges])
    length = np.array([stop - start for start, stop in segments(steps, samples, _LEAST_EDGES)])
    sizes = np.abs(heights)
    up, early = heights > 0, np.arange(len(heights)) < len(heights) / 2
    split = {UP_DOWN: up}
    if not (np.array_equal(up, early) or np.array_equal(up, ~early)):
        split[HALVES] = early
    if np.max(sizes) > _TWO_SIZES * np.min(sizes):
        split[SIZES] = sizes < np.sqrt(np.max(sizes) * np.min(sizes))
    for name, first in split.items():
        if 0 < np.sum(first) < len(first):
            yield name, np.repeat(np.where(first, 1.0, -1.0), length)


def _of(survey: Survey, name: str, weight: FloatArray) -> Contrast:
    fitted, problem = survey.fitted, survey.problem
    answer = fitted.gain * problem.response(fitted)
    by_gain = np.cumsum(weight * np.diff(answer, prepend=answer[0]))
    by_lag = -weight * np.gradient(answer, problem.period)
    score = survey.space.score(np.column_stack([by_gain, by_lag]))
    gain, lag = 2 * score.size
    gain_uncertainty, lag_uncertainty = 2 * np.sqrt(np.diag(score.covariance))
    return Contrast(name, gain, gain_uncertainty, lag, lag_uncertainty, _chance(score))


def _chance(score: Score) -> float:
    return float(np.exp(score.log_p))
