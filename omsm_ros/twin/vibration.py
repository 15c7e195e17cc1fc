"""Lines of vibration between workpiece and probe, free or synchronous with the spindle.

A line above half the sampling rate appears at its alias. Not imitated: broadband vibration (see
``ProbeErrors.noise_m``), lines with a variable frequency.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import ConfigurationError
from omsm_ros.twin.record_checks import check_numbers


@dataclass(frozen=True, slots=True, kw_only=True)
class VibrationLine:
    """Line ``amplitude_m · sin(2π frequency_hz t + per_turn · c + phase_rad)``.

    amplitude_m: half of peak to valley
    frequency_hz: of a free line;  per_turn: waves a turn of a synchronous line
    phase_rad: None takes a random phase
    """

    amplitude_m: float
    frequency_hz: float = 0.0
    per_turn: float = 0.0
    phase_rad: float | None = None

    def __post_init__(self) -> None:
        check_numbers(self, not_negative=("frequency_hz",))
        if not self.frequency_hz and not self.per_turn:
            raise ConfigurationError(
                "VibrationLine: frequency_hz and per_turn are both zero; give one of them"
            )

    def height(self, time: FloatArray, c: FloatArray, random_phase: float) -> FloatArray:
        """Return the height [m] at ``time`` (n,) [s] and spindle angle ``c`` (n,) [rad]."""
        phase = random_phase if self.phase_rad is None else self.phase_rad
        turning = 2 * np.pi * self.frequency_hz * time + self.per_turn * c + phase
        return np.asarray(self.amplitude_m * np.sin(turning), np.float64)

    def turn(self, duration_s: float, spindle_rad: FloatArray) -> FloatArray:
        """Return the change of its phase [rad] while the spindle turns by ``spindle_rad`` (n,)."""
        return 2 * np.pi * self.frequency_hz * duration_s + self.per_turn * spindle_rad


@dataclass(frozen=True)
class Vibration:
    """Several lines with their phases [rad]."""

    lines: Sequence[VibrationLine]
    phases: Sequence[float]

    @classmethod
    def of(cls, lines: Sequence[VibrationLine], random: np.random.Generator) -> Vibration:
        """Return the lines with random phases for those without one."""
        return cls(lines, random.uniform(0.0, 2 * np.pi, len(lines)).tolist())

    def height(
        self, middle: FloatArray, c: FloatArray, exposure_s: float, turned: FloatArray
    ) -> FloatArray:
        """Return the sum of all lines, averaged over exposures [m].

        middle: of the exposures (n,) [s];  c: spindle angle then (n,) [rad]
        turned: rotation of the spindle within an exposure (n,) [rad]
        """
        total = np.zeros_like(middle)
        for line, phase in zip(self.lines, self.phases, strict=True):
            dimmed = np.sinc(line.turn(exposure_s, turned) / (2 * np.pi))
            total += dimmed * line.height(middle, c, phase)
        return total

    def acceleration(self, time: FloatArray, c: FloatArray, spindle: FloatArray) -> FloatArray:
        """Return the second derivative of the height [m/s²] at speeds ``spindle`` (n,) [rad/s]."""
        total = np.zeros_like(time)
        for line, phase in zip(self.lines, self.phases, strict=True):
            total -= line.turn(1.0, spindle) ** 2 * line.height(time, c, phase)
        return total
