"""Faults of a recording that its counters, stamps and readings show.

Lost samples leave a gap in the counter. Two counters that were not started together pair samples
of different instants, which only their stamps show. The readings of a working probe scatter: equal
readings in succession were repeated by a driver, and equal readings at the end of the range were
clipped or mean "no reading".
"""

from collections.abc import Iterator

import numpy as np

from omsm_ros.core.streams.blocks import (
    SAME_PERIOD,
    AxisBlock,
    Block,
    DistanceBlock,
    FloatArray,
    IntArray,
)
from omsm_ros.core.streams.continuity import TriggerCount
from omsm_ros.core.streams.stamps import period_fault
from omsm_ros.core.streams.trigger_slips import EQUAL_COUNTS, CommonTrigger, TriggerSlip
from omsm_ros.errors import Notice
from omsm_ros.units import NANOSECONDS_PER_S

# Number of gaps whose counts a message lists.
_NAMED = 3
# Equal readings in succession that are a fault: this many, and this many times the mean run of the
# others. Coarse readings of a slow surface repeat, ten times as long where it has an extremum.
_LEAST_HELD, _LONGER = 100, 50.0
# Readings at the end of the range that are a fault: this many, and this many times those at the
# next value, unless readings are so coarse that each repeats this often on average.
_LEAST_PILED, _PILED, _COARSE = 20, 10.0, 5.0
# Samples of the axes that are searched for steps, and the number of steps that is sufficient.
_STEP_SAMPLES, _LEAST_STEPS = 1_000_000, 20
# Half the noise of a probe, and the lateral error that makes it at a slope of half a per cent:
# smaller rms errors do not change a result.
_HEIGHT_ERROR_M, _LATERAL_ERROR_M = 5e-9, 1e-6


