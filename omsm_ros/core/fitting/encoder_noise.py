"""Noise of the encoder's own: what it shows at rest and the probe did not follow.

A fit takes the input for exact. Noise in it goes through the response and comes out larger where
that rings, so a fit damps a light mode, or finds backlash and errors of the scale that swallow
the noise (errors in variables, Ljung 1999, sec. 13.5). Where an axis rests, a mean of many
samples has no noise to speak of.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import fft

from omsm_ros.core.dynamics.transfer_function import ComplexArray
from omsm_ros.core.fitting.descent import Effort
from omsm_ros.core.fitting.output_error import Fit, Problem
from omsm_ros.core.fitting.steps import Edge
from omsm_ros.core.samples.blocks import FloatArray, IntArray

# Width of the intervals that must have a value in common, in standard deviations. On quintic steps
# with noise of 1 and 3 nm two leaves least: 0.15 of it, and of quintic edges nothing that repeats.
_INTERVAL = 2.0
# Standard deviations beyond which a part that is followed, or is not, is no chance. Noise that
# shows less imitates no departure that would be significant.
_CLEARLY = 5.0
# Those beyond which a mean over all edges is no chance in a hundred samples after each.
_SEEN = 3.0
_TINY = float(np.finfo(np.float64).tiny)
# Of a record's spectrum: dozens of bands, the lowest of so many lines that they tell their noise.
_BANDS_AN_OCTAVE, _NARROWEST = 3, 64


def without_unfollowed(problem: Problem, fitted: Fit, edges: Sequence[Edge] = ()) -> Problem | None:
    """Return the problem without that part of the input's noise that the probe did not follow.

    edges: of the input, if it has any
    fitted: to ``problem``; its residual shows how much of that noise did not come through it.
        Where some of it did, its expected motion stays (Carroll et al. 2006, ch. 4).
    None where the probe followed all, as far as the residual shows, or it was taken out before.
    """
    if problem.noise <= 0 or problem.unfollowed is not None:
        return None
    smooth, left = smoothed(problem.input, problem.noise, edges)
    noise = problem.input - smooth
    quiet = replace(problem, input=smooth, noise=left)
    made = np.where(problem.used, problem.modelled(fitted) - quiet.modelled(fitted), 0.0)
    if not np.any(made):
        return None
    share, band = _not_followed(problem.on_grid(fitted.residual, 0.0), made)
    if share is None:
        return None
    unfollowed = fft.irfft(share[band] * fft.rfft(noise), len(noise))
    # It is fitted from the start; what was tried with the noise in it counts no more.
    return replace(
        problem,
        input=problem.input - unfollowed,
        noise=left,
        unfollowed=unfollowed,
        effort=Effort(),
    )


def _not_followed(residual: FloatArray, made: FloatArray) -> tuple[FloatArray | None, IntArray]:
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
