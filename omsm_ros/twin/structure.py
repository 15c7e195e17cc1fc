"""Structural errors in addition to G(s): creep, soft modes, stiffness, friction, backlash.

``slide → G(s) → creep, soft modes → stiffness → friction → backlash → probe``

All except creep and soft modes act without memory in time, on the deflection or the position. Not
imitated: backlash and friction within the servo loop, stiffness that changes the frequency of a
mode (it scales the whole deflection), temperature.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy import signal

from omsm_ros.core.kinematics.trajectories import s_curve
from omsm_ros.core.lti.transfer_function import ComplexArray
from omsm_ros.core.model_errors.families import dahl_friction, through_backlash
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import ConfigurationError
from omsm_ros.quantities import LENGTH, CheckedRecord
from omsm_ros.twin.plant import Trajectory
from omsm_ros.twin.record_checks import ANY, DAMPING, DURATION, FREQUENCY, SIZE, WIDTH

# Time in which the motion is faded in, so that it does not excite a soft mode.
_SPIN_UP_S = 4.0
# Two relaxations per decade approximate logarithmic creep to 0.5 %.
_RELAXATIONS_PER_DECADE = 2
# Shortest time constant of creep [s].
_SHORTEST_RELAXATION_S = 1e-4


@dataclass(frozen=True, eq=False)
class BacklashOutput(Trajectory):
    """Motion behind backlash, as exact between its values as the motion of its driver.

    driver: driving motion;  half_width: half of the backlash [m]
    """

    driver: Trajectory
    half_width: float

    def at(self, time: FloatArray) -> FloatArray:
        """Return the position [m] at ``time`` [s], of its shape, with sharp kinks."""
        driver = self.driver.at(time)
        latest = np.floor((time - self.start) / self.step).astype(np.int64)
        held = self.values[np.clip(latest, 0, len(self.values) - 1)]
        low, high = driver - self.half_width, driver + self.half_width
        return np.asarray(np.clip(held, low, high), np.float64)


def backlash(driver: Trajectory, width: float) -> BacklashOutput:
    """Return the motion behind a backlash of ``width`` [m], at first in its middle."""
    values = through_backlash(driver.values, width / 2)
    return BacklashOutput(driver.start, driver.step, values, driver, width / 2)


@dataclass(frozen=True, slots=True, kw_only=True)
class Creep(CheckedRecord):
    """Creep of a share of each move: ``1 - ε + ε / (1 + sτ)``.

    fraction: ε of the move [1];  time_constant_s: τ
    """

    fraction: float = field(metadata=ANY.metadata)
    time_constant_s: float = field(metadata=DURATION.metadata)


@dataclass(frozen=True, slots=True, kw_only=True)
class LogCreep(CheckedRecord):
    """Creep proportional to the logarithm of time, as of piezos and grease.

    fraction_per_decade: of the move, in each decade from shortest_s to longest_s [1]
    """

    fraction_per_decade: float = field(metadata=ANY.metadata)
    shortest_s: float = DURATION.of_field(0.01)
    longest_s: float = DURATION.of_field(1000.0)

    def __post_init__(self) -> None:
        CheckedRecord.__post_init__(self)
        if not _SHORTEST_RELAXATION_S <= self.shortest_s <= self.longest_s:
            raise ConfigurationError(
                f"LogCreep: from {self.shortest_s!r} to {self.longest_s!r} s, expected to begin at "
                f"{_SHORTEST_RELAXATION_S:g} s or later and to end after that"
            )

    @property
    def relaxations(self) -> tuple[Creep, ...]:
        """Equal relaxations with time constants in equal ratios that approximate the creep."""
        decades = np.log10(self.longest_s / self.shortest_s)
        count = max(round(decades * _RELAXATIONS_PER_DECADE), 0) + 1
        each = self.fraction_per_decade / _RELAXATIONS_PER_DECADE
        spread = np.geomspace(self.shortest_s, self.longest_s, count)
        return tuple(Creep(fraction=each, time_constant_s=float(tau)) for tau in spread)


@dataclass(frozen=True, slots=True, kw_only=True)
class SoftMode(CheckedRecord):
    """Weak mode of base or isolator: ``1 - p + p ω² / (s² + 2ζω s + ω²)``.

    participation: p, static share of the motion [1]
    """

    frequency_hz: float = field(metadata=FREQUENCY.metadata)
    damping_ratio: float = field(metadata=DAMPING.metadata)
    participation: float = field(metadata=ANY.metadata)

    @property
    def omega(self) -> float:
        """Angular frequency [rad/s]."""
        return 2 * np.pi * self.frequency_hz


@dataclass(frozen=True, slots=True, kw_only=True)
class Friction(CheckedRecord):
    """Pre-sliding friction (Dahl 1968) that retards the probe by up to ``drag_m``.

    dF/dz = (1 - F sgn ż) / presliding_m, F from -1 to 1
    """

    drag_m: float = field(metadata=LENGTH.metadata)
    presliding_m: float = field(metadata=WIDTH.metadata)


@dataclass(frozen=True, slots=True, kw_only=True)
class StructureErrors(CheckedRecord):
    """Errors between slide and probe; none by default.

    creep, log_creep, soft_modes: linear, slow
    compliance_per_m_of_z, compliance_per_m_of_x: the deflection ``slide - probe`` grows by
        this part per metre of Z or X
    hardening_deflection_m: deflection at which a hardening spring has twice its stiffness
    backlash_m: lost motion at a reversal, the full width of the loop
    friction: pre-sliding drag
    """

    creep: tuple[Creep, ...] = ()
    log_creep: LogCreep | None = None
    soft_modes: tuple[SoftMode, ...] = ()
    compliance_per_m_of_z: float = ANY.of_field(0.0)
    compliance_per_m_of_x: float = ANY.of_field(0.0)
    hardening_deflection_m: float | None = WIDTH.of_field(None)
    backlash_m: float = SIZE.of_field(0.0)
    friction: Friction | None = None

    @property
    def relaxations(self) -> tuple[Creep, ...]:
        """All relaxations of both laws of creep."""
        return self.creep + (self.log_creep.relaxations if self.log_creep else ())

    @property
    def lead_s(self) -> float:
        """Duration of the motion before time 0."""
        return _SPIN_UP_S if self.relaxations or self.soft_modes else 0.0

    def response(self, s: ComplexArray) -> ComplexArray:
        """Return the response of creep and soft modes, the linear part, at ``s`` [rad/s]."""
        result = np.ones_like(s)
        for creep in self.relaxations:
            result += creep.fraction * (1 / (1 + s * creep.time_constant_s) - 1)
        for mode in self.soft_modes:
            ratio = mode.omega**2 / (s**2 + 2 * mode.damping_ratio * mode.omega * s + mode.omega**2)
            result += mode.participation * (ratio - 1)
        return result


def deform(
    errors: StructureErrors, moved: tuple[Trajectory, Trajectory], slide_x: Trajectory
) -> Trajectory:
    """Return the motion of the probe with the ``errors`` of the structure.

    moved: slide and probe without them [m]
    slide_x: position of X [m], on any grid that covers ``moved``
    """
    slide, driven = moved[0].values, moved[1]
    probe = driven.values + _slow_parts(errors, driven)
    if errors.compliance_per_m_of_z or errors.compliance_per_m_of_x:
        x = np.interp(driven.times, slide_x.times, slide_x.values)
        along = errors.compliance_per_m_of_z * slide + errors.compliance_per_m_of_x * x
        probe = slide - (slide - probe) * (1 + along)
    if errors.hardening_deflection_m is not None:
        probe = slide - hardened(slide - probe, errors.hardening_deflection_m)
    if errors.friction:
        probe = (
            probe - errors.friction.drag_m * dahl_friction(probe, errors.friction.presliding_m)[0]
        )
    result = Trajectory(driven.start, driven.step, probe)
    return backlash(result, errors.backlash_m) if errors.backlash_m else result


def _slow_parts(errors: StructureErrors, probe: Trajectory) -> FloatArray:
    """Return the effect of creep and soft modes on the motion of the probe (n,) [m]."""
    if not errors.lead_s:
        return np.zeros(1)
    # The motion about its mean, faded in smoothly before time 0.
    before = max(round(-probe.start / probe.step), 1)
    moving = probe.values - probe.values[:before].mean()
    moving[:before] *= s_curve(np.arange(before) / before)
    added: FloatArray = np.zeros_like(moving)
    for creep in errors.relaxations:
        filtered = _through(([1.0], [creep.time_constant_s, 1.0]), moving, probe.step)
        added += creep.fraction * (filtered - moving)
    for mode in errors.soft_modes:
        ratio = ([mode.omega**2], [1.0, 2 * mode.damping_ratio * mode.omega, mode.omega**2])
        added += mode.participation * (_through(ratio, moving, probe.step) - moving)
    return added


def _through(ratio: tuple[list[float], list[float]], values: FloatArray, step: float) -> FloatArray:
    """Return linearly interpolated ``values``, zero before, after a continuous filter."""
    numerator, denominator, _ = signal.cont2discrete(ratio, step, method="foh")
    return np.asarray(signal.lfilter(numerator.ravel(), denominator, values))


def hardened(linear: FloatArray, scale: float) -> FloatArray:
    """Return δ of a spring whose stiffness is ``1 + (δ/scale)²`` times the ``linear`` one's.

    The real root of ``δ + δ³/scale² = linear`` [m].
    """
    root3 = np.sqrt(3.0)
    return np.asarray(
        2 * scale / root3 * np.sinh(np.arcsinh(1.5 * root3 * linear / scale) / 3), np.float64
    )
