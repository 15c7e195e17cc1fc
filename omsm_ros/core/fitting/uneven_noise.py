"""Noise that is not the same at all readings: rounding without noise, and scatter in time.

A reading that is δ late is off by δ times the rate of the motion. Where δ is random this is
noise, from sample to sample anew, in proportion to the rate; what a model misses is not, for it
lasts longer than a sample.
"""

from __future__ import annotations

from math import comb

import numpy as np

from omsm_ros.core.fitting.output_error import Problem
from omsm_ros.core.samples.blocks import FloatArray

# Standard deviations beyond which an excess, or a correlation, is no chance.
_CLEARLY = 5.0
# Their variance is known to 10 %.
_LEAST_STILL = 200
# Of the greatest rate squared: slower is at rest.
_STILL = 1e-4
# Orders of differences: what is left of a smooth motion falls with the order, noise does not.
_SMOOTH, _SMOOTHER = 4, 8
# By which two orders may differ; noise makes a tenth.
_ALIKE = 0.2
# Second differences of white noise share their noise: Σ ρ² over all lags.
_SHARED = 1 + 2 * ((4 / 6) ** 2 + (1 / 6) ** 2)


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


def timing_variance(on_grid: FloatArray, rate: FloatArray) -> float:
    """Return the variance [s²] of the time of a reading, from a residual; 0 where it does not show.

    on_grid: residual (n,) [m], NaN where nothing is compared;  rate: of the motion (n,) [m/s]
    """
    square = rate**2
    second = np.diff(on_grid, 2)
    weight = square[:-2] + 4 * square[1:-1] + square[2:]
    known = np.isfinite(second)
    second, weight = second[known], weight[known]
    still = weight < _STILL * np.max(weight, initial=0.0)
    if np.sum(still) < _LEAST_STILL or _lasts(on_grid, rate):
        return 0.0
    at_rest = float(np.mean(second[still] ** 2))
    total = float(np.sum(weight**2))
    found = float(np.sum(weight * (second**2 - at_rest))) / total
    # Of the excess itself, and of the noise at rest that it exceeds.
    known_to = 1 / total + (float(np.sum(weight)) / total) ** 2 / float(np.sum(still))
    spread = at_rest * np.sqrt(2 * _SHARED * known_to)
    return found if found > _CLEARLY * spread else 0.0


def _lasts(on_grid: FloatArray, rate: FloatArray) -> bool:
    """Return True if neighbours in ``on_grid`` resemble each other where the axis moves."""
    moving = rate**2 > _STILL * np.max(rate**2)
    value = np.where(moving & np.isfinite(on_grid), on_grid, 0.0)
    product = value[1:] * value[:-1]
    spread = float(np.sqrt(np.sum(product**2)))
    return bool(np.sum(product) > _CLEARLY * spread)


def motion_scatter(motion: FloatArray, rate: FloatArray) -> float:
    """Return the standard deviation [s] of the time of a reading of ``motion`` (n,) itself.

    0 where it does not show, or where the motion is too sharp for its samples to tell.
    rate: of the motion (n,) [m/s]

    The instant of a reading of the axes passes through the response, so that what it leaves in a
    residual lasts. Between the readings of one smooth motion it does not.
    """
    rough, smooth = (_scatter_of_differences(motion, rate, n) for n in (_SMOOTH, _SMOOTHER))
    return smooth if abs(rough - smooth) < _ALIKE * smooth else 0.0


def _scatter_of_differences(motion: FloatArray, rate: FloatArray, order: int) -> float:
    kernel = np.array([(-1.0) ** i * comb(order, i) for i in range(order + 1)])
    kernel /= np.linalg.norm(kernel)
    square = np.convolve(motion, kernel, "valid") ** 2
    weight = np.convolve(rate**2, kernel**2, "valid")
    still = weight < _STILL * np.max(weight, initial=0.0)
    if np.sum(still) < _LEAST_STILL:
        return 0.0
    excess = float(np.sum(weight * (square - np.mean(square[still]))))
    return float(np.sqrt(max(excess, 0.0) / np.sum(weight**2)))
