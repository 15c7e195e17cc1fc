"""What the encoder of Z makes of the carriage's motion.

Not imitated: errors of the encoders of X, Y, B and C, count loss, a scale that bends.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import signal

from omsm_ros.core.dynamics.transfer_function import ComplexArray
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.twin.record_checks import check_numbers, is_default
from omsm_ros.twin.trajectory import Trajectory
from omsm_ros.units import PPM


@dataclass(frozen=True, slots=True, kw_only=True)
class Pitch:
    """The carriage pitches, and the encoder, ``arm_m`` beside the probe's line, sees ``E = L α``.

    rad_per_m: steady bend of the way;  periodic_rad, period_m: of its rollers or screw
    rad_per_m_s2: pitch under acceleration, through a mode of frequency_hz and damping_ratio
    """

    arm_m: float
    rad_per_m: float = 0.0
    periodic_rad: float = 0.0
    period_m: float = 1e-3
    rad_per_m_s2: float = 0.0
    frequency_hz: float = 60.0
    damping_ratio: float = 0.05

    def __post_init__(self) -> None:
        check_numbers(self, positive=("period_m", "frequency_hz", "damping_ratio"))

    @property
    def _mode(self) -> tuple[list[float], list[float]]:
        omega = 2 * np.pi * self.frequency_hz
        ratio = [1.0, 2 * self.damping_ratio * omega, omega**2]
        return [self.rad_per_m_s2 * omega**2, 0.0, 0.0], ratio

    def angle(self, carriage: Trajectory) -> FloatArray:
        """Return the pitch α [rad] along the carriage's motion, (n,)."""
        z = carriage.values
        steady = self.rad_per_m * z + self.periodic_rad * np.sin(2 * np.pi * z / self.period_m)
        if not self.rad_per_m_s2:
            return np.asarray(steady, np.float64)
        numerator, denominator, _ = signal.cont2discrete(self._mode, carriage.step, method="foh")
        return np.asarray(steady + signal.lfilter(numerator.ravel(), denominator, z - z[0]))

    def response(self, s: ComplexArray) -> ComplexArray:
        """Return ``E / X_d`` at ``s`` [rad/s], without the periodic part."""
        numerator, denominator = self._mode
        dynamic = np.polyval(numerator, s) / np.polyval(denominator, s)
        return np.asarray(self.arm_m * (self.rad_per_m + dynamic), np.complex128)


@dataclass(frozen=True, slots=True, kw_only=True)
class EncoderErrors:
    """Of the encoder of Z; nothing by default.

    scale_ppm: reads so much too long
    interpolation_m, signal_period_m: ``interpolation_m · sin(2π z / signal_period_m)``
    resolution_m: of its counts, 0 for none
    pitch: it sees another motion than the probe
    """

    scale_ppm: float = 0.0
    interpolation_m: float = 0.0
    signal_period_m: float = 4e-6
    resolution_m: float = 0.0
    pitch: Pitch | None = None

    def __post_init__(self) -> None:
        check_numbers(self, positive=("signal_period_m",), not_negative=("resolution_m",))

    def seen(self, carriage: Trajectory) -> Trajectory:
        """Return the position under the encoder [m], before its own errors."""
        if self.pitch is None:
            return carriage
        values = carriage.values + self.pitch.arm_m * self.pitch.angle(carriage)
        return Trajectory(carriage.start, carriage.step, values)

    def read(self, position: FloatArray, noise: FloatArray) -> FloatArray:
        """Return what it says at ``position`` (n,) [m], with ``noise`` (n,) [m]."""
        if is_default(self):
            return position + noise
        wave = self.interpolation_m * np.sin(2 * np.pi * position / self.signal_period_m)
        said = position * (1 + self.scale_ppm * PPM) + wave + noise
        step = self.resolution_m
        return np.asarray(np.round(said / step) * step if step else said, np.float64)

    def response(self, s: ComplexArray) -> ComplexArray:
        """Return reading over motion of the carriage at ``s`` [rad/s], its linear part."""
        pitch = self.pitch.response(s) if self.pitch else np.zeros_like(s)
        return np.asarray((1 + self.scale_ppm * PPM) * (1 + pitch), np.complex128)
