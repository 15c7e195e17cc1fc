"""Motions of the cell as functions of time, such as a machine can run.

Each motion gives the commanded axes at any time, also before its start: a machine is
already moving when the first trigger comes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from omsm_ros.core.machine.surface_height import Surface
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.errors import ConfigurationError
from omsm_ros.units import RPM_HZ, RPM_RAD_S


class AxisPositions(NamedTuple):
    """Commanded positions, each of the shape of the time they were asked for: m, m, m, rad, rad."""

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
    """Return rest-to-rest move from 0 to 1 over ``phase`` 0…1 with a jerk of constant magnitude.

    The jerk is ±32 (per unit of phase cubed) with signs + - - + over the four quarters.
    """
    p = np.clip(phase, 0.0, 1.0)
    mirrored = np.where(p > 0.5, 1.0 - p, p)
    late = mirrored - 0.25
    # Products, for a power of three takes ten times as long.
    first = 16 / 3 * (mirrored * mirrored * mirrored)
    second = 1 / 12 + late * (1 + late * (4 - 16 / 3 * late))
    half = np.where(mirrored < 0.25, first, second)
    return np.where(p > 0.5, 1.0 - half, half)


def _z_only(z: FloatArray) -> AxisPositions:
    zero = np.zeros_like(z)
    return AxisPositions(zero, zero, z, zero, zero)


@dataclass(frozen=True, slots=True)
class StepTest:
    """Z climbs ``count`` steps and comes down again, resting ``dwell`` after each edge.

    step: height of a step [m]
    count: steps up; as many follow down
    dwell: time from one edge to the next [s]
    rise: duration of a jerk-limited edge [s]; 0 is a sharp edge
    """

    step: float = 9.8e-6
    count: int = 10
    dwell: float = 0.5
    rise: float = 20e-3

    def __post_init__(self) -> None:
        if self.count < 1 or not self.dwell > self.rise >= 0:
            raise ConfigurationError(
                f"step test: count {self.count!r} must be 1 or more and dwell {self.dwell!r} s "
                f"longer than rise {self.rise!r} s, which is not negative"
            )

    @property
    def duration(self) -> float:
        """[s], with one dwell of rest before the first edge."""
        return self.dwell * (2 * self.count + 1)

    def positions(self, time: FloatArray) -> AxisPositions:
        """Return the commanded axes at ``time`` [s]."""
        # Rest before the first edge and after the last one are edges of no height.
        levels = np.r_[np.zeros(1), np.arange(self.count + 1), np.arange(self.count)[::-1]]
        edge = np.floor(time / self.dwell)
        index = np.clip(edge, 0, 2 * self.count).astype(np.int64)
        since = time - index * self.dwell
        if self.rise > 0:
            progress = s_curve(since / self.rise)
        else:
            progress = (since >= 0).astype(np.float64)
        before, after = levels[index], levels[index + 1]
        return _z_only(self.step * (before + (after - before) * progress))


@dataclass(frozen=True, slots=True)
class Spiral:
    """X feeds from ``start_radius`` to the centre while C turns and Z follows ``surface``.

    start_radius: [m];  feed_per_turn: [m];  spindle_speed: [rpm], negative reverses.
    Before its start the motion is a circle at the start radius.
    """

    surface: Surface
    start_radius: float
    feed_per_turn: float
    spindle_speed: float

    def __post_init__(self) -> None:
        if self.start_radius <= 0 or self.feed_per_turn <= 0 or self.spindle_speed == 0:
            raise ConfigurationError(
                f"spiral: start_radius {self.start_radius!r} m and feed_per_turn "
                f"{self.feed_per_turn!r} m must be positive, spindle_speed "
                f"{self.spindle_speed!r} rpm not zero"
            )
        if self.feed_per_turn > self.start_radius:
            raise ConfigurationError(
                f"spiral: a feed of {self.feed_per_turn!r} m a turn from a radius of "
                f"{self.start_radius!r} m makes not one turn; give a smaller feed, or a larger "
                "radius"
            )

    @property
    def duration(self) -> float:
        """Time until X reaches the centre [s]."""
        return self.start_radius / (self.feed_per_turn * abs(self.spindle_speed) * RPM_HZ)

    def positions(self, time: FloatArray) -> AxisPositions:
        """Return the commanded axes at ``time`` [s]."""
        feed = self.feed_per_turn * abs(self.spindle_speed) * RPM_HZ * np.maximum(time, 0.0)
        x = self.start_radius - feed
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
        """[s]"""
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
        """Return the commanded axes at ``time`` [s]; at rest before the start."""
        running = np.maximum(time, 0.0)
        sweep = (self.end_frequency - self.start_frequency) / self.duration
        turns = self.start_frequency * running + 0.5 * sweep * running**2
        return _z_only(0.5 * self.peak_to_peak * np.cos(2 * np.pi * turns))


@dataclass(frozen=True, slots=True)
class Multisine:
    """Z swings at several ``frequencies`` [Hz] at once, each with ``amplitude`` [m].

    Their phases keep the peak low (Schroeder 1970). Before its start it swings already.
    """

    frequencies: tuple[float, ...] = (0.7, 1.3, 2.9, 5.1, 7.7, 11.3, 14.9)
    amplitude: float = 3e-6
    duration: float = 20.0

    def positions(self, time: FloatArray) -> AxisPositions:
        """Return the commanded axes at ``time`` [s]."""
        count, z = len(self.frequencies), np.zeros_like(time)
        for k, frequency in enumerate(self.frequencies):
            z = z + np.cos(2 * np.pi * frequency * time - np.pi * k * k / count)
        return _z_only(self.amplitude * z)
