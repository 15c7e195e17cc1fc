"""Maps as a page embeds them: heights of 16 bits in a PNG, and the script that draws them.

The page needs no network and no library; the script may draw whatever else calls its ``set``.
"""

from __future__ import annotations

import io
import json
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from importlib import resources

import matplotlib
import numpy as np
from matplotlib.image import imsave

from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.errors import DataError
from omsm_ros.report.common import style
from omsm_ros.report.measurement.raster import Raster, rasterise
from omsm_ros.units import MICROMETRE_M, MILLIMETRE_M, NANOMETRE_M

_STEPS = 65_534
_ROBUST_PERCENT = (0.25, 99.75)
_COLOURS = 128


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """One map: ``heights`` [m] at x, y [m], each (n,), in ``unit`` "nm" or "µm"; numbers in "1".

    symmetric: colours about zero, for deviations; else from the least to the greatest
    pitch: of the grid on which all points lie [m]; 0: they are scattered
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
    colours = matplotlib.colormaps[style.MAP_COLOURS](np.linspace(0, 1, _COLOURS))[:, :3]
    content = {
        "colours": "".join(f"{round(255 * part):02x}" for row in colours for part in row),
        "missing": style.MISSING.lstrip("#"),
        "layers": [_entry(layer) for layer in layers],
    }
    # Within a script's tags nothing is unescaped, and a name could end them.
    data = json.dumps(content, separators=(",", ":")).replace("<", r"\u003c")
    return EmbeddedMap(data, tuple(layer.name for layer in layers))


def script() -> str:
    """Return the script of the maps."""
    folder = resources.files("omsm_ros.report") / "templates"
    return (folder / "surface_map.js").read_text(encoding="utf-8")


def policy_of(text: str) -> str:
    """Return what a content security policy calls this script, and no other."""
    return f"'sha256-{b64encode(sha256(text.encode()).digest()).decode()}'"


def _entry(layer: Layer) -> dict[str, object]:
    units = {"nm": NANOMETRE_M, "µm": MICROMETRE_M, "1": 1.0}
    if layer.unit not in units:
        raise DataError(f"unit {layer.unit!r} of a map is unknown, expected one of {[*units]}")
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
    """Return a pixel for each place of the layer's grid."""
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
    """Return a picture whose red and green are the two bytes of each code, first row lowest."""
    pixels = np.stack([codes >> 8, codes & 255, np.zeros_like(codes)], axis=2).astype(np.uint8)
    content = io.BytesIO()
    imsave(content, pixels, format="png", pil_kwargs=dict(style.FAST_PNG))
    return b64encode(content.getvalue()).decode()
