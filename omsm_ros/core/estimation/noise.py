"""Noise that is not stationary and white: timing jitter, quantisation, noise of the encoder.

**Timing jitter.** A reading that is late by δ is wrong by δ times the rate of the motion. Random δ
make noise that is independent from sample to sample and proportional to the rate; an error of the
model lasts longer than a sample.

**Quantisation.** With noise of half a step or more, the rounding error is noise too. With less
noise all readings of a plateau share one rounding error of up to half a step, which no mean
reduces.

**Errors in variables** (Ljung 1999, sec. 13.5). A fit takes the input as exact. A resonance of the
model amplifies noise of the encoder that the probe did not follow. So a fit increases the damping
of a mode, or fits backlash and scale errors to that noise. Where the axis is stationary, the mean
of many samples has little noise.

**Random walk.** Drift of a machine has more power the slower it is, and polynomials follow only
its slowest part. What is left would look like a relaxation or a soft mode in white noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import comb

import numpy as np
from scipy import fft

from omsm_ros.core.estimation.model_structure import Fit
from omsm_ros.core.estimation.output_error import Problem
from omsm_ros.core.estimation.steps import Edge, Steps
from omsm_ros.core.lti.transfer_function import ComplexArray
from omsm_ros.core.streams.blocks import BoolArray, FloatArray, IntArray

# Standard deviations beyond which an excess or a correlation is significant: 6e-7 by chance.
CLEARLY = 5.0
# Stationary samples needed: their variance is then known to 10 %.
LEAST_STILL = 200
# Part of the greatest squared rate below which the axis counts as stationary.
_STILL = 1e-4
# Orders of differences: the remainder of a smooth motion falls with the order, noise does not.
_SMOOTH, _SMOOTHER = 4, 8
# Relative difference allowed between the two orders; noise alone makes a tenth.
_ALIKE = 0.2
# Correlation of the second differences of white noise: Σ ρ² over all lags.
_SHARED = 1 + 2 * ((4 / 6) ** 2 + (1 / 6) ** 2)


def uneven_rows(problem: Problem, columns: FloatArray, scatter: float) -> FloatArray:
    """Return effects of rounding, encoder noise and jitter on ``columns`` (k, c), as rows.

    Each row is the effect of one independent error of one standard deviation.
    scatter: variance of the time of a reading [s²], see :func:`scatter_in_time`
    """
    rows, used = [np.zeros((0, columns.shape[1]))], problem.used
    rate = rate_of(problem)[used]
    if problem.plateau is not None and problem.shared + problem.input_shared > 0:
        # One rounding error for each plateau, one for each reading while moving. It has the
        # variance of its first harmonic times π²/6, which is Σ 1/k².
        plateau = problem.plateau[used]
        sums = np.zeros((int(np.max(problem.plateau)) + 2, columns.shape[1]))
        np.add.at(sums, plateau + 1, columns)
        moving = np.pi / np.sqrt(6) * columns[plateau < 0]
        rows.append(np.sqrt(problem.shared) * np.concatenate([sums[1:], moving]))
        # Steps of whole counts leave the axis at one place between two counts on every plateau.
        every = np.concatenate([sums[1:], np.sum(sums[1:], axis=0, keepdims=True)])
        rows.append(np.sqrt(problem.input_shared) * every)
    wrong = motion_error_variance(problem)[used]
    rows.append(np.sqrt(wrong[wrong > 0])[:, np.newaxis] * columns[wrong > 0])
    if scatter > 0:
        rows.append(np.sqrt(scatter) * rate[:, np.newaxis] * columns)
    return np.concatenate(rows)


def motion_error_variance(problem: Problem) -> FloatArray:
    """Return the variance [m²] of each reading of the input that the probe does not follow, (n,).

    Where the axis is stationary, its errors are a constant or were taken out.
    """
    square = rate_of(problem) ** 2
    return np.where(square > _STILL * np.max(square), problem.input_error, 0.0)


def scatter_in_time(problem: Problem, residual: FloatArray) -> float:
    """Return the variance [s²] of the time of a reading, estimated from ``residual`` (k,).

    It is 0 where rounding exceeds noise, because rounding errors too vary only while the axis
    moves.
    """
    if problem.shared > 0:
        return 0.0
    noisy = problem.errors_in_variables is not None
    return timing_variance(problem.on_grid(residual, np.nan), rate_of(problem), noisy=noisy)


def rate_of(problem: Problem) -> FloatArray:
    """Return the rate of the motion [m/s], (n,)."""
    return np.asarray(np.gradient(problem.input, problem.period))


def timing_variance(on_grid: FloatArray, rate: FloatArray, *, noisy: bool = False) -> float:
    """Return the variance [s²] of the time of a reading, 0 where it is not significant.

    on_grid: residual (n,) [m], NaN where nothing is compared;  rate: of the motion (n,) [m/s]
    noisy: whether all readings in motion have further noise, of the encoder
    """
    square = rate**2
    second = np.diff(on_grid, 2)
    weight = square[:-2] + 4 * square[1:-1] + square[2:]
    known = np.isfinite(second)
    second, weight = second[known], weight[known]
    still = weight < _STILL * np.max(weight, initial=0.0)
    # A residual that persists from sample to sample in motion is no scatter in time.
    moving = (square > _STILL * np.max(square)) & np.isfinite(on_grid)
    product = np.where(moving, on_grid, 0.0)
    product = product[1:] * product[:-1]
    persists = np.sum(product) > CLEARLY * float(np.linalg.norm(product))
    if np.sum(still) < LEAST_STILL or persists:
        return 0.0
    at_rest = float(np.mean(second[still] ** 2))
    if noisy:
        at_rest = float(np.mean(second[~still] ** 2))
        weight = np.where(still, 0.0, weight - np.mean(weight[~still]))
    total = float(np.sum(weight**2))
    found = float(np.sum(weight * (second**2 - at_rest))) / total
    # Relative variance of the excess, and of the stationary noise that is subtracted.
    known_to = 1 / total + (float(np.sum(weight)) / total) ** 2 / float(np.sum(still))
    spread = at_rest * np.sqrt(2 * _SHARED * known_to)
    return found if found > CLEARLY * spread else 0.0


def motion_scatter(motion: FloatArray, rate: FloatArray) -> float:
    """Return the standard deviation [s] of the time of a reading of ``motion`` (n,) itself.

    rate: of the motion (n,) [m/s]

    It is 0 where it is not significant, or where the motion is too sharp for its sampling. A
    residual cannot show it, because there the jitter of the axis is filtered by the response.
    """
    rough, smooth = (_scatter_of_differences(motion, rate, n) for n in (_SMOOTH, _SMOOTHER))
    return smooth if abs(rough - smooth) < _ALIKE * smooth else 0.0


def _scatter_of_differences(motion: FloatArray, rate: FloatArray, order: int) -> float:
    kernel = np.array([(-1.0) ** i * comb(order, i) for i in range(order + 1)])
    kernel /= np.linalg.norm(kernel)
    square = np.convolve(motion, kernel, "valid") ** 2
    weight = np.convolve(rate**2, kernel**2, "valid")
    still = weight < _STILL * np.max(weight, initial=0.0)
    if np.sum(still) < LEAST_STILL:
        return 0.0
    excess = float(np.sum(weight * (square - np.mean(square[still]))))
    return float(np.sqrt(max(excess, 0.0) / np.sum(weight**2)))


# Quantised readings share their values; without quantisation hardly two are equal.
_LEAST_READINGS_A_LEVEL = 3.0
# Part of a squared step that is negligible against any noise.
_NOTHING = 1e-4
# Harmonics of the rounding error that are summed: all but 0.6 % of q²/12.
_HARMONICS = 100
# Tolerance of gaps between levels as whole steps: decimals are rounded.
_WHOLE = 0.05


def reading_step(readings: FloatArray) -> float:
    """Return the quantisation step of finite ``readings`` (k,) [m]; 0 where there is none."""
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
    # Rounding adds q²/12 to the spread; a reading that never changes may have any smaller noise.
    noise = max(spread - step**2 / 12, 0.0)
    harmonic = np.arange(1, _HARMONICS + 1)
    weakened = np.exp(-4 * np.pi**2 * harmonic**2 * noise / step**2) / harmonic**2
    shared = step**2 / (2 * np.pi**2) * float(np.sum(weakened))
    return shared if shared > _NOTHING * step**2 else 0.0


# Half width of the intervals that must intersect, in standard deviations. On quintic steps with
# noise of 1 and 3 nm, 2 leaves the least noise (0.15 of it) and nothing of the edges.
_INTERVAL = 2.0
# Protects divisions of signals without power.
_TINY = float(np.finfo(np.float64).tiny)
# Bands of the spectrum: dozens of them, the lowest with enough lines to estimate its noise.
_BANDS_AN_OCTAVE, _NARROWEST = 3, 64


def correct_errors_in_variables(
    problem: Problem, fitted: Fit, edges: Sequence[Edge] = ()
) -> Problem | None:
    """Return the problem without the noise of the input; the background has what the probe follows.

    edges: of the input, if it has any
    fitted: to ``problem``; its gain and response tell how far the probe follows the noise: jitter
        of the axis through G, what moves axis and probe alike without G, noise of the reading not
        at all (Carroll et al. 2006, ch. 4).

    Return None where the probe followed all of it through G, or where it was taken out before.
    """
    if problem.noise <= 0 or problem.errors_in_variables is not None:
        return None
    # Readings that change by one step agree with a constant. No mean reduces what they share.
    rounding = max(problem.input_error - problem.input_shared, 0.0)
    reach = max(problem.noise, 0.5 * float(np.sqrt(12 * rounding)))
    smooth, left = smoothed(problem.input, reach, edges)
    noise = problem.input - smooth
    # Unfiltered: the readings have noise at all frequencies.
    quiet = replace(problem, input=smooth, noise=0.0)
    modelled = quiet.modelled(fitted)
    made = replace(problem, noise=0.0).modelled(fitted) - modelled
    if not np.any(made[problem.used]):
        return None
    spectra = [
        fft.rfft(np.where(problem.used, values, 0.0))
        for values in (problem.output - modelled, made, fitted.gain * noise)
    ]
    share, direct = _followed(*spectra)
    if np.all(share == 1) and direct == 0:
        return None
    followed, column = (
        fft.irfft(share * fft.rfft(values), len(noise)) + direct * alike
        for values, alike in ((noise, noise), (made, fitted.gain * noise))
    )
    return replace(
        quiet,
        noise=left * problem.noise / reach,
        background=np.column_stack([problem.background, *([column] if np.any(column) else [])]),
        input_error=max(problem.input_error, float(np.mean((made - column) ** 2)) / fitted.gain**2),
        errors_in_variables=noise - followed,
        recorded=problem.input,
    )


def _followed(
    seen: ComplexArray, made: ComplexArray, direct: ComplexArray
) -> tuple[FloatArray, float]:
    """Return how much of ``made`` (k,) is in ``seen`` (k,), (k,), and how much of ``direct`` (k,).

    Bands that do not differ have one share of ``made``. Others have their own: vibration of the
    servo is followed by the probe, while noise in other bands is not. A share that may be 1 is
    taken as 1, one that may be 0 as 0.
    """
    line = np.arange(len(seen))
    band = np.floor(np.log2(1 + line / _NARROWEST) * _BANDS_AN_OCTAVE).astype(np.int64)
    # The share of ``direct`` follows from its difference to a part of ``made`` in each band.
    odd, left = (each - _shares(made, each, band)[0][band] * made for each in (direct, seen))
    whole = np.zeros_like(band)
    (alike,), (chance,) = _shares(odd, left, whole)
    alike = float(alike) if alike > CLEARLY * chance else 0.0
    found, known_to = _shares(made, seen - alike * direct, band)
    order = np.argsort(found)
    total = np.cumsum(1 / known_to[order])
    median = found[order][np.searchsorted(total, 0.5 * total[-1])]
    own = np.abs(found - median) > CLEARLY * known_to
    weight = np.where(own, 0.0, known_to**-2.0)
    share = np.where(own, found, np.sum(weight * found) / np.sum(weight))
    known_to = CLEARLY * np.where(own, known_to, np.sum(weight) ** -0.5)
    share = np.where(share > 1 - known_to, 1.0, np.where(share < known_to, 0.0, share))
    return np.asarray(share[band], np.float64), alike


def _shares(
    expected: ComplexArray, seen: ComplexArray, band: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return the share of ``expected`` (k,) that is in ``seen`` (k,) in each band (b,).

    The second is the standard deviation of each, from the rest of the spectrum.
    """
    power = np.maximum(np.bincount(band, np.abs(expected) ** 2), _TINY)
    share = np.bincount(band, (seen * expected.conj()).real) / power
    rest = seen - share[band] * expected
    spread = np.sqrt(np.bincount(band, 0.5 * np.abs(rest * expected) ** 2)) / power
    return np.asarray(share, np.float64), np.asarray(np.maximum(spread, _TINY), np.float64)


