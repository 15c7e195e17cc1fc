"""Simulate one recording of the machine: motion, structure, probe, encoders.

The carriage's encoder reads z; the probe is at G z, changed by the ``structure`` effects. The probe
reads distance = surface − its own place, a little late, so that height = z + distance and, on a
fixed target, the distance falls when z rises. A part turned by C shows, at slide position x and
y = 0, its point X = x cos c, Y = −x sin c (b = 0).

Not imitated: motion of B and Y, spot size and loss of focus on slopes, spectrometer peaks, coupling
of Z's forces into X and C, servo saturation, aliasing of structure vibration into the encoder.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from zlib import crc32

import numpy as np

from benchmarks.worlds.dynamics import LinearSystem, sample
from benchmarks.worlds.part import Flat, Nominal, Part, Pose, slopes

Array = np.ndarray
STAGES = ("structure", "angle", "place", "loop", "probe", "record")
LEAD_S = 0.5
"""Motion before the first trigger, in which the servo's start dies away."""


@dataclass(frozen=True)
class Path:
    """Commanded motion: functions of time [s] since the first trigger, and what it was made for."""

    x: Callable[[Array], Array]
    c: Callable[[Array], Array]
    z: Callable[[Array, Array], Array]
    """Of time and C: Z is geared to the spindle."""
    duration: float
    rpm: float = 0.0
    outward: bool = False
    start: float = 0.0
    """Time since the part was clamped [s]."""
    oversampling: int = 5


@dataclass(frozen=True)
class Moment:
    """State of the machine at many instants, as the effects see it; arrays of one shape."""

    t: Array
    x: Array
    c: Array
    z: Array
    """Carriage [m]."""
    probe: Array
    """Z of the probe [m], before the effect that asks."""
    path: Path
    nominal: Nominal
    radius: float
    seed: int
    period: float
    """Between the instants [s]."""
    clocking: float = 0.0
    """Of the part on the spindle [rad]."""

    @property
    def age(self) -> Array:
        """Return the time since the part was clamped [s]."""
        return self.t + self.path.start

    @property
    def turns_per_second(self) -> float:
        """Return the spindle's speed with its sign [1/s]."""
        return self.path.rpm / 60

    @cached_property
    def rate(self) -> Array:
        """Return dz/dt of the carriage [m/s]."""
        return np.gradient(self.z, self.period)

    @cached_property
    def slope(self) -> tuple[Array, Array]:
        """Return the nominal slopes along the machine's x and y at the beam."""
        cos, sin = np.cos(self.c + self.clocking), np.sin(self.c + self.clocking)
        along_x, along_y = slopes(self.nominal.height, self.x * cos, -self.x * sin)
        return along_x * cos - along_y * sin, along_x * sin + along_y * cos

    def rng(self, name: str) -> np.random.Generator:
        """Return this recording's own source of chance for the effect ``name``."""
        return np.random.default_rng([self.seed, crc32(name.encode())])


@dataclass
class Recording:
    """Channels as logged, (n,) each, and the true heights at the same triggers.

    Lengths in m, angles in rad (c unwrapped), time in s; distance is NaN without a reading.
    """

    t: Array
    x: Array
    y: Array
    z: Array
    b: Array
    c: Array
    distance: Array
    intensity: Array
    height: Array
    """True height of the part as clamped, where x and c truly were on the trigger."""
    deviation: Array
    """Deviation from nominal there, along z, in the part's own frame."""
    part_x: Array
    part_y: Array
    """That place in the part's frame, for a pose of clocking alone."""
    path: Path
    reference: Array = field(default_factory=lambda: np.zeros(0))
    """Reference sensor on the carriage [m], in step tests."""

    @property
    def raw_height(self) -> Array:
        """Return z + distance [m]."""
        return self.z + self.distance

    def keep(self, rows: Array) -> None:
        """Drop the triggers that ``rows``, a mask or indices, does not select."""
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray) and value.size:
                setattr(self, name, value[rows])

    def round(self, machine: Machine) -> None:
        """Round the channels to what their devices resolve."""
        steps = {"x": machine.x_resolution, "z": machine.z_resolution}
        steps |= {"c": machine.c_resolution, "distance": machine.probe_resolution}
        for name, step in steps.items():
            if step:
                setattr(self, name, step * np.round(getattr(self, name) / step))


