"""Detection of slips between the trigger counters of two streams.

A trigger that one device missed, or a counter that was started later, shifts one count against
the other, and only the stamps show it. The *skew* is the time of the axes minus the time of the
distance at equal counts; after a slip it is a whole number of sample periods.

The median skew of about a second is judged every 0.2 s. A slip begins at ``|median| >= period / 2 +
tolerance + 3 scatter`` and ends at ``|median| < period / 2 + tolerance``. Between the two limits
the last verdict holds. Before the first verdict the pairs wait; after ten seconds it is a slip. The
scatter is that of the second, or of the last half minute if it is larger, because a driver's clock
wanders while it is estimated from arrivals. The movement of that estimate bounds its error: the
earliest of n arrivals is late by about 1/n of their scatter, the earliest of n/k by k/n of it.

A difference of the delays of two devices of half a period or more compensates a slip. So a median
that differs from the usual one by ``period / 2 + 3 scatter`` is a slip, too.

A pair waits for later stamps of both streams that agree. At the start it waits for the first
verdict, and after a deviating stamp for the verdict on the stamps that follow. Blocks of one driver
carry the same stamps to the nanosecond and never wait.

A decision uses only the stamps of blocks up to its count, so that live and offline agree.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from omsm_ros.core.streams.blocks import BoolArray, FloatArray
from omsm_ros.core.streams.stamps import PAUSE_NS, StampHistory, StampLine
from omsm_ros.core.streams.statistics import median, spread_about_median
from omsm_ros.errors import Notice
from omsm_ros.quantities import COUNTER_OFFSET, STAMP_TOLERANCE, CheckedRecord
from omsm_ros.units import NANOSECONDS_PER_S

# Stamps of a driver are within 0.1 ms of the truth after 10 s (devices/clock.py); two drivers.
TWO_DRIVERS_S = 0.2e-3
# The first stamps of a driver are as uneven as its first arrivals: they are not judged [s].
_FIRST_S = 1.0
# Length of the judged median, and time between verdicts. A slip is found after half to all of
# the span [s].
_SPAN_S, _STRIDE_S = 0.8, 0.2
# Stamps of each stream that a verdict needs; those of long blocks span more than a second.
_LEAST_STAMPS = 8
# Time over which the scatter is also taken: the window of a driver's clock [s].
_WANDER_S = 30.0
# Stamps kept for a median; single-sample blocks at 1 kHz make 800 in a span.
_MOST_STAMPS = 1024
# Standard deviations of single stamps that the median of several does not reach.
_SEVERAL_TIMES = 3.0
# Number of verdicts in the first judged span, within which a slip is found.
_FOUND_IN = 5


@dataclass(frozen=True, kw_only=True)
class CommonTrigger(CheckedRecord):
    """Statement about the trigger that two devices count.

    counter_offset: added to the distance's count, it gives the axes' count [samples]
    stamp_tolerance: constant difference of their stamps of one trigger that is allowed [s]

    Raises ConfigurationError for implausible numbers.
    """

    counter_offset: int = COUNTER_OFFSET.of_field(0)
    stamp_tolerance: float = STAMP_TOLERANCE.of_field(TWO_DRIVERS_S)

    def least_slip(self, period: float) -> float:
        """Return the skew of stamps without scatter that is a slip [samples of ``period`` [s]]."""
        return 0.5 + self.stamp_tolerance / period


EQUAL_COUNTS = CommonTrigger()

# Two stamps of one trigger by one driver differ by rounding only [ns].
_SAME_NS = 2.0
# Samples without a partner that show that the counters do not agree [s].
_APART_S = 2.0
# Time after which pairs are released without a first verdict, where blocks are too long, and after
# which a skew that may be that of a slip is one [s].
_MOST_WAIT_S = 10.0


@dataclass(frozen=True, slots=True)
class TriggerSlip:
    """Verdict on two trigger counters.

    samples: periods by which axes are stamped later at equal counts; 0 while they agree
    seen_from: least slip that exceeds the scatter of the stamps [samples]; None if not judged
    skew: time of the axes minus time of the distance at equal counts [s]
    trigger: the statement it was judged by

    ``str(slip)`` is the sentence for the user.
    """

    samples: int = 0
    seen_from: int | None = None
    skew: float = 0.0
    trigger: CommonTrigger = EQUAL_COUNTS

    @classmethod
    def judged(
        cls, skew: float, period: float, trigger: CommonTrigger, limit: float | None = None
    ) -> TriggerSlip:
        """Return the verdict on a ``skew`` [samples] of counters with a ``period`` [s].

        limit: skew that is a slip [samples]; None takes that of stamps without scatter
        """
        limit = trigger.least_slip(period) if limit is None else limit
        if abs(skew) < limit:
            return cls()
        samples = round(skew) or int(math.copysign(1, skew))
        return cls(samples, math.ceil(limit), skew * period, trigger)

    def notice(self) -> Notice:
        """Return the slip as code and values."""
        return Notice(
            "streams.slip",
            samples=self.samples,
            skew=self.skew,
            tolerance=self.trigger.stamp_tolerance,
            offset=self.trigger.counter_offset - self.samples,
        )

    def __str__(self) -> str:
        return str(self.notice())


class TriggerSlipDetector:
    """Judges pairs of two streams by the stamps of their blocks.

    sessions: of axes and distance, whose pairs are judged
    found: the last slip, even if it has ended; None if there was none
    same_stamps: both streams carry the stamps of one device, which latches both
    in_doubt: since the start the stamps neither agree nor show a slip
    """

    def __init__(self, axes: StampLine, distance: StampLine, trigger: CommonTrigger) -> None:
        self._lines = (axes, distance)
        self._trigger = trigger
        self.found: TriggerSlip | None = None
        self._apart_ns, self._apart = 0.0, TriggerSlip()  # since the last pair
        self._restart((-1, -1), 0)

    def _restart(self, sessions: tuple[int, int], first: int) -> None:
        self.sessions, self._start = sessions, first
        self._state = TriggerSlip()
        self._judged, self._since, self._period_ns = -1, 0.0, 1.0
        self._starting, self.same_stamps = True, False  # until the first verdict
        self.in_doubt = False
        self._shown = [first, first]  # per stream: the last block that began where stamps agree
        # Count up to which a verdict found no slip; last count with a stamp that is off.
        self._judged_to, self._odd_at = first, -math.inf
        # True if any stamp since the last verdict is off; otherwise the median is not.
        self._odd = False
        self._seen = StampHistory(_MOST_STAMPS)
        # Skew at each verdict of the last half minute without a slip [ns].
        self._wander: deque[float] = deque(maxlen=round(_WANDER_S / _STRIDE_S))
        self._usual = math.nan  # skew [ns]
        self._found_in = _FOUND_IN  # verdicts; skews before them show how clocks move

    @property
    def state(self) -> TriggerSlip:
        """The last verdict, also on counters so far apart that there are no pairs."""
        if self._apart.samples or self._state.samples:
            return self._apart if self._apart.samples else self._state
        rows = self._recent()
        if rows is None or not self._seen.stamps_follow_counts(self._period_ns):
            return TriggerSlip()
        return TriggerSlip(seen_from=math.ceil(self._limit(rows[:, 1] / self._period_ns)))

    def apart(self, skew_ns: float, samples: int, period_ns: float) -> None:
        """Judge counters at whose equal counts ``samples`` find no partner of the same time."""
        self._apart_ns += samples * period_ns
        if self._apart_ns > _APART_S * NANOSECONDS_PER_S:
            skew = skew_ns / period_ns
            self._apart = TriggerSlip(round(skew), 1, skew_ns / NANOSECONDS_PER_S, self._trigger)

    def settled(
        self, sessions: tuple[int, int], first: int, end: int, period_ns: float
    ) -> Iterator[tuple[int, bool]]:
        """Judge the pairs from ``first`` to ``end``, which follow on those before.

        Yield counts up to which waiting pairs are settled, with True where they slipped.
        """
        self._apart_ns, self._apart = 0.0, TriggerSlip()
        if sessions != self.sessions:
            self._restart(sessions, first)
        lines = tuple(zip(self._lines, sessions, strict=True))
        for line, session in lines:
            line.advance(session, first - 1)
        while (count := min(line.next_in(session, end) for line, session in lines)) < end:
            if self.same_stamps or any(
                line.step_to(s, count, period_ns) >= PAUSE_NS for line, s in lines
            ):
                yield count, self.end()
            before = self._state.samples
            self._observe(count, period_ns)
            if before or self._state.samples:
                yield count, True
                self._shown = [count, count]
            else:
                yield self._agreed_until(count, period_ns), False
        stamped = all(line.stamp_of(s, first, period_ns) is not None for line, s in lines)
        if self.same_stamps or self._state.samples or not stamped:
            yield end, bool(self._state.samples)

    def end(self) -> bool:
        """Return whether the pairs that still wait slipped, as far as their stamps show."""
        since = self._start - 1 if self._starting else min(self._shown)
        known = self._state.samples or self._odd_at <= since
        if known or not self._seen.stamps_follow_counts(self._period_ns):
            return bool(self._state.samples)
        rows = self._seen.rows[self._seen.rows[:, 0] > since]
        # As after ten seconds, a skew at the start that may be that of a slip is one.
        found = self._verdict(rows[:, 1] / self._period_ns, 0.0 if self._starting else None)
        self.found = found if found.samples else self.found
        return bool(found.samples)

    def _agreed_until(self, count: int, period_ns: float) -> int:
        """Return the count up to which stamps have shown that there is no slip."""
        per_s = NANOSECONDS_PER_S / period_ns
        if self.in_doubt or (self._starting and not self._overdue(count)):
            return self._start
        self._starting = False
        odd = count - self._odd_at <= _SPAN_S * per_s
        return self._judged_to if odd else max(min(self._shown), self._judged_to)

    def _overdue(self, count: int) -> bool:
        return (count - self._start) * self._period_ns > _MOST_WAIT_S * NANOSECONDS_PER_S

    def _observe(self, count: int, period_ns: float) -> None:
        """Take the skew at ``count``, where a block of either stream begins."""
        (axes, distance), (a, d) = self._lines, self.sessions
        begun = axes.advance(a, count), distance.advance(d, count)
        skew = axes.stamp_difference(distance, self.sessions, period_ns)
        if skew is None:
            self.same_stamps = False
            return
        self._period_ns, per_s = period_ns, NANOSECONDS_PER_S / period_ns
        changed = abs(skew - self._usual) >= period_ns / 2  # False while none is usual
        off = (changed or abs(skew) >= period_ns / 2) and bool(self._off(np.array(skew)))
        self.same_stamps |= not len(self._seen.rows)  # the first one
        self.same_stamps &= abs(skew) <= _SAME_NS
        for stream in (0, 1):
            if begun[stream] and not off:
                self._shown[stream] = count
        self._odd_at = count if off else self._odd_at
        stride = int(count // max(_STRIDE_S * NANOSECONDS_PER_S / period_ns, 1.0))
        judged, self._judged = self._judged, stride
        early_days = count - self._start < _FIRST_S * per_s
        if stride != judged:
            if not early_days:
                self._since = count - _SPAN_S * per_s
                self._judge(count)
            if not self._state.samples:  # a slip in the newest ones is not found yet
                self._wander.append(skew)
                if len(self._wander) >= 3 * (latest := self._found_in):
                    self._usual = median(np.array([*self._wander][-2 * latest : -latest]))
        time = axes.stamp_of(a, count, period_ns) or 0.0
        self._seen.add(count, skew, *begun, time)
        self._odd |= off and not early_days

    def _off(self, skew: FloatArray) -> BoolArray:
        """Return which ``skew`` (n,) of single stamps [ns] may be of a slip."""
        limit = self._period_ns / 2 + _SEVERAL_TIMES * self._scatter()
        far = abs(skew) >= self._steady() * self._period_ns
        return np.asarray(far | (abs(skew - self._usual) >= limit))

    def _judge(self, count: int) -> None:
        rows = self._recent()
        if rows is not None:  # long blocks make the judged span longer
            strides = rows[:, 0] // (_STRIDE_S * NANOSECONDS_PER_S / self._period_ns)
            self._found_in = max(int(np.count_nonzero(np.diff(strides))) + 1, _FOUND_IN)
        if not (self._odd or self._state.samples or self._starting):
            return
        if rows is None or not self._seen.stamps_follow_counts(self._period_ns):
            self._state, self._odd = TriggerSlip(), True
            if rows is not None:
                self._starting, self._judged_to = False, count  # stamps show nothing
        else:
            self._state = self._verdict(rows[:, 1] / self._period_ns)
            beyond = abs(median(rows[:, 1])) >= self._steady() * self._period_ns
            self.in_doubt = self._starting and beyond and not self._state.samples
            if self.in_doubt and not self._overdue(count):
                return
            if self.in_doubt:
                self._state = self._verdict(rows[:, 1] / self._period_ns, above=0.0)
                self.in_doubt = False
            self._starting, self._judged_to = False, int(rows[0, 0])
            self._odd = bool(np.any(self._off(rows[:, 1])))
            self.found = self._state if self._state.samples else self.found

    def _recent(self) -> FloatArray | None:
        """Return the rows of :class:`StampHistory` to be judged; None if too few."""
        first = self._start + _FIRST_S * NANOSECONDS_PER_S / self._period_ns
        return self._seen.recent(first, self._since, _LEAST_STAMPS)

    def _scatter(self) -> float:
        """Return the scatter of the skews at verdicts [ns], at least the error of their clocks.

        A slip in the newest skews is not a movement of clocks.
        """
        if not self._wander:
            return 0.0
        wander = np.array(self._wander)
        known = wander[: -self._found_in]
        arrivals = np.arange(1, len(known) + 1) / len(wander)
        uncertainty = float(np.max(abs(known - known[-1:]) * arrivals, initial=0.0))
        return max(spread_about_median(wander), uncertainty)

    def _steady(self) -> float:
        return self._trigger.least_slip(self._period_ns / NANOSECONDS_PER_S)

    def _limit(self, window: FloatArray) -> float:
        """Return the skew that is a slip [samples]."""
        scatter = self._scatter() / self._period_ns
        return self._steady() + _SEVERAL_TIMES * max(spread_about_median(window), scatter)

    def _verdict(self, window: FloatArray, above: float | None = None) -> TriggerSlip:
        """Return the verdict on the skews ``window`` (n,) [samples].

        above: by how much a slip exceeds that of stamps without scatter; None by their scatter
        """
        limit, skew, steady = self._limit(window), median(window), self._steady()
        period = self._period_ns / NANOSECONDS_PER_S
        if above is None:
            above = 0.0 if self._state.samples else limit - steady
        found = TriggerSlip.judged(skew, period, self._trigger, steady + above)
        change = skew - self._usual / self._period_ns
        if abs(change) >= 0.5 + above:
            samples = round(change) or int(math.copysign(1, change))
            found = TriggerSlip(samples, 1, skew * period, self._trigger)
        return replace(found, seen_from=math.ceil(limit)) if found.samples else found
