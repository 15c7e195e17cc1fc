"""What do the counters, stamps and readings of a recording say against it?

Samples that never came leave a gap in the counter and nothing else; two counters that were not
started together pair samples of different instants, and only their stamps show it. A probe
scatters: what stands still to the last digit, or piles up at one end of all readings, was not
measured, but repeated by a driver, cut off, or stands for no reading.
"""

from __future__ import annotations

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
from omsm_ros.core.streams.stamps import contradiction
from omsm_ros.core.streams.trigger_slips import EQUAL_COUNTS, CommonTrigger
from omsm_ros.readable import plain, quantity
from omsm_ros.units import MILLISECOND_S, NANOSECONDS_PER_S

# Places that are named; of more, the number.
_NAMED = 3
# Stamps of two clocks scatter; a counter is off by one sample or by none.
_SKEW_SAMPLES = 0.5
# Readings in succession, and as many times the mean of all others: coarse readings of a probe that
# follows a slow surface repeat, and some ten times as long where that turns.
_LEAST_HELD, _LONGER = 100, 50.0
# Readings at an end of all, and as many times those next to it; of coarse ones, which repeat this
# often on the average, many may lie there.
_LEAST_PILED, _PILED, _COARSE = 20, 10.0, 5.0
# Samples of the axes in which steps are looked for, and how many steps tell.
_STEPS_LOOKED_FOR, _STEPS_REPORTED = 1_000_000, 20
# Half a probe's noise, and what a slope of a per cent makes it: less is in no figure.
_STEP_OF_HEIGHT_M, _LATERAL_STEP_M = 5e-9, 1e-6


class StreamWatch:
    """Follows the blocks of one stream, in their order.

    missing: trigger counts left out;  gaps: the first places, each (first, last) of what is missing
    places, restarts, repeated: gaps in all, times that the count began anew, samples seen twice
    invalid, samples: readings of the probe, or places of the axes, that are none, of all
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
        # Of each session: counts of first samples and their stamps [ns].
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
            if self.samples <= _STEPS_LOOKED_FOR:
                x = np.abs(block.x[np.isfinite(block.x)])
                self._widest = float(np.max(x, initial=self._widest))
                for axis, steps in self._steps.items():
                    steps.add(getattr(block, axis))

    def marks(self, since_ns: int) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Yield counts, and stamps after ``since_ns`` [s], of the blocks of each session."""
        for session in self._marks:
            counts, stamps = np.concatenate([np.empty((0, 2), np.int64), *session]).T
            yield counts.astype(np.float64), (stamps - since_ns) / NANOSECONDS_PER_S

    @property
    def begin_ns(self) -> int:
        """Stamp of the first block [ns]; 0 without one."""
        return int(self._marks[0][0][0, 1]) if self.samples else 0

    def period_fault(self, name: str, time_lapse: float = 1.0) -> Iterator[str]:
        """Yield what the stamps of the longest session say against the stated sample period.

        time_lapse: how much faster than real time the recording was played [1]
        """
        longest = max(self.marks(self.begin_ns), key=lambda marks: len(marks[0]), default=None)
        if longest is None or len(self.periods) > 1:
            return
        count, stamp = longest
        said = contradiction(name, count, stamp, min(self.periods), time_lapse)
        if said is not None:
            yield said

    def step_faults(self, resolution: float = 0.0, lateral: float = 0.0) -> Iterator[str]:
        """Yield which axes stand still and jump by so much that heights are open by it.

        resolution: step of Z that is stated [m];  lateral: uncertainty of places that is [m]
        A control that passes on positions slower than the trigger comes, or in coarse counts.
        """
        x, z, c = (self._steps[axis].size for axis in "xzc")
        left = z / np.sqrt(12)
        if left > _STEP_OF_HEIGHT_M and z > 1.5 * resolution:
            yield (
                f"Z stands still and goes on in steps of {quantity(z, 'm')}, which leaves every "
                f"height open by {quantity(left, 'm')} (rms): record it at each trigger and with "
                "all its digits, or state encoder_resolution"
            )
        for axis, unit, size, lateral_step in (("X", "m", x, x), ("C", "rad", c, c * self._widest)):
            if (left := lateral_step / np.sqrt(12)) > max(_LATERAL_STEP_M, 1.5 * lateral):
                yield (
                    f"{axis} stands still and goes on in steps of {quantity(size, unit)}, which "
                    f"leaves places open by {quantity(left, 'm')} (rms): record it at each trigger "
                    "and with all its digits, or state --lateral"
                )

    def faults(self, name: str) -> Iterator[str]:
        """Yield what is wrong, in words for people; nothing is with what never came."""
        if not self.samples:
            return
        if self.missing:
            places = ", ".join(f"{first} to {last}" for first, last in self.gaps)
            more = f" and {self.places - len(self.gaps)} more" * (self.places > len(self.gaps))
            yield (
                f"{name}: {self.missing} trigger numbers are missing ({places}{more}): samples were"
                " lost between device and disk; look at the state of driver and recorder"
            )
        if self.restarts:
            yield f"{name}: the counter began anew {self.restarts} times: the device was restarted"
        if self.repeated:
            yield f"{name}: {self.repeated} samples repeat trigger numbers that came before"
        if max(self.periods) - min(self.periods) > SAME_PERIOD * min(self.periods):
            yield f"{name}: sample periods from {min(self.periods)} s to {max(self.periods)} s"
        if self.invalid == self.samples:
            yield f"{name}: not one of {self.samples} readings is valid"
        elif self.least == self.most and self.samples - self.invalid > 1:
            yield (
                f"{name}: all {self.samples - self.invalid} valid readings are "
                f"{quantity(self.least, 'm')}, to the last digit: a probe scatters; look whether "
                "it measures, and whether its driver passes on what it sends"
            )
        else:
            yield from self._readings.faults(name)


