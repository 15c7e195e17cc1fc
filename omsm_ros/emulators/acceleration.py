"""The accelerometer of the emulated cell: blocks in step with the motion that is played."""

from __future__ import annotations

from omsm_ros.core.samples.blocks import AccelerationBlock
from omsm_ros.twin.cell import Recording
from omsm_ros.units import NANOSECONDS_PER_S


class AccelerationFeed:
    """Hands out a recording's acceleration as the motion goes on; one without has none."""

    def __init__(self, recording: Recording, start_ns: int) -> None:
        """start_ns: when the motion begins [ns]."""
        self._whole, self._start_ns, self._given = recording.acceleration, start_ns, 0
        self._period = recording.axes.sample_period

    def due(self, played: int) -> AccelerationBlock | None:
        """Return what has been felt until the trigger ``played``, and not been handed out yet."""
        whole = self._whole
        if whole is None:
            return None
        until = min(int(played * self._period / whole.sample_period), len(whole))
        if until <= self._given:
            return None
        part = slice(self._given, until)
        stamp = self._start_ns + round(self._given * whole.sample_period * NANOSECONDS_PER_S)
        first, self._given = whole.first_sample + self._given, until
        return AccelerationBlock(
            stamp_ns=stamp,
            first_sample=first,
            sample_period=whole.sample_period,
            x=whole.x[part],
            y=whole.y[part],
            z=whole.z[part],
        )
