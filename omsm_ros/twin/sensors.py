"""Simulate reference sensor, accelerometer, sampling instants, and the encoder of Z.

Not imitated: anti-alias filters, saturation of the accelerometer, ground loops, stamps of the
computer. Not imitated for encoders: errors of X, Y, B and C, count loss, bending of a scale. Slips
of a counter are faults of the emulators.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy import signal

from omsm_ros.core.lti.transfer_function import ComplexArray
from omsm_ros.core.streams.blocks import AccelerationBlock, DistanceBlock, FloatArray, Status
from omsm_ros.quantities import LENGTH, CheckedRecord
from omsm_ros.twin.plant import Trajectory
from omsm_ros.twin.record_checks import (
    ANGLE,
    ANY,
    DAMPING,
    FREQUENCY,
    LAG,
    NOT_NEGATIVE,
    OFFSET,
    PARTS_PER_MILLION,
    SENSOR_PERIOD,
    SIZE,
    WIDTH,
    is_default,
)
from omsm_ros.units import MICROMETRE_M, NANOMETRE_M, PPM

# One of 10⁹ draws of a normal distribution lies beyond 6.1 σ.
_JITTER_LIMIT = 7.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferenceSensor(CheckedRecord):
    """Capacitive sensor on the motion of the slide, as a CPL190 (250 µm).

    latency_s: of the reading;  scale_ppm: relative error, positive for a long reading
    noise_m: standard deviation;  half_range_m: largest distance from zero with a reading
    cubic_m: linearity error at the end of its range
    """

    latency_s: float = LAG.of_field(0.0)
    scale_ppm: float = PARTS_PER_MILLION.of_field(0.0)
    noise_m: float = SIZE.of_field(2 * NANOMETRE_M)
    half_range_m: float = WIDTH.of_field(125 * MICROMETRE_M)
    cubic_m: float = LENGTH.of_field(0.0)

    def read(
        self, slide: Trajectory, time: FloatArray, period: float, random: np.random.Generator
    ) -> DistanceBlock:
        """Return the readings of the motion of the slide for triggers at ``time`` (n,) [s]."""
        z = slide.at(time - self.latency_s)
        said = z * (1 + self.scale_ppm * PPM) + self.cubic_m * (z / self.half_range_m) ** 3
        in_range = abs(z) <= self.half_range_m
        noisy = said + random.normal(0.0, self.noise_m, len(z))
        return DistanceBlock(
            stamp_ns=0,
            first_sample=0,
            sample_period=period,
            distance=np.where(in_range, noisy, np.nan),
            status=np.where(in_range, Status.OK, Status.OUT_OF_RANGE).astype(np.uint8),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class AccelerationSensor(CheckedRecord):
    """Piezoelectric accelerometer on the probe, as a PCB 356A17.

    sample_period_s: of the sensor, None for that of the trigger
    noise_m_per_s2: standard deviation of a sample on each axis
    high_pass_hz: cutoff frequency;  scale_ppm: relative error, positive for a large reading
    cross_talk: share of z in x and y [1]
    """

    sample_period_s: float | None = SENSOR_PERIOD.of_field(None)
    noise_m_per_s2: float = NOT_NEGATIVE.of_field(6e-4)
    high_pass_hz: float = FREQUENCY.of_field(0.5)
    scale_ppm: float = PARTS_PER_MILLION.of_field(0.0)
    cross_talk: float = ANY.of_field(0.0)

    def read(
        self, acceleration: FloatArray, period: float, random: np.random.Generator
    ) -> AccelerationBlock:
        """Return the readings for an ``acceleration`` (n,) of the probe, every ``period`` [s]."""
        tau = 1 / (2 * np.pi * self.high_pass_hz)
        b, a, _ = signal.cont2discrete(([tau, 0.0], [tau, 1.0]), period, method="bilinear")
        z = signal.lfilter(b.ravel(), a, acceleration) * (1 + self.scale_ppm * PPM)
        noise = random.normal(0.0, self.noise_m_per_s2, (3, len(z)))
        return AccelerationBlock(
            stamp_ns=0,
            first_sample=0,
            sample_period=period,
            x=self.cross_talk * z + noise[0],
            y=self.cross_talk * z + noise[1],
            z=z + noise[2],
        )


def acceleration_of(motion: Trajectory) -> Trajectory:
    """Return the second derivative of a motion [m/s²], 0.1 % low at 1/50 of its rate."""
    second = np.diff(motion.values, 2) / motion.step**2
    return Trajectory(motion.start + motion.step, motion.step, second)


class Instants(NamedTuple):
    """Sampling instants of trigger, encoders of Z and C, and probe [s], (n,)."""

    trigger: FloatArray
    z: FloatArray
    c: FloatArray
    probe: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockErrors(CheckedRecord):
    """Deviations of the sampling instants from the trigger count; none by default.

    trigger_jitter_s: rms of all devices in common;  probe_jitter_s: rms of the probe alone
    probe_offset_s: delay of the samples of the probe
    probe_drift_ppm: deviation of its clock, positive for a slow clock
    z_latch_late_s, c_latch_late_s: delay of the latch of the encoder after the trigger
    """

    trigger_jitter_s: float = LAG.of_field(0.0)
    probe_jitter_s: float = LAG.of_field(0.0)
    probe_offset_s: float = OFFSET.of_field(0.0)
    probe_drift_ppm: float = PARTS_PER_MILLION.of_field(0.0)
    z_latch_late_s: float = OFFSET.of_field(0.0)
    c_latch_late_s: float = OFFSET.of_field(0.0)

    @property
    def lag_s(self) -> float:
        """Delay of the encoder of Z relative to the reading, at the start."""
        return self.z_latch_late_s - self.probe_offset_s

    def reach_s(self, duration: float) -> float:
        """Return the largest deviation of a sample from its nominal instant [s]."""
        jitter = _JITTER_LIMIT * (self.trigger_jitter_s + self.probe_jitter_s)
        late = max(abs(self.z_latch_late_s), abs(self.c_latch_late_s), abs(self.probe_offset_s))
        return jitter + late + abs(self.probe_drift_ppm) * PPM * duration

    def instants(self, time: FloatArray, random: np.random.Generator) -> Instants:
        """Return the instants of all devices for nominal ones ``time`` (n,) [s]."""
        if is_default(self):
            return Instants(time, time, time, time)
        together, alone = np.clip(random.normal(size=(2, len(time))), -_JITTER_LIMIT, _JITTER_LIMIT)
        trigger = time + self.trigger_jitter_s * together
        probe = trigger + self.probe_jitter_s * alone + self.probe_offset_s
        return Instants(
            trigger=trigger,
            z=trigger + self.z_latch_late_s,
            c=trigger + self.c_latch_late_s,
            probe=probe + self.probe_drift_ppm * PPM * time,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Pitch(CheckedRecord):
    """Pitch α of the slide, by which the encoder measures ``E = L α`` in addition (Abbe error).

    arm_m: L, offset of the encoder from the line of the probe
    rad_per_m: curvature of the way;  periodic_rad, period_m: of its rollers or screw
    rad_per_m_s2: pitch under acceleration, through a mode of frequency_hz and damping_ratio
    """

    arm_m: float = field(metadata=LENGTH.metadata)
    rad_per_m: float = ANY.of_field(0.0)
    periodic_rad: float = ANGLE.of_field(0.0)
    period_m: float = WIDTH.of_field(1e-3)
    rad_per_m_s2: float = ANY.of_field(0.0)
    frequency_hz: float = FREQUENCY.of_field(60.0)
    damping_ratio: float = DAMPING.of_field(0.05)

    @property
    def _mode(self) -> tuple[list[float], list[float]]:
        omega = 2 * np.pi * self.frequency_hz
        ratio = [1.0, 2 * self.damping_ratio * omega, omega**2]
        return [self.rad_per_m_s2 * omega**2, 0.0, 0.0], ratio

    def angle(self, slide: Trajectory) -> FloatArray:
        """Return the pitch α [rad] along the motion of the slide, (n,)."""
        z = slide.values
        steady = self.rad_per_m * z + self.periodic_rad * np.sin(2 * np.pi * z / self.period_m)
        if not self.rad_per_m_s2:
            return np.asarray(steady, np.float64)
        numerator, denominator, _ = signal.cont2discrete(self._mode, slide.step, method="foh")
        return np.asarray(steady + signal.lfilter(numerator.ravel(), denominator, z - z[0]))

    def response(self, s: ComplexArray) -> ComplexArray:
        """Return ``E / X_d`` at ``s`` [rad/s], without the periodic part."""
        numerator, denominator = self._mode
        dynamic = np.polyval(numerator, s) / np.polyval(denominator, s)
        return np.asarray(self.arm_m * (self.rad_per_m + dynamic), np.complex128)


@dataclass(frozen=True, slots=True, kw_only=True)
class EncoderErrors(CheckedRecord):
    """Errors of the encoder of Z; none by default.

    scale_ppm: relative error, positive for a long reading
    interpolation_m, signal_period_m: ``interpolation_m · sin(2π z / signal_period_m)``
    resolution_m: of its counts, 0 for none
    pitch: of the slide, by which the encoder measures another motion than that of the probe
    """

    scale_ppm: float = PARTS_PER_MILLION.of_field(0.0)
    interpolation_m: float = LENGTH.of_field(0.0)
    signal_period_m: float = WIDTH.of_field(4e-6)
    resolution_m: float = SIZE.of_field(0.0)
    pitch: Pitch | None = None

    def seen(self, slide: Trajectory) -> Trajectory:
        """Return the position under the encoder [m], without errors of the encoder itself."""
        if self.pitch is None:
            return slide
        values = slide.values + self.pitch.arm_m * self.pitch.angle(slide)
        return Trajectory(slide.start, slide.step, values)

    def read(self, position: FloatArray, noise: FloatArray) -> FloatArray:
        """Return the reading at ``position`` (n,) [m], with ``noise`` (n,) [m]."""
        if is_default(self):
            return position + noise
        wave = self.interpolation_m * np.sin(2 * np.pi * position / self.signal_period_m)
        said = position * (1 + self.scale_ppm * PPM) + wave + noise
        step = self.resolution_m
        return np.asarray(np.round(said / step) * step if step else said, np.float64)

    def response(self, s: ComplexArray) -> ComplexArray:
        """Return the linear response from motion of the slide to reading at ``s`` [rad/s]."""
        pitch = self.pitch.response(s) if self.pitch else np.zeros_like(s)
        return np.asarray((1 + self.scale_ppm * PPM) * (1 + pitch), np.complex128)
