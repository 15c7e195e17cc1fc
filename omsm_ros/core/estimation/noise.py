"""Noise that is not the same at all readings: rounding without noise, and scatter in time.

A reading that is δ late is off by δ times the rate of the motion. Where δ is random this is
noise, from sample to sample anew, in proportion to the rate; what a model misses is not, for it
lasts longer than a sample.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import comb

import numpy as np
from scipy import fft

from omsm_ros.core.estimation.output_error import Fit, Problem
from omsm_ros.core.estimation.steps import Edge, Steps
from omsm_ros.core.lti.transfer_function import ComplexArray
from omsm_ros.core.streams.blocks import BoolArray, FloatArray, IntArray

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
    return np.concatenate(
        [_rounding_rows(problem, columns), _timing_rows(problem, columns, scatter)]
    )


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


def _rounding_rows(problem: Problem, columns: FloatArray) -> FloatArray:
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


def _timing_rows(problem: Problem, columns: FloatArray, variance: float) -> FloatArray:
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
    if np.sum(still) < _LEAST_STILL or _persists(on_grid, rate):
        return 0.0
    at_rest = float(np.mean(second[still] ** 2))
    total = float(np.sum(weight**2))
    found = float(np.sum(weight * (second**2 - at_rest))) / total
    # Of the excess itself, and of the noise at rest that it exceeds.
    known_to = 1 / total + (float(np.sum(weight)) / total) ** 2 / float(np.sum(still))
    spread = at_rest * np.sqrt(2 * _SHARED * known_to)
    return found if found > _CLEARLY * spread else 0.0


def _persists(on_grid: FloatArray, rate: FloatArray) -> bool:
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


# What the steps of a probe's readings leave open where noise does not carry it across them.
#
# With noise of half a step and more the error of rounding is noise too. With less it is the same
# at each reading of a plateau, up to half a step, and no number of readings averages it.

# Readings of a probe with steps share their values; of one without, hardly any two do.
_LEAST_READINGS_A_LEVEL = 3.0
# Of a step squared: this much is lost in any noise.
_NOTHING = 1e-4
# Of the error of rounding, that are added up: without noise all but 0.6 % of q²/12.
_HARMONICS = 100
# Gaps between levels are whole steps, but for the rounding of decimals.
_WHOLE = 0.05


def reading_step(readings: FloatArray) -> float:
    """Return the step of ``readings`` (k,) [m], finite; 0 where they show none."""
    levels = np.unique(readings)
    if len(levels) < 3 or len(readings) < _LEAST_READINGS_A_LEVEL * len(levels):
        return 0.0
    gaps = np.diff(levels)
    gaps = gaps[gaps > 1e-9 * float(np.max(np.abs(levels)))]
    step = float(np.min(gaps))
    return step if np.all(np.abs(gaps / step - np.round(gaps / step)) < _WHOLE) else 0.0


def plateaus(steps: Steps, used: BoolArray) -> IntArray:
    """Return the number of the plateau that a sample belongs to, (n,); -1 where the axis moves."""
    if not steps.edges:
        return np.full(len(used), -1)
    begun = np.diff(steps.moving.astype(np.int8), prepend=1) == -1
    return np.asarray(np.where(steps.moving, -1, np.cumsum(begun) - 1), np.int64)


def plateau_variance(readings: FloatArray, plateau: IntArray, step: float) -> float:
    """Return the variance [m²] of the error of rounding that all readings of a plateau share.

    The error is periodic in the position; noise σ weakens its harmonic k, q/πk, as
    exp(-2π²k²σ²/q²) (Widrow and Kollár 2008, ch. 19); without noise their sum is q²/12.
    readings: (k,), plateau: (k,)
    """
    resting = plateau >= 0
    if step == 0 or not np.any(resting):
        return 0.0
    count = np.bincount(plateau[resting])
    mean = np.bincount(plateau[resting], readings[resting]) / np.maximum(count, 1)
    spread = float(np.mean((readings - mean[plateau])[resting] ** 2))
    # Of a reading that never changes all noise may be hidden; of others rounding adds its own.
    noise = max(spread - step**2 / 12, 0.0)
    harmonic = np.arange(1, _HARMONICS + 1)
    weakened = np.exp(-4 * np.pi**2 * harmonic**2 * noise / step**2) / harmonic**2
    shared = step**2 / (2 * np.pi**2) * float(np.sum(weakened))
    return shared if shared > _NOTHING * step**2 else 0.0


# Noise of the encoder's own: what it shows at rest and the probe did not follow.
#
# A fit takes the input for exact. Noise in it goes through the response and comes out larger where
# that rings, so a fit damps a light mode, or finds backlash and errors of the scale that swallow
# the noise (errors in variables, Ljung 1999, sec. 13.5). Where an axis rests, a mean of many
# samples has no noise to speak of.

# Width of the intervals that must have a value in common, in standard deviations. On quintic steps
# with noise of 1 and 3 nm two leaves least: 0.15 of it, and of quintic edges nothing that repeats.
_INTERVAL = 2.0
# Standard deviations beyond which a part that is followed, or is not, is no chance. Noise that
# shows less imitates no departure that would be significant.

# Those beyond which a mean over all edges is no chance in a hundred samples after each.
_SEEN = 3.0
_TINY = float(np.finfo(np.float64).tiny)
# Of a record's spectrum: dozens of bands, the lowest of so many lines that they tell their noise.
_BANDS_AN_OCTAVE, _NARROWEST = 3, 64


def correct_errors_in_variables(
    problem: Problem, fitted: Fit, edges: Sequence[Edge] = ()
) -> Problem | None:
    """Return the problem without that part of the input's noise that the probe did not follow.

    edges: of the input, if it has any
    fitted: to ``problem``; its residual shows how much of that noise did not come through it.
        Where some of it did, its expected motion stays (Carroll et al. 2006, ch. 4).
    None where the probe followed all, as far as the residual shows, or it was taken out before.
    """
    if problem.noise <= 0 or problem.errors_in_variables is not None:
        return None
    smooth, left = smoothed(problem.input, problem.noise, edges)
    noise = problem.input - smooth
    quiet = replace(problem, input=smooth, noise=left)
    made = np.where(problem.used, problem.modelled(fitted) - quiet.modelled(fitted), 0.0)
    if not np.any(made):
        return None
    share, band = _unfollowed_share(problem.on_grid(fitted.residual, 0.0), made)
    if share is None:
        return None
    errors_in_variables = fft.irfft(share[band] * fft.rfft(noise), len(noise))
    return replace(
        problem,
        input=problem.input - errors_in_variables,
        noise=left,
        errors_in_variables=errors_in_variables,
    )


def _unfollowed_share(residual: FloatArray, made: FloatArray) -> tuple[FloatArray | None, IntArray]:
    """Return the share of what was ``made`` (n,) that ``residual`` (n,) lacks, of each band.

    The second is the band of each line of their spectra. Bands that do not differ have one share;
    others their own: what a servo does at rest is followed, beside noise that is not. None where
    nothing is lacking.
    """
    expected, seen = fft.rfft(made), fft.rfft(residual)
    line = np.arange(len(expected))
    band = np.floor(np.log2(1 + line / _NARROWEST) * _BANDS_AN_OCTAVE).astype(np.int64)
    found, known_to = _shares(expected, seen, band)
    own = np.abs(found - _weighted_median(found, 1 / known_to)) > _CLEARLY * known_to
    weight = np.where(own, 0.0, known_to**-2.0)
    share = np.where(own, found, np.sum(weight * found) / np.sum(weight))
    known_to = np.where(own, known_to, np.sum(weight) ** -0.5)
    # What may all be there stays; of the rest, what may all be lacking is taken out.
    lacking = share > _CLEARLY * known_to
    share = np.where(lacking, np.where(share > 1 - _CLEARLY * known_to, 1.0, share), 0.0)
    return (share if np.any(lacking) else None), band


def _shares(
    expected: ComplexArray, seen: ComplexArray, band: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return the share of ``expected`` (k,) that ``seen`` (k,) lacks in each band (b,).

    The second is the standard deviation of each, from what else there is to see.
    """
    power = np.maximum(np.bincount(band, np.abs(expected) ** 2), _TINY)
    share = np.bincount(band, -(seen * expected.conj()).real) / power
    rest = seen + share[band] * expected
    spread = np.sqrt(np.bincount(band, 0.5 * np.abs(rest * expected) ** 2)) / power
    return np.asarray(share, np.float64), np.asarray(np.maximum(spread, _TINY), np.float64)