class StreamWatch:
    """Statistics of the blocks of one stream, in their order.

    missing: trigger counts that never came;  gaps: first and last count of the first gaps
    places: number of gaps;  restarts: of the count;  repeated: samples that came twice
    samples: of all blocks;  invalid: those without a valid reading or with a lost axis
    least, most: of the valid readings of the probe [m]
    """

    def __init__(self) -> None:
        self.missing = self.places = self.restarts = self.repeated = 0
        self.invalid = self.samples = 0
        self.least, self.most = np.inf, -np.inf
        self.gaps: list[tuple[int, int]] = []
        self.periods: set[float] = set()
        self._readings = _Readings()
        self._steps = {axis: _Steps() for axis in "xzc"}
        self._widest = 0.0
        self._count = TriggerCount()
        # For each session: counts of first samples and their stamps [ns], (k, 2).
        self._marks: list[list[IntArray]] = []

    def add(self, block: Block) -> None:
        """Take the next block."""
        arrival = self._count.place(block, len(block))
        self.samples += len(block)
        self.periods.add(block.sample_period)
        self.repeated += arrival.skip - arrival.late
        self.missing += arrival.missing - arrival.late
        if arrival.missing:
            self.places += 1
            if len(self.gaps) < _NAMED:
                self.gaps.append((arrival.first - arrival.missing, arrival.first - 1))
        while len(self._marks) <= arrival.session:
            self._marks.append([])
        self.restarts = len(self._marks) - 1
        if not arrival.skip:
            self._marks[arrival.session].append(block.stamps)
        if isinstance(block, DistanceBlock):
            self.invalid += int(np.sum(~block.ok))
            valid = block.distance[block.ok]
            self.least = float(np.min(valid, initial=self.least))
            self.most = float(np.max(valid, initial=self.most))
            self._readings.add(valid)
        elif isinstance(block, AxisBlock):
            axes = np.array([block.x, block.y, block.z, block.b, block.c])
            self.invalid += int(np.sum(~np.all(np.isfinite(axes), axis=0)))
            if self.samples <= _STEP_SAMPLES:
                x = np.abs(block.x[np.isfinite(block.x)])
                self._widest = float(np.max(x, initial=self._widest))
                for axis, steps in self._steps.items():
                    steps.add(getattr(block, axis))

    def marks(self) -> Iterator[IntArray]:
        """Yield the first counts and stamps [ns] of the blocks of each session, (k, 2)."""
        for session in self._marks:
            yield np.concatenate([np.empty((0, 2), np.int64), *session])

    def period_fault(self, name: str, time_lapse: float = 1.0) -> Iterator[Notice]:
        """Yield how the stamps of the longest session contradict the stated sample period.

        time_lapse: factor by which the recording was played faster than real time [1]
        """
        longest = max(self.marks(), key=len, default=None)
        if longest is None or len(self.periods) > 1:
            return
        fault = period_fault(name, longest, min(self.periods), time_lapse)
        if fault is not None:
            yield fault

    def step_faults(self, resolution: float = 0.0, lateral: float = 0.0) -> Iterator[Notice]:
        """Yield the axes that move in steps whose rms error matters for the heights.

        resolution: stated step of Z [m];  lateral: stated lateral uncertainty [m]
        A controller makes such steps if it updates positions more slowly than the trigger, or
        rounds them.
        """
        x, z, c = (self._steps[axis].size for axis in "xzc")
        error = z / np.sqrt(12)
        if error > _HEIGHT_ERROR_M and z > 1.5 * resolution:
            yield Notice("streams.steps_z", step=z, error=float(error))
        for axis, unit, size, shift in (("X", "m", x, x), ("C", "rad", c, c * self._widest)):
            if (error := shift / np.sqrt(12)) > max(_LATERAL_ERROR_M, 1.5 * lateral):
                yield Notice(f"streams.steps_{unit}", axis=axis, step=size, error=float(error))

    def faults(self, name: str) -> Iterator[Notice]:
        """Yield the faults of the stream called ``name``; none if it has no samples."""
        if not self.samples:
            return
        if self.missing:
            gaps = [f"{first} to {last}" for first, last in self.gaps]
            if self.places > len(gaps):
                gaps[-1] += f" and {self.places - len(gaps)} more"
            yield Notice("streams.missing", stream=name, samples=self.missing, gaps=gaps)
        if self.restarts:
            yield Notice("streams.restarts", stream=name, times=self.restarts)
        if self.repeated:
            yield Notice("streams.repeated", stream=name, samples=self.repeated)
        shortest, longest = min(self.periods), max(self.periods)
        if longest - shortest > SAME_PERIOD * shortest:
            yield Notice("streams.periods", stream=name, shortest=shortest, longest=longest)
        valid = self.samples - self.invalid
        if not valid:
            yield Notice("streams.no_valid_reading", stream=name, samples=self.samples)
        elif self.least == self.most and valid > 1:
            yield Notice("streams.constant", stream=name, samples=valid, value=self.least)
        else:
            yield from self._readings.faults(name)


class _Readings:
    """Longest run of equal readings [m], and the readings at both ends of their range."""

    def __init__(self) -> None:
        self._samples = self._changes = 0
        self._run, self._last = 0, np.nan
        self._longest, self._value = 0, np.nan
        # The least values are the greatest of the readings with inverted sign.
        self._ends = {"greatest": (1, _EndValues()), "least": (-1, _EndValues())}

    def add(self, readings: FloatArray) -> None:
        """Take the next readings (n,), finite."""
        if not len(readings):
            return
        self._samples += len(readings)
        begins = np.flatnonzero(np.diff(readings, prepend=self._last) != 0)
        self._changes += len(begins)
        # The first run continues the last one of the readings before.
        runs = np.diff(np.concatenate([[-self._run], begins, [len(readings)]]))
        place = int(np.argmax(runs))
        if runs[place] > self._longest:
            self._longest = int(runs[place])
            self._value = float(readings[begins[place - 1]]) if place else self._last
        self._run, self._last = int(runs[-1]), float(readings[-1])
        for sign, end in self._ends.values():
            end.add(sign * readings)

    def faults(self, name: str) -> Iterator[Notice]:
        """Yield readings that were repeated or clipped."""
        others = (self._samples - self._longest) / max(self._changes - 1, 1)
        if self._changes > 2 and self._longest >= max(_LEAST_HELD, _LONGER * others):
            yield Notice(
                "streams.held",
                stream=name,
                readings=self._longest,
                value=self._value,
                usual=max(others, 1.0),
            )
        for word, (sign, end) in self._ends.items():
            value, times = end.greatest
            if end.piled and times > self._longest and others < _COARSE:
                yield Notice(
                    "streams.clipped",
                    stream=name,
                    readings=times,
                    samples=self._samples,
                    end=word,
                    value=sign * value,
                )


