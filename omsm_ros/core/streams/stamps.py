"""Stamps over the trigger count: the line through them, and the stamps of blocks to come.

The stamps of a device's blocks jitter, its sample clock does not: a line through the stamps of a
session gives the time of every sample. Its slope shows a stated sample period that is wrong.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from omsm_ros.core.streams.blocks import Block, FloatArray, IntArray
from omsm_ros.core.streams.statistics import falling_density_likelihood, slopes_below
from omsm_ros.errors import DataError, Notice
from omsm_ros.units import NANOSECONDS_PER_S, PPM

# Sample clocks are quartz oscillators; a stated period that is off by more is wrong.
_MAX_RATE_ERROR = 1e-3
# Clocks of two computers differ by a tenth of this; the lag of a motion changes by less than 1 %.
_GREATEST_DIFFERENCE = 5e-3
# Number of standard uncertainties by which the stamps must contradict a stated period.
_COVERAGE = 5.0
# The uncertainty of a line through fewer blocks is not known well enough to contradict a period.
_LEAST_BLOCKS = 5


@dataclass(frozen=True, slots=True)
class StampClock:
    """Time of the sample ``count``: ``start + offset + (count - first) · period``.

    first, start_ns: a sample and its stamp [ns];  offset_ns: from its stamp to the line [ns]
    period_ns: [ns];  period_uncertainty_ns: standard uncertainty of it [ns]
    """

    first: int
    start_ns: int
    offset_ns: float
    period_ns: float
    period_uncertainty_ns: float = 0.0

    @classmethod
    def through(cls, stamps: IntArray, nominal_ns: float) -> StampClock:
        """Return the regression line through ``stamps`` (k, 2), counts and times [ns].

        nominal_ns: period [ns], which is taken where all stamps are of one count
        """
        first, start = stamps[0].tolist()
        count, since = (stamps - stamps[0]).T.astype(np.float64)
        late = since - count * nominal_ns
        if np.ptp(count) == 0:
            return cls(first, start, float(late.mean()), nominal_ns)
        centred = count - count.mean()
        square = float(centred @ centred)
        drift = float(centred @ late / square)
        offset = float(late.mean() - drift * count.mean())
        residual = late - offset - drift * count
        variance = float(residual @ residual) / max(len(count) - 2, 1)
        return cls(first, start, offset, nominal_ns + drift, float(np.sqrt(variance / square)))

    def since(self, count: FloatArray, origin_ns: int) -> FloatArray:
        """Return the times of samples ``count`` (n,) after ``origin_ns`` [s]."""
        whole = self.start_ns - origin_ns
        fine = self.offset_ns + (count - self.first) * self.period_ns
        return np.asarray((whole + fine) / NANOSECONDS_PER_S, np.float64)


def fit_clock(blocks: Sequence[Block]) -> StampClock:
    """Return the line through the stamps of a session; DataError if they contradict the period."""
    nominal = blocks[0].sample_period * NANOSECONDS_PER_S
    stamps = np.concatenate([block.stamps for block in blocks])  # (k, 2)
    clock = StampClock.through(stamps, nominal)
    drift, limit = abs(clock.period_ns - nominal), _MAX_RATE_ERROR * nominal
    if drift > limit + _COVERAGE * clock.period_uncertainty_ns:
        raise DataError(
            "streams.rate",
            stamped=clock.period_ns / NANOSECONDS_PER_S,
            stated=blocks[0].sample_period,
        )
    if drift <= limit:
        return clock
    # Few blocks with jitter do not show the rate, so the stated period stands.
    count, since = (stamps - stamps[0]).T.astype(np.float64)
    offset = float((since - count * nominal).mean())
    return StampClock(clock.first, clock.start_ns, offset, nominal)


def check_period(name: str, blocks: Sequence[Block], time_lapse: float = 1.0) -> None:
    """Raise DataError where the stamps of ``blocks`` clearly contradict their sample period.

    time_lapse: factor by which the recording was played faster than real time [1]
    A wrong period scales all frequencies and lags, and no residual shows it.
    """
    if not blocks:
        return
    stamps = np.array([(block.first_sample, block.stamp_ns) for block in blocks])
    fault = period_fault(name, stamps, blocks[0].sample_period, time_lapse)
    if fault is not None:
        raise DataError(fault.code, **fault.values)


def period_fault(
    name: str, stamps: IntArray, stated: float, time_lapse: float = 1.0
) -> Notice | None:
    """Return how ``stamps`` (k, 2) contradict the ``stated`` sample period [s], None if not.

    stamps: counts and times [ns] of one session;  time_lapse: see :func:`check_period`
    """
    if len(stamps) < _LEAST_BLOCKS or np.ptp(stamps[:, 0]) == 0:
        return None
    line = StampClock.through(stamps, stated * NANOSECONDS_PER_S)
    scale = time_lapse / NANOSECONDS_PER_S
    period, uncertainty = line.period_ns * scale, line.period_uncertainty_ns * scale
    allowed = max(_GREATEST_DIFFERENCE * stated, _COVERAGE * uncertainty)
    if period <= 0 or abs(period - stated) <= allowed:
        return None
    if (jump := _jump(stamps, stated / time_lapse)) is not None:
        count, size = jump
        return Notice("streams.clock_set", stream=name, jump=size, sample=count, stated=stated)
    return Notice("streams.period", stream=name, stated=stated, stamped=period)


def _jump(stamps: IntArray, period: float) -> tuple[int, float] | None:
    """Return the sample and size [s] of a jump of the stamps, None unless one jump explains them.

    The sample counts from the first one.
    """
    samples, passed = np.diff(stamps, axis=0).T
    passed = passed / NANOSECONDS_PER_S
    ahead = passed - samples * period
    place = int(np.argmax(np.abs(ahead)))
    others = np.arange(len(ahead)) != place
    if abs(np.sum(ahead[others])) > _GREATEST_DIFFERENCE * abs(np.sum(samples[others])) * period:
        return None
    return int(stamps[place + 1, 0] - stamps[0, 0]), float(ahead[place])


# A stamp that is this far ahead begins a motion after a pause. It is half of the time after which
# a live node settles the pairs that wait [ns].
PAUSE_NS = 0.5e9


class StampLine:
    """Stamps of the blocks of one stream, in the order of sessions and counts, as a queue."""

    def __init__(self) -> None:
        # Session, first count and stamp of each block to come, and of the current one.
        self._coming: deque[tuple[int, int, int]] = deque()
        self._current: tuple[int, int, int] | None = None

    def add(self, session: int, count: int, stamp_ns: int) -> None:
        """Append the newest block's session, first count and stamp."""
        self._coming.append((session, count, stamp_ns))

    def advance(self, session: int, count: int) -> bool:
        """Move to the block that holds ``count``; return whether it begins there."""
        moved = False
        while self._coming and self._coming[0][:2] <= (session, count):
            self._current, moved = self._coming.popleft(), True
        return moved and self._current is not None and self._current[:2] == (session, count)

    def step_to(self, session: int, count: int, period_ns: float) -> float:
        """Return the stamp of the next block less that predicted from the current one [ns].

        0 unless it begins at ``count``.
        """
        if self._current is None or not self._coming or self._coming[0][:2] != (session, count):
            return 0.0
        begun, before, stamp = self._current
        step = self._coming[0][2] - stamp - (count - before) * period_ns
        return step if begun == session else 0.0

    def next_in(self, session: int, end: int) -> int:
        """Return the count at which the next block begins, at most ``end``."""
        coming = self._coming and self._coming[0][0] == session
        return min(self._coming[0][1], end) if coming else end

    def stamp_of(self, session: int, count: int, period_ns: float) -> float | None:
        """Return the time of the sample ``count`` [ns], None where no stamp is known."""
        if self._current is None or self._current[0] != session:
            return None
        return self._current[2] + (count - self._current[1]) * period_ns

    def stamp_difference(
        self, other: StampLine, sessions: tuple[int, int], period_ns: float
    ) -> float | None:
        """Return how much later a count is stamped here than in ``other`` [ns], None if unknown.

        It compares the current blocks. Stamps are subtracted as integers: a float cannot hold
        nanoseconds since 1970.
        """
        here, there = self._current, other._current
        if here is None or there is None or (here[0], there[0]) != sessions:
            return None
        return here[2] - there[2] + (there[1] - here[1]) * period_ns


