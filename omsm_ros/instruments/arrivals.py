"""Arrivals of samples: they give the host's time of a device's clock, and show missed triggers.

No sample arrives before it was taken, and a busy host only delays arrivals. So host time is the
likeliest line ``offset + (1 + drift) · device time`` below the arrivals of half a minute: late ones
do not move it. It is fitted over a window, since crystals change with temperature.
"""

import math
from collections import deque

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import ConfigurationError
from omsm_ros.units import NANOSECOND_S, NANOSECONDS_PER_S, PPM

# Long enough to average jitter out, short enough to follow a crystal that warms up [s].
WINDOW_S = 30.0
# Only the earliest arrival in this time counts, which bounds the fit to 150 points [s].
_SPAN_S = 0.2
# Crystals differ by some tens of ppm: the standard uncertainty of the drift before any arrival.
_DRIFT_SIGMA = 50 * PPM
# A drift beyond this by five of its standard uncertainties is not that of a crystal: the device
# is played faster than it was recorded, or set to another rate.
_LARGEST_CRYSTAL_DRIFT = 1000 * PPM
# Points that show a gross drift, and any other one.
_LEAST_POINTS, _SURE_POINTS = 6, 9
# A clock was set if all arrivals are late, by the first more than usual, for the second time [s].
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
# Delays below this are those of the clocks themselves [s].
_LEAST_DELAY_S = 1e-6


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
        # Begin of each span [device], device time and delay of its earliest arrival, after the
        # origin [s].
        self._spans: deque[tuple[float, float, float]] = deque(maxlen=round(WINDOW_S / _SPAN_S))
        self._origin = self._newest = (0, 0)
        self._offset = self._slope = self._usual = 0.0
        self._late_since: tuple[float, float] | None = None  # all arrivals [device, arrival; s]

    @property
    def drift(self) -> float | None:
        """Return host seconds per device second, less one; None before it is known."""
        span = self._spans[-1][1] - self._spans[0][1] if self._spans else 0.0
        patience = _GROSS_SPAN_S if abs(self._slope) > _GROSS else _LEAST_SPAN_S
        return self._slope if span >= patience else None

    def observe(self, device_ns: int, arrival_ns: int) -> None:
        """Enter the arrival at ``arrival_ns`` of a sample taken at ``device_ns``.

        The last one of samples that arrive together is enough.
        """
        if not self._spans:
            self._origin = (device_ns, arrival_ns)
        device = (device_ns - self._origin[0]) * NANOSECOND_S
        late = (arrival_ns - self._origin[1]) * NANOSECOND_S - device
        if self._stepped(device, late):
            self.restart()
            self.observe(device_ns, arrival_ns)
            return
        self._newest = (device_ns, arrival_ns)
        self._keep(device, late)

    def to_host(self, device_ns: int) -> int:
        """Return the host time [ns] of ``device_ns``, later than every stamp given before.

        A device time out of the possible range is replaced by that of the newest sample.
        """
        if not self._spans:
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
        """Enter an arrival; the line is fitted when a span ends, and is never above an arrival."""
        if self._spans and 0 <= device - self._spans[-1][0] < _SPAN_S:
            if late < self._spans[-1][2]:
                self._spans[-1] = (self._spans[-1][0], device, late)
        else:
            self._spans.append((device, device, late))
            while device + late - sum(self._spans[0][1:]) > WINDOW_S:
                self._spans.popleft()
            _, x, y = np.array(self._spans).T
            self._offset, self._slope, rest, _ = _line_below(x, y)
            self._usual = float(np.median(rest))
        self._offset += min(late - self._offset - self._slope * device, 0.0)

    def _stepped(self, device: float, late: float) -> bool:
        """Return whether arrivals have been late for too long, or one is too far off the line."""
        off = late - (self._offset + self._slope * device)
        if self._spans and not -_EARLY_S < off < _OLDEST_S:
            return True
        if not self._spans or off < _STEP_S + 2 * self._usual:
            self._late_since = None
            return False
        since, arrived = self._late_since = self._late_since or (device, device + late)
        return min(device - since, device + late - arrived) > _STEP_AFTER_S


