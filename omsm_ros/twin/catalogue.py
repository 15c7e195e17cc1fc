"""Disturbances by name, each in three plausible sizes: what a bench switches on.

Small is a good machine on a good day, large one that its owner still thinks is sound.
"""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

from omsm_ros.errors import ConfigurationError
from omsm_ros.twin.disturbances import Disturbances
from omsm_ros.twin.machine_errors import Drift, MachineErrors, PartPose
from omsm_ros.twin.probe import ProbeErrors
from omsm_ros.twin.structure import Creep, Friction, LogCreep, SoftMode, StructureErrors
from omsm_ros.twin.vibration import VibrationLine
from omsm_ros.units import MICROMETRE_M, NANOMETRE_M

Sizes = tuple[Disturbances, Disturbances, Disturbances]
Record = TypeVar("Record")

SIZES = ("small", "medium", "large")


def _probe(*sizes: ProbeErrors) -> Sizes:
    small, medium, large = (Disturbances(probe=size) for size in sizes)
    return small, medium, large


def _structure(*sizes: StructureErrors) -> Sizes:
    small, medium, large = (Disturbances(structure=size) for size in sizes)
    return small, medium, large


def _machine(*sizes: MachineErrors) -> Sizes:
    small, medium, large = (Disturbances(machine=size) for size in sizes)
    return small, medium, large


def _line(**fixed: float) -> Sizes:
    small, medium, large = (
        Disturbances(vibration=(VibrationLine(amplitude_m=size, **fixed),))
        for size in (5 * NANOMETRE_M, 10 * NANOMETRE_M, 20 * NANOMETRE_M)
    )
    return small, medium, large


def _creep(time_constant_s: float) -> Sizes:
    return _structure(
        *(
            StructureErrors(creep=(Creep(fraction=f, time_constant_s=time_constant_s),))
            for f in (1e-4, 3e-4, 1e-3)
        )
    )


def _soft_mode(frequency_hz: float, damping_ratio: float) -> Sizes:
    return _structure(
        *(
            StructureErrors(
                soft_modes=(
                    SoftMode(
                        frequency_hz=frequency_hz, damping_ratio=damping_ratio, participation=p
                    ),
                )
            )
            for p in (1e-4, 3e-4, 1e-3)
        )
    )


def _drift(name: str, *sizes: float, **fixed: float) -> Sizes:
    return _machine(*(MachineErrors(drift=Drift(**{name: size, **fixed})) for size in sizes))


CATALOGUE: dict[str, Sizes] = {
    "latency": _probe(*(ProbeErrors(latency_s=s) for s in (0.05e-3, 0.17e-3, 0.34e-3))),
    "exposure": _probe(*(ProbeErrors(exposure_s=s) for s in (0.1e-3, 0.3e-3, 0.9e-3))),
    "averaging": _probe(*(ProbeErrors(exposure_s=0.2e-3, averages=n) for n in (2, 4, 8))),
    "creep, 0.2 s": _creep(0.2),
    "creep, 2 s": _creep(2.0),
    "creep, 20 s": _creep(20.0),
    "logarithmic creep": _structure(
        *(StructureErrors(log_creep=LogCreep(fraction_per_decade=f)) for f in (1e-4, 3e-4, 1e-3))
    ),
    "base mode, 8 Hz": _soft_mode(8.0, 0.02),
    "isolator, 2.5 Hz": _soft_mode(2.5, 0.1),
    "backlash": _structure(*(StructureErrors(backlash_m=w * NANOMETRE_M) for w in (10, 30, 100))),
    "friction": _structure(
        *(
            StructureErrors(friction=Friction(drag_m=d * NANOMETRE_M, presliding_m=MICROMETRE_M))
            for d in (5, 15, 50)
        )
    ),
    "hardening": _structure(
        *(StructureErrors(hardening_deflection_m=d * MICROMETRE_M) for d in (3.0, 1.0, 0.5))
    ),
    "stiffness along Z": _structure(
        *(StructureErrors(compliance_per_m=c) for c in (20.0, 70.0, 200.0))
    ),
    "part tilted": _machine(
        *(MachineErrors(pose=PartPose(tilt_x_rad=t, tilt_y_rad=-t)) for t in (5e-6, 20e-6, 50e-6))
    ),
    "part decentred": _machine(
        *(MachineErrors(pose=PartPose(x_m=d, y_m=-d)) for d in (0.5e-6, 2e-6, 5e-6))
    ),
    "part clocked": _machine(
        *(MachineErrors(pose=PartPose(clocking_rad=a)) for a in (0.1e-3, 0.3e-3, 1e-3))
    ),
    "drift, steady": _drift("ramp_m_per_s", 0.1e-9, 0.3e-9, 1e-9),
    "drift, exponential": _drift("exponential_m", 20e-9, 60e-9, 200e-9),
    "drift, sine": _drift("sine_m", 20e-9, 60e-9, 200e-9, period_s=20.0),
    "drift, random walk": _drift("random_walk_m_per_root_s", 0.5e-9, 1.5e-9, 5e-9),
    "vibration, 13.7 Hz": _line(frequency_hz=13.7),
    "vibration, 50 Hz": _line(frequency_hz=50.0),
    "vibration, 680 Hz": _line(frequency_hz=680.0),
    "vibration, twice a step": _line(frequency_hz=4.0),
    "vibration, 11 times a turn": _line(per_turn=11.0),
}
"""Small, medium and large of each disturbance by its name."""


def together(first: Record, second: Record) -> Record:
    """Both disturbances at once, record by record; rows of creep, modes or lines are joined.

    Raises ConfigurationError where both set the same number, each to something else.
    """
    if first == second:
        return first
    joined: dict[str, Any] = {}
    nothing = type(first)()
    for field in fields(first):  # type: ignore[arg-type]
        a, b, off = (getattr(r, field.name) for r in (first, second, nothing))
        joined[field.name] = _joined(field.name, a, b, off)
    return replace(first, **joined)  # type: ignore[type-var]


def _joined(name: str, a: Any, b: Any, off: Any) -> Any:
    if a in (off, b):
        return b
    if b == off:
        return a
    if isinstance(a, tuple):
        return a + b
    if is_dataclass(a) and off is not None:
        return together(a, b)
    raise ConfigurationError(f"disturbances: {name} is set twice, {a!r} and {b!r}; choose one")
