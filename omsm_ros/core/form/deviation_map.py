"""Figures of a deviation map as it was measured, and the noise in it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from omsm_ros.core.streams.blocks import BoolArray, FloatArray, IntArray
from omsm_ros.core.streams.statistics import noise_of


@dataclass(frozen=True, slots=True)
class UncertainValue:
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


def neighbour_noise(x: FloatArray, y: FloatArray, deviation: FloatArray) -> float:
    """Return the same of points (n,) in any order: from each to those beside it in strips of y."""
    span_x, span_y = float(np.ptp(x)), float(np.ptp(y))
    spacing = np.sqrt(span_x * span_y / max(len(x), 1))
    strip = np.floor((y - y.min()) / (2 * spacing)) if spacing > 0 else np.zeros(len(y))
    return noise_of(deviation[np.lexsort((x, strip))])


# Means of a map on square cells, and the Gaussian filters of ISO 16610 on them.
#
# The mean of a cell is the deviation under a window of one cell; cells without a point are missing,
# and stay so. Filters divide by the weight of the cells that are there (ISO 16610-28, weighted
# regression of order zero), so that an edge is not dragged to zero.

# Eight points leave a third of their noise in a cell (1/√8).
_MOST_ACROSS, _POINTS_PER_CELL = 256, 8.0
# A profile has one row; its cells are as fine as its points.
_MOST_ALONG = 1024
# Of the weighting function exp(−π (x / α λ)²): half of a sine of wavelength λ passes.
_ALPHA = float(np.sqrt(np.log(2) / np.pi))


@dataclass(frozen=True, eq=False)
class GridCells:
    """Means on cells, rows along y.

    x, y: middles of the columns (c,) and rows (r,) [m];  pitch: of the cells [m]
    present: cells that have points (r, c)
    mean: of the deviations (r, c) [m], zero where there are none;  noise: of each mean (r, c) [m]
    effects: the same means of what each source of error does (e, r, c) [m]
    """

    x: FloatArray
    y: FloatArray
    pitch: float
    present: BoolArray
    mean: FloatArray
    noise: FloatArray
    effects: FloatArray

    @classmethod
    def of(cls, map_: DeviationMap) -> GridCells:
        """Return the means of a map on cells as fine as its points allow, at most 256 across."""
        spans = float(np.ptp(map_.x)), float(np.ptp(map_.y))
        # Of a strip fewer are needed across; eight points a cell where the area is filled.
        side = np.sqrt(max(spans[0] * spans[1], 1e-6 * max(spans) ** 2) / len(map_))
        pitch = max(float(side * np.sqrt(_POINTS_PER_CELL)), max(spans) / _MOST_ACROSS)
        if min(spans) == 0:
            pitch = max(spans) / min(max(len(map_) - 1, 1), _MOST_ALONG) or 1.0
        # What lies on an edge but for rounding lies beyond it.
        column, row = (
            ((values - values.min()) / pitch + 1e-9).astype(np.int64) for values in (map_.x, map_.y)
        )
        shape = int(row.max()) + 1, int(column.max()) + 1
        place = row * shape[1] + column
        size = shape[0] * shape[1]
        counts = np.bincount(place, minlength=size)
        divisor = np.maximum(counts, 1)

        def mean(values: FloatArray) -> FloatArray:
            return np.asarray((np.bincount(place, values, size) / divisor).reshape(shape))

        effects = [mean(effect) for effect in map_.effects]
        starts = float(map_.x.min()), float(map_.y.min())
        x, y = (
            np.asarray(start + pitch * (np.arange(count) + 0.5), np.float64)
            for start, count in zip(starts, reversed(shape), strict=True)
        )
        return cls(
            x=x,
            y=y,
            pitch=pitch,
            present=(counts > 0).reshape(shape),
            mean=mean(map_.deviation),
            noise=(map_.noise / np.sqrt(divisor)).reshape(shape),
            effects=np.array(effects).reshape(len(effects), *shape),
        )

    def smoothed(self, images: FloatArray, cutoff: float) -> FloatArray:
        """Return images (…, r, c) under the Gaussian of ``cutoff`` wavelength [m] (16610-61)."""
        rows, columns = (gaussian_weights(size, cutoff / self.pitch) for size in self.present.shape)
        weight = rows @ self.present @ columns
        made = rows @ (images * self.present) @ columns
        return np.asarray(made / np.maximum(weight, np.finfo(np.float64).tiny) * self.present)

    def smoothed_square(self, variance: FloatArray, cutoff: float) -> FloatArray:
        """Return the variance (r, c) of independent cells after :meth:`smoothed`."""
        rows, columns = (gaussian_weights(size, cutoff / self.pitch) for size in self.present.shape)
        weight = rows @ self.present @ columns
        made = rows**2 @ (variance * self.present) @ columns**2
        return np.asarray(made / np.maximum(weight, np.finfo(np.float64).tiny) ** 2 * self.present)


def gaussian_weights(size: int, cutoff: float) -> FloatArray:
    """Return the weights (size, size) of each cell for each other; ``cutoff`` in cells."""
    apart = np.subtract.outer(np.arange(size), np.arange(size)) / (_ALPHA * cutoff)
    return np.asarray(np.exp(-np.pi * apart**2))


# Does the part hold its tolerance? (ISO 14253-1)
#
# What is measured holds a tolerance for certain only if it does so with its expanded uncertainty
# added, and fails it for certain only with that taken off; between the two nobody can tell.

HOLDS, FAILS, OPEN = "holds", "fails", "cannot tell"
COVERAGE_FACTOR = 2.0


@dataclass(frozen=True)
class Conformity:
    """verdict: HOLDS, FAILS or OPEN;  value, expanded (k = 2), tolerance: [m]

    expanded: None if the uncertainty was not evaluated
    """

    verdict: str
    value: float
    expanded: float | None
    tolerance: float

    def entry(self) -> dict[str, Any]:
        """Return the JSON values for result files."""
        return asdict(self)


def conformity(figure: UncertainValue, tolerance: float) -> Conformity | None:
    """Return whether ``figure`` is at most ``tolerance`` [m]; None for a figure without a value."""
    if figure.value is None:
        return None
    if figure.uncertainty is None:
        return Conformity(OPEN, figure.value, None, tolerance)
    expanded = COVERAGE_FACTOR * figure.uncertainty
    verdict = OPEN
    if figure.value + expanded <= tolerance:
        verdict = HOLDS
    elif figure.value - expanded > tolerance:
        verdict = FAILS
    return Conformity(verdict, figure.value, expanded, tolerance)
