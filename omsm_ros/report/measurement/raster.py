"""From a cloud of any size to an image: the mean of each pixel, narrow gaps closed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.samples.blocks import FloatArray, IntArray
from omsm_ros.errors import DataError

MAX_PIXELS = 400
_POINTS_PER_PIXEL = 2
# Beyond any image, and its square still a whole number.
_FAR = 10_000
# Of the steps from pixel to pixel along rows and columns, those that cross from track to track.
_CROSSING = 0.65


@dataclass(frozen=True, slots=True, eq=False)
class Raster:
    """Means on square pixels.

    image: (rows along y, columns along x), NaN where no point is near
    extent: left, right, bottom, top of the image [m]
    """

    image: FloatArray
    extent: tuple[float, float, float, float]


def rasterise(x: FloatArray, y: FloatArray, value: FloatArray) -> Raster:
    """Return the mean of ``value`` at x, y [m], each (n,), on at most 400 × 400 pixels.

    A pixel between two tracks takes the weighted mean of its surroundings; a pixel
    farther from any point than the tracks are from each other stays NaN, so that
    dropouts remain to be seen.
    """
    if not len(x) or not np.all(np.isfinite(x) & np.isfinite(y) & np.isfinite(value)):
        raise DataError("a map needs at least one point, and finite ones only")
    pixels = int(np.clip(np.sqrt(len(x) / _POINTS_PER_PIXEL), 8, MAX_PIXELS))
    pitch = max(np.ptp(x), np.ptp(y)) / pixels or 1.0
    column, columns = _pixel(x, pitch)
    row, rows = _pixel(y, pitch)
    index = row * columns + column
    count, total = (
        np.asarray(np.bincount(index, each, rows * columns), np.float64).reshape(rows, columns)
        for each in (None, value)
    )
    left, bottom = float(x.min()), float(y.min())
    extent = (left, left + columns * pitch, bottom, bottom + rows * pitch)
    return Raster(_close_gaps(total, count), extent)


def _pixel(position: FloatArray, pitch: float) -> tuple[IntArray, int]:
    number = np.floor((position - position.min()) / pitch).astype(np.int64)
    # The largest coordinate lies on the outer edge of the last pixel.
    count = max(int(np.ceil(np.ptp(position) / pitch - 1e-9)), 1)
    return np.minimum(number, count - 1), count


def _close_gaps(total: FloatArray, count: FloatArray) -> FloatArray:
    away, reach = _near(count > 0)
    spread = [smoothed(part, reach / 2) for part in (total, count)]
    with np.errstate(invalid="ignore", divide="ignore"):
        image = np.where(count > 0, total / count, spread[0] / spread[1])
    return np.where(away <= reach, image, np.nan)


def _near(filled: NDArray[np.bool_]) -> tuple[FloatArray, float]:
    """Return pixels to the nearest filled one, exact up to the reach of a gap to be closed."""
    steps = np.concatenate([_steps(filled), _steps(filled.T)])
    if not len(steps):
        return distances(filled, 2), 1.5
    # Along straight tracks half of all steps are of one pixel; the rest cross from one to the
    # next. A hole, however large, is crossed once in a row and counts as one step of many.
    between = float(np.quantile(steps, _CROSSING))
    reach = max(0.55 * between, 1.5)
    return distances(filled, int(np.ceil(reach))), reach


def _steps(filled: NDArray[np.bool_]) -> IntArray:
    """Return pixels from each filled one of an image to the next filled one of its row."""
    row, column = np.nonzero(filled)
    return np.diff(column)[np.diff(row) == 0]


def distances(filled: NDArray[np.bool_], within: int) -> FloatArray:
    """Return pixels to the nearest filled one of an image (rows, columns) that has one.

    First along the columns, then the least sum of squares over the columns beside. Exact where
    it is no more than ``within``, elsewhere never less than the truth.
    """
    rows, columns = filled.shape
    row = np.arange(rows)[:, np.newaxis]
    before = np.maximum.accumulate(np.where(filled, row, -_FAR), axis=0)
    after = np.minimum.accumulate(np.where(filled, row, _FAR)[::-1], axis=0)[::-1]
    along = np.minimum(row - before, after - row).astype(np.float64) ** 2
    nearest = along.copy()
    for aside in range(1, min(within + 1, columns)):
        left, right = slice(None, -aside), slice(aside, None)
        nearest[:, left] = np.minimum(nearest[:, left], along[:, right] + aside**2)
        nearest[:, right] = np.minimum(nearest[:, right], along[:, left] + aside**2)
    return np.sqrt(nearest)


def smoothed(image: FloatArray, sigma: float) -> FloatArray:
    """Return the image under a Gaussian of ``sigma`` pixels, cut off at four; zero beyond."""
    rows, columns = (_gaussian(size, sigma) for size in image.shape)
    return np.asarray(rows @ image @ columns, np.float64)


def _gaussian(size: int, sigma: float) -> FloatArray:
    """Return the weights (size, size) of each pixel of a line for each other one."""
    cut = int(4 * sigma + 0.5)
    weights = np.exp(-0.5 * (np.arange(max(size, cut + 1)) / sigma) ** 2)
    weights[cut + 1 :] = 0.0
    apart = abs(np.subtract.outer(np.arange(size), np.arange(size)))
    return np.asarray((weights / (2 * weights.sum() - weights[0]))[apart])
