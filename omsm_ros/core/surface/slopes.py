"""How steep is a surface, and where is its normal?"""

from __future__ import annotations

from typing import Protocol, TypeAlias, runtime_checkable

import numpy as np

from omsm_ros.core.machine.surface_height import Surface, slopes_by_differences
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.units import MICROMETRE_M

Gradient: TypeAlias = tuple[FloatArray, FloatArray]
"""Slopes ∂z/∂x and ∂z/∂y [1], each of the shape of x and y."""

# Of a shape that tells its height alone: central differences are off by step²/6 times the third
# derivative, 1e-9 on an optic of 50 mm radius, and its height is known to 1e-17 m.
_STEP_M = 2 * MICROMETRE_M


@runtime_checkable
class SlopedSurface(Protocol):
    """A surface that knows its slopes in closed form."""

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m], of their broadcast shape."""
        ...

    def gradient(self, x: FloatArray, y: FloatArray) -> Gradient:
        """Return the slopes ∂z/∂x, ∂z/∂y [1] at x, y [m]."""
        ...


def gradient_of(surface: Surface, x: FloatArray, y: FloatArray) -> Gradient:
    """Return the slopes of ``surface`` at x, y [m]; by differences if it knows its height alone."""
    if isinstance(surface, SlopedSurface):
        return surface.gradient(x, y)
    return slopes_by_differences(surface, x, y, _STEP_M)


def unit_normal(slope_x: FloatArray, slope_y: FloatArray) -> FloatArray:
    """Return the upward unit normals (3, …) of a surface with these slopes."""
    length = np.sqrt(1 + slope_x**2 + slope_y**2)
    return np.stack([-slope_x / length, -slope_y / length, 1 / length])
