"""Convert a cloud of any size to an image, the mean of each pixel with narrow gaps closed."""

import io
import json
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from hashlib import sha256
from importlib import resources

import matplotlib
import numpy as np
from matplotlib.image import imsave
from numpy.typing import NDArray
from scipy import ndimage

from omsm_ros.core.streams.blocks import FloatArray, IntArray
from omsm_ros.core.surface.area_weights import area_weights
from omsm_ros.errors import DataError
from omsm_ros.report import style
from omsm_ros.units import MICROMETRE_M, MILLIMETRE_M, NANOMETRE_M

MAX_PIXELS = 400
_POINTS_PER_PIXEL = 2
# This quantile of the steps between filled pixels is the distance between tracks: along straight
# tracks half of the steps are one pixel, the others cross to the next track.
_CROSSING = 0.65


@dataclass(frozen=True, slots=True, eq=False)
class Raster:
    """Means on square pixels.

    image: (rows along y, columns along x), NaN without a near point
    extent: left, right, bottom, top of the image [m]
    """

    image: FloatArray
    extent: tuple[float, float, float, float]


def rasterise(x: FloatArray, y: FloatArray, value: FloatArray) -> Raster:
    """Return the mean of ``value`` at x, y [m], each (n,), on at most 400 × 400 pixels.

    A pixel between two tracks is the weighted mean of its surroundings. A pixel farther from any
    point than the distance of the tracks is NaN, so that dropouts stay visible.
    """
    if not len(x) or not np.all(np.isfinite(x) & np.isfinite(y) & np.isfinite(value)):
        raise DataError("a map needs one or more points, all of them finite")
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
    filled = count > 0
    away, reach = ndimage.distance_transform_edt(~filled), _reach(filled)
    # A Gaussian that ends at 4 sigma, with nothing beyond the edges.
    spread = [ndimage.gaussian_filter(part, reach / 2, mode="constant") for part in (total, count)]
    with np.errstate(invalid="ignore", divide="ignore"):
        image = np.where(count > 0, total / count, spread[0] / spread[1])
    return np.where(away <= reach, image, np.nan)


def _reach(filled: NDArray[np.bool_]) -> float:
    """Return the width of a gap between tracks that is to be closed [pixels]."""
    steps = np.concatenate([_steps(filled), _steps(filled.T)])
    # A hole of any size is crossed once per row, so it hardly changes the quantile.
    return max(0.55 * float(np.quantile(steps, _CROSSING)), 1.5) if len(steps) else 1.5


def _steps(filled: NDArray[np.bool_]) -> IntArray:
    """Return pixels from each filled one of an image to the next filled one of its row."""
    row, column = np.nonzero(filled)
    return np.diff(column)[np.diff(row) == 0]


@dataclass(frozen=True, eq=False, kw_only=True)
class CloudView:
    """Corrected points for figures, in the order of measurement, each array (n,), SI.

    time: since the start of the scan [s]
    x, y: position in the workpiece frame [m]
    height: corrected [m] (Eq. 10)
    dynamic_error: (1 - G_m) X_d [m] (Eq. 5), removed by the correction
    uncertainty: standard uncertainty of height [m], k = 1
    """

    time: FloatArray
    x: FloatArray
    y: FloatArray
    height: FloatArray
    dynamic_error: FloatArray
    uncertainty: FloatArray

    def __len__(self) -> int:
        return len(self.x)

    @cached_property
    def area(self) -> FloatArray:
        """Area that each point represents, (n,), of mean 1."""
        return area_weights(self.x, self.y)


# An embedded map holds heights of 16 bits in a PNG, and a script draws it without a library.
_STEPS = 65_534
_ROBUST_PERCENT = (0.25, 99.75)
_COLOURS = 128


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """One map: ``heights`` [m] at x, y [m], each (n,), drawn in ``unit`` "nm", "µm" or "1".

    symmetric: colour range about zero, for deviations; else from least to largest
    pitch: spacing of the grid of the points [m]; 0: scattered points
    """

    name: str
    x: FloatArray
    y: FloatArray
    heights: FloatArray
    unit: str
    symmetric: bool = True
    pitch: float = 0.0