def _line_below(x: FloatArray, y: FloatArray) -> tuple[float, float, FloatArray, float]:
    """Return offset, slope and rests (n,) of the likeliest line below the points.

    The last value is how unlikely its slope is by itself (log). The rests are exponentially
    distributed, with an unknown mean, the slopes normally. A busy host delays all arrivals of about
    a second, so only one rest a second counts.
    """
    drift, uncertainty = _expected_drift(x, y)
    slopes = np.append(_slopes_below(x, y), drift)
    offsets = np.min(y - slopes[:, np.newaxis] * x, axis=1)
    mean = np.maximum(y.mean() - offsets - slopes * x.mean(), _LEAST_DELAY_S)
    unlikely = ((slopes - drift) / uncertainty) ** 2 / 2
    best = np.argmin(len(x) * _SPAN_S * np.log(mean) + unlikely)
    offset, slope = float(offsets[best]), float(slopes[best])
    return offset, slope, y - slope * x - offset, float(unlikely[best])


def _slopes_below(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the slopes of the edges of the lower convex hull of the points."""
    hull: list[tuple[float, float]] = []
    for k in np.lexsort((y, x)):
        point = (float(x[k]), float(y[k]))
        if hull and point[0] == hull[-1][0]:
            continue
        while len(hull) > 1 and _slope(hull[-2], point) <= _slope(hull[-2], hull[-1]):
            hull.pop()
        hull.append(point)
    return np.array([*map(_slope, hull[:-1], hull[1:])])


def _slope(a: tuple[float, float], b: tuple[float, float]) -> float:
    return (b[1] - a[1]) / (b[0] - a[0])


def _expected_drift(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Return the drift of crystals and its uncertainty.

    Where no crystal has the drift of the regression line, return that and its range.
    """
    centred = x - x.mean()
    square = float(centred @ centred)
    if len(x) >= _LEAST_POINTS and square > 0:
        drift = float(centred @ y) / square
        range_ = 5 * max(float(np.std(y - drift * x)), _LEAST_DELAY_S) / math.sqrt(square)
        least = _LARGEST_CRYSTAL_DRIFT if len(x) >= _SURE_POINTS else _GROSS
        if abs(drift) - range_ > least:
            return drift, range_
    return 0.0, _DRIFT_SIGMA


# The reference: the number of spans, the least number, and that from which on the limit of what is
# late only falls.
_SPANS, _LEAST_SPANS, _MANY_SPANS = 50, 4, 15
# The last sample of a portion may be nearly a period old: the lateness that confirms [period].
_LATE_PERIODS, _AGE_PERIODS = 0.75, 0.25
# Spans in whose earliest arrival the delays by a busy host are short, as a rule. The limit is at
# least this multiple of that delay.
_WINDOW, _USUAL = 4, 2.0
# This number of spans without a confirming arrival shows how many triggers were missed.
_SHOWING = 3
# It is certain if it is likelier than any other by this (log), by the latest spans of one of these
# numbers; earlier ones may be from before the missed triggers.
_CERTAIN, _LATEST = 12.0, (12, 16, 20, 24, 32, 48, 64, 96)
# Resolution of arrivals [period].
_NARROWEST = 0.01
# The true number is searched within this distance of the one that the old line shows [periods].
_NEAR = 4


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
        # Begin and earliest lateness of each span [s].
        self._earliest: list[tuple[float, float]] = []
        self._line: tuple[float, float] | None = None  # lateness of the earliest at 0, drift
        self._limit, self.seen_from = math.inf, 1
        # Last arrival that confirmed, and begin of the last span that was judged [s].
        self._confirmed = self._judged = 0.0

    def confirms(self, due: float, arrival: float) -> bool:
        """Return whether no trigger was missed before this arrival, as far as can be seen.

        due: count times period [s];  arrival: monotonic [s]
        """
        late, excess = arrival - due, self.excess(due, arrival)
        # The drift of crystals makes a line uncertain that is not confirmed any more.
        limit = self._limit - 2 * _DRIFT_SIGMA * (arrival - self._confirmed)
        confirmed = limit > 0 and excess <= limit
        if confirmed:
            self._confirmed = arrival
            if self._line is not None and excess < 0:
                self._line = (self._line[0] + excess, self._line[1])
        if self._earliest and arrival - self._earliest[-1][0] < _SPAN_S:
            begin, least = self._earliest[-1]
            self._earliest[-1] = (begin, min(least, late))
        else:
            self._set_reference()
            self._earliest.append((arrival, late))
            known = sum(begin <= self._confirmed for begin, _ in self._earliest)
            del self._earliest[known : max(len(self._earliest) - _LATEST[-1] - 1, known)]
            del self._earliest[: max(known - _SPANS, 0)]
        return confirmed

    def excess(self, due: float, arrival: float) -> float:
        """Return by how much an arrival is later than the earliest ones [s]; -inf if not known."""
        if self._line is None:
            return -math.inf
        return arrival - due - self._line[0] - self._line[1] * arrival

    @property
    def missed(self) -> int:
        """Return the missed triggers that the latest arrivals show if none confirms; else 0."""
        _, since = self._spans()
        if self._line is None or len(since) < _SHOWING:
            return 0
        begin, late = since[-_WINDOW:].T
        excess = float((late - self._line[0] - self._line[1] * begin).min())
        return max(math.floor(excess / self._period + _AGE_PERIODS), 0)

    def forget_missed(self) -> int:
        """Return the number of missed triggers if it is certain, else 0.

        Arrivals are then expected at the times of the triggers again, so their samples must be
        renumbered.
        """
        if self._judged == self._earliest[-1][0]:
            return 0
        self._judged = self._earliest[-1][0]
        before, since = self._spans()
        for number in _LATEST:
            latest = since[-number - 1 : -1]  # the last one has not ended
            if len(latest) < number:
                break
            if (missed := self._missed_between(before, latest)) is not None:
                latest[:, 1] -= missed * self._period
                self._confirmed = self._earliest[-1][0]
                self._earliest = [*map(tuple, before), *map(tuple, latest)]
                self._set_reference()
                return missed
        return 0

    def _missed_between(self, before: FloatArray, since: FloatArray) -> int | None:
        """Return by how many periods spans ``since`` (n, 2) are later; None if not certain.

        With the true number, both lie at one edge, with another only one of them.
        """
        likely = {}
        for missed in range(max(self.missed - _NEAR, 0), self.missed + _NEAR):
            begin, late = np.concatenate([before, since - [0.0, missed * self._period]]).T
            *_, rest, unlikely = _line_below(begin - begin[-1], late)
            likely[missed] = _edge(rest / self._period) - unlikely
        other, best = sorted(likely, key=likely.__getitem__)[-2:]
        return best if likely[best] - likely[other] > _CERTAIN else None

    def _spans(self) -> tuple[FloatArray, FloatArray]:
        """Return the spans (n, 2) before and after the last confirmation."""
        spans = np.reshape(self._earliest, (-1, 2))
        begin = spans[:, 0]
        return spans[begin + _SPAN_S <= self._confirmed], spans[begin > self._confirmed]

    def _set_reference(self) -> None:
        """Lay the highest line below the earliest arrivals; their scatter is the limit."""
        begin, late = np.reshape(self._earliest, (-1, 2)).T
        learning = len(begin) < _MANY_SPANS
        sure = begin <= (math.inf if learning else self._confirmed)
        if np.sum(sure) < _LEAST_SPANS:
            return
        least, drift, *_ = _line_below((begin - begin[-1])[sure], late[sure])
        self._line = (least - drift * float(begin[-1]), drift)
        # All arrivals count, or the limit would fall by leaving late ones out.
        rest = late - least - drift * (begin - begin[-1])
        windows = sliding_window_view(rest, min(_WINDOW, len(rest)))
        usual = _USUAL * float(np.median(windows.min(axis=1)))
        limit = max(_LATE_PERIODS * self._period, usual + _AGE_PERIODS * self._period)
        self._limit = limit if learning else min(self._limit, limit)
        self.seen_from = math.ceil(self._limit / self._period)


def _edge(rest: FloatArray) -> float:
    """Return how likely arrivals with these rests (n,) above a line [period] lie at an edge (log).

    Without an edge an arrival is within a width w of the line by a chance of w. For the likeliest
    number k of arrivals the log likelihood is -k log w; the two that define the line do not count.
    """
    width = np.maximum(np.sort(rest)[2:], _NARROWEST)
    return float(np.max(-np.arange(1, len(width) + 1) * np.log(width)))
