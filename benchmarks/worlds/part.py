"""Shape the part to be measured: nominal surface, pose on the spindle and true heights.

Lengths in metres, angles in radians. Heights count along the spindle's axis, towards the probe.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from benchmarks.worlds.figure import Figure, Truth, truth_of

Array = np.ndarray
INCH_M = 25.4e-3
POSE_ITERATIONS = 3
"""Each one reduces the error by tilt × slope, some 2e-4."""


@dataclass(frozen=True)
class OffAxisParaboloid:
    """Off-axis piece of z = r²/(4f), its height taken along the normal at its centre.

    x points away from the parent's axis. The defaults are a 90° mirror of one inch of parent focus.
    """

    parent_focus: float = INCH_M
    off_axis: float = 2 * INCH_M

    def height(self, x: Array, y: Array) -> Array:
        """Solve the quadric a h² − 2 b h + c = 0 for its small root; shapes of x and y."""
        f = self.parent_focus
        slope = self.off_axis / (2 * f)
        root = np.hypot(1.0, slope)
        cos, sin = 1 / root, slope / root
        # P = P0 + x (cos, 0, sin) + y (0, 1, 0) + h (−sin, 0, cos), put into X² + Y² = 4 f Z.
        a = sin**2
        b = self.off_axis * sin + x * cos * sin + 2 * f * cos
        c = (x * cos) ** 2 + np.square(y)
        return c / (b + np.sqrt(b**2 - a * c))


@dataclass(frozen=True)
class Sphere:
    """Sphere through the origin; a positive radius is concave towards the probe."""

    curvature_radius: float = 0.1

    def height(self, x: Array, y: Array) -> Array:
        """Return the exact sag, stable for small x and y."""
        r2 = np.square(x) + np.square(y)
        big = self.curvature_radius
        return r2 / (big + np.sign(big) * np.sqrt(big**2 - r2))


@dataclass(frozen=True)
class Flat:
    """Plane across the spindle's axis."""

    def height(self, x: Array, y: Array) -> Array:
        """Return zeros of the shape of x and y."""
        return np.zeros(np.broadcast(x, y).shape)


@dataclass(frozen=True)
class Toric:
    """Circle of radius ``radius_x`` in x–z, turned about an axis along x at ``radius_y``."""

    radius_x: float = 0.15
    radius_y: float = 0.2

    def height(self, x: Array, y: Array) -> Array:
        """Return the exact sag of the surface of revolution."""
        sag = Sphere(self.radius_x).height(x, 0.0)
        inner = self.radius_y - sag
        return sag + np.square(y) / (inner + np.sqrt(inner**2 - np.square(y)))


Nominal = OffAxisParaboloid | Sphere | Flat | Toric


@dataclass(frozen=True)
class Pose:
    """Clamping of the part: q = Rz(clocking) Ry(tilt) Rx(tip) p + (x, y, piston)."""

    x: float = 0.0
    y: float = 0.0
    piston: float = 0.0
    tip: float = 0.0
    tilt: float = 0.0
    clocking: float = 0.0

    @cached_property
    def rotation(self) -> Array:
        """Return the 3 × 3 matrix from the part's frame to the spindle's."""
        return _turn(2, self.clocking) @ _turn(1, self.tilt) @ _turn(0, self.tip)

    def to_part(self, q: tuple[Array, Array, Array]) -> list[Array]:
        """Return the coordinates (x, y, z) in the part's frame of points of the spindle's."""
        moved = (q[0] - self.x, q[1] - self.y, q[2] - self.piston)
        return [sum(self.rotation[j, i] * moved[j] for j in range(3)) for i in range(3)]


def _turn(axis: int, angle: float) -> Array:
    """Return the right-handed rotation by ``angle`` about axis 0, 1 or 2."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = np.cos(angle)
    matrix[i, j], matrix[j, i] = -np.sin(angle), np.sin(angle)
    return matrix


@dataclass(frozen=True)
class Part:
    """Nominal surface plus figure error inside a circular aperture."""

    nominal: Nominal = field(default_factory=OffAxisParaboloid)
    figure: Figure | None = None
    radius: float = INCH_M / 2

    def deviation(self, x: Array, y: Array) -> Array:
        """Return the height above nominal at (x, y) of the part's frame."""
        if self.figure is None:
            return np.zeros(np.broadcast(x, y).shape)
        return self.figure.height(x, y)

    def height(self, x: Array, y: Array) -> Array:
        """Return nominal height plus deviation at (x, y) of the part's frame."""
        return self.nominal.height(x, y) + self.deviation(x, y)

    def posed_height(self, x: Array, y: Array, pose: Pose) -> Array:
        """Return where a line along the spindle's axis at (x, y) meets the part as clamped."""
        h = self.nominal.height(*pose.to_part((x, y, np.full(np.shape(x), pose.piston)))[:2])
        for _ in range(POSE_ITERATIONS):
            px, py, pz = pose.to_part((x, y, h))
            h = h - (pz - self.nominal.height(px, py))
        px, py, _ = pose.to_part((x, y, h))
        return h + self.deviation(px, py)

    def cosine(self, x: Array, y: Array) -> Array:
        """Return the cosine between the nominal surface's normal and the axis."""
        return 1 / np.sqrt(1 + sum(s**2 for s in slopes(self.nominal.height, x, y)))

    def truth(self, along: str = "normal") -> Truth:
        """Return PV, rms and Zernike terms of the deviation, ``along`` the "normal" or "z"."""
        if along not in ("normal", "z"):
            raise ValueError(f'along has to be "normal" or "z", not {along!r}')

        def error(x: Array, y: Array) -> Array:
            return self.deviation(x, y) * (self.cosine(x, y) if along == "normal" else 1.0)

        return truth_of(error, self.radius)


def slopes(
    height: Callable[[Array, Array], Array], x: Array, y: Array, step: float = 1e-6
) -> tuple[Array, Array]:
    """Return the slopes along x and y by central differences over ± ``step``."""
    along_x = (height(x + step, y) - height(x - step, y)) / (2 * step)
    return along_x, (height(x, y + step) - height(x, y - step)) / (2 * step)
