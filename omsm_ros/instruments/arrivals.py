"""Arrivals of samples: they give the host's time of a device's clock, and show missed triggers.

Host time is fitted as ``offset + (1 + drift) · device time`` over the arrivals of half a minute:
robustly, since some arrivals are very late, and over a window, since crystals change with
temperature.
"""

import math
from collections import deque
from collections.abc import Sequence

import numpy as np

from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.streams.statistics import spread
from omsm_ros.errors import ConfigurationError
from omsm_ros.units import NANOSECOND_S, NANOSECONDS_PER_S, PPM

# Long enough to average jitter out, short enough to follow a crystal that warms up [s].
WINDOW_S = 30.0
# Arrivals closer than this count as one, their mean: it bounds the fit to 1500 points [s].
_BIN_S = 0.02
# The line is fitted anew after this time [s], and after this part of its span [1].
_FIT_S, _FIT_PART = 0.1, 0.02
# Crystals differ by some tens of ppm: the standard uncertainty of the drift before any arrival.
_DRIFT_SIGMA = 100 * PPM
# A drift beyond this by five of its standard uncertainties is not that of a crystal: the device
# is played faster than it was recorded, or set to another rate.
_LARGEST_CRYSTAL_DRIFT = 1000 * PPM
# A clock was set if all arrivals are off the line to one side, by this, for the second time [s].
_STEP_S, _STEP_AFTER_S = 0.02, 2.0
# A busy host delays its first arrivals by less than this, so an arrival that is earlier by more
# shows at once that a clock was set [s].
_EARLY_S = 1.0
# No device holds a sample back for longer than this before it sends it [s].
_OLDEST_S = 3600.0
# The drift is reported after this time of arrivals [s].
_LEAST_SPAN_S = 5.0
# A drift of a tenth or more is another rate; arrivals uneven by 20 ms determine it to 0.01 in 1 s.
_GROSS, _GROSS_SPAN_S = 0.1, 1.0
# Huber's constant for a Gaussian efficiency of 95 % is 1.345; at 1.5 uniform jitter is not clipped.
_HUBER = 1.5
_ITERATIONS = 5
_LEAST_SCALE_S = 1e-6


class DeviceClock:
    """Converts device time to host time; the stamps rise strictly and evenly.

    If the clock of the device or the host is set, the stamps follow after two seconds, or at once
    if samples then arrive before they were taken.
    """

    def __init__(self) -> None:
        self._last_stamp: int | None = None
        self.restart()

    def restart(self) -> None:
        """Forget all arrivals, as after a restart of the device's clock; stamps still rise."""
        # Bins: sums of device time and of delay after the origin [s], and how many.
        self._bins: deque[tuple[float, float, int]] = deque()
        self._origin = self._newest = (0, 0)
        self._offset = self._slope = 0.0
        self._span = 0.0
        self._fitted_at = -np.inf
        # Whether arrivals have been late or early, and since when [device, arrival; s].
        self._astray: tuple[bool, float, float] | None = None

    @property
    def drift(self) -> float | None:
        """Return host seconds per device second, less one; None before it is known."""
        patience = _GROSS_SPAN_S if abs(self._slope) > _GROSS else _LEAST_SPAN_S
        return self._slope if self._span >= patience else None

    def observe(self, device_ns: int, arrival_ns: int) -> None:
        """Enter the arrival at ``arrival_ns`` of a sample taken at ``device_ns``.

        The last one of samples that arrive together is enough.
        """
        if not self._bins:
            self._origin = (device_ns, arrival_ns)
        device = (device_ns - self._origin[0]) * NANOSECOND_S
        late = (arrival_ns - self._origin[1]) * NANOSECOND_S - device
        if self._stepped(device, late):
            self.restart()
            self.observe(device_ns, arrival_ns)
            return
        self._newest = (device_ns, arrival_ns)
        self._keep(device, late)
        patience = max(_FIT_S, _FIT_PART * self._span)
        if len(self._bins) < 50 or not 0 <= device - self._fitted_at < patience:
            self._fit()
            self._fitted_at = device

    def to_host(self, device_ns: int) -> int:
        """Return the host time [ns] of ``device_ns``, later than every stamp given before.

        A device time out of the possible range is replaced by that of the newest sample.
        """
        if not self._bins:
            raise ConfigurationError("DeviceClock.to_host before any arrival; call observe() first")
        age = (self._newest[0] - device_ns) * NANOSECOND_S
        if not -_EARLY_S < age < _OLDEST_S:
            device_ns = self._newest[0]
        since = device_ns - self._origin[0]
        late = self._offset + self._slope * (since * NANOSECOND_S)
        stamp = self._origin[1] + since + round(late * NANOSECONDS_PER_S)
        if self._last_stamp is not None:
            stamp = max(stamp, self._last_stamp + 1)
        self._last_stamp = stamp
        return stamp

    def _keep(self, device: float, late: float) -> None:
        """Add to the last bin, or begin one; remove bins that are older than the window."""
        if self._bins:
            total, delay, count = self._bins[-1]
            if 0 <= device - total / count < _BIN_S:
                self._bins[-1] = (total + device, delay + late, count + 1)
                return
        self._bins.append((device, late, 1))
        while device + late - _arrival(self._bins[0]) > WINDOW_S:
            self._bins.popleft()

    def _stepped(self, device: float, late: float) -> bool:
        """Return whether arrivals have been off the line, to one side, for too long or too far."""
        off = late - (self._offset + self._slope * device)
        if self._bins and not -_EARLY_S < off < _OLDEST_S:
            return True
        side, arrival = bool(off > 0), device + late
        if not self._bins or abs(off) < _STEP_S:
            self._astray = None
        elif self._astray is None or self._astray[0] != side:
            self._astray = (side, device, arrival)
        if self._astray is None:
            return False
        _, since, arrived = self._astray
        return min(device - since, arrival - arrived) > _STEP_AFTER_S

    def _fit(self) -> None:
        """Fit Huber's line through the bins, with the prior of crystals for the drift."""
        bins = np.array(self._bins)
        count = bins[:, 2]
        device, late = bins[:, 0] / count, bins[:, 1] / count
        self._span = float(np.ptp(device))
        # About the middle, the estimates of offset and drift do not correlate.
        middle = float(device.mean())
        free = _line(device - middle, late, count, np.inf)
        beyond = abs(free[1]) - 5 * free[2] > _LARGEST_CRYSTAL_DRIFT and len(count) > 5
        offset, slope, _ = free if beyond else _line(device - middle, late, count, _DRIFT_SIGMA)
        self._slope = slope
        self._offset = offset - slope * middle


