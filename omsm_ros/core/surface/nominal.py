"""Nominal surfaces: height and slope over the workpiece plane.

A surface is described in the workpiece frame of the scan: x, y in the plane of the
chuck, height along the spindle axis, all in metres.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from omsm_ros.core.machine.surface_height import Surface
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.core.surface.aspheres import Asphere, Biconic, Toroid
from omsm_ros.core.surface.freeforms import QBfs, QCon, XYPolynomial, ZernikeSurface
from omsm_ros.core.surface.posed import OffAxisSection, Sum
from omsm_ros.core.surface.q_freeform import QFreeform
from omsm_ros.core.surface.slopes import Gradient
from omsm_ros.errors import SurfaceError
from omsm_ros.quantities import FOCAL_LENGTH, LENGTH, RADIUS


@dataclass(frozen=True, slots=True)
class Flat:
    """A plane at constant ``level`` [m]."""

    level: float = 0.0

    def __post_init__(self) -> None:
        LENGTH.checked(self.level, SurfaceError, "level")

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m]."""
        return np.full(np.broadcast(x, y).shape, self.level)

    def gradient(self, x: FloatArray, y: FloatArray) -> Gradient:
        """Return the slopes ∂z/∂x, ∂z/∂y [1]."""
        zero = np.zeros(np.broadcast(x, y).shape)
        return zero, zero


@dataclass(frozen=True, slots=True)
class Sphere:
    """A sphere of ``radius`` [m] touching the plane at the origin; concave if positive."""

    radius: float

    def __post_init__(self) -> None:
        RADIUS.checked(self.radius, SurfaceError)

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m]; NaN outside the sphere's equator."""
        square = np.asarray(x) ** 2 + np.asarray(y) ** 2
        root = np.sqrt(np.maximum(self.radius**2 - square, 0.0))
        sag = np.sign(self.radius) * square / (abs(self.radius) + root)
        return np.where(square <= self.radius**2, sag, np.nan)

    def gradient(self, x: FloatArray, y: FloatArray) -> Gradient:
        """Return the slopes ∂z/∂x, ∂z/∂y [1]; NaN from the equator on."""
        return Asphere(self.radius).gradient(x, y)


@dataclass(frozen=True, slots=True)
class OffAxisParaboloid:
    """A piece of a paraboloid, its height taken along the normal at its centre.

    parent_focal_length: f of the parent ``Z = R²/4f`` [m]
    off_axis_distance: from the parent's axis to the centre of the piece [m]

    x points away from the parent's axis. With slope ``m = d/2f`` at the centre and
    ``q² = 1 + m²``, a point (u, v, w) of the tangent frame lies on the parent where
    ``4 f q w = ((u - m w)/q)² + v²``; the smaller root of this quadratic is the height.
    """

    parent_focal_length: float
    off_axis_distance: float

    def __post_init__(self) -> None:
        FOCAL_LENGTH.checked(self.parent_focal_length, SurfaceError, "parent_focal_length")
        LENGTH.checked(self.off_axis_distance, SurfaceError, "off_axis_distance")

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m]."""
        b, c, root, _ = self._quadratic(x, y)
        # 2c / (b + √…) is the small root without the cancellation of (b - √…) / 2a.
        return np.asarray(2 * c / (b + root), np.float64)

    def gradient(self, x: FloatArray, y: FloatArray) -> Gradient:
        """Return the slopes ∂z/∂x, ∂z/∂y [1]: of ``a w² − b w + c = 0``, differentiated."""
        b, c, root, slope = self._quadratic(x, y)
        q2 = 1 + slope**2
        w = 2 * c / (b + root)
        along_x = 2 * (np.asarray(x) - slope * w) / (q2 * root)
        return np.asarray(along_x), np.asarray(2 * np.asarray(y) / root)

    def _quadratic(
        self, x: FloatArray, y: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, float]:
        """Return b, c, √(b² − 4ac) and the slope m of ``a w² − b w + c = 0``, a = m²/q²."""
        slope = self.off_axis_distance / (2 * self.parent_focal_length)
        q2 = 1 + slope**2
        b = 2 * slope / q2 * np.asarray(x) + 4 * self.parent_focal_length * np.sqrt(q2)
        c = np.square(x) / q2 + np.square(y)
        with np.errstate(invalid="ignore"):  # beyond the rim there is no surface
            root = np.sqrt(b**2 - 4 * slope**2 / q2 * c)
        return b, c, root, slope


PAPER_MIRROR = OffAxisParaboloid(parent_focal_length=25.4e-3, off_axis_distance=50.8e-3)
"""The paper's mirror: 90° off-axis paraboloid of 50.8 mm effective focal length."""

PAPER_MIRROR_RADIUS_M = 12.7e-3

SHAPES: dict[str, Callable[..., Surface]] = {
    "flat": Flat,
    "sphere": Sphere,
    "off_axis_paraboloid": OffAxisParaboloid,
    "asphere": Asphere,
    "toroid": Toroid,
    "biconic": Biconic,
    "xy_polynomial": XYPolynomial,
    "zernike": ZernikeSurface,
    "q_bfs": QBfs,
    "q_con": QCon,
    "q_freeform": QFreeform,
    "off_axis_section": OffAxisSection,
    "sum": Sum,
}
"""The surfaces by the name that a description gives their ``shape``."""
