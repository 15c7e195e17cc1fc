"""Motions as functions of time: step tests, scans, chirps and planned step tests.

Each motion gives the commanded axes at any time, also before its start.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np

from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import ConfigurationError
from omsm_ros.units import RPM_HZ, RPM_RAD_S


class AxisPositions(NamedTuple):
    """Commanded positions x, y, z [m], b, c [rad], each of the shape of the time."""

    x: FloatArray
    y: FloatArray
    z: FloatArray
    b: FloatArray
    c: FloatArray


class Motion(Protocol):
    """A motion of the cell of ``duration`` [s]."""

    @property
    def duration(self) -> float:
        """From the first commanded position to the last [s]."""
        ...

    def positions(self, time: FloatArray) -> AxisPositions:
        """Return the commanded axes at ``time`` [s]; negative before the start."""
        ...


def s_curve(phase: FloatArray) -> FloatArray:
    """Return the move from 0 to 1 over ``phase`` 0…1 with a jerk of constant magnitude.

    The jerk is ±32 (per unit of phase cubed) with signs + - - + over the four quarters.
    """
    p = np.clip(phase, 0.0, 1.0)
    mirrored = np.where(p > 0.5, 1.0 - p, p)
    late = mirrored - 0.25
    # Products, because a power of three takes ten times as long.
    first = 16 / 3 * (mirrored * mirrored * mirrored)
    second = 1 / 12 + late * (1 + late * (4 - 16 / 3 * late))
    half = np.where(mirrored < 0.25, first, second)
    return np.where(p > 0.5, 1.0 - half, half)


def _z_only(z: FloatArray) -> AxisPositions:
    zero = np.zeros_like(z)
    return AxisPositions(zero, zero, z, zero, zero)


@dataclass(frozen=True, slots=True)
class Spiral:
    """X feeds from ``start_radius`` to the centre while C turns and Z follows ``surface``.

    start_radius: [m];  feed_per_turn: [m];  spindle_speed: [rpm], negative reverses.
    outward: to ``start_radius`` instead;  beyond: way of X on the other side of the centre [m]
    Before its start the motion is a circle at the start radius.
    """

    surface: Surface
    start_radius: float
    feed_per_turn: float
    spindle_speed: float
    outward: bool = False
    beyond: float = 0.0

    def __post_init__(self) -> None:
        if self.start_radius <= 0 or self.feed_per_turn <= 0 or self.spindle_speed == 0:
            raise ConfigurationError(
                "kinematics.spiral",
                radius=self.start_radius,
                feed=self.feed_per_turn,
                speed=self.spindle_speed,
            )
        if self.feed_per_turn > (way := self.start_radius + self.beyond):
            raise ConfigurationError("kinematics.feed", feed=self.feed_per_turn, radius=way)

    @property
    def duration(self) -> float:
        """Time that the feed takes [s]."""
        way = self.start_radius + self.beyond
        return way / (self.feed_per_turn * abs(self.spindle_speed) * RPM_HZ)

    def positions(self, time: FloatArray) -> AxisPositions:
        """Return the commanded axes at ``time`` [s]."""
        feed = self.feed_per_turn * abs(self.spindle_speed) * RPM_HZ * np.maximum(time, 0.0)
        x = feed - self.beyond if self.outward else self.start_radius - feed
        return _on_surface(self.surface, x, self.spindle_speed * RPM_RAD_S * time)


@dataclass(frozen=True, slots=True)
class Circle:
    """``turns`` turns at constant ``radius`` [m] and ``spindle_speed`` [rpm], Z on ``surface``."""

    surface: Surface
    radius: float
    spindle_speed: float
    turns: float = 1.0

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return self.turns / (abs(self.spindle_speed) * RPM_HZ)

    def positions(self, time: FloatArray) -> AxisPositions:
        """Return the commanded axes at ``time`` [s]."""
        x = np.full_like(time, self.radius)
        return _on_surface(self.surface, x, self.spindle_speed * RPM_RAD_S * time)


def _on_surface(surface: Surface, x: FloatArray, c: FloatArray) -> AxisPositions:
    zero = np.zeros_like(x)
    # Kinematics with y = b = 0: the probe is over X = x cos c, Y = -x sin c of the workpiece.
    z = surface.height(x * np.cos(c), -x * np.sin(c))
    return AxisPositions(x, zero, z, zero, c)


@dataclass(frozen=True, slots=True)
class Chirp:
    """Z swings with constant amplitude while its frequency rises linearly (the paper's Fig. 9).

    peak_to_peak: [m];  start_frequency, end_frequency: [Hz];  duration: [s]
    """

    peak_to_peak: float = 40e-6
    start_frequency: float = 0.0
    end_frequency: float = 15.0
    duration: float = 25.0

    def positions(self, time: FloatArray) -> AxisPositions:
        """Return the commanded axes at ``time`` [s], at standstill before the start."""
        running = np.maximum(time, 0.0)
        sweep = (self.end_frequency - self.start_frequency) / self.duration
        turns = self.start_frequency * running + 0.5 * sweep * running**2
        return _z_only(0.5 * self.peak_to_peak * np.cos(2 * np.pi * turns))


# The golden ratio distributes any number of edges evenly over the sample period.
_GOLDEN = 0.6180339887498949
# Samples in an S-curve from which its content above the Nyquist frequency is negligible.
_LEAST_RISE_SAMPLES = 10
# Defaults of a planned step test: 90 µm of travel with steps of two heights in one minute, which
# determines a relaxation as slow as the test to 12 ppm (10 nm of noise at 1 kHz).
PLANNED_COUNT = 14
PLANNED_DWELL_S = 2.0
PLANNED_STEP_M = 9.8e-6
# Ratio of the second height to the first, 3 µm to 9.8 µm, no simple fraction.
SECOND_SHARE = 3 / 9.8
BEYOND = 0.3  # share of the radius by which a verifying scan goes on beyond the axis
# Lines of a table that a controller reads: a quarter of an hour at 1 kHz, 30 MB.
_MOST_LINES = 1_000_000


@dataclass(frozen=True, slots=True)
class StepPlan:
    """A step test: start [s] and height [m] of each edge, their rise [s], and the duration [s].

    Edges are jerk-limited S-curves that start at different fractions of the sample period, so that
    aliased content differs from edge to edge. Raises ConfigurationError if edges overlap.
    """

    starts: tuple[float, ...]
    heights: tuple[float, ...]
    rise: float
    duration: float

    def __post_init__(self) -> None:
        if np.any(np.diff(self.starts) < self.rise):
            raise ConfigurationError("kinematics.edges_overlap", rise=self.rise)

    @property
    def travel(self) -> float:
        """Distance from the lowest to the highest plateau [m]."""
        return float(np.ptp(np.cumsum([0.0, *self.heights])))

    def z(self, time: FloatArray) -> FloatArray:
        """Return the commanded position [m] at ``time`` [s], of the same shape."""
        starts, heights = np.asarray(self.starts), np.asarray(self.heights)
        levels = np.concatenate([[0.0], np.cumsum(heights)])
        edge = np.maximum(np.searchsorted(starts, time, side="right") - 1, 0)
        with np.errstate(divide="ignore", invalid="ignore"):  # without a rise edges are sharp
            phase = (time - starts[edge]) / self.rise
        progress = np.ones_like(phase)
        # Evaluated only within the edges, a hundredth of the time.
        moving = phase < 1
        progress[moving] = s_curve(phase[moving])
        return np.asarray(levels[edge] + heights[edge] * progress)

    def positions(self, time: FloatArray) -> AxisPositions:
        """Return the commanded axes at ``time`` [s]; only Z moves."""
        return _z_only(self.z(time))


def plan_steps(
    *,
    sample_period: float,
    step: float = PLANNED_STEP_M,
    second_step: float | None = None,
    count: int = 10,
    dwell: float = 0.5,
    rise: float = 20e-3,
    half_range: float = 50e-6,
    sharp: bool = False,
) -> StepPlan:
    """Return ``count`` steps up and as many down, dithered within ``sample_period`` [s].

    The motion goes half of the travel up, all of it down and half of it up again. It separates a
    slow relaxation from a drift twice as well as a motion from one end to the other and back.

    step: [m];  second_step: height of every other step [m], None for equal steps; two heights
        separate non-linearity (backlash, friction, stiffening) from linear dynamics
    dwell: from edge to edge [s], as long as the slowest relaxation to be separated from gain
    sharp: edges rise within a tenth of a sample, for a mode in equivalent time alone
    rise: of an edge [s];  half_range: of the probe [m], which must include the whole travel

    Raises ConfigurationError for a plan that the probe or the sampling cannot follow.
    """
    if sharp:
        rise = sample_period / 10
    elif rise < _LEAST_RISE_SAMPLES * sample_period:
        least = _LEAST_RISE_SAMPLES * sample_period
        raise ConfigurationError("kinematics.rise", rise=rise, period=sample_period, least=least)
    upward = np.where(np.arange(count) % 2, step if second_step is None else second_step, step)
    travel = float(np.sum(upward))
    if travel > 2 * half_range:
        raise ConfigurationError(
            "kinematics.travel", count=count, travel=travel, half_range=half_range
        )
    if dwell < 3 * rise:
        raise ConfigurationError("kinematics.dwell", dwell=dwell, rise=rise, least=3 * rise)
    edges = np.arange(1, 2 * count + 1)
    dither = (edges * _GOLDEN) % 1.0 * sample_period
    middle = count // 2
    heights = np.concatenate([upward[middle:], -upward[::-1], upward[:middle]])
    return StepPlan(
        tuple((edges * dwell + dither).tolist()),
        tuple(heights.tolist()),
        rise,
        float(dwell * (2 * count + 1)),
    )


# Number of odd lines in a group; one of each is left out to show distortion of odd degree.
_GROUP = 4


@dataclass(frozen=True, slots=True)
class MultisinePlan:
    """A random-phase multisine in Z for the best linear approximation.

    sample_period: [s];  period: samples of a period;  periods: that are evaluated
    realisations: with phases of their own, each after one period in which the phases change
    lines: that are excited, in periods a period;  amplitudes: of each [m];  seed: of the phases
    """

    sample_period: float
    period: int
    periods: int
    realisations: int
    lines: tuple[int, ...]
    amplitudes: tuple[float, ...]
    seed: int

    @property
    def samples(self) -> int:
        """Return the number of samples, with one period in which the motion ends."""
        return self.period * (self.realisations * (self.periods + 1) + 1)

    @property
    def times(self) -> FloatArray:
        """Return the times of the samples [s]."""
        return np.asarray(self.sample_period * np.arange(self.samples), np.float64)

    @property
    def duration(self) -> float:
        """Return the duration [s]."""
        return self.samples * self.sample_period

    def z(self, time: FloatArray) -> FloatArray:
        """Return the commanded position [m] at ``time`` (n,) [s]."""
        turns = np.asarray(time, np.float64) / (self.period * self.sample_period)
        random, found = np.random.default_rng(self.seed), np.zeros(len(turns))
        for number in range(self.realisations):
            start = number * (self.periods + 1)
            phases = random.uniform(0, 2 * np.pi, len(self.lines))
            used = np.flatnonzero((turns > start) & (turns < start + self.periods + 2))
            own, wave = turns[used], np.zeros(len(used))
            for line, amplitude, phase in zip(self.lines, self.amplitudes, phases, strict=True):
                wave += amplitude * np.cos(2 * np.pi * line * own + phase)
            found[used] += wave * (s_curve(own - start) - s_curve(own - start - self.periods - 1))
        return found

    def positions(self, time: FloatArray) -> AxisPositions:
        """Return the commanded axes at ``time`` [s]; only Z moves."""
        return _z_only(self.z(time))


def plan_multisine(
    *,
    sample_period: float,
    resolution: float = 0.5,
    up_to: float = 60.0,
    periods: int = 3,
    realisations: int = 6,
    half_range: float = 50e-6,
    speed: float = 5e-3,
    acceleration: float = 1.0,
    seed: int = 1,
) -> MultisinePlan:
    """Return a multisine of odd lines up to ``up_to`` [Hz], as large as the limits allow.

    resolution: distance of lines [Hz];  half_range: of the probe [m]
    speed, acceleration: largest of the axis [m/s], [m/s²]
    The amplitude falls with the frequency, as those of scans do.

    Raises ConfigurationError for a plan that cannot be sampled or evaluated.
    """
    period, last = round(1 / (resolution * sample_period)), int(up_to / resolution)
    if periods < 2 or realisations < 2 or not 2 * _GROUP <= last < 0.4 * period:
        raise ConfigurationError(
            "kinematics.multisine",
            periods=periods,
            realisations=realisations,
            up_to=up_to,
            least=2 * _GROUP * resolution,
            most=0.4 / sample_period,
        )
    odd = np.arange(1, last + 1, 2)
    random = np.random.default_rng(seed)
    left_out = np.arange(0, len(odd) - _GROUP + 1, _GROUP)
    lines = np.delete(odd, left_out + random.integers(1, _GROUP, len(left_out)))
    shape = 1 / (lines + 0.1 * last)
    plan = MultisinePlan(
        sample_period,
        period,
        periods,
        realisations,
        tuple(lines.tolist()),
        tuple(shape.tolist()),
        seed,
    )
    z = plan.z(plan.times)
    rate = np.diff(z) / sample_period
    sizes = np.max(np.abs(z)), np.max(np.abs(rate)), np.max(np.abs(np.diff(rate))) / sample_period
    allowed = half_range, speed, acceleration
    size = 0.98 * min(most / found for most, found in zip(allowed, sizes, strict=True))
    return replace(plan, amplitudes=tuple((size * shape).tolist()))


def plan_csv(plan: StepPlan | MultisinePlan, period: float) -> str:
    """Return ``time_s,z_m`` lines every ``period`` [s]; ConfigurationError beyond a million."""
    if plan.duration > _MOST_LINES * period:
        raise ConfigurationError(
            "kinematics.lines",
            duration=plan.duration,
            period=period,
            lines=round(plan.duration / period),
            most=_MOST_LINES,
        )
    time = np.asarray(np.arange(round(plan.duration / period) + 1) * period, np.float64)
    rows = [f"{t:.6f},{z:.12e}" for t, z in zip(time, plan.z(time), strict=True)]
    return "\n".join(["time_s,z_m", *rows]) + "\n"