def _arrival(item: tuple[float, float, int]) -> float:
    return (item[0] + item[1]) / item[2]


def _line(
    x: FloatArray, y: FloatArray, count: FloatArray, sigma: float
) -> tuple[float, float, float]:
    """Return offset, slope and its uncertainty of a robust line; sigma: of the slope's prior."""
    offset, slope = float(np.median(y)), 0.0
    weight, scale = count, _LEAST_SCALE_S
    uncertainty = np.inf
    for _ in range(_ITERATIONS):
        residual = y - offset - slope * x
        scale = max(_LEAST_SCALE_S, spread(residual))
        weight = count * np.minimum(1.0, _HUBER * scale / np.maximum(abs(residual), 1e-12))
        total = weight.sum()
        mx, my = float((weight * x).sum() / total), float((weight * y).sum() / total)
        held = (scale / sigma) ** 2
        power = float((weight * (x - mx) ** 2).sum()) + held
        slope = float((weight * (x - mx) * (y - my)).sum()) / power if power > 0 else 0.0
        offset = my - slope * mx
        uncertainty = scale / np.sqrt(power) if power > 0 else np.inf
    return offset, slope, float(uncertainty)


# Arrivals of a span of _DECISION_S decide whether triggers were missed if there are _ARRIVALS, else
# those of _LONG_DECISION_S; a decision waits no longer than _LONGEST_S.
_DECISION_S, _ARRIVALS, _LONG_DECISION_S, _LONGEST_S = 0.2, 12, 0.6, 0.8
_LEAST_ARRIVALS = 3
# Earliest arrivals of so many spans are the reference; least number of it, and that for a drift.
_SPANS, _LEAST_SPANS, _DRIFT_SPANS = 15, 4, 8
# The last sample of a portion may be nearly a period old, so a delay counts from here on [period].
_LATE_PERIODS, _AGE_PERIODS, _AGES_OF_FEW = 0.75, 0.25, 1.5
# Limit of lateness over the range of the earliest arrivals, of many and of few spans [1].
_RANGES, _RANGES_OF_FEW = 2.0, 3.0


