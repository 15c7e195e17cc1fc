"""From a cloud of any size to an image: the mean of each pixel, narrow gaps closed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from omsm_ros.core.samples.blocks import FloatArray, IntArray
from omsm_ros.errors import DataError

MAX_PIXELS = 400
_POINTS_PER_PIXEL = 2


@dataclass(frozen=True, slots=True, eq=False)
class Raster:
    """Means on square pixels.

    image: (rows along y, columns along x), NaN where no point is near
    extent: left, right, bottom, top of the image [m]
    """

    image: FloatArray
    extent: tuple[float, float, float, float]


def rasterise(x: FloatArray, y: FloatArray, value: FloatArray) -> Raster:
    """Mean of ``value`` at x, y [m], each (n,), on at most 400 × 400 pixels.

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
    away = ndimage.distance_transform_edt(count == 0)
    # Between tracks a pixels apart half of all pixels are within a/4 of one.
    reach = max(2.5 * float(np.median(away)), 1.5)
    spread = [ndimage.gaussian_filter(part, reach / 2, mode="constant") for part in (total, count)]
    with np.errstate(invalid="ignore", divide="ignore"):
        image = np.where(count > 0, total / count, spread[0] / spread[1])
    return np.where(away <= reach, image, np.nan)