class _Steps:
    """Size of the steps of an axis that stands still between them."""

    def __init__(self) -> None:
        self._tail = np.empty(0)
        self._moves = self._alone = 0
        self._squares = 0.0

    def add(self, positions: FloatArray) -> None:
        """Take the next positions (n,); NaN interrupts the sequence."""
        row = np.concatenate([self._tail, positions])
        self._tail = row[-3:]
        steps = np.diff(row)
        moved = steps != 0
        inner = steps[1:-1]
        self._moves += int(np.count_nonzero(moved[1:-1]))
        alone = inner[moved[1:-1] & ~moved[:-2] & ~moved[2:]]
        self._alone += len(alone)
        self._squares += float(np.sum(alone**2))

    @property
    def size(self) -> float:
        """Rms of a step; 0 where most steps follow another step directly."""
        if self._alone < max(_LEAST_STEPS, self._moves / 2):
            return 0.0
        return float(np.sqrt(self._squares / self._alone))


class _EndValues:
    """The two greatest values, and how often each came."""

    def __init__(self) -> None:
        self._times: dict[float, int] = {}

    def add(self, values: FloatArray) -> None:
        """Take more values (n,)."""
        least = min(self._times) if len(self._times) == 2 else -np.inf
        found, times = np.unique(values[values >= least], return_counts=True)
        for value, count in zip(found[-2:].tolist(), times[-2:].tolist(), strict=True):
            self._times[value] = self._times.get(value, 0) + count
        self._times = dict(sorted(self._times.items())[-2:])

    @property
    def greatest(self) -> tuple[float, int]:
        """The greatest value, and how often it came; NaN before the first."""
        return max(self._times.items(), default=(np.nan, 0))

    @property
    def piled(self) -> bool:
        """True if the greatest value came far more often than the next one."""
        _, times = self.greatest
        others = sum(self._times.values()) - times
        return times >= _LEAST_PILED and times > _PILED * others


def counter_skew(axes: StreamWatch, distance: StreamWatch) -> float | None:
    """Return the median of stamp of the axes minus stamp of the distance at equal counts [s].

    None where one of the two has no blocks.
    """
    found: list[float] = []
    for here, there in zip(axes.marks(), distance.marks(), strict=False):
        if not len(here) or not len(there):
            continue
        period, since = min(axes.periods), int(here[0, 1])
        common = np.union1d(here[:, 0], there[:, 0])
        least, most = max(here[0, 0], there[0, 0]), min(here[-1, 0], there[-1, 0])
        within = common[(common >= least) & (common <= most)]
        where = within if len(within) else np.array([least])
        stamps = (_stamp_at(where, marks, since, period) for marks in (here, there))
        found += list(next(stamps) - next(stamps))
    return float(np.median(found)) if found else None


def skew_fault(
    skew: float | None, period: float, trigger: CommonTrigger = EQUAL_COUNTS
) -> Iterator[Notice]:
    """Yield the slip that a ``skew`` of the counters [s] means, if it is one."""
    if skew is None:
        return
    slip = TriggerSlip.judged(skew / period + trigger.counter_offset, period, trigger)
    if slip.samples:
        yield slip.notice()


def _stamp_at(where: IntArray, marks: IntArray, since_ns: int, period: float) -> FloatArray:
    """Return stamps [s] at counts ``where``: linear between blocks, a period a sample outside."""
    count, stamp = marks[:, 0], (marks[:, 1] - since_ns) / NANOSECONDS_PER_S
    beyond = np.maximum(where - count[-1], 0) - np.maximum(count[0] - where, 0)
    return np.asarray(np.interp(where, count, stamp) + beyond * period, np.float64)
