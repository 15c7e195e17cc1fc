"""Figures of a deviation map: what each is, and how sure it is.

A figure is a function of the deviations. Its uncertainty is propagated through that function
itself: every independent source of error is added to the map and taken from it, and half the
difference of the two figures is its share (GUM, 5.1.4). Noise of the points makes extremes larger
and never smaller; by how much is told by what more noise of the same size would do.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray

# 99.5 % of the area lies between these (ISO 10110-5:2015 calls for a share to be stated).
_ROBUST = (0.0025, 0.9975)
_NOISE_SEED = 20
_ENOUGH_FOR_QUANTILES = 20_000


@dataclass(frozen=True, slots=True)
class Figure:
    """A value and its standard uncertainty, in one unit; None: not evaluated."""

    value: float | None
    uncertainty: float | None

    def entry(self) -> dict[str, float | None]:
        """Return what a result file says of it."""
        return {"value": self.value, "uncertainty": self.uncertainty}


@dataclass(frozen=True, eq=False, kw_only=True)
class DeviationMap:
    """Deviations of a registered part, in the order in which they were measured.

    x, y: in the part's frame [m], (n,);  deviation: along the normal [m], (n,)
    area: which each point stands for, of mean one (n,)
    effects: what each independent source of error, off by its standard uncertainty, does to the
        deviations (e, n) [m]
    noise: standard deviation of one point [m]
    """

    x: FloatArray
    y: FloatArray
    deviation: FloatArray
    area: FloatArray
    effects: FloatArray
    noise: float

    def __len__(self) -> int:
        return len(self.x)

    def every(self, most: int) -> DeviationMap:
        """Return every k-th point, so that there are no more than ``most``."""
        chosen = slice(None, None, -(-len(self) // most))
        return DeviationMap(
            **{name: getattr(self, name)[chosen] for name in ("x", "y", "deviation", "area")},
            effects=self.effects[:, chosen],
            noise=self.noise,
        )


Functional = Callable[[FloatArray], float]


def from_sources(map_: DeviationMap, figure: Functional) -> float:
    """Return the standard uncertainty of a ``figure`` of the deviations from all effects."""
    shares = [
        (figure(map_.deviation + effect) - figure(map_.deviation - effect)) / 2
        for effect in map_.effects
    ]
    return float(np.sqrt(np.sum(np.square(shares))))


def peak_to_valley(map_: DeviationMap, extent: float) -> Figure:
    """Return the largest minus the smallest of all deviations, which ``extent`` [m] is.

    Of a perfect surface it would be some nine times the noise. Its uncertainty holds what
    noise has added to it.
    """
    shares = from_sources(map_, np.ptp)
    return Figure(extent, float(np.hypot(shares, _by_noise(map_, np.ptp))))


def robust_peak_to_valley(map_: DeviationMap) -> Figure:
    """Return the extent of the deviations of 99.5 % of the area."""
    # Quantiles need an order, which costs: the shares are those of the same extent of some points.
    few = map_.every(_ENOUGH_FOR_QUANTILES)
    shares = from_sources(few, lambda d: _extent(d, few.area))
    by_noise = _by_noise(map_, lambda d: _extent(d, map_.area))
    return Figure(_extent(map_.deviation, map_.area), float(np.hypot(shares, by_noise)))


def _extent(deviation: FloatArray, area: FloatArray) -> float:
    low, high = weighted_quantiles(deviation, area, _ROBUST)
    return high - low


def root_mean_square(map_: DeviationMap) -> tuple[Figure, Figure]:
    """Return the area-weighted rms about zero, and the same without the noise of the points."""

    def rms(deviation: FloatArray) -> float:
        return float(np.sqrt(np.average(deviation**2, weights=map_.area)))

    value = rms(map_.deviation)
    square = max(value**2 - map_.noise**2, 0.0)
    clean = float(np.sqrt(square))
    scatter = _scatter_of_square(map_)
    shares = from_sources(map_, rms)
    of_clean = scatter / (2 * clean) if clean > 0 else np.inf
    # Where noise is all there is, the square root of its scatter bounds what else there may be.
    of_clean = min(of_clean, float(np.sqrt(scatter)))
    of_value = float(np.hypot(scatter / (2 * value) if value else 0.0, value - clean))
    return (
        Figure(value, float(np.hypot(shares, of_value))),
        Figure(clean, float(np.hypot(shares, of_clean))),
    )


def _scatter_of_square(map_: DeviationMap) -> float:
    """Return the standard deviation of the mean square [m²] from the noise of the points.

    4 d²σ² of a point from its form and 2 σ⁴ from its noise, and as much again for not knowing σ.
    """
    share = map_.area / map_.area.sum()
    variance = np.sum(share**2 * (4 * map_.deviation**2 * map_.noise**2 + 4 * map_.noise**4))
    return float(np.sqrt(variance))


def _by_noise(map_: DeviationMap, figure: Functional) -> float:
    """Return by how much noise has made an extent larger, by what as much again adds to it.

    What it adds is proportional to its standard deviation, of which twice the variance has √2 − 1
    more.
    """
    more = np.random.default_rng(_NOISE_SEED).normal(0.0, 1.0, len(map_)) * map_.noise
    added = figure(map_.deviation + more) - figure(map_.deviation)
    return float(np.clip(added / (np.sqrt(2) - 1), 0.0, figure(map_.deviation)))


def weighted_quantiles(
    values: FloatArray, weights: FloatArray, shares: tuple[float, ...]
) -> tuple[float, ...]:
    """Return the values below which these shares of the weight lie."""
    order = np.argsort(values)
    below = np.cumsum(weights[order]) - weights[order] / 2
    found = np.interp(np.array(shares) * weights.sum(), below, values[order])
    return tuple(float(value) for value in found)


def noise_of(deviation: FloatArray) -> float:
    """Return the standard deviation of what changes from point to point [m], robustly.

    From second differences of points in the order in which they were measured, for which form and
    slow drift are straight lines: ``median |d_(i−1) − 2 d_i + d_(i+1)| = 0.6745 √6 σ``.
    """
    if len(deviation) < 3:
        return 0.0
    return float(np.median(np.abs(np.diff(deviation, 2))) * 1.4826 / np.sqrt(6))
