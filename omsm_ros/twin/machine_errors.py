"""What the machine does that no encoder tells: the part's pose and thermal drift.

Signs: a positive height brings the workpiece nearer to the probe.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from omsm_ros.core.machine.surface_height import Surface
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.twin.quantities import check_numbers, is_default
from omsm_ros.twin.trajectory import Trajectory

# Each turn of the iteration brings tilt times slope, at most a hundredth, of the error before.
_POSE_ITERATIONS = 5


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
        """Height [m] at x, y [m] of the chuck, of their broadcast shape."""
        pose, turn = self.pose, self.pose.rotation
        across, along = np.asarray(x) - pose.x_m, np.asarray(y) - pose.y_m
        z = self.surface.height(across, along)
        for _ in range(_POSE_ITERATIONS):
            # In the part's frame: p = Rᵀ (q - shift).
            px, py, pz = (
                turn[0, i] * across + turn[1, i] * along + turn[2, i] * z for i in range(3)
            )
            z = z + (self.surface.height(px, py) - pz) / turn[2, 2]
        return np.asarray(z + pose.z_m, np.float64)


def posed(surface: Surface, pose: PartPose) -> Surface:
    """``surface`` on the chuck; itself where it sits as it should."""
    return surface if is_default(pose) else PosedSurface(surface, pose)


@dataclass(frozen=True, slots=True, kw_only=True)
class Drift:
    """Height of the workpiece over time, thermal as a rule; zero at time 0.

    ramp_m_per_s: steady
    exponential_m, time_constant_s: ``exponential_m · (1 - exp(-t/τ))``
    sine_m, period_s: amplitude and period
    random_walk_m_per_root_s: standard deviation after one second
    """

    ramp_m_per_s: float = 0.0
    exponential_m: float = 0.0
    time_constant_s: float = 60.0
    sine_m: float = 0.0
    period_s: float = 60.0
    random_walk_m_per_root_s: float = 0.0

    def __post_init__(self) -> None:
        check_numbers(
            self,
            positive=("time_constant_s", "period_s"),
            not_negative=("random_walk_m_per_root_s",),
        )

    def height(self, time: FloatArray, walk: Trajectory) -> FloatArray:
        """Height [m] at ``time`` [s]; ``walk`` is a random walk of one metre per root second."""
        return np.asarray(
            self.ramp_m_per_s * time
            + self.exponential_m * -np.expm1(-time / self.time_constant_s)
            + self.sine_m * np.sin(2 * np.pi * time / self.period_s)
            + (
                self.random_walk_m_per_root_s * walk.at(time)
                if self.random_walk_m_per_root_s
                else 0.0
            )
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineErrors:
    """All that the machine does and no encoder tells; nothing by default."""

    pose: PartPose = field(default_factory=PartPose)
    drift: Drift = field(default_factory=Drift)


def random_walk(times: FloatArray, random: np.random.Generator) -> FloatArray:
    """Random walk (n,) at equidistant ``times``, of standard deviation √t and zero at time 0."""
    steps = random.normal(0.0, np.sqrt(times[1] - times[0]), len(times))
    walk = np.cumsum(steps)
    return np.asarray(walk - walk[np.argmin(abs(times))])
