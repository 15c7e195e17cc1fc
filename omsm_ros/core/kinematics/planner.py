"""Paths that the planner of a controller executes well, and what it makes of them.

A planner joins straight segments by parabolas: C leaves its speed within a cycle while it reaches
the next one within another, so the polygon of the vertices is averaged over two cycles. Then cubics
interpolate the cycles: each becomes a sixth of its neighbours and two thirds of itself. It runs in
whole servo cycles, so a segment that takes a fraction of a cycle more is shortened: 27.8 ms at
1 kHz take 27 ms, and C turns 3 % too fast. So segments take whole cycles, and C reaches its speed
within one. The vertices are moved outward so that the path, not the vertices, is on the surface.
LinuxCNC 2.9 executes this to 0.01 nm.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy  # whose parts are loaded when they are used

from omsm_ros.core.streams.blocks import FloatArray

Path = Callable[[FloatArray], tuple[FloatArray, FloatArray, FloatArray]]
"""x [m], z [m] and c [rad] at times (n,) [s]."""

# Cycles of a segment, longest first. With fewer the planner of LinuxCNC adds or drops a cycle.
_CYCLES = (20, 16, 12, 10, 8, 6, 5, 4)
# Points of a segment at which its error is evaluated, and turns of moving the vertices outward.
_WITHIN, _ROUNDS = 8, 3
# Part of a path that chooses the segments [s]: some turns at the largest radius.
_TRIED_S = 10.0
# C reaches its speed within a cycle, and a little earlier, so that rounding decides nothing.
_SURPLUS = 1.001


@dataclass(frozen=True, eq=False)
class PlannedPath:
    """Vertices of a path at equal times, and the motion that a planner makes of them.

    time: of the vertices [s];  x, z: [m];  c: [rad], each (n,);  height: of the path there [m]
    cycle: of the servo [s], in which C reaches its speed
    error: bound on the distance of the motion from the path along Z [m];  rms: of it [m]
    """

    time: FloatArray
    x: FloatArray
    z: FloatArray
    c: FloatArray
    height: FloatArray
    cycle: float
    error: float
    rms: float

    @property
    def segment(self) -> float:
        """Duration of a segment [s]."""
        return float(self.time[1] - self.time[0])

    @property
    def c_acceleration(self) -> float:
        """Acceleration of C [rad/s²] that the controller must allow for a steady speed."""
        return _SURPLUS * float(abs(self.c[-1] - self.c[-2])) / self.segment / self.cycle

    def motion(self, time: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return x, z [m] and c [rad] at ``time`` (n,) [s]."""
        x, z, c = (executed(time, self.time, v, self.cycle) for v in (self.x, self.z, self.c))
        return x, z, c


def executed(at: FloatArray, time: FloatArray, values: FloatArray, cycle: float) -> FloatArray:
    """Return the motion at ``at`` (n,) [s] through vertices ``values`` (m,) at ``time`` (m,)."""
    before, there, after = (averaged(at + k * cycle, time, values, 2 * cycle) for k in (-1, 0, 1))
    return np.asarray((before + 4 * there + after) / 6)


def averaged(at: FloatArray, time: FloatArray, values: FloatArray, ramp: float) -> FloatArray:
    """Return the polygon through ``values`` (n,) at ``time`` (n,), averaged over ``ramp`` [s]."""
    reach = ramp + max(float(time[0] - np.min(at)), float(np.max(at) - time[-1]), 0.0)
    longer = np.concatenate([[time[0] - reach], time, [time[-1] + reach]])
    held = np.concatenate([values[:1], values, values[-1:]])
    integral = scipy.interpolate.make_interp_spline(longer, held, k=1).antiderivative()
    return np.asarray((integral(at + ramp / 2) - integral(at - ramp / 2)) / ramp)


def plan_path(path: Path, duration: float, cycle: float, bound: float) -> PlannedPath:
    """Return the longest segments with which a planner stays within ``bound`` [m] of ``path``.

    If none does, the shortest that planners execute well: compare ``error`` with the bound.

    cycle: of the servo [s];  duration: of the path [s]
    """
    tried = min(duration, _TRIED_S)
    for cycles in _CYCLES:
        found = planned_at(path, tried, cycles * cycle, cycle)
        if found.error <= bound or cycles == _CYCLES[-1]:
            found = planned_at(path, duration, cycles * cycle, cycle)
            if found.error <= bound:
                break
    return found


def planned_at(path: Path, duration: float, segment: float, cycle: float) -> PlannedPath:
    """Return ``path`` in segments of ``segment`` [s]."""
    time = np.asarray(np.arange(round(duration / segment) + 1) * segment, np.float64)
    x, z, c = path(time)
    within = np.asarray((np.arange(_WITHIN * (len(time) - 1)) + 0.5) * (segment / _WITHIN))
    wanted = path(within)[1]
    moved = z.copy()
    for _ in range(_ROUNDS):
        off = executed(within, time, moved, cycle) - wanted
        mean = np.mean(off.reshape(-1, _WITHIN), axis=1)
        moved[1:-1] -= (mean[1:] + mean[:-1]) / 2
    # At its ends the motion comes from rest and goes to rest, which is not the planner's error.
    off = (executed(within, time, moved, cycle) - wanted)[_WITHIN:-_WITHIN]
    return PlannedPath(
        time, x, moved, c, z, cycle, float(np.max(np.abs(off))), float(np.sqrt(np.mean(off**2)))
    )
