"""Surfaces in another pose: moved and rotated on the machine, or an off-axis section.

Heights stay along the machine's z. A point q of the machine is ``p = Rᵀ (q − t)`` in the frame of
the part; the height over x, y solves ``p_z = h(p_x, p_y)`` by Newton's method.
"""

from dataclasses import dataclass, field

import numpy as np

from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.surface.height_grid import Gradient, gradient_of
from omsm_ros.errors import SurfaceError
from omsm_ros.quantities import LENGTH, TURN, CheckedRecord

# Iterations of Newton's method, which doubles the digits each time; NaN if it does not converge.
_MOST_STEPS = 25
_SETTLED = 4 * np.finfo(np.float64).eps


@dataclass(frozen=True, slots=True, kw_only=True)
class Pose(CheckedRecord):
    """Pose of a part relative to the frame of the machine.

    x, y, piston: position of its origin along x, y, z [m]
    tip, tilt, clocking: rotation about x, then about y, then about z [rad]
    """

    x: float = LENGTH.of_field(0.0)
    y: float = LENGTH.of_field(0.0)
    piston: float = LENGTH.of_field(0.0)
    tip: float = TURN.of_field(0.0)
    tilt: float = TURN.of_field(0.0)
    clocking: float = TURN.of_field(0.0)
    error = SurfaceError

    @property
    def origin(self) -> FloatArray:
        """Origin of the part in the machine's frame (3,) [m]."""
        return np.array([self.x, self.y, self.piston])

    @property
    def rotation(self) -> FloatArray:
        """Rotation R (3, 3) from the part's frame to the machine's."""
        about_x, about_y, about_z = self._turns()
        return np.asarray(about_z @ about_y @ about_x, np.float64)

    def rotation_rates(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the derivatives (3, 3) of R by tip, tilt and clocking."""
        about_x, about_y, about_z = self._turns()
        # The derivative of a rotation is the rotation times the cross product with its axis.
        return (
            np.asarray(about_z @ about_y @ about_x @ _CROSS[0]),
            np.asarray(about_z @ about_y @ _CROSS[1] @ about_x),
            np.asarray(_CROSS[2] @ about_z @ about_y @ about_x),
        )

    def _turns(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        angles = np.array([self.tip, self.tilt, self.clocking])
        (sx, sy, sz), (cx, cy, cz) = np.sin(angles), np.cos(angles)
        return (
            np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]]),
            np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]]),
            np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]]),
        )


_CROSS = (
    np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    np.array([[0.0, 0, 1], [0, 0, 0], [-1, 0, 0]]),
    np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 0]]),
)


@dataclass(frozen=True, slots=True)
class PosedSurface:
    """A ``surface`` in a ``pose`` on the machine."""

    surface: Surface
    pose: Pose

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m] of the machine; NaN where the surface has none."""
        return np.asarray(self._met(x, y)[2] + self.pose.piston)

    def gradient(self, x: FloatArray, y: FloatArray) -> Gradient:
        """Return the slopes ∂z/∂x, ∂z/∂y [1]."""
        return _turned_slopes(self.surface, self.pose.rotation, self._met(x, y))

    def _met(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        across, along = np.asarray(x) - self.pose.x, np.asarray(y) - self.pose.y
        return _intersected(self.surface, self.pose.rotation, across, along)


@dataclass(frozen=True, slots=True)
class OffAxisSection:
    """A section of a ``parent``, with the height along the parent's normal at its centre.

    distance: from the parent's axis to the centre of the section [m]
    azimuth: of the centre about the parent's axis, from the parent's x [rad]

    x points away from the parent's axis.
    """

    parent: Surface
    distance: float
    azimuth: float = 0.0
    _centre: FloatArray = field(init=False, repr=False, compare=False)
    _frame: FloatArray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        LENGTH.checked(self.distance, SurfaceError, "distance")
        TURN.checked(self.azimuth, SurfaceError, "azimuth")
        away = np.array([np.cos(self.azimuth), np.sin(self.azimuth)])
        x, y = (np.atleast_1d(self.distance * part) for part in away)
        height = float(self.parent.height(x, y)[0])
        slopes = np.array([float(part[0]) for part in gradient_of(self.parent, x, y)])
        if not np.all(np.isfinite([height, *slopes])):
            raise SurfaceError("surface.off_axis", distance=self.distance, parent=repr(self.parent))
        normal = np.array([-slopes[0], -slopes[1], 1.0]) / np.sqrt(1 + slopes @ slopes)
        along = np.array([away[0], away[1], slopes @ away])
        along /= np.linalg.norm(along)
        frame = np.stack([along, np.cross(normal, along), normal])
        object.__setattr__(self, "_centre", np.array([float(x[0]), float(y[0]), height]))
        object.__setattr__(self, "_frame", frame)

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m]; NaN where the parent has none."""
        return _intersected(self.parent, self._frame, x, y, self._centre)[2]

    def gradient(self, x: FloatArray, y: FloatArray) -> Gradient:
        """Return the slopes ∂z/∂x, ∂z/∂y [1]."""
        found = _intersected(self.parent, self._frame, x, y, self._centre)
        return _turned_slopes(self.parent, self._frame, found)


def _intersected(
    surface: Surface, rotation: FloatArray, x: FloatArray, y: FloatArray,
    centre: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Return x and y in the frame of the surface, and the height z in the rotated frame, over x, y.

    rotation: R;  centre: of the rotated frame on the surface (3,) [m], its origin if None
    """
    across, along = (np.asarray(v, np.float64) for v in np.broadcast_arrays(x, y))
    z = np.zeros(across.shape)
    cx, cy, cz = np.zeros(3) if centre is None else centre
    a, b = (rotation[0, i] * across + rotation[1, i] * along for i in range(2))
    c = rotation[0, 2] * across + rotation[1, 2] * along
    reach = float(np.max(np.abs([across, along]), initial=0.0)) + float(np.abs([cx, cy, cz]).max())
    for _ in range(_MOST_STEPS):
        px, py = a + rotation[2, 0] * z + cx, b + rotation[2, 1] * z + cy
        missed = c + rotation[2, 2] * z + cz - surface.height(px, py)
        slope_x, slope_y = gradient_of(surface, px, py)
        rate = rotation[2, 2] - slope_x * rotation[2, 0] - slope_y * rotation[2, 1]
        change = missed / rate
        z = z - change
        largest = float(np.nanmax(np.abs(change), initial=0.0))
        if largest <= _SETTLED * reach:
            break
    z = np.where(np.abs(change) <= 1e3 * _SETTLED * reach, z, np.nan)
    return a + rotation[2, 0] * z + cx, b + rotation[2, 1] * z + cy, z


def _turned_slopes(
    surface: Surface, rotation: FloatArray, found: tuple[FloatArray, FloatArray, FloatArray]
) -> Gradient:
    """Return the slopes in the rotated frame, from the normal R (−∂x, −∂y, 1)."""
    slope_x, slope_y = gradient_of(surface, found[0], found[1])
    nx, ny, nz = (
        rotation[i, 2] - rotation[i, 0] * slope_x - rotation[i, 1] * slope_y for i in range(3)
    )
    return np.asarray(-nx / nz), np.asarray(-ny / nz)


@dataclass(frozen=True, slots=True)
class Sum:
    """The sum of the heights of several surfaces in one frame."""

    parts: tuple[Surface, ...]

    def __post_init__(self) -> None:
        if not self.parts:
            raise SurfaceError("surface.empty_sum")

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m]."""
        return np.asarray(sum(part.height(x, y) for part in self.parts), np.float64)

    def gradient(self, x: FloatArray, y: FloatArray) -> Gradient:
        """Return the slopes ∂z/∂x, ∂z/∂y [1]."""
        along_x, along_y = gradient_of(self.parts[0], x, y)
        for part in self.parts[1:]:
            more = gradient_of(part, x, y)
            along_x, along_y = along_x + more[0], along_y + more[1]
        return along_x, along_y
