"""State what a careful shop knows of its machine, and draw a machine for which that is true.

Names and units are those of ``docs/budget.md``; values are standard uncertainties.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from benchmarks.worlds import effects
from benchmarks.worlds.machine import Machine, Moment
from benchmarks.worlds.part import Pose

PROBE_HALF_RANGE_M = 50e-6
EXPOSURE_S = 2e-4
LATENCY_S = 1e-4
NOISE_M = 10e-9
RESOLUTION_OF_Z_M = 0.4e-9
DRIFT_WALK = 1.2e-9
ABBE_ARM_M = 0.05


@dataclass(frozen=True)
class Site:
    """Random numbers that last, part radius and exposure, as effects need them when made."""

    rng: np.random.Generator
    radius: float
    exposure: float = EXPOSURE_S

    def phase(self) -> float:
        """Draw a phase [rad]."""
        return float(self.rng.uniform(0, 2 * np.pi))

    def sign(self) -> float:
        """Draw +1 or −1."""
        return float(self.rng.choice([-1.0, 1.0]))


def x_of(now: Moment) -> np.ndarray:
    """Return the X slide's place [m]."""
    return now.x


def z_of(now: Moment) -> np.ndarray:
    """Return the carriage's place [m]."""
    return now.z


Build = Callable[[Machine, float, Site], Machine]


@dataclass(frozen=True)
class Source:
    """One declared source, and how a drawn value of it changes a machine."""

    name: str
    value: float
    unit: str
    build: Build
    more: dict[str, float] = field(default_factory=dict)

    def row(self) -> dict[str, object]:
        """Return the row of a file of sources."""
        said = {"source": self.name, "value": self.value, "unit": self.unit, **self.more}
        return {**said, "how": "evaluated", "reason": "drawn for this machine, 2026-03-02"}


def _harmonic(kind: Callable, per_turn: float) -> Build:
    """Draw the phase of a harmonic."""
    return lambda m, value, site: m.plus("loop", kind(per_turn, value, site.phase()))


def _radial(m: Machine, value: float, site: Site) -> Machine:
    """Move the spindle laterally twice a turn."""
    phase = site.phase()
    wave = effects.offset_beam_by(lambda now: np.cos(2 * now.c + phase), value)
    return m.plus("place", wave)


def _wave(stage: str, of: Callable, share: float) -> Build:
    """Draw a wave over X or Z whose period is ``share`` of the part's radius."""

    def build(m: Machine, value: float, site: Site) -> Machine:
        period = share * site.radius
        if stage == "loop":
            return m.plus(stage, effects.waving(of, 2**0.5 * value, period, site.phase()))
        phase = site.phase()
        turn = effects.offset_beam_by(
            lambda now: np.sin(2 * np.pi * of(now) / period + phase), 2**0.5 * value
        )
        return m.plus(stage, turn)

    return build


def _add(stage: str, make: Callable[[float], Callable]) -> Build:
    """Add the effect ``make(value)``."""
    return lambda m, value, site: m.plus(stage, make(value))


def _set(name: str, base: float = 0.0) -> Build:
    """Set a property of the machine to ``base + value``."""
    return lambda m, value, site: replace(m, **{name: base + value})


def _pass(m: Machine, value: float, site: Site) -> Machine:
    """Leave the machine: the source acts elsewhere (noise, pose)."""
    return m


