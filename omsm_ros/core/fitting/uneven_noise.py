"""Noise that is not the same at all readings: rounding without noise, and scatter in time."""

from __future__ import annotations

import numpy as np

from omsm_ros.core.fitting.output_error import Problem
from omsm_ros.core.fitting.timing_noise import timing_variance
from omsm_ros.core.samples.blocks import FloatArray


def uneven_rows(problem: Problem, columns: FloatArray, scatter: float) -> FloatArray:
    """Return what errors beside even noise make of ``columns`` (k, c), an independent error a row.

    Each row is that of one standard deviation, so that with rows E their covariance is EᵀE.
    scatter: variance of the time of a reading [s²], see :func:`scatter_in_time`
    """
    return np.concatenate([_rounded(problem, columns), _late(problem, columns, scatter)])


def scatter_in_time(problem: Problem, residual: FloatArray) -> float:
    """Return the variance [s²] of the time of a reading that ``residual`` (k,) shows.

    0 where rounding is larger than noise: that too scatters where the axis moves only.
    """
    if problem.shared > 0:
        return 0.0
    return timing_variance(problem.on_grid(residual, np.nan), rate_of(problem))


def rate_of(problem: Problem) -> FloatArray:
    """Return the rate of the motion [m/s], (n,)."""
    return np.asarray(np.gradient(problem.input, problem.period))


def _rounded(problem: Problem, columns: FloatArray) -> FloatArray:
    """Return rows of rounding errors: one a plateau, whose readings share it, one a moving reading.

    The noise at rest does not show the latter.
    """
    if problem.plateau is None or problem.shared == 0:
        return np.zeros((0, columns.shape[1]))
    plateau = problem.plateau[problem.used]
    sums = np.zeros((int(np.max(problem.plateau)) + 2, columns.shape[1]))
    np.add.at(sums, plateau + 1, columns)
    # Rounding has the variance of its first harmonic times π²/6, which is Σ 1/k².
    moving = np.pi / np.sqrt(6) * columns[plateau < 0]
    return np.asarray(np.sqrt(problem.shared) * np.concatenate([sums[1:], moving]))


def _late(problem: Problem, columns: FloatArray, variance: float) -> FloatArray:
    if variance == 0:
        return np.zeros((0, columns.shape[1]))
    rate = rate_of(problem)[problem.used, np.newaxis]
    return np.asarray(np.sqrt(variance) * rate * columns)