def smoothed(
    positions: FloatArray, noise: float, edges: Sequence[Edge] = ()
) -> tuple[FloatArray, float]:
    """Return ``positions`` (n,) [m] averaged where stationary, and the remaining noise [m].

    noise: standard deviation of a sample, white [m];  edges: of a motion in steps

    Each sample becomes the mean of as many neighbours on each side as agree with a constant: the
    intervals of their means intersect (Goldenshluger and Nemirovski 1997). Edges and any motion
    above the noise keep their shape. The settling of the axis would be averaged too; the part of it
    that is common to all edges is added back.
    """
    middle = float(np.mean(positions))
    rest = positions - middle
    before, earlier = _mean_before(rest, noise)
    after, later = _mean_before(rest[::-1], noise)
    # Both hold the sample itself.
    count = earlier + later[::-1] - 1
    mean = (earlier * before + later[::-1] * after[::-1] - rest) / count
    alike, left = _alike(rest - mean, noise, edges)
    for edge in edges:
        # Samples that agree there by chance are no constant.
        count[edge.start : edge.stop] = 1.0
    return np.asarray(mean + alike + middle), noise * float(np.sqrt(np.mean(1 / count + left)))


def _alike(taken: FloatArray, noise: float, edges: Sequence[Edge]) -> tuple[FloatArray, FloatArray]:
    """Return the part of ``taken`` (n,) common to all ``edges``, per height, (n,).

    The second is the share of the variance of ``noise`` in it, (n,). The mean over all edges is
    averaged as positions are, because noise common to all edges would show in no residual.
    """
    alike, left = np.zeros((2, len(taken)))
    if not edges:
        return alike, left
    # Settling is looked for over once more the duration of an edge.
    length = 2 * max(edge.stop - edge.start for edge in edges)
    ends = [edge.start for edge in edges[1:]] + [len(taken)]
    parts = [slice(e.start, min(e.start + length, end)) for e, end in zip(edges, ends, strict=True)]
    moved, power = np.zeros((2, length))
    for edge, part in zip(edges, parts, strict=True):
        moved[: part.stop - part.start] += edge.height * taken[part]
        power[: part.stop - part.start] += edge.height**2
    # Edges that return to their start have neither a common part nor power.
    if np.max(power) == 0:
        return alike, left
    spread = noise / float(np.sqrt(np.max(power)))
    shape, known_to = smoothed(moved / np.maximum(power, _TINY), spread)
    for edge, part in zip(edges, parts, strict=True):
        alike[part] = edge.height * shape[: part.stop - part.start]
        left[part] = (edge.height * known_to / noise) ** 2
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


