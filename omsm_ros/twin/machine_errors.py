"""Machine errors that no encoder measures: spindle, slides, drift, pose, mount of the probe.

Each is a shift of the workpiece relative to the probe; positive z brings it nearer. Not imitated:
errors of Y and of the angle of C, roll of the slides, thermal deformation of the part.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from omsm_ros.core.kinematics.kinematics import Geometry
from omsm_ros.core.kinematics.trajectories import AxisPositions
from omsm_ros.core.lti.transfer_function import ComplexArray
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.quantities import LENGTH, CheckedRecord
from omsm_ros.twin.part import PartPose
from omsm_ros.twin.plant import Trajectory
from omsm_ros.twin.record_checks import (
    ANGLE,
    ANGLE_NOISE,
    ANY,
    DURATION,
    FREQUENCY,
    NOT_NEGATIVE,
    SIZE,
    WIDTH,
)


class Shift(NamedTuple):
    """Shift of the workpiece relative to the probe, in the machine frame [m]; (n,) or (1,)."""

    x: FloatArray
    y: FloatArray
    z: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Drift(CheckedRecord):
    """Drift of the height of the workpiece, zero at time 0.

    ramp_m_per_s: constant rate
    exponential_m, time_constant_s: ``exponential_m · (1 - exp(-t/τ))``
    sine_m, period_s: amplitude and period
    random_walk_m_per_root_s: standard deviation after one second
    """

    ramp_m_per_s: float = ANY.of_field(0.0)
    exponential_m: float = LENGTH.of_field(0.0)
    time_constant_s: float = DURATION.of_field(60.0)
    sine_m: float = LENGTH.of_field(0.0)
    period_s: float = DURATION.of_field(60.0)
    random_walk_m_per_root_s: float = NOT_NEGATIVE.of_field(0.0)

    def height(self, time: FloatArray, walk: Trajectory) -> FloatArray:
        """Return the height [m] at ``time`` [s]; ``walk``: random, one metre per root second."""
        moved = (
            self.ramp_m_per_s * time
            + self.exponential_m * -np.expm1(-time / self.time_constant_s)
            + self.sine_m * np.sin(2 * np.pi * time / self.period_s)
        )
        if self.random_walk_m_per_root_s:
            moved = moved + self.random_walk_m_per_root_s * walk.at(time)
        return np.asarray(moved, np.float64)


@dataclass(frozen=True, slots=True, kw_only=True)
class Harmonic(CheckedRecord):
    """Rotating vector ``amplitude · (cos φ, sin φ)`` with ``φ = per_turn · c + phase_rad``.

    amplitude: in the unit of its quantity; for a single direction only the cosine counts
    per_turn: turns of the vector per turn of the spindle; negative for the opposite direction
    """

    amplitude: float = field(metadata=ANY.metadata)
    per_turn: int
    phase_rad: float = ANGLE.of_field(0.0)

    def vector(self, c: FloatArray) -> ComplexArray:
        """Return the vector as x + iy at spindle angle ``c`` [rad], of its shape."""
        turned = np.exp(1j * (self.per_turn * c + self.phase_rad))
        return np.asarray(self.amplitude * turned, np.complex128)


@dataclass(frozen=True, slots=True, kw_only=True)
class SpindleError(CheckedRecord):
    """Synchronous and asynchronous error motion of the spindle (ISO 230-7).

    axial_m, radial_m, tilt_rad: harmonics;  tilt rotates about the origin of X and Y
    axial_noise_m, radial_noise_m, tilt_noise_rad: rms of the asynchronous part, white up to
        half the rate of the trigger
    """

    axial_m: tuple[Harmonic, ...] = ()
    radial_m: tuple[Harmonic, ...] = ()
    tilt_rad: tuple[Harmonic, ...] = ()
    axial_noise_m: float = SIZE.of_field(0.0)
    radial_noise_m: float = SIZE.of_field(0.0)
    tilt_noise_rad: float = ANGLE_NOISE.of_field(0.0)

    def shift(self, time: FloatArray, slides: AxisPositions, noise: list[Trajectory]) -> Shift:
        """Return the shift of the workpiece; ``noise``: five signals of variance one."""
        axial, radial, tilt = (
            sum((h.vector(slides.c) for h in harmonics), np.zeros(1, np.complex128))
            for harmonics in (self.axial_m, self.radial_m, self.tilt_rad)
        )
        if noise:
            first, *others = (n.at(time) for n in noise)
            axial = axial + self.axial_noise_m * first
            radial = radial + self.radial_noise_m * (others[0] + 1j * others[1])
            tilt = tilt + self.tilt_noise_rad * (others[2] + 1j * others[3])
        z = axial.real + tilt.real * slides.x + tilt.imag * slides.y
        return Shift(radial.real, radial.imag, z)


@dataclass(frozen=True, slots=True, kw_only=True)
class Straightness(CheckedRecord):
    """Straightness deviation of a slide over its position p.

    ``bow_m · (p / half_travel_m)² + periodic_m · sin(2π p / period_m)``
    """

    bow_m: float = LENGTH.of_field(0.0)
    half_travel_m: float = WIDTH.of_field(0.1)
    periodic_m: float = LENGTH.of_field(0.0)
    period_m: float = WIDTH.of_field(0.01)

    def deviation(self, position: FloatArray) -> FloatArray:
        """Return the error [m] at ``position`` [m], of its shape."""
        wave = self.periodic_m * np.sin(2 * np.pi * position / self.period_m)
        return np.asarray(self.bow_m * (position / self.half_travel_m) ** 2 + wave, np.float64)


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineErrors(CheckedRecord):
    """Errors of the machine; none by default.

    pose: of the part on the chuck;  mount: true place and direction of the probe
    x_slide_along_z: straightness of X towards the probe;  z_slide_along_x: lateral, of Z
    b_wobble_rad, b_wobble_hz: oscillation of B, which its encoder measures
    """

    pose: PartPose = field(default_factory=PartPose)
    mount: Geometry = field(default_factory=Geometry)
    spindle: SpindleError = field(default_factory=SpindleError)
    x_slide_along_z: Straightness = field(default_factory=Straightness)
    z_slide_along_x: Straightness = field(default_factory=Straightness)
    drift: Drift = field(default_factory=Drift)
    b_wobble_rad: float = ANGLE.of_field(0.0)
    b_wobble_hz: float = FREQUENCY.of_field(1.0)


def random_walk(times: FloatArray, random: np.random.Generator) -> FloatArray:
    """Return a random walk (n,) at even ``times``, of standard deviation √t and zero at time 0."""
    steps = random.normal(0.0, np.sqrt(times[1] - times[0]), len(times))
    walk = np.cumsum(steps)
    return np.asarray(walk - walk[np.argmin(abs(times))])
