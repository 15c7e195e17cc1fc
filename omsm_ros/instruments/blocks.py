"""Cuts runs of samples into blocks, stamped by the host's clock.

Host time is fitted as ``offset + (1 + drift) · device time`` over the arrivals of half a minute:
robustly, since some arrivals are very late, and over a window, since crystals change with
temperature.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from omsm_ros.core.streams.blocks import (
    MAX_BLOCK_SAMPLES,
    AxisBlock,
    DistanceBlock,
    FloatArray,
    IntArray,
)
from omsm_ros.core.streams.statistics import spread
from omsm_ros.errors import ConfigurationError
from omsm_ros.instruments.counting import SAMPLE, CountedRun, Samples, Turns
from omsm_ros.instruments.scaling import AXES, AxisScaling
from omsm_ros.units import NANOSECOND_S, NANOSECONDS_PER_S, PPM

# Long enough to average jitter out, short enough to follow a crystal that warms up [s].
WINDOW_S = 30.0
# Arrivals closer than this count as one, their mean: it bounds the fit to 1500 points [s].
_BIN_S = 0.02
# Crystals differ by some tens of ppm: the standard uncertainty of the drift before any arrival.
_DRIFT_SIGMA = 100 * PPM
# A drift beyond this by five of its standard uncertainties is not that of a crystal: the device
# is played faster than it was recorded, or set to another rate.
_LARGEST_CRYSTAL_DRIFT = 1000 * PPM
# A clock was set if all arrivals are off the line by the first, to one side, during the second [s].
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
        if len(self._bins) < 50 or device - self._fitted_at > 0.1 or device < self._fitted_at:
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


# Span of arrivals that decides whether triggers were missed: it lasts for the first [s] and holds
# the second number of arrivals, or lasts for the third; and the longest wait for a decision.
_DECISION_S, _ARRIVALS, _LONG_DECISION_S, _LONGEST_S = 0.2, 8, 0.6, 0.8
_LEAST_ARRIVALS = 3
# Spans whose earliest arrivals are the reference; how many it needs, and how many show a drift.
_SPANS, _LEAST_SPANS, _DRIFT_SPANS = 15, 4, 8
# The last sample of a portion may be nearly a period old, so only a delay of this is one [period].
_LATE_PERIODS = 0.75
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
        self._since = self._expected = self._drift = 0.0
        self._limit, self.seen_from = _LATE_PERIODS * self._period, 1

    def missed(self, due: float, arrival: float) -> int | None:
        """Return the triggers missed before this arrival; 0 confirms it; None: it has to wait.

        due: count, with the triggers missed so far, times period [s];  arrival: monotonic [s]
        A negative number is of triggers that were counted in excess.
        """
        late = arrival - due
        excess = late - self._expected - self._drift * (arrival - self._since)
        early = bool(self._off) and self._off[0][1] < 0
        if len(self._earliest) < _LEAST_SPANS or (abs(excess) <= self._limit and not early):
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
        if abs(min(recent[:half]) - min(recent[half:])) > self._limit:
            if waited < _LONGEST_S:
                return None
            if len(self._off) > _ARRIVALS // 2 and not self._dropped:
                self._off, self._dropped = self._off[-half:], True  # the first ones were by chance
                return None
            self.restart()  # what grows is another rate
            return 0
        self._off.clear()
        self._dropped = False
        return round(min(recent) / self._period)

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
        self._since, self._expected = float(begin[-1]), float(rest[-_LEAST_SPANS:].min())
        scatter = (_RANGES if many else _RANGES_OF_FEW) * float(np.ptp(rest))
        self._limit = max(_LATE_PERIODS * self._period, scatter)
        self.seen_from = int(np.ceil(self._limit / self._period))


def _is_whole(lasted: float, arrivals: int) -> bool:
    """Return whether a span that ``lasted`` [s] decides."""
    return lasted >= (_DECISION_S if arrivals >= _ARRIVALS else _LONG_DECISION_S)


# Crystals differ by less; beyond it the stated period is wrong.
PERIOD_TOLERANCE = 100 * PPM
# A free-running device that deviates by more is set to another rate.
RATE_TOLERANCE = 1000 * PPM
# The same for a trigger from outside, and for a device without time stamps, by its arrivals.
TRIGGER_TOLERANCE = ARRIVAL_TOLERANCE = 5000 * PPM
# The period of a trigger is wrong if it is so in each of these parts of a block: no pause is.
_PARTS = 4


class BlockPair(NamedTuple):
    """Two blocks of the same samples; None where the device has no such channels."""

    axes: AxisBlock | None
    distance: DistanceBlock | None


@dataclass(frozen=True, slots=True, kw_only=True)
class BlockSettings:
    """Settings of the blocks.

    sample_period: nominal [s];  block_size: samples
    pause: silence after which a partial block is handed over [s]
    renew: silence after which the connection is made again, which may cost two samples [s];
        0 = never
    free_running: the device keeps the period itself, so a block at another rate is withheld
    """

    sample_period: float = 1e-3
    block_size: int = 100
    pause: float = 0.2
    renew: float = 0.0
    free_running: bool = False

    def __post_init__(self) -> None:
        for name in ("sample_period", "pause"):
            value = getattr(self, name)
            if not 0 < value < np.inf:
                raise ConfigurationError(f"{name} {value!r} s, expected a positive number")
        if not 0 < self.block_size <= MAX_BLOCK_SAMPLES:
            raise ConfigurationError(
                f"block_size {self.block_size!r}, expected 1 to {MAX_BLOCK_SAMPLES}"
            )


class Channels(NamedTuple):
    """Channels of a device.

    distance: it has a probe;  axes: scaling of its encoders in the order of AXES, or None
    timed: its samples carry the time of its own clock
    """

    distance: bool = True
    axes: tuple[AxisScaling, ...] | None = None
    timed: bool = True


def wrapping(axes: tuple[AxisScaling, ...] | None, counts: int) -> tuple[AxisScaling, ...] | None:
    """Return the axes, whose encoders wrap after ``counts`` if they state nothing else."""
    if axes is None:
        return None
    return tuple(replace(axis, wrap=axis.wrap or counts) for axis in axes)


class BlockCutter:
    """Cuts runs into blocks of ``block_size`` samples; a gap or restart ends a block early.

    delivered, withheld: samples in blocks handed over, and kept back for their wrong rate
    missed: triggers without a sample of the device, by the arrivals of the others
    period_deviation: relative, from nominal: of the last full block's device time, or of the
        arrivals of a device without time stamps [1]
    period_warnings: full blocks beyond PERIOD_TOLERANCE
    """

    def __init__(self, settings: BlockSettings, channels: Channels) -> None:
        self._settings = settings
        self._channels = channels
        self._clock = DeviceClock()
        self._pending: Samples = np.empty(0, SAMPLE)
        self._first = self._stamp = 0
        self._turns = [Turns(axis.wrap) for axis in channels.axes or ()]
        # Without a clock of the device, only arrivals show a trigger that it missed.
        watched = not (channels.timed or settings.free_running)
        self._detector = MissedTriggerDetector(settings.sample_period) if watched else None
        self._waiting: list[CountedRun] = []
        self.missed = self._ahead = 0
        self.delivered = self.withheld = self.blocks = self.period_warnings = 0
        self.period_deviation = 0.0
        self._evenly_wrong = False

    @property
    def pending(self) -> int:
        """Return the number of samples that wait for their block, or for later arrivals."""
        return len(self._pending) + sum(len(run.samples) for run in self._waiting)

    @property
    def least_missed(self) -> int:
        """Return the least number of missed triggers that is detected; 0 = not by arrivals."""
        return self._detector.seen_from if self._detector else 0

    @property
    def wrong_rate(self) -> bool:
        """Return whether the device, or its trigger, has another rate than stated."""
        if not self._channels.timed:
            return abs(self.period_deviation) > ARRIVAL_TOLERANCE
        if self._settings.free_running:
            return abs(self.period_deviation) > RATE_TOLERANCE
        return self._evenly_wrong

    def add(
        self,
        runs: Sequence[CountedRun],
        arrival_ns: int,
        now: float = 0.0,
        *,
        after_silence: bool = False,
    ) -> Iterator[BlockPair]:
        """Yield the blocks completed by ``runs``, which arrived together.

        arrival_ns: by the clock of the stamps;  now: the same, monotonic [s]
        """
        if self._detector is None or not runs:
            yield from self._cut(runs, arrival_ns, after_silence)
            return
        if after_silence or any(run.restarted for run in runs):
            yield from self._release(self._detector.end(), arrival_ns)
            self._detector.restart()
            yield from self._cut(runs, arrival_ns, after_silence)
            return
        self._waiting += runs
        last = self._waiting[-1]
        count = last.first_sample + len(last.samples) - 1 + self._ahead
        missed = self._detector.missed(count * self._settings.sample_period, now)
        if missed is not None:
            yield from self._release(missed, arrival_ns)

    def _release(self, missed: int, arrival_ns: int) -> Iterator[BlockPair]:
        """Yield the blocks of the samples that waited, after ``missed`` triggers."""
        waiting, self._waiting = self._waiting, []
        if missed and waiting:
            yield from self._flush()
            self._first = waiting[0].first_sample
            self._ahead += missed
            self.missed += abs(missed)
        if waiting:
            yield from self._cut(waiting, arrival_ns, False)

    def _cut(
        self, runs: Sequence[CountedRun], arrival_ns: int, after_silence: bool
    ) -> Iterator[BlockPair]:
        for i, run in enumerate(runs):
            if run.restarted or run.first_sample != self._first + len(self._pending):
                yield from self._flush()
                self._first = run.first_sample
            if i == 0 or run.restarted:
                self._set_clock(runs[i:], arrival_ns, after_silence and i == 0)
            yield from self._append(run)

    def _set_clock(self, runs: Sequence[CountedRun], arrival_ns: int, after_silence: bool) -> None:
        """Enter the arrival of the last sample before a restart of the device."""
        continuous = self._channels.timed or self._settings.free_running
        if runs[0].restarted or (after_silence and not continuous):
            self._clock.restart()
        anew = (i for i, run in enumerate(runs) if i and run.restarted)
        last = runs[next(anew, len(runs)) - 1]
        self._clock.observe(int(self._times(last)[-1]), arrival_ns)

    def _append(self, run: CountedRun) -> Iterator[BlockPair]:
        samples = run.samples.copy()
        samples["time"] = self._times(run)
        if not len(self._pending):
            self._stamp = self._clock.to_host(int(samples["time"][0]))
        self._pending = np.concatenate([self._pending, samples])
        while len(self._pending) >= self._settings.block_size:
            yield from self._take(self._settings.block_size)

    def flush(self, arrival_ns: int) -> Iterator[BlockPair]:
        """Yield the partial block, if any, with the samples that waited for later arrivals."""
        if self._detector is not None:
            yield from self._release(self._detector.end(), arrival_ns)
        yield from self._flush()

    def _flush(self) -> Iterator[BlockPair]:
        if len(self._pending):
            yield from self._take(len(self._pending))

    def _times(self, run: CountedRun) -> IntArray:
        """Return the device time [ns] of each sample: its own, or its count times the period."""
        times: IntArray = run.samples["time"]
        if not self._channels.timed:
            counts = run.first_sample + self._ahead + np.arange(len(run.samples))
            period_ns = self._settings.sample_period * NANOSECONDS_PER_S
            times = np.rint(counts * period_ns).astype(np.int64)
        return times

    def _take(self, count: int) -> Iterator[BlockPair]:
        samples, self._pending = self._pending[:count], self._pending[count:]
        first, self._first = self._first, self._first + count
        stamp = self._stamp
        if len(self._pending):
            self._stamp = self._clock.to_host(int(self._pending["time"][0]))
        self._check_period(samples)
        if self.wrong_rate:
            self.withheld += count
            return
        self.delivered += count
        self.blocks += 1
        yield self._blocks(samples, first, stamp)

    def _check_period(self, samples: Samples) -> None:
        if not self._channels.timed:
            self.period_deviation = self._clock.drift or 0.0
            return
        periods = len(samples) - 1
        if periods < max(1, self._settings.block_size - 1):
            return  # too short to distinguish a wrong period from jitter
        nominal = periods * self._settings.sample_period
        elapsed = (int(samples["time"][-1]) - int(samples["time"][0])) * NANOSECOND_S
        self.period_deviation = elapsed / nominal - 1
        self.period_warnings += abs(self.period_deviation) > PERIOD_TOLERANCE
        edges = np.unique(np.linspace(0, periods, _PARTS + 1).astype(int))
        parts = np.diff(samples["time"][edges]) * NANOSECOND_S
        off = parts / np.maximum(np.diff(edges) * self._settings.sample_period, NANOSECOND_S) - 1
        least, most = float(off.min()), float(off.max())
        self._evenly_wrong = least > TRIGGER_TOLERANCE or most < -TRIGGER_TOLERANCE

    def _blocks(self, samples: Samples, first: int, stamp: int) -> BlockPair:
        common = {
            "stamp_ns": stamp,
            "first_sample": first,
            "sample_period": self._settings.sample_period,
        }
        axes = distance = None
        if self._channels.axes is not None:
            axes = AxisBlock(**common, **self._positions(samples, self._channels.axes))  # type: ignore[arg-type]
        if self._channels.distance:
            reported = not np.isnan(samples["intensity"]).all()
            distance = DistanceBlock(
                **common,  # type: ignore[arg-type]
                distance=samples["distance"],
                status=samples["status"],
                intensity=samples["intensity"] if reported else np.empty(0, np.float32),
            )
        return BlockPair(axes, distance)

    def _positions(
        self, samples: Samples, scaling: tuple[AxisScaling, ...]
    ) -> dict[str, FloatArray]:
        turned = [
            turns.continued(counts)
            for turns, counts in zip(self._turns, samples["counts"].T[: len(scaling)], strict=True)
        ]
        return {
            name: axis.values(column)
            for name, axis, column in zip(AXES, scaling, turned, strict=True)
        }
