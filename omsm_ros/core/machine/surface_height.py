"""What a motion follows and a probe looks at: a height over the plane, and its slopes."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.units import MICROMETRE_M

# The slope of a wave of a millimetre is short by 0.07 %, and rounding far below a microradian.
_STEP_M = 10 * MICROMETRE_M


class Surface(Protocol):
    """Anything with a height over the plane."""

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m], of their broadcast shape."""
        ...


def slopes_by_differences(
    surface: Surface, x: FloatArray, y: FloatArray, step: float = _STEP_M
) -> tuple[FloatArray, FloatArray]:
    """Return ∂z/∂x and ∂z/∂y [1] at x, y [m] by central differences over ``step`` [m] each way."""
    along_x = (surface.height(x + step, y) - surface.height(x - step, y)) / (2 * step)
    along_y = (surface.height(x, y + step) - surface.height(x, y - step)) / (2 * step)
    return np.asarray(along_x, np.float64), np.asarray(along_y, np.float64)