SOURCES = (
    Source("probe_noise", NOISE_M, "m", _pass),
    Source("probe_resolution", 0.3e-9, "m", _pass),
    Source("encoder_noise", 0.3e-9, "m", _pass),
    Source("encoder_resolution", RESOLUTION_OF_Z_M / 12**0.5, "m", _pass),
    Source("discretisation", 0.1e-9, "m", _pass),
    Source(
        "vibration", 2e-9, "m",
        lambda m, v, s: m.plus("loop", effects.line(143.7, 2**0.5 * abs(v), s.exposure)),
    ),
    Source("static_gain", 1e-4, "1", _add("probe", lambda v: lambda now, d: v * d)),
    Source("probe_latency", 1e-5, "s", _set("latency", LATENCY_S)),
    Source("lag_change", 3e-7, "s", _add("structure", lambda v: effects.lagging(lambda now: v))),
    Source("motion_error", 0.5e-9, "m", _add("structure", lambda v: effects.playing(2 * abs(v)))),
    Source("tilt", 2e-5, "rad", _pass),
    Source("decentre", 5e-6, "m", _pass),
    Source("clocking", 5e-5, "rad", _pass),
    Source("expansion", 1e-6, "1", _add("place", lambda v: effects.offset_beam_by(x_of, dx=-v))),
    Source("centre_x", 3e-7, "m", _add("place", lambda v: effects.offset_beam(dx=v))),
    Source("centre_y", 3e-7, "m", _add("place", lambda v: effects.offset_beam(dy=v))),
    Source("beam", 1e-4, "1", lambda m, v, s: replace(m, beam=(v, v * s.sign()))),
    Source("squareness", 1e-6, "rad", _add("loop", lambda v: effects.over(x_of, v))),
    Source("parallelism", 5e-6, "rad", _add("place", lambda v: effects.offset_beam_by(z_of, v, v))),
    Source(
        "straightness_x", 5e-9, "m", _wave("loop", x_of, 1.5), {"correlation_length": 5e-3}
    ),
    Source(
        "straightness_z", 20e-9, "m", _wave("place", z_of, 0.05), {"correlation_length": 1e-4}
    ),
    Source("spindle_axial", 6e-9, "m", _harmonic(effects.axial, 2), {"per_turn": 2}),
    Source("spindle_axial", 4e-9, "m", _harmonic(effects.axial, 3), {"per_turn": 3}),
    Source("spindle_axial", 3e-9, "m", _harmonic(effects.axial, 4), {"per_turn": 4}),
    Source("spindle_tilt", 1e-7, "rad", _harmonic(effects.tilting, 2), {"per_turn": 2}),
    Source("spindle_radial", 2e-8, "m", _radial, {"per_turn": 2}),
    Source("encoder_scale", 1e-6, "1", _add("record", lambda v: effects.scaled_column("z", v))),
    Source(
        "encoder_interpolation", 0.5e-9, "m",
        lambda m, v, s: m.plus(
            "record", effects.waving_column("z", 2**0.5 * v, 5e-7, s.phase())
        ),
        {"period": 5e-7},
    ),
    Source(
        "probe_linearity", 3e-9, "m",
        _add("probe", lambda v: lambda now, d: v * (d / PROBE_HALF_RANGE_M) ** 3),
        {"half_range": PROBE_HALF_RANGE_M},
    ),
    Source(
        "probe_periodic", 1e-9, "m",
        _add("probe", lambda v: lambda now, d: 2**0.5 * v * np.sin(2 * np.pi * d / 8e-6)),
        {"period": 8e-6},
    ),
    Source("probe_slope", 2e-8, "m/rad", _add("probe", lambda v: lambda n, d: v * n.slope[0])),
    Source(
        "probe_slope_square", 2e-8, "m/rad",
        _add("probe", lambda v: lambda n, d: v * sum(np.square(s) for s in n.slope)),
    ),
    Source(
        "pitch", 2e-8, "rad",
        lambda m, v, s: m.plus(
            "loop", effects.waving(z_of, ABBE_ARM_M * 2**0.5 * v, 1e-3, s.phase())
        ),
    ),
    Source(
        "drift", 2e-9, "m", _add("loop", lambda v: effects.wandering(abs(v), 30.0)),
        {"correlation_time": 30.0},
    ),
    Source("drift_rate", 1.5e-10, "m/s", _add("loop", effects.ramp)),
    Source("drift_walk", DRIFT_WALK, "m/√s", _pass),
)  # fmt: skip


def quiet() -> Machine:
    """Return a machine with the noise, exposure and latency of a good one and no error besides."""
    return Machine(
        latency=LATENCY_S,
        exposure=EXPOSURE_S,
        probe_noise=NOISE_M,
        probe_resolution=1e-9,
        z_noise=3e-10,
        z_resolution=RESOLUTION_OF_Z_M,
        x_resolution=1e-9,
        c_resolution=1e-7,
    )


@dataclass(frozen=True)
class Shop:
    """One drawn shop: its machine when it scans, the same in its step test, and the clamping."""

    scanning: Machine
    testing: Machine
    pose: Pose
    values: dict[str, float]
    """What was drawn, by source; of harmonics the last one."""


def drawn(seed: int, radius: float, share: float = 1.0) -> Shop:
    """Draw a shop for which the declared sources are true, all sizes times ``share``."""
    site = Site(np.random.default_rng([seed, 311]), radius)
    machine, values, since_test = quiet(), {}, None
    for source in SOURCES:
        # Cosine and sine of a harmonic have the declared size each.
        chance = site.rng.chisquare(2) ** 0.5 if "per_turn" in source.more else site.rng.normal()
        value = share * source.value * float(chance)
        values[source.name] = value
        machine = source.build(machine, value, site)
        if source.name == "lag_change":
            since_test = machine.effects[-1]
    machine = machine.plus("loop", effects.walk(share * DRIFT_WALK))
    before = replace(machine, effects=tuple(e for e in machine.effects if e is not since_test))
    angles = share * 2e-5 * site.rng.normal(size=2)
    shift = share * 5e-6 * site.rng.normal(size=2)
    pose = Pose(float(shift[0]), float(shift[1]), 0.0, *map(float, angles), values["clocking"])
    return Shop(machine, before, pose, values)


def declared(left_out: str = "") -> dict[str, object]:
    """Return the sources as a careful shop states them, but for those named ``left_out``.

    ``latency``: from the middle of an exposure to its trigger [s]; ``probe_latency`` is how well it
    is known. ``abbe_arm`` [m] belongs to ``pitch``.
    """
    rows = [source.row() for source in SOURCES if source.name != left_out]
    return {
        "schema": "omsm-sources/1",
        "sources": rows,
        "latency": LATENCY_S + EXPOSURE_S / 2,
        "abbe_arm": ABBE_ARM_M,
    }
