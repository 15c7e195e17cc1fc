"""Do the counts of two devices mean one trigger? What the newest motion says of it.

Stamps show a slip only beyond half a sample and what links deliver late, and a link that is late
by a constant looks like one. A motion of Z before a fixed target tells both apart.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.samples.blocks import AxisBlock, DistanceBlock, FloatArray
from omsm_ros.core.verification.counter_offset import CounterOffset, counter_offset
from omsm_ros.errors import DataError

# What is judged: so much of the newest motion, but no more samples [s, samples].
_SPAN_S, _MOST_SAMPLES = 4.0, 16_384
# Offsets are searched as far as links may be late [s].
_SEARCH_S = 0.25
# A surface that moves with Z, but some samples later, looks like an offset of its share of them. So
# the distance must answer to Z as before a fixed target, to this part of the static gain.
_SAME_GAIN = 0.01
# Between two findings that must agree, so that one of them holds motion that the other has not [s].
_APART_S = 1.0


class LiveOffset:
    """Keeps the newest samples of both streams, and what a motion established of their counts.

    calibration: its lag is what the distance comes late by anyway
    in_use: added to the distance's count it should give the axes' count [samples]
    established: what has to be added besides; None until a motion told, and after a restart
    """

    def __init__(self, calibration: Calibration, in_use: int) -> None:
        self.in_use = in_use
        self.established: CounterOffset | None = None
        self._gain = abs(calibration.static_gain)
        self._lag = calibration.dynamics.low_frequency_delay
        self._lag_uncertainty = calibration.low_frequency_delay_uncertainty
        self._axes, self._distance = _Newest(), _Newest()
        self._found: tuple[int, int] | None = None

    def add(self, block: AxisBlock | DistanceBlock) -> None:
        """Take the next block of either stream."""
        if isinstance(block, AxisBlock):
            anew = self._axes.add(block.first_sample, block.z, block.sample_period)
        else:
            told = np.where(block.ok, block.distance, np.nan)
            anew = self._distance.add(block.first_sample + self.in_use, told, block.sample_period)
        if anew:
            self.established = self._found = None

    def judge(self) -> None:
        """Look whether the newest motion tells the offset: twice the same, then it is believed."""
        period = self._axes.period
        end = min(self._axes.end, self._distance.end)
        first = max(self._axes.first, self._distance.first, end - self._axes.most)
        if not period or end <= first:
            return
        if self._found is not None and end < self._found[0] + _APART_S / period:
            return
        z, distance = (stream.column(first, end) for stream in (self._axes, self._distance))
        known = np.flatnonzero(np.isfinite(z))
        if not len(known):
            return
        z = np.interp(np.arange(len(z)), known, z[known])
        try:
            found = counter_offset(
                z,
                distance,
                np.isfinite(distance),
                most=min(round(_SEARCH_S / period), len(z) // 8),
                lag=self._lag / period,
                lag_uncertainty=self._lag_uncertainty / period,
            )
        except DataError:
            return  # this motion does not tell
        if abs(abs(found.gain) - self._gain) > _SAME_GAIN * self._gain:
            return  # it follows a surface
        before, self._found = self._found, (end, found.samples)
        if before is not None and before[1] == found.samples:
            self.established = found


class _Newest:
    """The newest samples of one stream, by count.

    first, end: counts that are kept;  most: how many are [samples];  period: of them [s]
    """

    def __init__(self) -> None:
        self.first = self.end = self.most = 0
        self.period = 0.0
        self._parts: deque[tuple[int, FloatArray]] = deque()

    def add(self, first: int, values: FloatArray, period: float) -> bool:
        """Append a block; return whether its counter began anew."""
        anew = bool(self._parts) and first < self.end
        if anew:
            self._parts.clear()
        # Of samples further apart than the span the newest one is kept.
        self.period, self.most = period, min(max(round(_SPAN_S / period), 1), _MOST_SAMPLES)
        self._parts.append((first, values))
        self.end = first + len(values)
        while self._parts[0][0] + len(self._parts[0][1]) <= self.end - self.most:
            self._parts.popleft()
        self.first = self._parts[0][0]
        return anew

    def column(self, first: int, end: int) -> FloatArray:
        """Return the values of counts ``first`` to ``end`` (n,), NaN where there is none."""
        made = np.full(end - first, np.nan)
        for start, values in self._parts:
            low, high = max(start, first), min(start + len(values), end)
            if low < high:
                made[low - first : high - first] = values[low - start : high - start]
        return made