Effect = Callable[..., Array]


@dataclass(frozen=True)
class Machine:
    """Properties of machine and probe; the defaults are free of all errors but G and latency 0."""

    structure: LinearSystem = field(default_factory=LinearSystem.paper)
    servo: LinearSystem = field(default_factory=lambda: LinearSystem.second_order(200.0))
    sampling: float = 1000.0
    """Triggers per second."""
    latency: float = 0.0
    """From the end of an exposure to the trigger that it is stored with [s]."""
    exposure: float = 0.0
    """Time over which a reading averages [s], before the latency."""
    exposure_nodes: int = 2
    """Gauss points per exposure; tool marks that pass within one need more."""
    half_range: float = 60e-6
    beam: tuple[float, float] = (0.0, 0.0)
    """Slope of the beam along x and y: it meets the surface aside by slope × distance."""
    probe_noise: float = 0.0
    probe_resolution: float = 0.0
    z_resolution: float = 0.0
    z_noise: float = 0.0
    """Of the encoder's reading alone [m]."""
    z_jitter: float = 0.0
    """Of the carriage [m], from trigger to trigger; encoder and probe both see it."""
    x_resolution: float = 0.0
    c_resolution: float = 0.0
    z_late: float = 0.0
    c_late: float = 0.0
    x_late: float = 0.0
    """How much later than the trigger the encoders are latched [s]."""
    trigger_jitter: float = 0.0
    """Of the true time of a trigger [s], for all channels; the stamps do not show it."""
    reference_noise: float = 5e-9
    effects: tuple[tuple[str, Effect], ...] = ()
    """(stage, function); see `plus`."""

    def plus(self, stage: str, *effects: Effect) -> Machine:
        """Return this machine with effects added at a stage.

        structure: f(moment, probe) → probe [m], on the fine grid of time.
        angle: f(moment) → what C truly is beyond its encoder [rad].
        place: f(moment) → (dx, dy), where the beam is beyond x, y = 0 at the turning part [m].
        loop: f(moment) → height that is added to the surface [m].
        probe: f(moment, distance) → what the probe reads beyond the distance [m].
        record: f(recording, moment) changes the recording in place.
        """
        if stage not in STAGES:
            raise ValueError(f"stage {stage!r} is none of {STAGES}")
        return replace(self, effects=(*self.effects, *((stage, e) for e in effects)))

    def of(self, stage: str) -> list[Effect]:
        """Return the effects of a stage, in the order in which they were added."""
        return [effect for name, effect in self.effects if name == stage]


def record(machine: Machine, part: Part | Nominal, pose: Pose, path: Path, seed: int) -> Recording:
    """Run the path and return what is logged, beside the truth."""
    part = part if isinstance(part, Part) else Part(part)
    drive = _drive(machine, part, pose, path, seed)
    n = round(path.duration * machine.sampling)
    stamps = np.arange(n) / machine.sampling
    trigger = stamps + machine.trigger_jitter * drive.rng("trigger").normal(size=n)
    jitter = machine.z_jitter * drive.rng("jitter").normal(size=n)
    now, distance = _reading(machine, part, pose, drive, trigger - machine.latency)
    distance = distance - jitter
    distance += sum(effect(now, distance) for effect in machine.of("probe"))
    distance += machine.probe_noise * now.rng("probe").normal(size=n)
    distance[np.abs(distance) > machine.half_range] = np.nan
    z = _at(drive, "z", trigger + machine.z_late) + jitter
    out = Recording(
        t=stamps,
        x=path.x(trigger + machine.x_late),
        y=np.zeros(n),
        z=z + machine.z_noise * now.rng("encoder").normal(size=n),
        b=np.zeros(n),
        c=path.c(trigger + machine.c_late),
        distance=distance,
        intensity=0.8 * (1 - 0.4 * np.square(distance / machine.half_range)),
        **_truth(part, pose, path.x(trigger), path.c(trigger)),
        path=path,
        reference=_at(drive, "z", trigger),
    )
    out.reference += machine.reference_noise * now.rng("reference").normal(size=n)
    for effect in machine.of("record"):
        effect(out, now)
    out.round(machine)
    return out


