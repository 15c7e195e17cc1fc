"""Figures of a deviation map as it was measured, and the noise in it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray, IntArray
from omsm_ros.core.samples.scatter import noise_of


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
    bounds: which of the effects are upper bounds of errors that may not be there at all
    moves: which of them are of a part that sits elsewhere, in the first order
    taken: the first t effects are of form that the fit may have taken for a move: it is missing
        from the deviations, not added to them. Mean products of how much of each is likely to be
        missing (t, t), at most one
    noise: standard deviation of one point [m]
    """

    x: FloatArray
    y: FloatArray
    deviation: FloatArray
    area: FloatArray
    effects: FloatArray
    noise: float
    bounds: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    moves: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    taken: FloatArray = field(default_factory=lambda: np.empty((0, 0)))

    def __len__(self) -> int:
        return len(self.x)

    def every(self, most: int) -> DeviationMap:
        """Return every k-th point, so that there are no more than ``most``."""
        chosen = slice(None, None, -(-len(self) // most))
        return DeviationMap(
            **{name: getattr(self, name)[chosen] for name in ("x", "y", "deviation", "area")},
            effects=self.effects[:, chosen],
            noise=self.noise,
            bounds=self.bounds,
            moves=self.moves,
            taken=self.taken,
        )


def root_mean_square(map_: DeviationMap) -> float:
    """Return the area-weighted rms of the deviations about zero, noise and all [m]."""
    return float(np.sqrt(np.average(map_.deviation**2, weights=map_.area)))


def weighted_quantiles(
    values: FloatArray, weights: FloatArray, shares: tuple[float, ...]
) -> tuple[float, ...]:
    """Return the values below which these shares of the weight lie."""
    order = np.argsort(values)
    below = np.cumsum(weights[order]) - weights[order] / 2
    found = np.interp(np.array(shares) * weights.sum(), below, values[order])
    return tuple(float(value) for value in found)


def noise_beside(x: FloatArray, y: FloatArray, deviation: FloatArray) -> float:
    """Return the same of points (n,) in any order: from each to those beside it in strips of y."""
    span_x, span_y = float(np.ptp(x)), float(np.ptp(y))
    spacing = np.sqrt(span_x * span_y / max(len(x), 1))
    strip = np.floor((y - y.min()) / (2 * spacing)) if spacing > 0 else np.zeros(len(y))
    return noise_of(deviation[np.lexsort((x, strip))])
