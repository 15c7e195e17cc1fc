"""Simulated signal that can be evaluated between its computed values."""

from dataclasses import dataclass

import numpy as np

from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import ConfigurationError

# Distance from the grid, in steps, that is rounding of k · period.
_ON_THE_GRID = 1e-7


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Signal with ``values`` (n,) at ``start`` [s] and every ``step`` [s] after it."""

    start: float
    step: float
    values: FloatArray

    @property
    def times(self) -> FloatArray:
        """Instants of the values [s], (n,)."""
        return self.start + np.arange(len(self.values), dtype=np.float64) * self.step

    def at(self, time: FloatArray) -> FloatArray:
        """Return the value at ``time`` [s], of its shape, by a cubic between the grid points.

        Raises ConfigurationError for a time before the start or after the end.
        """
        place = (time - self.start) / self.step
        nearest = np.rint(place)
        last = len(self.values) - 1
        if place.size and not -_ON_THE_GRID <= place.min() <= place.max() <= last + _ON_THE_GRID:
            raise ConfigurationError(
                f"twin: asked for {time.min():g} to {time.max():g} s, simulated are "
                f"{self.start:g} to {self.times[-1]:g} s; a clock cannot be off by so much"
            )
        if np.all(abs(place - nearest) < _ON_THE_GRID):
            return np.asarray(self.values[nearest.astype(np.int64)])
        return self._between(place)

    def _between(self, place: FloatArray) -> FloatArray:
        """Return Lagrange's cubic through two values before and two after ``place`` [steps]."""
        index = np.clip(np.floor(place).astype(np.int64), 1, len(self.values) - 3)
        u = place - index
        v, w, q = u + 1, u - 1, u - 2
        values = self.values
        return np.asarray(
            -u * w * q / 6 * values[index - 1]
            + v * w * q / 2 * values[index]
            - v * u * q / 2 * values[index + 1]
            + v * u * w / 6 * values[index + 2]
        )
