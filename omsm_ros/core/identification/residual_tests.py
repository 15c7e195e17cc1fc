"""Tests whether the residual of a fit is only noise, and a second method.

The tests of Ljung (1999, ch. 16). A white residual says that the model of the noise is right, one
that is independent of the motion says that the dynamics are. The second matters more: the
covariance allows for coloured noise, but nothing allows for a missing mode.
"""

from dataclasses import dataclass

import numpy as np
from scipy import stats

from omsm_ros.core.estimation.covariance import autoregression
from omsm_ros.core.estimation.impulse_response import gram_of
from omsm_ros.core.estimation.model_structure import Fit
from omsm_ros.core.estimation.noise import (
    LEAST_STILL,
    motion_error_variance,
    motion_scatter,
    rate_of,
    reading_step,
    scatter_in_time,
)
from omsm_ros.core.estimation.output_error import Problem
from omsm_ros.core.estimation.preparation import SETTLING_S
from omsm_ros.core.estimation.steps import Steps, extended
from omsm_ros.core.lti.frequency_response import frequency_response
from omsm_ros.core.model_errors.residual_diagnostics import LAGS
from omsm_ros.core.streams.blocks import BoolArray, FloatArray
from omsm_ros.core.streams.statistics import white_noise
from omsm_ros.linear_algebra import inverse_root

# Then it is known to a tenth.
_LEAST_CROSSINGS = 50
# Shares of an excess that explain it, and of the noise that are worth telling.
_MOST, NOTICEABLE = 0.5, 0.1
# Below the resolution of any probe; a misfit below it is none.
_FINEST_READING_M = 1e-10
# Resolves 1 Hz; a step test has a few edges in each segment. Fewer than eight lines show nothing.
SEGMENT_S, LEAST_SEGMENT = 1.0, 16
# A response that is the mean of fewer segments is known to a third at best.
_LEAST_SEGMENTS = 8


@dataclass(frozen=True)
class ResidualTests:
    """chi_square: mean square where the axis moves over that of noise;  noise: [m]
    timing: standard deviation of the time of a reading [s], 0 where it does not show
    axis_timing: that of a reading of the axis, 0 where it explains nothing of the residual
    whiteness: p-value, small where the residual is coloured
    """

    chi_square: float
    noise: float
    timing: float
    whiteness: float
    axis_timing: float = 0.0


def residual_tests(problem: Problem, fitted: Fit, steps: Steps) -> ResidualTests:
    """Test the residual of ``fitted`` against stationary noise, whiteness and the motion."""
    on_grid = np.zeros(len(problem.used))
    on_grid[problem.used] = fitted.residual
    active = problem.used & _active(steps, problem.period)
    noise = max(_noise(on_grid, problem.used, problem.used & ~active), _FINEST_READING_M)
    step = reading_step(problem.output[problem.used]) if problem.shared > 0 else 0.0
    crossing = problem.used & (np.abs(np.gradient(problem.input)) > step)
    if step > 0 and np.sum(crossing) >= _LEAST_CROSSINGS:
        # Rounded readings of a stationary axis hardly change and do not show the noise. Where the
        # axis crosses a step from sample to sample, the rounding error covers the whole step.
        active = crossing
        noise = max(noise, step / np.sqrt(12.0), white_noise(on_grid[crossing]))
    seen_moving = on_grid[active] if np.any(active) else fitted.residual
    lost = fitted.structure.size
    timing = scatter_in_time(problem, fitted.residual)
    moves = active if np.any(active) else problem.used
    expected = noise**2 + timing * float(np.mean(rate_of(problem)[moves] ** 2))
    if problem.errors_in_variables is not None:
        expected += float(np.mean(motion_error_variance(problem)[moves]))
    chi_square = float(np.sum(seen_moving**2)) / max(len(seen_moving) - lost, 1) / expected
    return ResidualTests(
        chi_square,
        noise,
        float(np.sqrt(timing)),
        whiteness(fitted.residual),
        _axis_timing(problem, fitted, moves, chi_square * expected - noise**2, noise),
    )