class _Readings:
    """Follows the valid readings of a probe [m], in their order: how long they stood still."""

    def __init__(self) -> None:
        self._samples = self._changes = 0
        self._run, self._last = 0, np.nan
        self._longest, self._value = 0, np.nan
        # The least are the greatest with their sign turned.
        self._ends = {"greatest": (1, _EndValues()), "least": (-1, _EndValues())}

    def add(self, readings: FloatArray) -> None:
        """Take the next readings (n,), finite."""
        if not len(readings):
            return
        self._samples += len(readings)
        begins = np.flatnonzero(np.diff(readings, prepend=self._last) != 0)
        self._changes += len(begins)
        # The first goes on with what stood at the end of the readings before.
        runs = np.diff(np.concatenate([[-self._run], begins, [len(readings)]]))
        place = int(np.argmax(runs))
        if runs[place] > self._longest:
            self._longest = int(runs[place])
            self._value = float(readings[begins[place - 1]]) if place else self._last
        self._run, self._last = int(runs[-1]), float(readings[-1])
        for sign, end in self._ends.values():
            end.add(sign * readings)

    def faults(self, name: str) -> Iterator[str]:
        """Yield what was held or cut off, in words for people."""
        others = (self._samples - self._longest) / max(self._changes - 1, 1)
        if self._changes > 2 and self._longest >= max(_LEAST_HELD, _LONGER * others):
            yield (
                f"{name}: {self._longest} readings in succession are "
                f"{quantity(self._value, 'm')}, to the last digit, where others change every "
                f"{plain(max(others, 1.0), 2)}: a probe scatters; look whether its driver repeats "
                "the last reading where there is none, and mark those as invalid"
            )
        for word, (sign, end) in self._ends.items():
            if end.piled and end.times > self._longest and others < _COARSE:
                yield (
                    f"{name}: {end.times} of {self._samples} readings are the {word}, "
                    f"{quantity(sign * end.value, 'm')} to the last digit: the probe is at the end "
                    "of its range, or that number stands for no reading; centre the probe, or mark "
                    "such readings as invalid"
                )


class _Steps:
    """Follows an axis: whether it stands still between its steps, and how large these are."""

    def __init__(self) -> None:
        self._tail = np.empty(0)
        self._moves = self._alone = 0
        self._squares = 0.0

    def add(self, positions: FloatArray) -> None:
        """Take the next positions (n,); those that are none break the row."""
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
        """Of a step, rms; 0 where most steps follow on another one."""
        if self._alone < max(_STEPS_REPORTED, self._moves / 2):
            return 0.0
        return float(np.sqrt(self._squares / self._alone))


class _EndValues:
    """The greatest of all values and how often it came, and the same of the next."""

    def __init__(self) -> None:
        self.value, self.times = -np.inf, 0
        self._next, self._next_times = -np.inf, 0

    def add(self, values: FloatArray) -> None:
        """Take more values (n,); most bring neither of the two."""
        while len(values) and (greatest := float(np.max(values))) >= self._next:
            times = int(np.count_nonzero(values == greatest))
            if greatest > self.value:
                self._next, self._next_times = self.value, self.times
                self.value, self.times = greatest, times
            elif greatest == self.value:
                self.times += times
            else:
                again = self._next_times if greatest == self._next else 0
                self._next, self._next_times = greatest, again + times
                return
            values = values[values < greatest]

    @property
    def piled(self) -> bool:
        """Whether the outermost value came far more often than the next."""
        return self.times >= _LEAST_PILED and self.times > _PILED * self._next_times


def counter_skew(axes: StreamWatch, distance: StreamWatch) -> float | None:
    """Return how much later axes are stamped than distance at the same count [s], at the median.

    None where the two have no count in common.
    """
    found: list[float] = []
    since = axes.begin_ns
    for (count, stamp), (other_count, other_stamp) in zip(
        axes.marks(since), distance.marks(since), strict=False
    ):
        if not len(count) or not len(other_count):
            continue
        period = min(axes.periods)
        common = np.union1d(count, other_count)
        least, most = max(count[0], other_count[0]), min(count[-1], other_count[-1])
        within = common[(common >= least) & (common <= most)]
        where = within if len(within) else np.array([least])
        here = _stamp_at(where, count, stamp, period)
        found += list(here - _stamp_at(where, other_count, other_stamp, period))
    return float(np.median(found)) if found else None


def skew_fault(
    skew: float | None, period: float, trigger: CommonTrigger = EQUAL_COUNTS
) -> Iterator[str]:
    """Yield what a skew of the counters [s] means, if it is one, in words for people.

    trigger: what is stated of them, and how close the stamps are at best
    """
    if skew is None:
        return
    skew += trigger.counter_offset * period
    if abs(skew) > _SKEW_SAMPLES * period + trigger.stamp_tolerance:
        yield (
            f"at the same trigger number axes are stamped {skew / MILLISECOND_S:.4g} ms later than "
            f"the distance, {skew / period:.4g} samples: their counters were not started together, "
            "or their clocks differ; start both anew, or join them by their stamps (--by-stamps)"
        )


def _stamp_at(where: FloatArray, count: FloatArray, stamp: FloatArray, period: float) -> FloatArray:
    """Return the stamps between blocks on a line; beyond the last, a sample a period."""
    beyond = np.maximum(where - count[-1], 0.0) - np.maximum(count[0] - where, 0.0)
    return np.asarray(np.interp(where, count, stamp) + beyond * period, np.float64)
