"""Lines of vibration between workpiece and probe, free running or in step with the spindle.

A line above half the rate folds when the probe samples it, as it does in reality. Not imitated:
broadband vibration (see ``ProbeErrors.noise_m``), a line whose frequency wanders.
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
    """``amplitude_m · sin(2π frequency_hz t + per_turn · c + phase_rad)``.

    amplitude_m: half of peak to valley
    frequency_hz: free running;  per_turn: so often a turn of the spindle, in step with it
    phase_rad: None takes one by the seed
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
        """Return how far its phase turns [rad] while the spindle turns by so much (n,)."""
        return 2 * np.pi * self.frequency_hz * duration_s + self.per_turn * spindle_rad


@dataclass(frozen=True)
class Vibration:
    """Several lines, each with its phase [rad]."""

    lines: Sequence[VibrationLine]
    phases: Sequence[float]

    @classmethod
    def of(cls, lines: Sequence[VibrationLine], random: np.random.Generator) -> Vibration:
        """Return the lines with phases by ``random`` where none is given."""
        return cls(lines, random.uniform(0.0, 2 * np.pi, len(lines)).tolist())

    def height(
        self, middle: FloatArray, c: FloatArray, exposure_s: float, turned: FloatArray
    ) -> FloatArray:
        """Return the sum of all lines [m], each the mean over an exposure.

        middle: of the exposures (n,) [s];  c: spindle angle then (n,) [rad]
        turned: by the spindle within an exposure (n,) [rad]
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
