"""How the part sits on the chuck: six degrees of freedom from where it should."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from omsm_ros.core.machine.surface_height import Surface
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.twin.record_checks import check_numbers, is_default

# Each turn of the iteration leaves tilt times slope, at most a hundredth, of the error before;
# it ends when what is left is beyond rounding of a millimetre [m].
_MOST_ITERATIONS = 8
_SETTLED_M = 1e-13


@dataclass(frozen=True, slots=True, kw_only=True)
class PartPose:
    """How the part sits on the chuck, from where it should.

    x_m, y_m, z_m: shift of its origin
    tilt_x_rad, tilt_y_rad: rotation about x and about y;  clocking_rad: about the spindle
    """

    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 0.0
    tilt_x_rad: float = 0.0
    tilt_y_rad: float = 0.0
    clocking_rad: float = 0.0

    def __post_init__(self) -> None:
        check_numbers(self)

    @property
    def rotation(self) -> FloatArray:
        """From the part's frame to the chuck's (3, 3): about x, then y, then z."""
        (sx, sy, sz), (cx, cy, cz) = (
            f(np.array([self.tilt_x_rad, self.tilt_y_rad, self.clocking_rad]))
            for f in (np.sin, np.cos)
        )
        about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
        about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
        about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
        return np.asarray(about_z @ about_y @ about_x, np.float64)


@dataclass(frozen=True, slots=True)
class PosedSurface:
    """``surface`` in the pose that it has on the chuck; heights are along the spindle."""

    surface: Surface
    pose: PartPose

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m] of the chuck, of their broadcast shape."""
        pose, turn = self.pose, self.pose.rotation
        across, along = np.asarray(x) - pose.x_m, np.asarray(y) - pose.y_m
        z = np.zeros(np.broadcast(across, along).shape)
        for _ in range(_MOST_ITERATIONS):
            # In the part's frame: p = Rᵀ (q - shift).
            px, py, pz = (
                turn[0, i] * across + turn[1, i] * along + turn[2, i] * z for i in range(3)
            )
            change = (self.surface.height(px, py) - pz) / turn[2, 2]
            z = z + change
            if np.all(abs(change) < _SETTLED_M):
                break
        return np.asarray(z + pose.z_m, np.float64)


def posed(surface: Surface, pose: PartPose) -> Surface:
    """Return ``surface`` on the chuck; itself where it sits as it should."""
    return surface if is_default(pose) else PosedSurface(surface, pose)
