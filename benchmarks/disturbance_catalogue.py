"""Disturbances by name, each in three plausible sizes, for benchmarks and tests.

Small is typical of a good machine, large of a machine that may still be in use.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from functools import partial
from typing import Any, TypeVar

from omsm_ros.core.kinematics.kinematics import Geometry
from omsm_ros.errors import ConfigurationError
from omsm_ros.twin.disturbances import Disturbances, VibrationLine
from omsm_ros.twin.machine_errors import Drift, Harmonic, MachineErrors, SpindleError, Straightness
from omsm_ros.twin.part import PartPose
from omsm_ros.twin.probe import ProbeErrors
from omsm_ros.twin.sensors import ClockErrors, EncoderErrors, Pitch, ReferenceSensor
from omsm_ros.twin.structure import Creep, Friction, LogCreep, SoftMode, StructureErrors

Sizes = tuple[Disturbances, Disturbances, Disturbances]
Record = TypeVar("Record")

SIZES = ("small", "medium", "large")
# Amplitudes of periodic disturbances in the three sizes [m].
_THREE_WAVES = (5e-9, 10e-9, 20e-9)


def _each(family: str, record: Callable[..., Any], name: str, *sizes: Any, **fixed: Any) -> Sizes:
    """Return the field ``name`` of a ``family`` of disturbances in three sizes."""
    small, medium, large = (
        Disturbances(**{family: record(**{name: size}, **fixed)}) for size in sizes
    )
    return small, medium, large


_probe = partial(_each, "probe", ProbeErrors)
_structure = partial(_each, "structure", StructureErrors)
_machine = partial(_each, "machine", MachineErrors)
_encoder = partial(_each, "encoder", EncoderErrors)
_clocks = partial(_each, "clocks", ClockErrors)


def _line(**fixed: float) -> Sizes:
    small, medium, large = (
        Disturbances(vibration=(VibrationLine(amplitude_m=size, **fixed),)) for size in _THREE_WAVES
    )
    return small, medium, large


def _creep(time_constant_s: float) -> Sizes:
    return _structure(
        "creep",
        *((Creep(fraction=f, time_constant_s=time_constant_s),) for f in (1e-4, 3e-4, 1e-3)),
    )


def _soft_mode(frequency_hz: float, damping_ratio: float) -> Sizes:
    mode = partial(SoftMode, frequency_hz=frequency_hz, damping_ratio=damping_ratio)
    return _structure("soft_modes", *((mode(participation=p),) for p in (1e-4, 3e-4, 1e-3)))


def _drift(name: str, *sizes: float, **fixed: float) -> Sizes:
    return _machine("drift", *(Drift(**{name: size}, **fixed) for size in sizes))


def _spindle(name: str, *sizes: float, per_turn: int) -> Sizes:
    error: Callable[..., SpindleError] = SpindleError
    return _machine(
        "spindle", *(error(**{name: (Harmonic(amplitude=s, per_turn=per_turn),)}) for s in sizes)
    )


CATALOGUE: dict[str, Sizes] = {
    "slow servo": (
        Disturbances(servo_bandwidth_hz=100.0),
        Disturbances(servo_bandwidth_hz=70.0),
        Disturbances(servo_bandwidth_hz=50.0),
    ),
    "latency": _probe("latency_s", 0.05e-3, 0.17e-3, 0.34e-3),
    "exposure": _probe("exposure_s", 0.1e-3, 0.3e-3, 0.9e-3),
    "averaging": _probe("averages", 2, 4, 8, exposure_s=0.2e-3),
    "noise of the probe": _probe("noise_m", 10e-9, 20e-9, 40e-9),
    "linearity, cubic": _probe("cubic_m", 5e-9, 15e-9, 50e-9),
    "linearity, periodic": _probe("periodic_m", *_THREE_WAVES, period_m=7e-6),
    "linearity, periodic as the steps": _probe("periodic_m", *_THREE_WAVES, period_m=9.8e-6),
    "slope error": _probe("slope_error_m_per_rad", 0.05e-6, 0.15e-6, 0.5e-6),
    "slope error, square": _probe("slope_error_m_per_rad2", 0.5e-6, 1.5e-6, 5e-6),
    "light lost on slopes": _probe("intensity_slope_rad", 0.5, 0.3, 0.15),
    "dropouts": _probe("dropout_probability", 1e-3, 1e-2, 5e-2),
    "dropouts on slopes": _probe("dropout_slope_rad", 0.2, 0.15, 0.1),
    "creep, 0.2 s": _creep(0.2),
    "creep, 2 s": _creep(2.0),
    "creep, 20 s": _creep(20.0),
    "logarithmic creep": _structure(
        "log_creep", *(LogCreep(fraction_per_decade=f) for f in (3e-5, 1e-4, 3e-4))
    ),
    "base mode, 8 Hz": _soft_mode(8.0, 0.02),
    "isolator, 2.5 Hz": _soft_mode(2.5, 0.1),
    "backlash": _structure("backlash_m", 10e-9, 30e-9, 100e-9),
    "friction": _structure(
        "friction", *(Friction(drag_m=d, presliding_m=1e-6) for d in (5e-9, 15e-9, 50e-9))
    ),
    "hardening": _structure("hardening_deflection_m", 3e-6, 1e-6, 0.5e-6),
    "stiffness along Z": _structure("compliance_per_m_of_z", 20.0, 70.0, 200.0),
    "stiffness along X": _structure("compliance_per_m_of_x", 2.0, 7.0, 20.0),
    "part tilted": _machine(
        "pose", *(PartPose(tilt_x_rad=t, tilt_y_rad=-t) for t in (5e-6, 20e-6, 50e-6))
    ),
    "part decentred": _machine("pose", *(PartPose(x_m=d, y_m=-d) for d in (0.5e-6, 2e-6, 5e-6))),
    "part clocked": _machine("pose", *(PartPose(clocking_rad=a) for a in (0.1e-3, 0.3e-3, 1e-3))),
    "zero of X": _machine("mount", *(Geometry(centre_x=d) for d in (0.1e-6, 0.3e-6, 1e-6))),
    "beam slanting": _machine("mount", *(Geometry(beam_x=s) for s in (1e-3, 3e-3, 10e-3))),
    "B swinging": _machine("b_wobble_rad", 0.1e-6, 0.3e-6, 1e-6, mount=Geometry(probe_x=0.05)),
    "spindle, axial twice a turn": _spindle("axial_m", 2.5e-9, 8e-9, 25e-9, per_turn=2),
    "spindle, radial twice a turn": _spindle("radial_m", 10e-9, 30e-9, 100e-9, per_turn=2),
    "spindle, tilt once a turn": _spindle("tilt_rad", 0.1e-6, 0.3e-6, 1e-6, per_turn=1),
    "spindle, asynchronous": _machine(
        "spindle", *(SpindleError(axial_noise_m=n, radial_noise_m=n) for n in (2e-9, 5e-9, 15e-9))
    ),
    "straightness of X": _machine(
        "x_slide_along_z",
        *(Straightness(bow_m=b, half_travel_m=12.7e-3) for b in (10e-9, 30e-9, 100e-9)),
    ),
    "straightness of Z": _machine(
        "z_slide_along_x",
        *(Straightness(bow_m=b, half_travel_m=1e-3) for b in (10e-9, 30e-9, 100e-9)),
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
    "encoder scale": _encoder("scale_ppm", 1.0, 3.0, 10.0),
    "encoder interpolation": _encoder("interpolation_m", 2e-9, 5e-9, 15e-9),
    "encoder interpolation as the steps": _encoder(
        "interpolation_m", 2e-9, 5e-9, 15e-9, signal_period_m=4.9e-6
    ),
    "encoder counts": _encoder("resolution_m", 1e-9, 3e-9, 10e-9),
    "pitch, steady": _encoder(
        "pitch",
        *(Pitch(arm_m=0.1, periodic_rad=p, period_m=30e-6) for p in (0.02e-6, 0.07e-6, 0.2e-6)),
    ),
    "pitch, under acceleration": _encoder(
        "pitch", *(Pitch(arm_m=0.1, rad_per_m_s2=p) for p in (0.1e-6, 0.3e-6, 1e-6))
    ),
    "trigger jitter": _clocks("trigger_jitter_s", 1e-6, 5e-6, 20e-6),
    "probe jitter": _clocks("probe_jitter_s", 1e-6, 5e-6, 20e-6),
    "probe clock offset": _clocks("probe_offset_s", 10e-6, 30e-6, 100e-6),
    "probe clock drift": _clocks("probe_drift_ppm", 0.1, 0.3, 1.0),
    "Z latched late": _clocks("z_latch_late_s", 10e-6, 30e-6, 100e-6),
    "C latched late": _clocks("c_latch_late_s", 10e-6, 30e-6, 100e-6),
    "reference late": _each("reference", ReferenceSensor, "latency_s", 0.02e-3, 0.06e-3, 0.2e-3),
}
"""Small, medium and large size of each disturbance by name."""


def together(first: Record, second: Record) -> Record:
    """Return both disturbances combined; tuples of creep, modes or lines are concatenated.

    Raises ConfigurationError where both set one number to different values.
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
