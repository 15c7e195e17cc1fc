"""Do equal trigger counts of two streams still mean the same trigger?

A trigger that one device missed, or a counter that was started later, shifts one count against
the other, and nothing but the stamps shows it. For equal counts the *skew* is the time of the
axes less the time of the distance, a whole number of sample periods where the counts slipped.
Its median over about a second is judged every fifth of one, against what the stamps allow:
``|median| >= period / 2 + tolerance + 3 scatter`` is a slip, ``|median| < period / 2 + tolerance``
ends it, and between the two the last verdict holds. The scatter is that within the second or that
over the last half minute, whichever is larger: a driver's clock wanders while it learns. What it
has still to learn is larger than that, and taken from how it moves: the mean of n arrivals moves by
1/n of their scatter with the next, and is wrong by 1/√n of it, so by √n times what it moves.

Until then nothing is shown: a pair waits until stamps that agree have come after it, from both
streams, at the start until the first verdict, and where a stamp is off until a verdict on what
came after it. Blocks of one driver carry the same stamps to the nanosecond, and wait for nothing.

Every decision rests on the stamps of blocks up to that count alone, so live and offline agree.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.streams.continuity import StampHistory, StampLine, upcoming_stamps
from omsm_ros.core.streams.statistics import median, spread_about_median
from omsm_ros.errors import ConfigurationError
from omsm_ros.quantities import COUNTER_OFFSET, STAMP_TOLERANCE
from omsm_ros.units import MILLISECOND_S, NANOSECONDS_PER_S

# Stamps of a driver are within 0.1 ms of the truth after 10 s (devices/clock.py); two drivers.
TWO_DRIVERS_S = 0.2e-3
# A driver's first stamps are as uneven as its first arrivals: of this time nothing is judged [s].
_FIRST_S = 1.0
# More than half of the span must have slipped: found 0.4 s to 0.8 s after it happened [s].
_SPAN_S, _STRIDE_S = 0.8, 0.2
# Stamps of either stream that a verdict needs; of long blocks they span more than a second.
_LEAST_STAMPS = 8
_SURE_STAMPS = 3  # one or two at the end cost the pairs that they are of, but show no slip
# Over which the scatter is also taken: the window of a driver's clock [s].
_WANDER_S = 30.0
# Blocks of one sample at 1 kHz make 800 in a span; more are not needed for a median.
_MOST_STAMPS = 1024
# Scatter (standard deviation) of single stamps that the median of several never reaches.
_SEVERAL_TIMES = 3.0
# A driver's clock is the end of a line, which moves more than a mean does. In 20 to 30 starts with
# arrivals uneven by ±20 ms: 0.5 gives 2 false alarms, 0.7 none; 1.0 finds small slips late.
_END_OF_LINE = 0.7


@dataclass(frozen=True, kw_only=True)
class CommonTrigger:
    """What is stated of the trigger that two devices count.

    counter_offset: added to the distance's count, it gives the axes' count [samples]
    stamp_tolerance: by how much their stamps of one trigger may differ, all the time [s]

    Raises ConfigurationError for numbers that are neither.
    """

    counter_offset: int = 0
    stamp_tolerance: float = TWO_DRIVERS_S

    def __post_init__(self) -> None:
        COUNTER_OFFSET.checked(self.counter_offset, ConfigurationError, "counter_offset")
        STAMP_TOLERANCE.checked(self.stamp_tolerance, ConfigurationError, "stamp_tolerance")


# One driver's stamps of one trigger, rounded twice, differ by no more than this [ns].
_SAME_NS = 2.0
# Stamps that are worth taking together.
_MANY = 16
# Pairs wait no longer than this for the first verdict: blocks are too long for one [s].
_MOST_WAIT_S = 10.0

EQUAL_COUNTS = CommonTrigger()


@dataclass(frozen=True, slots=True)
class TriggerSlip:
    """What the stamps say of two counters.

    samples: periods by which axes are stamped later at equal counts, 0 as long as they agree
    seen_from: a slip of fewer samples does not stand out of the stamps' scatter; None = not judged
    remedy: in words for people
    """

    samples: int = 0
    seen_from: int | None = None
    remedy: str = ""

    def __str__(self) -> str:
        return (
            f"the trigger counter slipped by {self.samples} samples against that of the axes: "
            f"{self.remedy}"
        )


class TriggerSlipDetector:
    """Judges pairs of two streams by the stamps of their blocks.

    sessions: of axes and distance, whose pairs are watched
    found: the last slip there was, healed or not; None if there was none
    """

    def __init__(self, axes: StampLine, distance: StampLine, trigger: CommonTrigger) -> None:
        self._lines = (axes, distance)
        self._trigger = trigger
        self.found: TriggerSlip | None = None
        self._restart((-1, -1), 0)

    def _restart(self, sessions: tuple[int, int], first: int) -> None:
        self.sessions, self._start = sessions, first
        self._state = TriggerSlip()
        self._judged, self._since, self._period_ns = -1, 0.0, 1.0
        # Nothing was judged yet; whether one driver stamps both, once any stamp was seen.
        self._starting, self._common = True, False
        # Of each stream: stamps seen, and the last block that began where stamps agree.
        self._stamps, self._shown = [0, 0], [first, first]
        # Up to where a verdict found none, in spite of stamps that are off; the last of those.
        self._judged_to, self._odd_at = first, -math.inf
        # Whether any stamp since the last verdict is off enough: without one no median is.
        self._odd = False
        self._seen = StampHistory(_MOST_STAMPS)
        # Skew at each stride of the last half minute without a slip [ns].
        self._wander: deque[float] = deque(maxlen=round(_WANDER_S / _STRIDE_S))

    @property
    def same_stamps(self) -> bool:
        """Whether both streams carry the same stamps: then one device latches both."""
        return self._common

    @property
    def state(self) -> TriggerSlip:
        """What the stamps said last."""
        if self._state.samples:
            return self._state
        window = self._window()
        return (
            TriggerSlip()
            if window is None
            else TriggerSlip(seen_from=math.ceil(self._limit(window)))
        )

    def settled(
        self, sessions: tuple[int, int], first: int, end: int, period_ns: float
    ) -> Iterator[tuple[int, bool]]:
        """Watch the pairs from ``first`` to ``end``, which go on with those before.

        Yield up to which count all those that still wait are settled, and whether they slipped.
        """
        if sessions != self.sessions:
            self._restart(sessions, first)
        for line, session in zip(self._lines, sessions, strict=True):
            line.advance(session, first - 1)
        while (count := self._next(end)) < end:
            if (last := self._skip_unremarkable(end, period_ns)) is not None:
                yield self._agreed_until(last, period_ns), False
                continue
            pairs = zip(self._lines, sessions, strict=True)
            if self._common or any(line.follows_gap(s, count, period_ns) for line, s in pairs):
                yield count, self.end()
            before = self._state.samples
            self._observe(count, period_ns)
            if before or self._state.samples:
                yield count, True
                self._shown = [count, count]
            else:
                yield self._agreed_until(count, period_ns), False
        pairs = zip(self._lines, sessions, strict=True)
        stamped = all(line.stamp_of(s, first, period_ns) is not None for line, s in pairs)
        if self._common or self._state.samples or not stamped:
            yield end, bool(self._state.samples)

    def _skip_unremarkable(self, end: int, period_ns: float) -> int | None:
        """Take the next stamps up to the first that stands out, as :meth:`_observe` takes each.

        Return the last one's count; None if that one has to be looked at by itself. Of a bag
        thousands are there at once, and of one driver or two nearly none stands out.
        """
        if self._starting or self._odd or self._state.samples or sum(map(len, self._lines)) < _MANY:
            return None
        ahead = upcoming_stamps(self._lines, self.sessions, end, period_ns)
        if ahead is None:
            return None
        self._period_ns = period_ns
        rows, leaps = ahead
        size = abs(rows[:, 1])
        apart = leaps | (size >= self._off_ns()) | (self._common & (size > _SAME_NS))
        rows = rows[: int(np.argmax(apart)) if apart.any() else None]
        if not len(rows):
            return None
        strides = rows[:, 0] // self._stride(period_ns)
        begins = np.flatnonzero(np.diff(strides, prepend=self._judged))
        if len(begins):
            self._judged = int(strides[-1])
            self._since = rows[begins[-1], 0] - _SPAN_S * NANOSECONDS_PER_S / period_ns
            self._wander.extend(rows[begins, 1].tolist())
        self._seen.add(rows)
        for stream, line in enumerate(self._lines):
            begun = np.flatnonzero(rows[:, 2 + stream])
            if len(begun):
                line.skip(len(begun))
                self._stamps[stream] += len(begun)
                self._shown[stream] = int(rows[begun[-1], 0])
        return int(rows[-1, 0])

    def end(self) -> bool:
        """Return whether the pairs that still wait slipped, as far as it can be told."""
        since = self._start - 1 if self._starting else min(self._shown)
        few = self._starting and min(self._stamps) < _LEAST_STAMPS
        if (
            self._state.samples
            or self._odd_at <= since
            or few
            or not self._seen.stamps_follow_counts(self._period_ns)
        ):
            return bool(self._state.samples)
        rows = self._seen.after(since)
        found = self._verdict(rows[:, 1] / self._period_ns)
        if found.samples and len(rows) >= _SURE_STAMPS:
            self._state = self.found = found
        return bool(found.samples)

    def _agreed_until(self, count: int, period_ns: float) -> int:
        """Return up to where stamps have shown that there is no slip."""
        per_s = NANOSECONDS_PER_S / period_ns
        if self._starting and count - self._start <= _MOST_WAIT_S * per_s:
            return self._start
        self._starting = False
        odd = count - self._odd_at <= _SPAN_S * per_s
        return self._judged_to if odd else max(min(self._shown), self._judged_to)

    def _next(self, end: int) -> int:
        pairs = zip(self._lines, self.sessions, strict=True)
        return min(line.next_in(session, end) for line, session in pairs)

    def _observe(self, count: int, period_ns: float) -> None:
        """Take the skew where a block of either stream begins."""
        (axes, distance), (a, d) = self._lines, self.sessions
        begun = axes.advance(a, count), distance.advance(d, count)
        skew = axes.stamp_difference(distance, self.sessions, period_ns)
        if skew is None:
            self._common = False
            return
        self._period_ns, per_s = period_ns, NANOSECONDS_PER_S / period_ns
        self._note(count, skew, begun)
        stride = int(count // self._stride(period_ns))
        judged, self._judged = self._judged, stride
        early_days = count - self._start < _FIRST_S * per_s
        if stride != judged:
            if not early_days:
                self._since = count - _SPAN_S * per_s
                self._judge(count)
            if not self._state.samples:
                self._wander.append(skew)
        time = axes.stamp_of(a, count, period_ns) or 0.0
        self._seen.add(np.array([[count, skew, *begun, time]]))
        self._odd |= self._is_off(skew) and not early_days

    def _note(self, count: int, skew: float, begun: tuple[bool, bool]) -> None:
        """Keep what one stamp shows, of the streams whose blocks have ``begun`` there."""
        first = not any(self._stamps)
        self._common = abs(skew) <= _SAME_NS and (first or self._common)
        for stream in np.flatnonzero(begun):
            self._stamps[stream] += 1
            if not self._is_off(skew):
                self._shown[stream] = count
        if self._is_off(skew):
            self._odd_at = count

    def _off_ns(self) -> float:
        """Return the skew that is off [ns]."""
        return self._steady(self._period_ns) * self._period_ns

    def _is_off(self, skew: float) -> bool:
        return abs(skew) >= self._off_ns()

    @staticmethod
    def _stride(period_ns: float) -> float:
        """Return the samples from one verdict to the next."""
        return max(_STRIDE_S * NANOSECONDS_PER_S / period_ns, 1.0)

    def _judge(self, count: int) -> None:
        if not (self._odd or self._state.samples or self._starting):
            return
        rows = self._recent()
        if rows is None or not self._seen.stamps_follow_counts(self._period_ns):
            self._state, self._odd = TriggerSlip(), True
            if rows is not None:
                self._starting, self._judged_to = False, count  # stamps tell nothing
        else:
            window = rows[:, 1] / self._period_ns
            self._state = self._verdict(window)
            self._starting, self._judged_to = False, int(rows[0, 0])
            self._odd = bool(np.any(abs(window) >= self._steady(self._period_ns)))
            self.found = self._state if self._state.samples else self.found

    def _recent(self) -> FloatArray | None:
        """Return the stamps to be judged, as :class:`StampHistory` has them; None if too few."""
        first = self._start + _FIRST_S * NANOSECONDS_PER_S / self._period_ns
        return self._seen.recent(first, self._since, _LEAST_STAMPS)

    def _window(self) -> FloatArray | None:
        """Return the skews to be judged [samples], None if they say nothing."""
        rows = self._recent()
        return (
            None
            if rows is None or not self._seen.stamps_follow_counts(self._period_ns)
            else rows[:, 1] / self._period_ns
        )

    def _steady(self, period_ns: float) -> float:
        """Return the skew of stamps without scatter that is a slip [samples]."""
        return 0.5 + self._trigger.stamp_tolerance * NANOSECONDS_PER_S / period_ns

    def _limit(self, window: FloatArray) -> float:
        """Return the skew that is a slip [samples]."""
        wander = np.array(self._wander) / self._period_ns
        scatter = max(
            spread_about_median(window), spread_about_median(wander), _clock_uncertainty(wander)
        )
        return self._steady(self._period_ns) + _SEVERAL_TIMES * scatter

    def _verdict(self, window: FloatArray) -> TriggerSlip:
        skew, limit = median(window), self._limit(window)
        slipped = abs(skew) >= (self._steady(self._period_ns) if self._state.samples else limit)
        if not slipped:
            return TriggerSlip()
        samples = round(skew) or int(math.copysign(1, skew))
        return TriggerSlip(samples, math.ceil(limit), self._remedy(skew, self._period_ns))

    def _remedy(self, skew: float, period_ns: float) -> str:
        later = skew * period_ns / NANOSECONDS_PER_S / MILLISECOND_S
        return (
            f"at equal counts axes are stamped {later:.4g} ms later, beyond what stamp_tolerance "
            f"{self._trigger.stamp_tolerance / MILLISECOND_S:.4g} ms and the scatter allow; check "
            "that both count the same trigger line and restart both drivers, or state "
            f"counter_offset {self._trigger.counter_offset - round(skew)} if they are known to be "
            "so far apart, or a stamp_tolerance that covers how late a link delivers"
        )


def _clock_uncertainty(wander: FloatArray) -> float:
    """Return by how much clocks that moved as in ``wander`` (n,) may still be wrong."""
    if len(wander) <= 2:
        return 0.0
    return _END_OF_LINE * spread_about_median(np.diff(wander)) * math.sqrt(len(wander))