# Stamps that advance faster or slower than the counts by more than this factor were made in time
# lapse, or hold no times. A slip of a third of the judged span is still within it.
_TIME_LAPSE = 1.5


class StampHistory:
    """The newest comparisons of the stamps of two streams, ``most`` of them.

    Each row holds: count, stamp of the first stream minus stamp of the second [ns], whether a
    block of the first and of the second stream begins there, time of the first stream [ns].
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._room, self._held = np.empty((2 * most, 5)), 0

    @property
    def rows(self) -> FloatArray:
        """The rows held (n, 5), in their order."""
        return self._room[max(self._held - self._most, 0) : self._held]

    def add(self, *row: float) -> None:
        """Append a row of five values."""
        if self._held == len(self._room):
            self._room[: self._most] = self.rows
            self._held = self._most
        self._room[self._held] = row
        self._held += 1

    def recent(self, first: float, since: float, least: int) -> FloatArray | None:
        """Return the rows from the count ``since`` on, with at least ``least`` blocks a stream.

        first: rows before this count are left out;  None if too few remain
        """
        rows = self.rows[np.searchsorted(self.rows[:, 0], first) :]
        starts = [np.flatnonzero(rows[:, column]) for column in (2, 3)]
        if min(map(len, starts)) < least:
            return None
        begin = int(np.searchsorted(rows[:, 0], since))
        return rows[min(begin, *(int(s[-least]) for s in starts)) :]

    def stamps_follow_counts(self, period_ns: float) -> bool:
        """Return whether stamps advance about as fast as the counts."""
        (first, *_, began), (last, *_, ended) = self.rows[0], self.rows[-1]
        elapsed, passed = (last - first) * period_ns, ended - began
        return bool(elapsed < _TIME_LAPSE * passed and passed < _TIME_LAPSE * elapsed)


# Only the earliest arrival in this time counts, which bounds the fit to 150 points [s].
SPAN_S = 0.2
# Crystals differ by some tens of ppm: the standard uncertainty of the drift before any arrival.
DRIFT_SIGMA = 50 * PPM
# A drift beyond this by five of its standard uncertainties is not that of a crystal: the device
# is played faster than it was recorded, or set to another rate.
LARGEST_CRYSTAL_DRIFT = 1000 * PPM
# Points that show a gross drift, and any other one.
_LEAST_POINTS, _SURE_POINTS = 6, 9
# A drift of a tenth or more is another rate.
GROSS_DRIFT = 0.1
# Delays below this are those of the clocks themselves [s].
_LEAST_DELAY_S = 1e-6
# How unlikely the drift of no crystal is beforehand (log).
_OTHER_RATE = 12.0


def line_below(x: FloatArray, y: FloatArray) -> tuple[float, float, FloatArray]:
    """Return offset, slope and rests (n,) of the likeliest line below the points.

    The rests are exponentially distributed, with an unknown mean, the slopes normally. A busy host
    delays all arrivals of about a second, so only one rest a second counts.
    """
    drift, uncertainty = expected_drift(x, y)
    slopes = np.append(slopes_below(x, y), drift)
    offsets = np.min(y - slopes[:, np.newaxis] * x, axis=1)
    mean = np.maximum(y.mean() - offsets - slopes * x.mean(), _LEAST_DELAY_S)
    unlikely = ((slopes - drift) / uncertainty) ** 2 / 2
    best = np.argmin(len(x) * SPAN_S * np.log(mean) + unlikely)
    offset, slope = float(offsets[best]), float(slopes[best])
    return offset, slope, y - slope * x - offset


def expected_drift(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Return the drift of crystals and its uncertainty.

    Where no crystal has the drift of the regression line, return that and its range.
    """
    centred = x - x.mean()
    square = float(centred @ centred)
    if len(x) >= _LEAST_POINTS and square > 0:
        drift = float(centred @ y) / square
        range_ = 5 * max(float(np.std(y - drift * x)), _LEAST_DELAY_S) / math.sqrt(square)
        least = LARGEST_CRYSTAL_DRIFT if len(x) >= _SURE_POINTS else GROSS_DRIFT
        if abs(drift) - range_ > least:
            return drift, range_
    return 0.0, DRIFT_SIGMA


def late_likelihood(x: FloatArray, y: FloatArray, period: float) -> tuple[float, FloatArray]:
    """Return the log likelihood of arrivals above the likeliest line, and their rests (n,).

    x: times [s];  y: lateness [period], (n,)

    Long delays are rarer than short ones. The two arrivals that define the line do not count.
    """
    drift, uncertainty = (each / period for each in expected_drift(x, y * period))
    slopes = np.append(slopes_below(x, y), drift)
    rests = y - slopes[:, np.newaxis] * x
    rests -= rests.min(axis=1, keepdims=True)
    likely = falling_density_likelihood(np.sort(rests, axis=1)[:, 2:])
    likely -= ((slopes - drift) / uncertainty) ** 2 / 2
    best = int(np.argmax(likely))
    return float(likely[best]) - (_OTHER_RATE if drift else 0.0), rests[best]