def _axis_timing(
    problem: Problem, fitted: Fit, moves: BoolArray, excess: float, noise: float
) -> float:
    """Return how the axis's readings scatter in time [s], if that explains most of ``excess``.

    excess: of the mean square of the residual where ``moves`` (n,), over ``noise``² [m²]
    """
    rate = rate_of(problem)
    # Noise removed only where the axis is stationary would look like scatter in motion.
    recorded = problem.input if problem.recorded is None else problem.recorded
    scatter = motion_scatter(recorded, rate)
    makes = scatter**2 * float(np.mean(rate[moves] ** 2)) * fitted.mean_power(problem.period)
    return scatter if makes > max(_MOST * excess, NOTICEABLE * noise**2) else 0.0


def noise_colour(problem: Problem, fitted: Fit, steps: Steps) -> float:
    """Return the stationary noise density at low frequency over its mean; 1 for white noise."""
    on_grid = problem.output - problem.modelled(fitted)
    rest = on_grid[problem.used & ~_active(steps, problem.period)]
    # Rounded readings of a stationary axis hardly change and have no spectrum of noise.
    if len(rest) < LEAST_STILL or problem.shared > 0:
        return 1.0
    rest = rest - np.mean(rest)
    coefficients, variance = autoregression(rest)
    power = float(np.mean(rest**2)) * float(np.sum(coefficients)) ** 2
    return max(variance / power, 1.0) if power > 0 else 1.0


def _active(steps: Steps, period: float) -> BoolArray:
    return extended(steps.moving, round(SETTLING_S / period))


def _noise(on_grid: FloatArray, used: BoolArray, rest: BoolArray) -> float:
    if np.sum(rest) >= LEAST_STILL:
        return float(np.std(on_grid[rest]))
    return white_noise(on_grid[used])


def whiteness(residual: FloatArray, lags: int = LAGS) -> float:
    """Return the p-value of Ljung and Box's portmanteau test that ``residual`` (k,) is white."""
    n = len(residual)
    products = [residual[lag:] @ residual[: n - lag] for lag in range(lags + 1)]
    correlation = np.array(products[1:]) / (products[0] or 1.0)
    statistic = n * (n + 2) * np.sum(correlation**2 / (n - np.arange(1, lags + 1)))
    return float(stats.chi2.sf(statistic, lags))


def independence(residual: FloatArray, drive: FloatArray, lags: int = LAGS) -> float:
    """Return p-value that ``residual`` (k,) does not follow ``drive`` (k,), the motion's rate.

    The residual is regressed on the last ``lags`` values of the drive, which are correlated;
    so few of its directions count, and only those above rounding are counted.
    """
    rest = residual[lags - 1 :]
    gram, moment = gram_of(drive[:, np.newaxis], rest, lags)
    root = inverse_root(gram)
    statistic = float(np.sum((root.T @ moment) ** 2)) / (float(np.mean(rest**2)) or 1.0)
    return float(stats.chi2.sf(statistic, root.shape[1])) if root.size else 1.0


def response_difference(problem: Problem, best: Fit, up_to: float) -> float | None:
    """Return the mean square difference from a response without a model, over its variance.

    up_to: highest frequency compared [Hz]

    The response of the residual is estimated: that of the measured output less that of the modelled
    output, both through the same windows. The leakage of a lightly damped mode is in both, and
    cancels. None where there is no line, or the two cannot be compared: the estimate takes the
    residual for noise that is alike everywhere, which rounding without noise is not.
    """
    residual = problem.on_grid(best.residual, 0.0)
    segment = min(round(SEGMENT_S / problem.period), len(residual) // _LEAST_SEGMENTS)
    found = frequency_response(problem.input, residual, problem.period, max(segment, LEAST_SEGMENT))
    lines = (found.frequency > 0) & (found.frequency <= up_to)
    if problem.shared > 0 or not np.any(lines):
        return None
    # Bendat and Piersol's uncertainty is relative, to a response that is all difference.
    value = float(np.mean(0.5 / found.uncertainty[lines] ** 2))
    return value if np.isfinite(value) else None
