"""The channels beside encoder and probe: a reference sensor and an accelerometer.

Not imitated: their anti-alias filters, saturation of the accelerometer, ground loops.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import signal

from omsm_ros.core.samples.blocks import AccelerationBlock, DistanceBlock, FloatArray, Status
from omsm_ros.errors import ConfigurationError
from omsm_ros.twin.record_checks import check_numbers
from omsm_ros.twin.trajectory import Trajectory
from omsm_ros.units import MICROMETRE_M, NANOMETRE_M, PPM

# No accelerometer has content beyond 100 kHz.
_SHORTEST_PERIOD_S = 5e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferenceSensor:
    """A capacitive sensor on the carriage's own motion, as a CPL190 has it (250 µm).

    latency_s: how late it reads;  scale_ppm: it reads so much too long
    noise_m: standard deviation;  half_range_m: beyond it there is no reading
    cubic_m: error of linearity at the end of its range
    """

    latency_s: float = 0.0
    scale_ppm: float = 0.0
    noise_m: float = 2 * NANOMETRE_M
    half_range_m: float = 125 * MICROMETRE_M
    cubic_m: float = 0.0

    def __post_init__(self) -> None:
        check_numbers(
            self,
            positive=("half_range_m",),
            not_negative=("latency_s", "noise_m"),
            lags=("latency_s",),
        )

    def read(
        self, carriage: Trajectory, time: FloatArray, period: float, random: np.random.Generator
    ) -> DistanceBlock:
        """Return what it reports of the carriage for the triggers at ``time`` (n,) [s]."""
        z = carriage.at(time - self.latency_s)
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
class Accelerometer:
    """A piezoelectric accelerometer on the probe, as a PCB 356A17.

    sample_period_s: its own, None for the trigger's
    noise_m_per_s2: standard deviation of a sample, each axis
    high_pass_hz: it sees nothing at rest;  scale_ppm: it reads so much too much
    cross_talk: part of z that x and y show [1]
    """

    sample_period_s: float | None = None
    noise_m_per_s2: float = 6e-4
    high_pass_hz: float = 0.5
    scale_ppm: float = 0.0
    cross_talk: float = 0.0

    def __post_init__(self) -> None:
        check_numbers(
            self, positive=("sample_period_s", "high_pass_hz"), not_negative=("noise_m_per_s2",)
        )
        if self.sample_period_s is not None and self.sample_period_s < _SHORTEST_PERIOD_S:
            raise ConfigurationError(
                f"Accelerometer: sample_period_s is {self.sample_period_s!r}, expected "
                f"{_SHORTEST_PERIOD_S:g} or more"
            )

    def read(
        self,
        acceleration: FloatArray,
        period: float,
        random: np.random.Generator,
    ) -> AccelerationBlock:
        """Return what it reports of the probe's ``acceleration`` (n,), every ``period`` [s]."""
        z = self._high_passed(acceleration, period) * (1 + self.scale_ppm * PPM)
        noise = random.normal(0.0, self.noise_m_per_s2, (3, len(z)))
        return AccelerationBlock(
            stamp_ns=0,
            first_sample=0,
            sample_period=period,
            x=self.cross_talk * z + noise[0],
            y=self.cross_talk * z + noise[1],
            z=z + noise[2],
        )

    def _high_passed(self, values: FloatArray, period: float) -> FloatArray:
        tau = 1 / (2 * np.pi * self.high_pass_hz)
        b, a, _ = signal.cont2discrete(([tau, 0.0], [tau, 1.0]), period, method="bilinear")
        return np.asarray(signal.lfilter(b.ravel(), a, values))


def acceleration_of(motion: Trajectory) -> Trajectory:
    """Return the second derivative of a motion [m/s²]; 0.1 % low at a fiftieth of its rate."""
    second = np.diff(motion.values, 2) / motion.step**2
    return Trajectory(motion.start + motion.step, motion.step, second)