class MissedTriggerDetector:
    """Detects triggers that a device without a clock missed, by the arrivals of its samples.

    No sample arrives before it was taken, so the earliest arrivals of each span are even although
    others are late by chance. After a missed trigger all arrivals are late by a period. An arrival
    that is not late confirms all samples up to it; until then they wait.

    seen_from: least number of missed triggers that exceeds the scatter of the arrivals
    """

    def __init__(self, period: float) -> None:
        """period: of the trigger [s]."""
        self._period = period
        self.restart()

    def restart(self) -> None:
        """Forget all arrivals, as after a pause of the trigger."""
        # Begin of each span, its earliest lateness [s], arrivals.
        self._earliest: deque[tuple[float, float, int]] = deque(maxlen=_SPANS)
        self._off: list[tuple[float, float]] = []  # arrival and excess of those that are off [s]
        self._dropped = False
        self._expected: float | None = None  # lateness of the earliest at ``_since`` [s]
        self._since = self._drift = 0.0
        self._limit, self.seen_from = _LATE_PERIODS * self._period, 1

    def missed(self, due: float, arrival: float) -> int | None:
        """Return the triggers missed before this arrival; 0 confirms it; None: it has to wait.

        due: count, with the triggers missed so far, times period [s];  arrival: monotonic [s]
        A negative number is of triggers that were counted in excess.
        """
        late = arrival - due
        if self._expected is None:
            self._accept(arrival, late)
            return 0
        excess = late - self._expected - self._drift * (arrival - self._since)
        early = bool(self._off) and self._off[0][1] < 0
        if abs(excess) <= self._limit and not early:
            self._accept(arrival, late)
            return 0
        if excess < -self._limit and not early:
            self._off.clear()  # earlier than expected: none was missed
        if excess < -self._limit or (excess > self._limit and not early):
            self._off.append((arrival, excess))
        return self._decide(arrival)

    def end(self) -> int:
        """Return the triggers missed before the samples that wait, when no more will come."""
        missed = self._decide(self._off[-1][0] + _LONGEST_S) if self._off else 0
        self._off.clear()
        return missed or 0

    def _decide(self, now: float) -> int | None:
        waited, few = now - self._off[0][0], len(self._off) < _LEAST_ARRIVALS
        if not _is_whole(waited, len(self._off)) or (few and waited < _LONGEST_S):
            return None
        if few:
            self._off.clear()
            return 0
        recent = [excess for _, excess in self._off][-max(_ARRIVALS, len(self._off) // 2) :]
        half = (len(recent) + 1) // 2
        earlier, later = (self._triggers(part) for part in (recent[:half], recent[half:]))
        if earlier != later:
            if waited < _LONGEST_S:
                return None
            if len(self._off) > _ARRIVALS // 2 and not self._dropped:
                self._off, self._dropped = self._off[-half:], True  # the first ones were by chance
                return None
            self.restart()  # what grows is another rate
            return 0
        self._off.clear()
        self._dropped = False
        return later

    def _triggers(self, excess: Sequence[float]) -> int:
        """Return the triggers that the earliest arrival shows; its age may add most of another."""
        return math.floor(min(excess) / self._period + 1 - _LATE_PERIODS)

    def _accept(self, arrival: float, late: float) -> None:
        self._off.clear()
        self._dropped = False
        if self._earliest:
            begin, least, count = self._earliest[-1]
            if not _is_whole(arrival - begin, count):
                self._earliest[-1] = (begin, min(least, late), count + 1)
                return
        if len(self._earliest) >= _LEAST_SPANS:
            self._set_reference()
        self._earliest.append((arrival, late, 1))

    def _set_reference(self) -> None:
        """Lay a line below the earliest arrivals; their scatter is the limit of detection."""
        begin, late, _ = np.array(self._earliest).T
        since = begin - begin[-1]
        many = len(begin) >= _DRIFT_SPANS
        self._drift = float(np.polyfit(since, late, 1)[0]) if many else 0.0
        rest = late - self._drift * since
        self._since, self._expected = float(begin[-1]), float(rest.min())
        scatter = float(np.ptp(rest))
        if scatter < self._period:  # only the ages of samples scatter, by less than a period
            scatter = (1 if many else _AGES_OF_FEW) * scatter + _AGE_PERIODS * self._period
        else:
            scatter *= _RANGES if many else _RANGES_OF_FEW
        self._limit = max(_LATE_PERIODS * self._period, scatter)
        self.seen_from = int(np.ceil(self._limit / self._period))


def _is_whole(lasted: float, arrivals: int) -> bool:
    """Return whether a span that ``lasted`` [s] decides."""
    return lasted >= (_DECISION_S if arrivals >= _ARRIVALS else _LONG_DECISION_S)
