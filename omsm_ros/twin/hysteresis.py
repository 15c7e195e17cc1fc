"""What follows a motion and depends on where it turned last: backlash and pre-sliding friction.

Between two reversals both have a closed form, so only the reversals are walked through.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.twin.trajectory import Trajectory

# A change smaller than this between two steps is rounding, not a reversal [m].
_STILL_M = 1e-16


@dataclass(frozen=True, eq=False)
class Driven(Trajectory):
    """A motion behind backlash, as exact between its values as that of what drives it.

    driver: what drives it;  held: where it stays until it is driven on, (n,) [m]
    half_width: of the play on either side [m]
    """

    driver: Trajectory
    held: FloatArray
    half_width: float

    def at(self, time: FloatArray) -> FloatArray:
        """Return the position [m] at ``time`` [s], of its shape; a cubic would round its kinks."""
        driver = self.driver.at(time)
        following = np.ceil((time - self.start) / self.step).astype(np.int64)
        held = self.held[np.minimum(following, len(self.held) - 1)]
        low, high = driver - self.half_width, driver + self.half_width
        return np.asarray(np.clip(held, low, high), np.float64)


def backlash(driver: Trajectory, width: float) -> Driven:
    """Return what follows ``driver`` through a gap of ``width`` [m], at first in its middle."""
    position, half = driver.values, width / 2
    runs, state, states = list(_monotone_runs(position)), position[0], []
    for _, last, up in runs:
        states.append(state)
        end = position[last - 1]
        state = max(state, end - half) if up else min(state, end + half)
    held = np.repeat(states, [last - first for first, last, _ in runs])
    values = np.clip(held, position - half, position + half)
    return Driven(driver.start, driver.step, values, driver, held, half)


def friction(position: FloatArray, presliding: float) -> FloatArray:
    """Return Dahl's friction, -1 to 1 (n,), along ``position`` (n,) [m], none at first.

    Along a run of one direction s: ``F = s - (s - F₀) exp(-|z - z₀| / presliding)``.
    """
    result, state = np.empty_like(position), 0.0
    for first, last, up in _monotone_runs(position):
        sign = 1.0 if up else -1.0
        travel = abs(position[first:last] - position[max(first - 1, 0)])
        result[first:last] = sign - (sign - state) * np.exp(-travel / presliding)
        state = result[last - 1]
    return result


def _monotone_runs(position: FloatArray) -> Iterator[tuple[int, int, bool]]:
    """Yield pieces ``first:last`` in which the position only rises (True) or only falls."""
    change = np.diff(position, prepend=position[0])
    moving = abs(change) > _STILL_M
    # At rest the direction is that of the last move.
    latest = np.maximum.accumulate(np.where(moving, np.arange(len(position)), 0))
    up = change[latest] > 0
    cuts = np.flatnonzero(up[1:] != up[:-1]) + 1
    bounds = [0, *cuts.tolist(), len(position)]
    for first, last in pairwise(bounds):
        yield first, last, bool(up[first])
