"""Disturbances of the simulated machine; none by default."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from omsm_ros.core.lti.transfer_function import ComplexArray, TransferFunction
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import ConfigurationError
from omsm_ros.quantities import LENGTH, CheckedRecord
from omsm_ros.twin.machine_errors import MachineErrors
from omsm_ros.twin.probe import Probe, ProbeErrors
from omsm_ros.twin.record_checks import ANGLE, ANY, FREQUENCY, RATE
from omsm_ros.twin.sensors import AccelerationSensor, ClockErrors, EncoderErrors, ReferenceSensor
from omsm_ros.twin.structure import StructureErrors


@dataclass(frozen=True, slots=True, kw_only=True)
class VibrationLine(CheckedRecord):
    """Line ``amplitude_m · sin(2π frequency_hz t + per_turn · c + phase_rad)``.

    amplitude_m: half of peak to valley
    frequency_hz: of a free line;  per_turn: waves a turn of a synchronous line
    phase_rad: None takes a random phase
    """

    amplitude_m: float = field(metadata=LENGTH.metadata)
    frequency_hz: float = RATE.of_field(0.0)
    per_turn: float = ANY.of_field(0.0)
    phase_rad: float | None = ANGLE.of_field(None)

    def __post_init__(self) -> None:
        CheckedRecord.__post_init__(self)
        if not self.frequency_hz and not self.per_turn:
            raise ConfigurationError(
                "VibrationLine: frequency_hz and per_turn are both zero; give one of them"
            )

    def height(
        self,
        middle: FloatArray,
        c: FloatArray,
        exposure_s: float = 0.0,
        turned: FloatArray | float = 0.0,
    ) -> FloatArray:
        """Return the height, averaged over exposures [m].

        middle: of the exposures (n,) [s];  c: spindle angle then (n,) [rad]
        turned: rotation of the spindle within an exposure (n,) [rad]
        """
        phase = 2 * np.pi * self.frequency_hz * middle + self.per_turn * c + (self.phase_rad or 0.0)
        dimmed = np.sinc(self._turn(exposure_s, turned) / (2 * np.pi))
        return np.asarray(dimmed * (self.amplitude_m * np.sin(phase)), np.float64)

    def acceleration(self, time: FloatArray, c: FloatArray, spindle: FloatArray) -> FloatArray:
        """Return the second derivative of the height [m/s²] at speeds ``spindle`` (n,) [rad/s]."""
        return np.asarray(-(self._turn(1.0, spindle) ** 2) * self.height(time, c), np.float64)

    def _turn(self, duration_s: float, spindle_rad: FloatArray | float) -> FloatArray | float:
        """Return the change of the phase [rad] while the spindle turns by ``spindle_rad``."""
        return 2 * np.pi * self.frequency_hz * duration_s + self.per_turn * spindle_rad


def with_phases(
    lines: Sequence[VibrationLine], random: np.random.Generator
) -> tuple[VibrationLine, ...]:
    """Return the lines with random phases for those without one."""
    phases = random.uniform(0.0, 2 * np.pi, len(lines)).tolist()
    return tuple(
        replace(line, phase_rad=phase) if line.phase_rad is None else line
        for line, phase in zip(lines, phases, strict=True)
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Disturbances(CheckedRecord):
    """Disturbances by family; the name of each quantity ends with its unit.

    servo_bandwidth_hz: of Z, None for that of the plant
    probe: timing, linearity and light of the probe;  structure: between slide and probe
    machine: spindle, slides, drift, pose of the part, mount of the probe
    encoder: of Z;  clocks: sampling instants of the devices
    vibration: lines between workpiece and probe
    reference, accelerometer: further channels, None for none
    """

    servo_bandwidth_hz: float | None = FREQUENCY.of_field(None)
    probe: ProbeErrors = field(default_factory=ProbeErrors)
    structure: StructureErrors = field(default_factory=StructureErrors)
    machine: MachineErrors = field(default_factory=MachineErrors)
    encoder: EncoderErrors = field(default_factory=EncoderErrors)
    clocks: ClockErrors = field(default_factory=ClockErrors)
    vibration: tuple[VibrationLine, ...] = ()
    reference: ReferenceSensor | None = None
    accelerometer: AccelerationSensor | None = None


NOTHING = Disturbances()


@dataclass(frozen=True, eq=False)
class TrueResponse:
    """Linear response from encoder to reading of the probe, at position 0 and time 0.

    Stiffness along Z or X, periodic pitch and drift of a clock are not included.
    """

    plant_dynamics: TransferFunction
    disturbances: Disturbances
    probe: Probe

    def response(self, frequency: ArrayLike) -> ComplexArray:
        """Return G at ``frequency`` [Hz], of its shape, with a static gain of 1."""
        f = np.asarray(frequency, np.float64)
        return self.structural_response(f) * self.probe_response(f)

    def structural_response(self, frequency: ArrayLike) -> ComplexArray:
        """Return the mechanical part, which delays Z only, of the shape of ``frequency`` [Hz]."""
        s = np.asarray(2j * np.pi * np.asarray(frequency, np.float64), np.complex128)
        moved = self.plant_dynamics.normalised().at(s) * self.disturbances.structure.response(s)
        seen = self.disturbances.encoder.response(s) / self._encoder_gain
        return np.asarray(moved / seen, np.complex128)

    def probe_response(self, frequency: ArrayLike) -> ComplexArray:
        """Return the part of the reading, a delay relative to all axes, at ``frequency`` [Hz]."""
        f = np.asarray(frequency, np.float64)
        turning = np.exp(-2j * np.pi * f * self.latency_s)
        return np.asarray(turning * np.sinc(f * self.disturbances.probe.window_s), np.complex128)

    @property
    def static_gain(self) -> float:
        """Static gain: reading over travel of the encoder [1]."""
        return self.probe.scale * self.plant_dynamics.dc_gain / self._encoder_gain

    @property
    def _encoder_gain(self) -> float:
        return float(self.disturbances.encoder.response(np.zeros(1, np.complex128))[0].real)

    @property
    def latency_s(self) -> float:
        """Delay of the reading relative to the encoder of Z, at time 0."""
        return self.disturbances.probe.lag_s + self.disturbances.clocks.lag_s
