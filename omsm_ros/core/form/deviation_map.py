"""Deviation map of a part, its means on cells with Gaussian filters, and conformity.

The mean of a cell is the deviation under a square window; cells without a point stay missing. The
filters of ISO 16610 divide by the weight of the cells present (ISO 16610-28, weighted regression
of order zero), so that edges are not drawn to zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from omsm_ros.core.streams.blocks import BoolArray, FloatArray, IntArray
from omsm_ros.core.streams.statistics import noise_of
from omsm_ros.errors import Notice


@dataclass(frozen=True, slots=True)
class UncertainValue:
    """A value and its standard uncertainty, in one unit; None: not evaluated."""

    value: float | None
    uncertainty: float | None

    def entry(self) -> dict[str, float | None]:
        """Return the JSON values for result files."""
        return {"value": self.value, "uncertainty": self.uncertainty}


@dataclass(frozen=True, eq=False, kw_only=True)
class DeviationMap:
    """Deviations of a registered part, in the order of measurement.

    x, y: in the part's frame [m], (n,);  deviation: along the normal [m], (n,)
    area: that each point stands for, of mean one (n,)
    effects: of one standard uncertainty of each independent error source on the deviations
        (e, n) [m]
    bounds: indices of effects that are upper bounds of errors that may be absent
    moves: indices of effects that are moves of the part, to first order
    taken: the first t effects are form that the fit may have taken for a move, so that it is
        missing from the deviations; mean products of their probable shares (t, t), at most one
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
        return self.part(slice(None, None, -(-len(self) // most)))

    def part(self, chosen: slice | IntArray) -> DeviationMap:
        """Return the ``chosen`` points."""
        columns = {name: getattr(self, name)[chosen] for name in _COLUMNS}
        return replace(self, **columns, effects=self.effects[:, chosen])

    def joined(self, other: DeviationMap) -> DeviationMap:
        """Return these points and those of ``other``, a part of the same map."""
        columns = {n: np.concatenate([getattr(m, n) for m in (self, other)]) for n in _COLUMNS}
        effects = np.concatenate([self.effects, other.effects], axis=1)
        return replace(self, **columns, effects=effects)


_COLUMNS = ("x", "y", "deviation", "area")


def root_mean_square(map_: DeviationMap) -> float:
    """Return the area-weighted rms of the deviations about zero, noise included [m]."""
    return float(np.sqrt(np.average(map_.deviation**2, weights=map_.area)))


def weighted_quantiles(
    values: FloatArray, weights: FloatArray, shares: tuple[float, ...]
) -> tuple[float, ...]:
    """Return the values below which these ``shares`` of the weight lie."""
    order = np.argsort(values)
    below = np.cumsum(weights[order]) - weights[order] / 2
    found = np.interp(np.array(shares) * weights.sum(), below, values[order])
    return tuple(float(value) for value in found)


def neighbour_noise(x: FloatArray, y: FloatArray, deviation: FloatArray) -> float:
    """Return the noise of points (n,) in any order, from neighbours in strips of y."""
    span_x, span_y = float(np.ptp(x)), float(np.ptp(y))
    spacing = np.sqrt(span_x * span_y / max(len(x), 1))
    strip = np.floor((y - y.min()) / (2 * spacing)) if spacing > 0 else np.zeros(len(y))
    return noise_of(deviation[np.lexsort((x, strip))])


# The mean of eight points has a third of their noise (1/√8).
_MOST_ACROSS, _POINTS_PER_CELL = 256, 8.0
# A profile has one row; its cells are as fine as its points.
_MOST_ALONG = 1024
# Constant of the weighting function exp(−π (x / α λ)²), which halves a sine of wavelength λ.
_ALPHA = float(np.sqrt(np.log(2) / np.pi))


@dataclass(frozen=True, eq=False)
class GridCells:
    """Means on square cells, rows along y.

    x, y: middles of the columns (c,) and rows (r,) [m];  pitch: of the cells [m]
    present: cells that have points (r, c)
    mean: of the deviations (r, c) [m], zero in empty cells;  noise: of each mean (r, c) [m]
    effects: means of the effects of each error source (e, r, c) [m]
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
        # The area of a strip is at least 1e-6 of a square's, to keep the cells finite.
        side = np.sqrt(max(spans[0] * spans[1], 1e-6 * max(spans) ** 2) / len(map_))
        pitch = max(float(side * np.sqrt(_POINTS_PER_CELL)), max(spans) / _MOST_ACROSS)
        if min(spans) == 0:
            pitch = max(spans) / min(max(len(map_) - 1, 1), _MOST_ALONG) or 1.0
        # A point within rounding of an edge belongs to the next cell.
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
        """Return images (…, r, c) after a Gaussian low-pass of ``cutoff`` [m] (ISO 16610-61)."""
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
    """Return the weight of each cell for each other (size, size); ``cutoff`` in cells."""
    apart = np.subtract.outer(np.arange(size), np.arange(size)) / (_ALPHA * cutoff)
    return np.asarray(np.exp(-np.pi * apart**2))


HOLDS, FAILS, OPEN = "holds", "fails", "cannot tell"
COVERAGE_FACTOR = 2.0


@dataclass(frozen=True)
class Conformity:
    """Conformity with a tolerance by the decision rule of ISO 14253-1.

    verdict: HOLDS, FAILS or OPEN;  value, tolerance: [m]
    expanded: uncertainty (k = 2) [m], None if it was not evaluated
    reasons: why it is open although the value alone would hold
    """

    verdict: str
    value: float
    expanded: float | None
    tolerance: float
    reasons: tuple[Notice | str, ...] = ()

    def entry(self) -> dict[str, Any]:
        """Return the JSON values for result files."""
        return {**asdict(replace(self, reasons=())), "reasons": [*map(str, self.reasons)]}


class Doubt(NamedTuple):
    """A part of the surface that no figure contains.

    reason: as a sentence;  peak_to_valley: of the surface with it [m], None if it is unknown
    """

    reason: Notice | str
    peak_to_valley: float | None


def conformity(
    figure: UncertainValue, tolerance: float, doubts: Sequence[Doubt] = ()
) -> Conformity | None:
    """Return whether ``figure`` is at most ``tolerance`` [m], None for a figure without a value.

    It holds if it does with the expanded uncertainty added, and fails if it does with that
    subtracted; in between the uncertainty leaves it open. With a doubt that may exceed the
    ``tolerance`` nothing is known to hold.
    """
    if figure.value is None:
        return None
    if figure.uncertainty is None:
        return Conformity(OPEN, figure.value, None, tolerance)
    expanded = COVERAGE_FACTOR * figure.uncertainty
    reasons = tuple(
        d.reason for d in doubts if d.peak_to_valley is None or d.peak_to_valley > tolerance
    )
    verdict = OPEN
    if figure.value + expanded <= tolerance:
        verdict = OPEN if reasons else HOLDS
    elif figure.value - expanded > tolerance:
        verdict = FAILS
    return Conformity(verdict, figure.value, expanded, tolerance, reasons)
