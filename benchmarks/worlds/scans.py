"""Command the paths: spirals over a part and step tests on a fixed flat mirror."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.worlds.machine import Machine, Path, Recording, record
from benchmarks.worlds.part import Flat, Part, Pose

Array = np.ndarray
STEP_OVERSAMPLING = 20


def spiral(
    part: Part,
    rpm: float = 30.0,
    direction: str = "in",
    clocking: float = 0.0,
    feed: float = 1e-4,
    beyond: float = 0.0,
    start: float = 0.0,
    ripple: tuple[float, float] = (0.0, 1.0),
) -> Path:
    """Return a spiral between the rim and ``beyond`` [m] past the centre.

    ``rpm`` below zero turns the spindle backwards; ``feed`` in m per turn; the part is clocked by
    ``clocking`` [rad], which Z's command knows; ``ripple``: amplitude [rad] and waves per turn of
    the true C against even speed.
    """
    if direction not in ("in", "out"):
        raise ValueError(f'direction has to be "in" or "out", not {direction!r}')
    pace = feed * abs(rpm) / 60
    length = part.radius + beyond
    sign = -1.0 if direction == "in" else 1.0
    first = part.radius if direction == "in" else -beyond
    turn = 2 * np.pi * rpm / 60
    cos, sin = np.cos(clocking), np.sin(clocking)

    def x_of(t: Array) -> Array:
        return first + sign * pace * t

    def c_of(t: Array) -> Array:
        return turn * t + ripple[0] * np.sin(ripple[1] * turn * t)

    def z_of(t: Array, c: Array) -> Array:
        qx, qy = x_of(t) * np.cos(c), -x_of(t) * np.sin(c)
        return part.nominal.height(qx * cos + qy * sin, qy * cos - qx * sin)

    return Path(x_of, c_of, z_of, length / pace, rpm, direction == "out", start)


def scan(
    machine: Machine, part: Part, path: Path, seed: int = 0, pose: Pose | None = None
) -> Recording:
    """Run a spiral; ``pose`` holds the clocking that the path was made for."""
    return record(machine, part, pose or Pose(), path, seed)


def steps(
    heights: Sequence[float] = (10e-6, 3e-6),
    count: int = 10,
    dwell: float = 0.7,
    edge: float = 0.02,
    centred: bool = True,
    seed: int = 0,
) -> Path:
    """Return a staircase of ``count`` steps up and ``count`` down for each height [m].

    An edge is a jerk-limited curve of ``edge`` seconds, or sharp if zero (the servo shapes it);
    it begins at an arbitrary moment within a sample period. ``centred`` begins and ends in the
    middle of the range.
    """
    rng = np.random.default_rng([seed, 77])
    ways = []
    for height in heights:
        half = count // 2 if centred else count
        ways += [height] * half + [-height] * count + [height] * (count - half)
    begin = dwell * (1 + np.arange(len(ways))) + rng.uniform(0, 1e-3, len(ways))
    bottom = 0.0 if centred else -count * max(heights) / 2

    def z_of(t: Array, c: Array) -> Array:
        z = np.full(len(t), bottom)
        for way, at in zip(ways, begin, strict=True):
            s = np.clip((t - at) / edge, 0, 1) if edge else (t >= at).astype(float)
            z += way * s**3 * (10 - 15 * s + 6 * s**2)
        return z

    def still(t: Array) -> Array:
        return np.zeros(len(t))

    duration = dwell * (len(ways) + 2)
    return Path(still, still, z_of, duration, oversampling=STEP_OVERSAMPLING)


def step_test(machine: Machine, path: Path | None = None, seed: int = 0) -> Recording:
    """Run a staircase before a flat mirror that does not turn."""
    return record(machine, Flat(), Pose(), path or steps(seed=seed), seed)
