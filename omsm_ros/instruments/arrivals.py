"""Arrivals of samples: they give the host's time of a device's clock, and show missed triggers.

Host time is fitted as ``offset + (1 + drift) · device time`` over the arrivals of half a minute:
robustly, since some arrivals are very late, and over a window, since crystals change with
temperature.
"""

import math
from collections import deque

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


# The reference: earliest arrivals of spans of this length [s]; the number of spans, the least
# number, and that from which on the limit of what is late only falls.
_SPAN_S, _SPANS, _LEAST_SPANS, _MANY_SPANS = 0.2, 50, 4, 15
# The last sample of a portion may be nearly a period old: the lateness that confirms [period].
_LATE_PERIODS, _AGE_PERIODS = 0.75, 0.25
# It is at least this multiple of the lateness that half of the earliest arrivals have.
_USUAL = 2.0
# The arrivals of this time [s], and the least number of them, show the number of missed triggers.
_LATEST_S, _ARRIVALS = 1.0, 12


class MissedTriggerDetector:
    """Confirms by their arrivals the samples of a device without a clock, which may miss triggers.

    No sample arrives before it was taken, so a line below the earliest arrivals is even although
    others are late by chance. After a missed trigger all arrivals are late by a period. An arrival
    that is not late confirms all samples up to it; lateness alone proves nothing, so until then
    they wait. A busy host later does not widen the limit of what is late.

    seen_from: least number of missed triggers that exceeds the scatter of the arrivals
    """

    def __init__(self, period: float) -> None:
        """period: of the trigger [s]."""
        self._period = period
        self.restart()

    def restart(self) -> None:
        """Forget all arrivals, as after a pause of the trigger."""
        # Begin of each span, earliest lateness of all arrivals and of those that confirmed [s].
        self._earliest: deque[tuple[float, float, float]] = deque(maxlen=_SPANS)
        self._off: deque[tuple[float, float]] = deque()  # arrival and excess since confirmed [s]
        self._line: tuple[float, float] | None = None  # lateness of the earliest at 0, drift
        self._limit, self.seen_from = math.inf, 1
        self._confirmed = 0.0  # last arrival that confirmed [s]

    def confirms(self, due: float, arrival: float) -> bool:
        """Return whether no trigger was missed before this arrival, as far as can be seen.

        due: count times period [s];  arrival: monotonic [s]
        """
        late, excess = arrival - due, self.excess(due, arrival)
        # A line that is not confirmed any more is uncertain by the drift of crystals.
        confirmed = excess <= self._limit - _DRIFT_SIGMA * (arrival - self._confirmed)
        if confirmed:
            self._confirmed = arrival
            self._off.clear()
            if self._line is not None and excess < 0:
                self._line = (self._line[0] + excess, self._line[1])
        else:
            self._off.append((arrival, excess))
            while arrival - self._off[0][0] > _LATEST_S:
                self._off.popleft()
        sure = late if confirmed else math.inf
        if self._earliest and arrival - self._earliest[-1][0] < _SPAN_S:
            begin, least, surest = self._earliest[-1]
            self._earliest[-1] = (begin, min(least, late), min(surest, sure))
        else:
            self._set_reference()
            self._earliest.append((arrival, late, sure))
        return confirmed

    def excess(self, due: float, arrival: float) -> float:
        """Return by how much an arrival is later than the earliest ones [s]; -inf if not known."""
        if self._line is None:
            return -math.inf
        return arrival - due - self._line[0] - self._line[1] * arrival

    @property
    def missed(self) -> int:
        """Return the missed triggers that the latest arrivals show if none confirms; else 0."""
        if len(self._off) < _ARRIVALS or self._off[-1][0] - self._off[0][0] < _SPAN_S:
            return 0
        least = min(excess for _, excess in self._off)
        return math.floor(least / self._period + 1 - _LATE_PERIODS)

    def _set_reference(self) -> None:
        """Lay the highest line below the earliest arrivals; their scatter is the limit."""
        if len(self._earliest) < _LEAST_SPANS:
            return
        begin, every, sure = np.array(self._earliest).T
        learning = len(begin) < _MANY_SPANS
        late = every if learning else sure
        used = np.isfinite(late)
        if np.sum(used) < _LEAST_SPANS:
            return
        since, late = (begin - begin[-1])[used], late[used]
        i, j = np.triu_indices(len(since), 1)
        slopes = (late[j] - late[i]) / (since[j] - since[i])
        least, drift, rest = _below(since, late, slopes)
        # Steeper than crystals only if the arrivals lie on the line, as of another rate.
        if abs(drift) > _DRIFT_SIGMA and np.median(rest) > _FIT_PART * abs(drift) * np.ptp(since):
            least, drift, rest = _below(since, late, np.clip(slopes, -_DRIFT_SIGMA, _DRIFT_SIGMA))
        self._line = (least - drift * float(begin[-1]), drift)
        # All arrivals count, or the limit would fall by leaving late ones out; two are on the line.
        rest = (every - least - drift * (begin - begin[-1]))[-_MANY_SPANS:]
        usual = _USUAL * float(np.median(np.sort(rest)[2:]))
        limit = max(_LATE_PERIODS * self._period, usual + _AGE_PERIODS * self._period)
        self._limit = limit if learning else min(self._limit, limit)
        self.seen_from = math.ceil(self._limit / self._period)


def _below(x: FloatArray, y: FloatArray, slopes: FloatArray) -> tuple[float, float, FloatArray]:
    """Return offset, slope and rests (n,) of the highest line below points, of some slopes (m,)."""
    offsets = np.min(y - slopes[:, np.newaxis] * x, axis=1)
    best = int(np.argmax(offsets + slopes * x.mean()))
    offset, slope = float(offsets[best]), float(slopes[best])
    return offset, slope, y - slope * x - offset
