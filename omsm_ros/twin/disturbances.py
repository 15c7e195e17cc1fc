"""Everything that makes a machine worse than its model, each with its size; nothing by default."""

from __future__ import annotations

from dataclasses import dataclass, field

from omsm_ros.twin.machine_errors import MachineErrors
from omsm_ros.twin.probe import ProbeErrors
from omsm_ros.twin.structure import StructureErrors
from omsm_ros.twin.vibration import VibrationLine


@dataclass(frozen=True, slots=True, kw_only=True)
class Disturbances:
    """One record a family; every quantity has its unit in its name.

    probe: when it looks and what it makes of a distance
    structure: between carriage and probe
    machine: pose of the part, drift
    vibration: lines between workpiece and probe
    """

    probe: ProbeErrors = field(default_factory=ProbeErrors)
    structure: StructureErrors = field(default_factory=StructureErrors)
    machine: MachineErrors = field(default_factory=MachineErrors)
    vibration: tuple[VibrationLine, ...] = ()


NOTHING = Disturbances()
