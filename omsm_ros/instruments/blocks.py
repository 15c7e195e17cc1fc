"""Cuts runs of samples into blocks, stamped by the host's clock."""

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from omsm_ros.core.streams.blocks import AxisBlock, DistanceBlock, IntArray
from omsm_ros.instruments.arrivals import DeviceClock, MissedTriggerDetector
from omsm_ros.instruments.counting import SAMPLE, CountedRun, Samples
from omsm_ros.instruments.scaling import AXES, AxisScaling, Turns
from omsm_ros.units import NANOSECOND_S, NANOSECONDS_PER_S, PPM

# A time that differs from those of its run by more was damaged on the line [ns].
_SPOILT_NS = 50_000_000
# Crystals differ by less; beyond it the stated period is wrong.
PERIOD_TOLERANCE = 100 * PPM
# A free-running device that deviates by more is set to another rate.
RATE_TOLERANCE = 1000 * PPM
# The same for a trigger from outside, and for a device without time stamps, by its arrivals.
TRIGGER_TOLERANCE = ARRIVAL_TOLERANCE = 5000 * PPM
# Time that a sample waits for an arrival that confirms it, before that is said, and before it is
# withheld [s].
_LONG_S, _LONGEST_S = 0.8, 3.0
# Parts of a block: a wrong period deviates in each of them, a pause or a damaged time in one.
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
    renew: longest time between two connections to a silent TCP stream, and silence after which
        a refused one is an error [s]; 0 = never
    """

    sample_period: float = 1e-3
    block_size: int = 100
    pause: float = 0.2
    renew: float = 0.0


class Channels(NamedTuple):
    """Channels of a device.

    distance: it has a probe;  axes: scaling of its encoders in the order of AXES, or None
    timed: its samples carry the time of its own clock
    homed: it sends positions only while they are known, so that a restart does not lose them
    """

    distance: bool = True
    axes: tuple[AxisScaling, ...] | None = None
    timed: bool = True
    homed: bool = False


def wrapping(axes: tuple[AxisScaling, ...] | None, counts: int) -> tuple[AxisScaling, ...] | None:
    """Return the axes, whose encoders wrap after ``counts`` if they state nothing else."""
    return axes and tuple(replace(axis, wrap=axis.wrap or counts) for axis in axes)


# Encoders nearer to zero than this may have been at zero all along [counts]. Those that were away
# are back at zero if less than this part of their counts before the restart is left.
_FROM_ZERO, _PART_OF_BEFORE = 10_000, 0.1


class BlockCutter:
    """Cuts runs into blocks of ``block_size`` samples; a gap or restart ends a block early.

    delivered, withheld: samples in blocks handed over, and kept back for their wrong rate or
        because no arrival confirms that no trigger was missed before them
    restarted_at_zero: the encoders lost their positions with a restart, so nothing is handed over
    perhaps_at_zero: they are at zero after a silence, as after a restart or a move to the origin
    detector: of missed triggers; None where arrivals are not watched
    unconfirmed: samples are withheld because triggers may have been missed before them
    period_deviation: relative, from nominal: of the last full block's device time, or of the
        arrivals of a device without time stamps [1]
    period_warnings: full blocks beyond PERIOD_TOLERANCE
    """

    def __init__(self, settings: BlockSettings, channels: Channels, free: bool = False) -> None:
        """free: the device keeps the period itself, so a block at another rate is withheld."""
        self._settings, self._channels, self._free = settings, channels, free
        self._clock = DeviceClock()
        self._pending: Samples = np.empty(0, SAMPLE)
        self._first = self._stamp = 0
        self._turns = [Turns(axis.wrap) for axis in channels.axes or ()]
        # Without a clock of the device, only arrivals show a trigger that it missed. Channels that
        # one device latches stay together.
        together = channels.distance and channels.axes is not None
        watched = not (channels.timed or free or together)
        period, pause = settings.sample_period, settings.pause
        wraps = [axis.wrap for axis in channels.axes or ()]
        self.detector = MissedTriggerDetector(period, pause, wraps) if watched else None
        # Arrival, the same by the clock of the stamps, whether after a silence.
        self._waiting: deque[tuple[float, int, bool, list[CountedRun]]] = deque()
        self._counts = np.zeros(len(AXES), np.int64)  # of the last sample
        self.restarted_at_zero = self.perhaps_at_zero = self.lost_settings = False
        # Device time less that of the count, and arrival, of the last samples [ns].
        self._usual: tuple[int, int] | None = None
        self._due = self._doubtful = self._latest = 0  # time by the count; offset to be confirmed
        self._skipped = self._end = 0  # counts left out for missed triggers; the next count
        self.unconfirmed = False
        self.delivered = self.withheld = self.blocks = self.period_warnings = self.resets = 0
        self.period_deviation = 0.0
        self._evenly_wrong = False

    @property
    def pending(self) -> int:
        """Return the number of samples that wait for their block, or for later arrivals."""
        waiting = (run for *_, runs in self._waiting for run in runs)
        return len(self._pending) + sum(len(run.samples) for run in waiting)

    @property
    def wrong_rate(self) -> bool:
        """Return whether the device, or its trigger, has another rate than stated.

        A trigger of a device without time may be played faster than it was recorded: see
        ``arrives_otherwise``.
        """
        timed = self._channels.timed
        return self._evenly_wrong if timed else self._free and self.arrives_otherwise

    @property
    def rate_known(self) -> bool:
        """Return whether device time or enough arrivals show the rate of the samples."""
        return self._channels.timed or self._clock.drift is not None

    @property
    def arrives_otherwise(self) -> bool:
        """Return whether samples come at another rate than stated, by their time or arrivals."""
        tolerance = PERIOD_TOLERANCE if self._channels.timed else ARRIVAL_TOLERANCE
        return abs(self.period_deviation) > tolerance

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
        if self.detector is None or not runs:
            yield from self._cut(runs, arrival_ns, after_silence)
            return
        period, together = self._settings.sample_period, list[CountedRun]()
        self._waiting.append((now, arrival_ns, after_silence, together))
        for i, run in enumerate(runs):
            if run.restarted:
                ahead = (self._end - run.first_sample) * period
                self.detector.restart(None if after_silence and i == 0 else ahead)
                self.withhold()
                self._waiting.append((now, arrival_ns, after_silence, together := []))
                self._skipped = 0
            first = run.first_sample + self._skipped
            linked = self.detector.resets if run.restarted else first == self._end
            linked &= not (after_silence and i == 0)
            self.detector.motion.follow(run.samples["counts"], linked=linked)
            together.append(replace(run, first_sample=first))
            self._end = first + len(run.samples)
        due = (self._end - 1) * period
        if self.detector.confirms(due, now, after_silence=after_silence):
            yield from self._release(self.detector, self.detector.by_motion)
        elif missed := self.detector.forget_missed():
            self.withhold()
            self._skipped += missed
            self._end += missed
        patience = _LONG_S if self.detector.missed else _LONGEST_S
        self.unconfirmed |= bool(self._waiting) and self._waiting[0][0] < now - patience
        self.withhold(now - _LONGEST_S)

    def _release(self, detector: MissedTriggerDetector, kept: int = 0) -> Iterator[BlockPair]:
        """Yield the blocks completed by the samples that wait, but the last ``kept`` portions."""
        self.unconfirmed = False
        while len(self._waiting) > kept:
            came, came_ns, after_silence, runs = self._waiting.popleft()
            if came == detector.resumed:
                self._clock.restart()
            yield from self._cut(runs, came_ns, after_silence)

    def end(self) -> Iterator[BlockPair]:
        """Yield what is left at the end of the stream, or before a long pause."""
        if self.detector is not None and self.detector.trusts_last():
            yield from self._release(self.detector)
        yield from self.flush()

    def withhold(self, until: float = np.inf) -> None:
        """Withhold the samples that arrived before ``until`` [s] and are not confirmed."""
        while self._waiting and self._waiting[0][0] < until:
            self.withheld += sum(len(run.samples) for run in self._waiting.popleft()[-1])

    def _cut(
        self, runs: Sequence[CountedRun], arrival_ns: int, after_silence: bool
    ) -> Iterator[BlockPair]:
        times = [self._times(run, arrival_ns, after_silence) for run in runs]
        for i, run in enumerate(runs):
            if run.restarted or run.first_sample != self._first + len(self._pending):
                yield from self.flush()
                self._first = run.first_sample
            if run.restarted:
                self.resets += after_silence and i == 0 and not self.lost_settings
                if self._channels.axes is not None and not self._channels.homed:
                    self._judge_restart(run, after_silence and i == 0)
            self._counts = run.samples["counts"][-1]
            if i == 0 or run.restarted:
                self._set_clock(runs[i:], times[i:], arrival_ns, after_silence and i == 0)
            yield from self._append(run, times[i])
        self.lost_settings &= not runs

    def _judge_restart(self, run: CountedRun, after_silence: bool) -> None:
        """Decide whether the encoders lost their positions with the restart before ``run``.

        During a silence the axes may have moved to their origin and the counter may have been
        reset on purpose, unless the device lost its connection or its settings too.
        """
        before, after = np.abs(self._counts), np.abs(run.samples["counts"][0])
        away = before > _FROM_ZERO
        at_zero = bool(away.any() and np.all(after[away] < _PART_OF_BEFORE * before[away]))
        self.restarted_at_zero |= at_zero and (self.lost_settings or not after_silence)
        self.perhaps_at_zero = at_zero and not self.restarted_at_zero

    def _set_clock(
        self,
        runs: Sequence[CountedRun],
        times: Sequence[IntArray],
        arrival_ns: int,
        after_silence: bool,
    ) -> None:
        """Enter the arrival of the last sample before a restart of the device."""
        may_pause = not (self._channels.timed or self._free or self.detector)
        if runs[0].restarted or (after_silence and may_pause):
            self._clock.restart()
        anew = (i for i, run in enumerate(runs) if i and run.restarted)
        self._clock.observe(int(times[next(anew, len(runs)) - 1][-1]), arrival_ns)

    def _append(self, run: CountedRun, times: IntArray) -> Iterator[BlockPair]:
        samples = run.samples.copy()
        samples["time"] = times
        if not len(self._pending):
            self._stamp = self._clock.to_host(int(samples["time"][0]))
        self._pending = np.concatenate([self._pending, samples])
        while len(self._pending) >= self._settings.block_size:
            yield from self._take(self._settings.block_size)

    def flush(self) -> Iterator[BlockPair]:
        """Yield the partial block, if any."""
        if len(self._pending):
            yield from self._take(len(self._pending))

    def _times(self, run: CountedRun, arrival_ns: int, after_silence: bool) -> IntArray:
        """Return the device time [ns] of each sample: its own, or its count times the period.

        A time that was spoilt on the line is replaced by that of the count.
        """
        times: IntArray = run.samples["time"]
        due_s = (run.first_sample + np.arange(len(run.samples))) * self._settings.sample_period
        due: IntArray = np.rint(due_s * NANOSECONDS_PER_S).astype(np.int64)
        if not self._channels.timed:
            return due
        before, self._latest = self._latest, int(times[-1])
        if self._latest == before or self._evenly_wrong:
            self._usual = None
            return times  # the clock of the device stands still, or its rate is another one
        usual = int(np.median(times - due))
        if not (run.restarted or after_silence or self._usual is None):
            begun, arrived = self._usual
            changed = usual - begun
            unseen = abs(changed - (arrival_ns - arrived - int(due[-1] - self._due)))
            spoilt = abs(changed) > _SPOILT_NS and unseen > abs(changed) // 2
            if spoilt and abs(usual - self._doubtful) > _SPOILT_NS:
                self._doubtful = usual  # accepted if the next ones agree
                return np.asarray(due + begun)
        self._usual, self._due, self._doubtful = (usual, arrival_ns), int(due[-1]), 0
        far = np.abs(times - due - usual) > _SPOILT_NS
        return np.where(far, due + usual, times) if far.any() else times

    def _take(self, count: int) -> Iterator[BlockPair]:
        samples, self._pending = self._pending[:count], self._pending[count:]
        first, self._first = self._first, self._first + count
        stamp = self._stamp
        if len(self._pending):
            self._stamp = self._clock.to_host(int(self._pending["time"][0]))
        self._check_period(samples)
        if self.wrong_rate or self.restarted_at_zero:
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
        elapsed = (int(samples["time"][-1]) - int(samples["time"][0])) * NANOSECOND_S
        self.period_deviation = elapsed / (periods * self._settings.sample_period) - 1
        self.period_warnings += abs(self.period_deviation) > PERIOD_TOLERANCE
        edges = np.unique(np.linspace(0, periods, _PARTS + 1).astype(int))
        parts = np.diff(samples["time"][edges]) * NANOSECOND_S
        off = parts / np.maximum(np.diff(edges) * self._settings.sample_period, NANOSECOND_S) - 1
        limit = RATE_TOLERANCE if self._free else TRIGGER_TOLERANCE
        self._evenly_wrong = bool(off.min() > limit or off.max() < -limit)

    def _blocks(self, samples: Samples, first: int, stamp: int) -> BlockPair:
        period = self._settings.sample_period
        common: Any = {"stamp_ns": stamp, "first_sample": first, "sample_period": period}
        axes = distance = None
        if (scaling := self._channels.axes) is not None:
            counts = samples["counts"].T[: len(scaling)]
            turned = [turns.continued(c) for turns, c in zip(self._turns, counts, strict=True)]
            columns = zip(AXES, scaling, turned, strict=True)
            positions: Any = {name: axis.values(column) for name, axis, column in columns}
            axes = AxisBlock(**common, **positions)
        if self._channels.distance:
            reported = not np.isnan(samples["intensity"]).all()
            intensity = samples["intensity"] if reported else np.empty(0, np.float32)
            channels: Any = {"distance": samples["distance"], "status": samples["status"]}
            distance = DistanceBlock(**common, **channels, intensity=intensity)
        return BlockPair(axes, distance)
