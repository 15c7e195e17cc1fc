"""Disturbances of the simulated machine; none by default."""

from __future__ import annotations

from dataclasses import dataclass, field

from omsm_ros.errors import ConfigurationError
from omsm_ros.twin.machine_errors import MachineErrors
from omsm_ros.twin.probe import ProbeErrors
from omsm_ros.twin.sensors import AccelerationSensor, ClockErrors, EncoderErrors, ReferenceSensor
from omsm_ros.twin.structure import StructureErrors
from omsm_ros.twin.vibration import VibrationLine


@dataclass(frozen=True, slots=True, kw_only=True)
class Disturbances:
    """Disturbances by family; the name of each quantity ends with its unit.

    servo_bandwidth_hz: of Z, None for that of the plant
    probe: timing, linearity and light of the probe;  structure: between slide and probe
    machine: spindle, slides, drift, pose of the part, mount of the probe
    encoder: of Z;  clocks: sampling instants of the devices
    vibration: lines between workpiece and probe
    reference, accelerometer: further channels, None for none
    """

    servo_bandwidth_hz: float | None = None
    probe: ProbeErrors = field(default_factory=ProbeErrors)
    structure: StructureErrors = field(default_factory=StructureErrors)
    machine: MachineErrors = field(default_factory=MachineErrors)
    encoder: EncoderErrors = field(default_factory=EncoderErrors)
    clocks: ClockErrors = field(default_factory=ClockErrors)
    vibration: tuple[VibrationLine, ...] = ()
    reference: ReferenceSensor | None = None
    accelerometer: AccelerationSensor | None = None

    def __post_init__(self) -> None:
        width = self.servo_bandwidth_hz
        if width is not None and not 0 < width < float("inf"):
            raise ConfigurationError(
                f"Disturbances: servo_bandwidth_hz is {width!r}, expected None or a positive number"
            )


NOTHING = Disturbances()
