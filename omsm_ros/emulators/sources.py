"""What an emulated device measures: the twin's recordings, or samples that hold their number."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.samples.blocks import FloatArray, Status
from omsm_ros.twin.cell import Recording

AXES = ("x", "y", "z", "b", "c")


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """Consecutive samples, arrays of shape (n,).

    distance: [m], NaN where there is none;  intensity: 0-1;  status: Status
    axes: x, y, z [m], b, c [rad] by name
    """

    distance: FloatArray
    intensity: NDArray[np.float32]
    status: NDArray[np.uint8]
    axes: dict[str, FloatArray]

    def __len__(self) -> int:
        return len(self.distance)


class Source(Protocol):
    """What there is to measure, sample by sample of a trigger."""

    length: float
    period: float

    def take(self, first: int, count: int) -> Measured:
        """Return samples ``first`` to ``first + count``; those beyond the length are left out."""


class RecordingSource:
    """A motion of the twin, once."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self.length = len(recording.axes)
        self.period = recording.axes.sample_period

    def take(self, first: int, count: int) -> Measured:
        part = slice(first, first + count)
        axes, distance = self._recording.axes, self._recording.distance
        size = len(axes.z[part])
        reported = len(distance.intensity) > 0
        return Measured(
            distance.distance[part],
            distance.intensity[part] if reported else np.full(size, 0.5, np.float32),
            distance.status[part] if len(distance.status) else np.zeros(size, np.uint8),
            {name: getattr(axes, name)[part] for name in AXES},
        )


class NumberedSource:
    """Without end; sample k stands at x = k nm, so every sample shows which one it is.

    The other channels follow from k too: see ``NumberedSource.take``.
    """

    def __init__(self, period: float = 1e-3) -> None:
        self.length = math.inf
        self.period = period

    def take(self, first: int, count: int) -> Measured:
        """Return distance (10 + k mod 80) µm, y -k nm, z k mod 1000 µm, b k µrad, c k mrad."""
        k = np.arange(first, first + count, dtype=np.float64)
        return Measured(
            (10 + k % 80) * 1e-6,
            np.full(count, 0.5, np.float32),
            np.full(count, Status.OK, np.uint8),
            {"x": k * 1e-9, "y": -k * 1e-9, "z": k % 1000 * 1e-6, "b": k * 1e-6, "c": k * 1e-3},
        )
