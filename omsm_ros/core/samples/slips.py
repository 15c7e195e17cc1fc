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

from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.core.samples.continuity import StampLine
from omsm_ros.core.samples.scatter import median, spread_about_median
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
# Stamps that advance faster or slower than the counts by this factor are of a time lapse, or none:
# a second of theirs is not one of the samples. A slip of a third of the span is still judged.
_TIME_LAPSE = 1.5


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
# Pairs wait no longer than this for the first verdict: blocks are too long for one [s].
_MOST_WAIT_S = 10.0

EQUAL_COUNTS = CommonTrigger()


@dataclass(frozen=True, slots=True)
class Slip:
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


class SlipWatch:
    """Judges pairs of two streams by the stamps of their blocks.

    sessions: of axes and distance, whose pairs are watched
    found: the last slip there was, healed or not; None if there was none
    """

    def __init__(self, axes: StampLine, distance: StampLine, trigger: CommonTrigger) -> None:
        self._lines = (axes, distance)
        self._trigger = trigger
        self.found: Slip | None = None
        self._restart((-1, -1), 0)

    def _restart(self, sessions: tuple[int, int], first: int) -> None:
        self.sessions, self._start = sessions, first
        self._state = Slip()
        self._judged, self._since, self._period_ns = -1, 0.0, 1.0
        # Nothing was judged yet; whether one driver stamps both, once any stamp was seen.
        self._starting, self._common = True, False
        # Of each stream: stamps seen, and the last block that began where stamps agree.
        self._stamps, self._shown = [0, 0], [first, first]
        # Up to where a verdict found none, in spite of stamps that are off; the last of those.
        self._judged_to, self._odd_at = first, -math.inf
        # Whether any stamp since the last verdict is off enough: without one no median is.
        self._odd = False
        # Of each stamp: count, skew [ns], whether it is of the axes, of the distance, axes' time.
        self._seen: deque[tuple[int, float, bool, bool, float]] = deque(maxlen=_MOST_STAMPS)
        # Skew at each stride of the last half minute without a slip [ns].
        self._wander: deque[float] = deque(maxlen=round(_WANDER_S / _STRIDE_S))

    @property
    def one_driver(self) -> bool:
        """Whether both streams carry the same stamps: then one device latches both."""
        return self._common

    @property
    def state(self) -> Slip:
        """What the stamps said last."""
        if self._state.samples:
            return self._state
        window = self._window()
        return Slip() if window is None else Slip(seen_from=math.ceil(self._limit(window)))

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
            if self._in_step(end, period_ns):
                continue
            pairs = zip(self._lines, sessions, strict=True)
            if self._common or any(line.leaps(s, count, period_ns) for line, s in pairs):
                yield count, self.end()
            before = self._state.samples
            self._observe(count, period_ns)
            if before or self._state.samples:
                yield count, True
                self._shown = [count, count]
            else:
                yield self._agreed(count, period_ns), False
        pairs = zip(self._lines, sessions, strict=True)
        stamped = all(line.stamp_of(s, first, period_ns) is not None for line, s in pairs)
        if self._common or self._state.samples or not stamped:
            yield end, bool(self._state.samples)

    def _in_step(self, end: int, period_ns: float) -> bool:
        """Take the next stamps that one driver gave both streams; return whether there were any.

        Nothing can have slipped there. Of a bag they are all there at once, and cost little.
        """
        if not self._common or self._starting or self._odd or self._state.samples:
            return False
        axes, distance = self._lines
        taken = axes.in_step(distance, self.sessions, end, _SAME_NS)
        if not taken:
            return False
        per_s = NANOSECONDS_PER_S / period_ns
        stride = max(_STRIDE_S * per_s, 1.0)
        for count, _, skew in taken:
            if (judged := int(count // stride)) != self._judged:
                self._judged, self._since = judged, count - _SPAN_S * per_s
                self._wander.append(skew)
        self._stamps = [stamps + len(taken) for stamps in self._stamps]
        self._shown = [taken[-1][0]] * 2
        self._seen.extend((n, skew, True, True, at) for n, at, skew in taken[-_MOST_STAMPS:])
        return True

    def end(self) -> bool:
        """Return whether the pairs that still wait slipped, as far as it can be told."""
        since = self._start - 1 if self._starting else min(self._shown)
        few = self._starting and min(self._stamps) < _LEAST_STAMPS
        if self._state.samples or self._odd_at <= since or few or not self._in_real_time():
            return bool(self._state.samples)
        rows = np.array([seen for seen in self._seen if seen[0] > since])
        found = self._verdict(rows[:, 1] / self._period_ns)
        if found.samples and len(rows) >= _SURE_STAMPS:
            self._state = self.found = found
        return bool(found.samples)

    def _agreed(self, count: int, period_ns: float) -> int:
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
        late, early = axes.stamp_of(a, count, period_ns), distance.stamp_of(d, count, period_ns)
        if late is None or early is None:
            self._common = False
            return
        skew, per_s = late - early, NANOSECONDS_PER_S / period_ns
        self._period_ns = period_ns
        self._note(count, skew, begun)
        stride = int(count // max(_STRIDE_S * per_s, 1.0))
        judged, self._judged = self._judged, stride
        early_days = count - self._start < _FIRST_S * per_s
        if stride != judged:
            if not early_days:
                self._since = count - _SPAN_S * per_s
                self._judge(count)
            if not self._state.samples:
                self._wander.append(skew)
        self._seen.append((count, skew, *begun, late))
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

    def _is_off(self, skew: float) -> bool:
        return abs(skew) >= self._steady(self._period_ns) * self._period_ns

    def _judge(self, count: int) -> None:
        if not (self._odd or self._state.samples or self._starting):
            return
        rows = self._recent()
        if rows is None or not self._in_real_time():
            self._state, self._odd = Slip(), True
            if rows is not None:
                self._starting, self._judged_to = False, count  # stamps tell nothing
        else:
            window = rows[:, 1] / self._period_ns
            self._state = self._verdict(window)
            self._starting, self._judged_to = False, int(rows[0, 0])
            self._odd = bool(np.any(abs(window) >= self._steady(self._period_ns)))
            self.found = self._state if self._state.samples else self.found

    def _recent(self) -> FloatArray | None:
        """Return the stamps to be judged, as in ``_seen`` (n, 5); None if they are too few."""
        seen = np.array(self._seen, np.float64).reshape(-1, 5)
        first = self._start + _FIRST_S * NANOSECONDS_PER_S / self._period_ns
        seen = seen[np.searchsorted(seen[:, 0], first) :]
        starts = [np.flatnonzero(seen[:, column]) for column in (2, 3)]
        if min(map(len, starts)) < _LEAST_STAMPS:
            return None
        since = int(np.searchsorted(seen[:, 0], self._since))
        return seen[min(since, *(int(s[-_LEAST_STAMPS]) for s in starts)) :]

    def _in_real_time(self) -> bool:
        """Return whether stamps [ns] advance about as the counts do."""
        (first, *_, began), (last, *_, ended) = self._seen[0], self._seen[-1]
        elapsed, passed = (last - first) * self._period_ns, ended - began
        return elapsed < _TIME_LAPSE * passed and passed < _TIME_LAPSE * elapsed

    def _window(self) -> FloatArray | None:
        """Return the skews to be judged [samples], None if they say nothing."""
        rows = self._recent()
        return None if rows is None or not self._in_real_time() else rows[:, 1] / self._period_ns

    def _steady(self, period_ns: float) -> float:
        """Return the skew of stamps without scatter that is a slip [samples]."""
        return 0.5 + self._trigger.stamp_tolerance * NANOSECONDS_PER_S / period_ns

    def _limit(self, window: FloatArray) -> float:
        """Return the skew that is a slip [samples]."""
        wander = np.array(self._wander) / self._period_ns
        scatter = max(
            spread_about_median(window), spread_about_median(wander), _to_be_learnt(wander)
        )
        return self._steady(self._period_ns) + _SEVERAL_TIMES * scatter

    def _verdict(self, window: FloatArray) -> Slip:
        skew, limit = median(window), self._limit(window)
        slipped = abs(skew) >= (self._steady(self._period_ns) if self._state.samples else limit)
        if not slipped:
            return Slip()
        samples = round(skew) or int(math.copysign(1, skew))
        return Slip(samples, math.ceil(limit), self._remedy(skew, self._period_ns))

    def _remedy(self, skew: float, period_ns: float) -> str:
        later = skew * period_ns / NANOSECONDS_PER_S / MILLISECOND_S
        return (
            f"at equal counts axes are stamped {later:.4g} ms later, beyond what stamp_tolerance "
            f"{self._trigger.stamp_tolerance / MILLISECOND_S:.4g} ms and the scatter allow; check "
            "that both count the same trigger line and restart both drivers, or state "
            f"counter_offset {self._trigger.counter_offset - round(skew)} if they are known to be "
            "so far apart, or a stamp_tolerance that covers how late a link delivers"
        )


def _to_be_learnt(wander: FloatArray) -> float:
    """Return by how much clocks that moved as in ``wander`` (n,) may still be wrong."""
    if len(wander) <= 2:
        return 0.0
    return _END_OF_LINE * spread_about_median(np.diff(wander)) * math.sqrt(len(wander))