def _weighted_median(values: FloatArray, weights: FloatArray) -> float:
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])


def smoothed(
    positions: FloatArray, noise: float, edges: Sequence[Edge] = ()
) -> tuple[FloatArray, float]:
    """Return ``positions`` (n,) [m] as their means where they rest, and the noise that is left [m].

    noise: standard deviation of a sample, white [m];  edges: where they move, if they do in steps

    Of the samples before and after, each as many are taken as agree with a constant: the intervals
    of their means intersect (Goldenshluger and Nemirovski 1997). So an edge keeps its shape, and a
    motion that stands out of the noise stays. How an axis comes to rest does not; what of it is
    alike at all edges, and stands out of the noise of their mean, is given back.
    """
    middle = float(np.mean(positions))
    rest = positions - middle
    before, earlier = _mean_before(rest, noise)
    after, later = _mean_before(rest[::-1], noise)
    # Both hold the sample itself.
    count = earlier + later[::-1] - 1
    mean = (earlier * before + later[::-1] * after[::-1] - rest) / count
    alike, left = _alike(rest - mean, noise, edges)
    return np.asarray(mean + alike + middle), noise * float(np.sqrt(np.mean(1 / count + left)))


def _alike(taken: FloatArray, noise: float, edges: Sequence[Edge]) -> tuple[FloatArray, FloatArray]:
    """Return what of ``taken`` (n,) is alike at all ``edges``, by their heights, (n,).

    The second is the share of the variance of ``noise`` in it, (n,). Noise that all edges had alike
    would show in no residual: nothing is returned that may be noise.
    """
    alike, left = np.zeros((2, len(taken)))
    if not edges:
        return alike, left
    # As long again as an edge takes it may come to rest.
    length = 2 * max(edge.stop - edge.start for edge in edges)
    ends = [edge.start for edge in edges[1:]] + [len(taken)]
    parts = [slice(e.start, min(e.start + length, end)) for e, end in zip(edges, ends, strict=True)]
    moved, power = np.zeros((2, length))
    for edge, part in zip(edges, parts, strict=True):
        moved[: part.stop - part.start] += edge.height * taken[part]
        power[: part.stop - part.start] += edge.height**2
    seen = np.abs(moved) > _SEEN * noise * np.sqrt(power)
    for edge, part in zip(edges, parts, strict=True):
        within = slice(part.stop - part.start)
        # Where all come back to where they were, nothing is seen, and there is no power either.
        scale = np.where(seen[within], edge.height / np.maximum(power[within], _TINY), 0.0)
        alike[part] = scale * moved[within]
        left[part] = scale * edge.height
    return alike, left


def _mean_before(values: FloatArray, noise: float) -> tuple[FloatArray, FloatArray]:
    """Return the mean of each of ``values`` (n,) and those before it, and their number, (n,)."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    mean, number = values.copy(), np.ones(len(values))
    low, high = values - _INTERVAL * noise, values + _INTERVAL * noise
    count, rests = 2, np.arange(1, len(values))
    while count <= len(values) and len(rests):
        found = (total[rests + 1] - total[rests + 1 - count]) / count
        reach = _INTERVAL * noise / np.sqrt(count)
        low[rests] = np.maximum(low[rests], found - reach)
        high[rests] = np.minimum(high[rests], found + reach)
        agree = low[rests] <= high[rests]
        rests = rests[agree]
        mean[rests], number[rests] = found[agree], count
        count *= 2
        rests = rests[rests + 1 >= count]
    return mean, number
