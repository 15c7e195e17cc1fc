"""What do the counters and stamps of a recording say against it?

Samples that never came leave a gap in the counter and nothing else; two counters that were not
started together pair samples of different instants, and only their stamps show it.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from omsm_ros.core.samples.blocks import SAME_PERIOD, AxisBlock, Block, DistanceBlock, FloatArray
from omsm_ros.core.samples.continuity import TriggerCount
from omsm_ros.core.samples.slips import EQUAL_COUNTS, CommonTrigger
from omsm_ros.readable import quantity
from omsm_ros.units import MILLISECOND_S, NANOSECONDS_PER_S

# Places that are named; of more, the number.
_NAMED = 3
# Stamps of two clocks scatter; a counter is off by one sample or by none.
_SKEW_SAMPLES = 0.5


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
        self._count = TriggerCount()
        # Of each session: counts of first samples and their stamps [ns].
        self._marks: list[list[tuple[int, int]]] = []

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
            self._marks[arrival.session].append((block.first_sample, block.stamp_ns))
        if isinstance(block, DistanceBlock):
            self.invalid += int(np.sum(~block.ok))
            valid = block.distance[block.ok]
            self.least = float(np.min(valid, initial=self.least))
            self.most = float(np.max(valid, initial=self.most))
        elif isinstance(block, AxisBlock):
            axes = np.array([block.x, block.y, block.z, block.b, block.c])
            self.invalid += int(np.sum(~np.all(np.isfinite(axes), axis=0)))

    def marks(self, since_ns: int) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Yield counts, and stamps after ``since_ns`` [s], of the blocks of each session."""
        for session in self._marks:
            counts, stamps = np.array(session, np.int64).reshape(-1, 2).T
            yield counts.astype(np.float64), (stamps - since_ns) / NANOSECONDS_PER_S

    @property
    def begin_ns(self) -> int:
        """Stamp of the first block [ns]; 0 without one."""
        return self._marks[0][0][1] if self.samples else 0

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