@dataclass(frozen=True, slots=True)
class EmbeddedMap:
    """data: JSON for the script;  names: of its layers"""

    data: str
    names: tuple[str, ...]


def embedded(layers: Sequence[Layer]) -> EmbeddedMap:
    """Return maps for a page, each of at most 400 × 400 pixels."""
    content = {
        "colours": palette(),
        "missing": style.MISSING.lstrip("#"),
        "layers": [_entry(layer) for layer in layers],
    }
    # A name with "<" could end the script element.
    data = json.dumps(content, separators=(",", ":")).replace("<", r"\u003c")
    return EmbeddedMap(data, tuple(layer.name for layer in layers))


def palette() -> str:
    """Return the colours of maps, least to largest, each as six hexadecimal digits."""
    colours = matplotlib.colormaps[style.MAP_COLOURS](np.linspace(0, 1, _COLOURS))[:, :3]
    return "".join(f"{round(255 * part):02x}" for row in colours for part in row)


def script() -> str:
    """Return the script of the maps."""
    folder = resources.files("omsm_ros.report") / "templates"
    return (folder / "surface_map.js").read_text(encoding="utf-8")


def policy_of(text: str) -> str:
    """Return the source of a content security policy that allows only this script."""
    return f"'sha256-{b64encode(sha256(text.encode()).digest()).decode()}'"


def _entry(layer: Layer) -> dict[str, object]:
    units = {"nm": NANOMETRE_M, "µm": MICROMETRE_M, "1": 1.0}
    raster = _on_its_grid(layer) if layer.pitch else rasterise(layer.x, layer.y, layer.heights)
    heights = raster.image / units[layer.unit]
    known = heights[np.isfinite(heights)]
    least, span = float(known.min()), float(np.ptp(known))
    step = span / _STEPS or 1.0
    codes = np.where(np.isfinite(heights), 1 + np.round((heights - least) / step), 0)
    return {
        "name": layer.name,
        "unit": "" if layer.unit == "1" else layer.unit,
        "least": least,
        "step": step,
        "extent": [edge / MILLIMETRE_M for edge in raster.extent],
        "full": _limits(known.min(), known.max(), layer.symmetric),
        "robust": _limits(*np.percentile(known, _ROBUST_PERCENT), layer.symmetric),
        "png": _png(codes.astype(np.uint16)),
    }


def _on_its_grid(layer: Layer) -> Raster:
    """Return a raster with one pixel per grid point of the layer."""
    left, bottom = (float(values.min()) for values in (layer.x, layer.y))
    column, row = (
        np.round((values - least) / layer.pitch).astype(np.int64)
        for values, least in ((layer.x, left), (layer.y, bottom))
    )
    image = np.full((int(row.max()) + 1, int(column.max()) + 1), np.nan)
    image[row, column] = layer.heights
    left, bottom = left - layer.pitch / 2, bottom - layer.pitch / 2
    right = left + image.shape[1] * layer.pitch
    return Raster(image, (left, right, bottom, bottom + image.shape[0] * layer.pitch))


def _limits(low: float, high: float, symmetric: bool) -> list[float]:
    if symmetric:
        bound = max(abs(float(low)), abs(float(high))) or 1.0
        return [-bound, bound]
    return [float(low), float(high) if high > low else float(low) + 1.0]


def _png(codes: np.ndarray) -> str:
    """Return a PNG with the two bytes of each code in red and green, first row lowest."""
    pixels = np.stack([codes >> 8, codes & 255, np.zeros_like(codes)], axis=2).astype(np.uint8)
    content = io.BytesIO()
    imsave(content, pixels, format="png", pil_kwargs=dict(style.FAST_PNG))
    return b64encode(content.getvalue()).decode()
