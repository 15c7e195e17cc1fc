"""The step test of the paper: equal edges at equal times, undithered."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from omsm_ros.core.kinematics.trajectories import AxisPositions, s_curve
from omsm_ros.core.streams.blocks import FloatArray


@dataclass(frozen=True, slots=True)
class StepTest:
    """Z climbs ``count`` steps and descends them again, with a rest after each edge.

    step: height of a step [m]
    count: steps up; as many follow down
    dwell: time from one edge to the next [s]
    rise: duration of a jerk-limited edge [s]; 0 is a sharp edge
    """

    step: float = 9.8e-6
    count: int = 10
    dwell: float = 0.5
    rise: float = 20e-3

    @property
    def duration(self) -> float:
        """Duration [s], with one dwell before the first edge."""
        return self.dwell * (2 * self.count + 1)

    def positions(self, time: FloatArray) -> AxisPositions:
        """Return the commanded axes at ``time`` [s]."""
        # The rests before the first and after the last edge are edges of zero height.
        levels = np.r_[np.zeros(1), np.arange(self.count + 1), np.arange(self.count)[::-1]]
        edge = np.floor(time / self.dwell)
        index = np.clip(edge, 0, 2 * self.count).astype(np.int64)
        since = time - index * self.dwell
        if self.rise > 0:
            progress = s_curve(since / self.rise)
        else:
            progress = (since >= 0).astype(np.float64)
        before, after = levels[index], levels[index + 1]
        z = self.step * (before + (after - before) * progress)
        zero = np.zeros_like(z)
        return AxisPositions(zero, zero, z, zero, zero)