# Blocks of a record: slower than two of them, a random walk exceeds white noise if it matters.
_WALK_BLOCKS = 128
# Log odds that are very strong evidence (Kass and Raftery 1995).
VERY_STRONG = 5.0
# A direction that the fit follows by less than this is rounding.
_FOLLOWED = 1e-6
# Variance ratios tried of walk to white noise over a record: from not visible to nothing else.
_WALK_RATIOS = np.geomspace(1e-2, 1e6, 97)


@dataclass(frozen=True, eq=False)
class RandomWalk:
    """Restricted likelihood of a random walk in a residual (Patterson and Thompson 1971).

    The means over blocks of the record are projected orthogonally to ``basis``, the columns of the
    fit: whatever the fit has followed does not bias the estimate.
    starts: first sample of each block;  length: of the record
    contrasts: (b, d) of the block means;  ratios: (d,) variance of each in a random walk over that
        in white noise
    """

    starts: IntArray
    length: int
    counts: FloatArray
    contrasts: FloatArray
    ratios: FloatArray

    @classmethod
    def of(cls, used: BoolArray, basis: FloatArray, recordings: Sequence[slice]) -> RandomWalk:
        """Return the likelihood for the samples of ``recordings`` that are ``used`` (n,).

        basis: (k, r) columns at those samples
        """
        size = max(len(used) // _WALK_BLOCKS, 1)
        starts = np.concatenate([np.arange(p.start, p.stop, size) for p in recordings])
        place = np.searchsorted(starts, np.flatnonzero(used), side="right") - 1
        counts = np.bincount(place, minlength=len(starts)).astype(np.float64)
        kept = np.flatnonzero(counts)
        starts, counts = starts[kept], counts[kept]
        first = np.searchsorted(np.flatnonzero(used), starts)
        # Unit variance of white noise: sums over the roots of the counts.
        followed = np.add.reduceat(basis, first, axis=0) / np.sqrt(counts)[:, np.newaxis]
        left, values, _ = np.linalg.svd(followed, full_matrices=True)
        free = left[:, np.sum(values > _FOLLOWED) :]
        recording = np.searchsorted([p.start for p in recordings], starts, side="right")
        shared = np.minimum.outer(starts, starts) * np.equal.outer(recording, recording)
        walk = shared * np.sqrt(np.outer(counts, counts))
        ratios, directions = np.linalg.eigh(free.T @ walk @ free)
        return cls(starts, len(used), counts, free @ directions, np.maximum(ratios, 0.0))

    def variance(
        self, residual: FloatArray, rows: FloatArray | tuple[()] = ()
    ) -> tuple[float, float]:
        """Return the variance per sample of the walk's increments, and χ² of ``rows`` (c, n).

        residual: (n,), 0 where not compared

        The walk is estimated together with ``rows`` only where they describe clearly more than a
        walk alone, because they were chosen for what they take of it. The variance is zero where
        no walk is shown (Schwarz 1978). χ² is the likelihood ratio of a walk with ``rows`` to one
        without.
        """
        if not len(self.ratios):  # the fit follows all block means
            return 0.0, 0.0
        restricted, white, alone = self._likelihood(residual, ())
        explained, price = 0.0, np.log(len(self.ratios))
        if len(rows):
            with_rows, white_then, together = self._likelihood(residual, rows)
            explained = 2 * float(np.max(together) - np.max(alone))
            if 0.5 * (explained - len(rows) * price) > VERY_STRONG:
                restricted, white = with_rows, white_then
        if 2 * np.max(restricted - restricted[0]) < price:
            return 0.0, explained
        best = int(np.argmax(restricted))
        return float(self._tried[best] * white[best]), explained

    @cached_property
    def _tried(self) -> FloatArray:
        """Variance of the walk's increments over that of white noise."""
        return np.append(0.0, _WALK_RATIOS / max(float(self.ratios[-1]), _TINY))

    def _likelihood(
        self, residual: FloatArray, rows: FloatArray | tuple[()]
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return, by ratio: log restricted likelihood, white variance, log likelihood."""
        sums = np.add.reduceat(np.vstack([*rows, residual]), self.starts, axis=1)
        shares = (sums / np.sqrt(self.counts)) @ self.contrasts
        variances = 1 + np.outer(self._tried, self.ratios)
        gram = np.einsum("id,td,jd->tij", shares, 1 / variances, shares)
        scale = np.sqrt(np.maximum(np.diagonal(gram, axis1=1, axis2=2), _TINY))
        unit = gram / (scale[:, :, np.newaxis] * scale[:, np.newaxis, :])
        # The last diagonal element of the factor is the part that the rows do not explain.
        factor = np.linalg.cholesky(unit + _FOLLOWED**2 * np.eye(len(shares)))
        diagonal = np.log(scale * np.diagonal(factor, axis1=1, axis2=2))
        spread = 0.5 * np.sum(np.log(variances), axis=1)
        degrees, rest = len(self.ratios) - len(rows), diagonal[:, -1]
        restricted = -degrees * rest - spread - np.sum(diagonal[:, :-1], axis=1)
        return restricted, np.exp(2 * rest) / degrees, -len(self.ratios) * rest - spread


def with_walk(noise: FloatArray, walk: float, length: int) -> FloatArray:
    """Return the larger of ``noise`` (``length`` // 2 + 1,) and the spectrum of a random walk.

    walk: variance per sample of its increments
    """
    if walk == 0:
        return noise
    rate = 2 * np.sin(np.pi * np.arange(1, len(noise)) / length)
    return np.append(noise[0], np.maximum(noise[1:], walk / rate**2))
