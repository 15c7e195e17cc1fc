"""The part on the chuck: its pose, its figure error and azimuthal ripple."""

from dataclasses import dataclass, field

import numpy as np

from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.surface.posed import Pose
from omsm_ros.quantities import LENGTH, CheckedRecord
from omsm_ros.twin.record_checks import ANGLE, ANY, WIDTH, is_default
from omsm_ros.units import MICROMETRE_M, MILLIMETRE_M, NANOMETRE_M

# Each iteration reduces the error by tilt times slope, at most 1/100; it ends at the rounding of a
# millimetre [m].
_MOST_ITERATIONS = 8
_SETTLED_M = 1e-13


@dataclass(frozen=True, slots=True, kw_only=True)
class PartPose(CheckedRecord):
    """Deviation of the part from its nominal pose on the chuck.

    x_m, y_m, z_m: shift of its origin
    tilt_x_rad, tilt_y_rad: rotation about x and about y;  clocking_rad: about the spindle
    """

    x_m: float = LENGTH.of_field(0.0)
    y_m: float = LENGTH.of_field(0.0)
    z_m: float = LENGTH.of_field(0.0)
    tilt_x_rad: float = ANGLE.of_field(0.0)
    tilt_y_rad: float = ANGLE.of_field(0.0)
    clocking_rad: float = ANGLE.of_field(0.0)

    @property
    def rotation(self) -> FloatArray:
        """Rotation from the frame of the part to that of the chuck (3, 3): about x, y, then z."""
        pose = Pose(tip=self.tilt_x_rad, tilt=self.tilt_y_rad, clocking=self.clocking_rad)
        return pose.rotation


@dataclass(frozen=True, slots=True)
class MountedSurface:
    """``surface`` in its ``pose`` on the chuck; heights are along the spindle."""

    surface: Surface
    pose: PartPose

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m] of the chuck, of their broadcast shape."""
        pose, turn = self.pose, self.pose.rotation
        across, along = np.asarray(x) - pose.x_m, np.asarray(y) - pose.y_m
        z = np.zeros(np.broadcast(across, along).shape)
        for _ in range(_MOST_ITERATIONS):
            # In the frame of the part: p = Rᵀ (q - shift).
            px, py, pz = (
                turn[0, i] * across + turn[1, i] * along + turn[2, i] * z for i in range(3)
            )
            change = (self.surface.height(px, py) - pz) / turn[2, 2]
            z = z + change
            if np.all(abs(change) < _SETTLED_M):
                break
        return np.asarray(z + pose.z_m, np.float64)


def mounted_surface(surface: Surface, pose: PartPose) -> Surface:
    """Return ``surface`` in its ``pose``, or itself in the nominal pose."""
    return surface if is_default(pose) else MountedSurface(surface, pose)


# Rule of fifth degree on a disc: its centre and a hexagon, exact for waves of 8 spots to 1e-5 of
# their amplitude.
_HEXAGON = (2 / 3) ** 0.5 * np.exp(1j * np.pi / 3 * np.arange(6))


@dataclass(frozen=True, slots=True)
class UnderSpot:
    """``surface`` averaged over a disc of ``diameter`` [m]: the lateral resolution of the probe."""

    surface: Surface
    diameter: float

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the mean height [m] about x, y [m], of their broadcast shape."""
        at = self.diameter / 2 * _HEXAGON
        around = sum(self.surface.height(x + p.real, y + p.imag) for p in at)
        return np.asarray(self.surface.height(x, y) / 4 + around / 8, np.float64)


@dataclass(frozen=True, slots=True)
class FigureError(CheckedRecord):
    """Surface ``nominal`` with a figure error: astigmatism, trefoil, concentric ripple, tool marks.

    radius: of the aperture [m], where astigmatism and trefoil reach their full size
    seed: of the orientations of astigmatism and trefoil
    astigmatism, trefoil, ripple: peak to valley of each part over the aperture [m]
    ripple_pitch: from crest to crest of the rings [m]
    tool_marks: peak to valley of the scallops [m];  tool_feed: from one to the next [m]
    """

    nominal: Surface
    radius: float = field(metadata=WIDTH.metadata)
    seed: int = 1
    astigmatism: float = LENGTH.of_field(80 * NANOMETRE_M)
    trefoil: float = LENGTH.of_field(40 * NANOMETRE_M)
    ripple: float = LENGTH.of_field(8 * NANOMETRE_M)
    ripple_pitch: float = WIDTH.of_field(1.6 * MILLIMETRE_M)
    tool_marks: float = LENGTH.of_field(0.0)
    tool_feed: float = WIDTH.of_field(15 * MICROMETRE_M)

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m], of their broadcast shape."""
        return self.nominal.height(x, y) + self.deviation(x, y)

    def deviation(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height above the nominal surface [m] at x, y [m], of their broadcast shape."""
        at, radius = (np.asarray(x) + 1j * np.asarray(y)) / self.radius, np.hypot(x, y)
        first, second = np.random.default_rng(self.seed).uniform(0.0, 2 * np.pi, 2)
        # ρⁿ cos(nθ - α) is the real part of e^(-iα) (ρ e^(iθ))ⁿ.
        waves = self.astigmatism / 2 * np.exp(-1j * first)
        waves = at**2 * (waves + self.trefoil / 2 * np.exp(-1j * second) * at)
        # The even cosine keeps the rings smooth at the centre.
        rings = self.ripple / 2 * np.cos(2 * np.pi * radius / self.ripple_pitch)
        error = np.asarray(waves.real + rings, np.float64)
        if self.tool_marks:  # parabolas from cusp to cusp
            turn = radius / self.tool_feed
            error += self.tool_marks * 4 * (turn - np.rint(turn)) ** 2
        return error


@dataclass(frozen=True, slots=True)
class AzimuthalRipple(CheckedRecord):
    """A surface: ``nominal`` plus waves across every circle about the spindle axis.

    wavelength: along the circle of ``radius`` [m], rounded to a whole number a turn
    rms: of the first wave [m];  second: of the second harmonic, as a share of the first
    """

    nominal: Surface
    radius: float = field(metadata=WIDTH.metadata)
    wavelength: float = WIDTH.of_field(15 * MICROMETRE_M)
    rms: float = LENGTH.of_field(11 * NANOMETRE_M)
    second: float = ANY.of_field(0.0)

    @property
    def count(self) -> int:
        """Waves a turn."""
        return max(round(2 * np.pi * self.radius / self.wavelength), 1)

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m], of their broadcast shape."""
        phase = self.count * np.arctan2(y, x)
        waves = np.cos(phase) + self.second * np.cos(2 * phase)
        return np.asarray(self.nominal.height(x, y) + 2**0.5 * self.rms * waves, np.float64)