def _truth(part: Part, pose: Pose, x: Array, c: Array) -> dict[str, Array]:
    """Return what a machine without error would find at x and c."""
    turned = x * np.cos(c), -x * np.sin(c)
    px, py, _ = Pose(clocking=pose.clocking).to_part((*turned, np.zeros(len(x))))
    height = part.posed_height(*turned, pose)
    return {"height": height, "deviation": part.deviation(px, py), "part_x": px, "part_y": py}


def _drive(machine: Machine, part: Part, pose: Pose, path: Path, seed: int) -> Moment:
    """Integrate servo and structure on the fine grid, with the lead before the first trigger."""
    dt = 1 / (machine.sampling * path.oversampling)
    count = int(np.ceil((path.duration + LEAD_S + 0.01) / dt))
    t = -LEAD_S + dt * np.arange(count)
    x, c = path.x(t), path.c(t)
    z = machine.servo.respond(path.z(t, c), dt)
    probe = machine.structure.respond(z, dt)
    moment = Moment(t, x, c, z, probe, path, part.nominal, part.radius, seed, dt, pose.clocking)
    for effect in machine.of("structure"):
        probe = effect(moment, probe)
    return replace(moment, probe=probe)


def _at(drive: Moment, name: str, t: Array) -> Array:
    """Interpolate "z" or "probe" of the fine grid at times ``t``."""
    return sample(getattr(drive, name), drive.t[0], drive.period, t)


def _reading(
    machine: Machine, part: Part, pose: Pose, drive: Moment, end: Array
) -> tuple[Moment, Array]:
    """Return the state in the middle of each exposure, and the true distance averaged over it."""
    nodes, weights = np.polynomial.legendre.leggauss(machine.exposure_nodes)
    if machine.exposure == 0:
        nodes, weights = np.zeros(1), np.full(1, 2.0)
    middle = _moment(machine, drive, end - machine.exposure / 2)
    distance = np.zeros(len(end))
    for node, weight in zip(nodes, weights, strict=True):
        now = middle
        if node:
            now = _moment(machine, drive, end + machine.exposure * (node - 1) / 2)
        distance += weight / 2 * (_surface(machine, part, pose, now) - now.probe)
    return middle, distance + sum(effect(middle) for effect in machine.of("loop"))


def _moment(machine: Machine, drive: Moment, t: Array) -> Moment:
    """Return the machine's state at times ``t``."""
    return replace(
        drive,
        t=t,
        x=drive.path.x(t),
        c=drive.path.c(t),
        z=_at(drive, "z", t),
        probe=_at(drive, "probe", t),
        period=1 / machine.sampling,
    )


def _surface(machine: Machine, part: Part, pose: Pose, now: Moment) -> Array:
    """Return the height of the part as clamped, where the beam truly meets it."""
    if isinstance(part.nominal, Flat) and now.path.rpm == 0:
        return np.zeros(len(now.t))  # the step test's mirror
    c = now.c + sum(effect(now) for effect in machine.of("angle"))
    x, y = now.x, np.zeros(len(now.t))
    for effect in machine.of("place"):
        dx, dy = effect(now)
        x, y = x + dx, y + dy
    cos, sin = np.cos(c), np.sin(c)
    if any(machine.beam):
        away = part.posed_height(x * cos + y * sin, y * cos - x * sin, pose) - now.probe
        x, y = x + machine.beam[0] * away, y + machine.beam[1] * away
    return part.posed_height(x * cos + y * sin, y * cos - x * sin, pose)
