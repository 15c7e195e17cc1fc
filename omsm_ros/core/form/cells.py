"""Means of a map on square cells, and the Gaussian filters of ISO 16610 on them.

The mean of a cell is the deviation under a window of one cell; cells without a point are missing,
and stay so. Filters divide by the weight of the cells that are there (ISO 16610-28, weighted
regression of order zero), so that an edge is not dragged to zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from omsm_ros.core.form.figures import DeviationMap
from omsm_ros.core.samples.blocks import BoolArray, FloatArray

# Eight points leave a third of their noise in a cell (1/√8).
_MOST_ACROSS, _POINTS_PER_CELL = 256, 8.0
# A profile has one row; its cells are as fine as its points.
_MOST_ALONG = 1024
# Of the weighting function exp(−π (x / α λ)²): half of a sine of wavelength λ passes.
_ALPHA = float(np.sqrt(np.log(2) / np.pi))


@dataclass(frozen=True, eq=False)
class Cells:
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
    def of(cls, map_: DeviationMap) -> Cells:
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
