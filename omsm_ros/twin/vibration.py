"""Lines of vibration between workpiece and probe, free running or in step with the spindle.

A line above half the rate folds when the probe samples it, as it does in reality. Not imitated:
broadband vibration (see ``ProbeErrors.noise_m``), a line whose frequency wanders.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.errors import ConfigurationError
from omsm_ros.twin.quantities import check_numbers


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
        """Height [m] at ``time`` [s] and spindle angle ``c`` [rad], of their shape."""
        phase = random_phase if self.phase_rad is None else self.phase_rad
        turning = 2 * np.pi * self.frequency_hz * time + self.per_turn * c + phase
        return np.asarray(self.amplitude_m * np.sin(turning), np.float64)


@dataclass(frozen=True)
class Vibration:
    """Several lines, each with its phase [rad]."""

    lines: Sequence[VibrationLine]
    phases: Sequence[float]

    @classmethod
    def of(cls, lines: Sequence[VibrationLine], random: np.random.Generator) -> Vibration:
        """The lines with phases by ``random`` where none is given."""
        return cls(lines, random.uniform(0.0, 2 * np.pi, len(lines)).tolist())

    def height(self, time: FloatArray, c: FloatArray) -> FloatArray:
        """Sum of all lines [m] at ``time`` [s] and ``c`` [rad]."""
        total = np.zeros(1)
        for line, phase in zip(self.lines, self.phases, strict=True):
            total = total + line.height(time, c, phase)
        return total
