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

Every decision rests on the stamps of blocks up to that count alone, so live and offline agree.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.core.samples.scatter import SIGMA_OF_MAD
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


class StampLine:
    """Stamps of one stream's blocks, in the order of sessions and counts."""

    def __init__(self) -> None:
        self._coming: deque[tuple[int, int, int]] = deque()
        self._current: tuple[int, int, int] | None = None

    def add(self, session: int, count: int, stamp_ns: int) -> None:
        """Append the newest block's session, first count and stamp."""
        self._coming.append((session, count, stamp_ns))

    def advance(self, session: int, count: int) -> bool:
        """Go to the block of ``count``; return whether it begins there."""
        while self._coming and self._coming[0][:2] <= (session, count):
            self._current = self._coming.popleft()
            if self._current[:2] == (session, count):
                return True
        return False

    def next_in(self, session: int, end: int) -> int:
        """Return where the next block begins, ``end`` if not before it."""
        if self._coming and self._coming[0][0] == session:
            return min(self._coming[0][1], end)
        return end

    def stamp_of(self, session: int, count: int, period_ns: float) -> float | None:
        """Return the time of the sample ``count`` [ns], None where no block says it."""
        if self._current is None or self._current[0] != session:
            return None
        return self._current[2] + (count - self._current[1]) * period_ns


class SlipWatch:
    """Judges pairs of two streams by the stamps of their blocks.

    found: the last slip there was, healed or not; None if there was none
    """

    def __init__(self, axes: StampLine, distance: StampLine, trigger: CommonTrigger) -> None:
        self._lines = (axes, distance)
        self._trigger = trigger
        self.found: Slip | None = None
        self._restart((-1, -1), 0)

    @property
    def state(self) -> Slip:
        """What the stamps said last."""
        if self._state.samples:
            return self._state
        window = self._window()
        return Slip() if window is None else Slip(seen_from=math.ceil(self._limit(window)))

    def spans(
        self, sessions: tuple[int, int], first: int, end: int, period_ns: float
    ) -> Iterator[tuple[int, bool]]:
        """Yield the end, and whether they slipped, of spans of pairs from ``first`` to ``end``."""
        if sessions != self._sessions:
            self._restart(sessions, first)
        for line, session in zip(self._lines, sessions, strict=True):
            line.advance(session, first - 1)
        while (count := self._next(end)) < end:
            before = self._state.samples
            self._observe(count, period_ns)
            if bool(self._state.samples) != bool(before) and count > first:
                yield count, bool(before)
        yield end, bool(self._state.samples)

    def _restart(self, sessions: tuple[int, int], first: int) -> None:
        self._sessions, self._start = sessions, first
        self._state = Slip()
        self._judged, self._since, self._period_ns = -1, 0.0, 1.0
        # Whether any stamp since the last verdict is off enough: without one no median is.
        self._odd = False
        # Of each stamp: count, skew [ns], whether it is of the axes, of the distance, axes' time.
        self._seen: deque[tuple[int, float, bool, bool, float]] = deque(maxlen=_MOST_STAMPS)
        # Skew at each stride of the last half minute without a slip [ns].
        self._wander: deque[float] = deque(maxlen=round(_WANDER_S / _STRIDE_S))

    def _next(self, end: int) -> int:
        pairs = zip(self._lines, self._sessions, strict=True)
        return min(line.next_in(session, end) for line, session in pairs)

    def _observe(self, count: int, period_ns: float) -> None:
        """Take the skew where a block of either stream begins."""
        (axes, distance), (a, d) = self._lines, self._sessions
        of_axes, of_distance = axes.advance(a, count), distance.advance(d, count)
        late, early = axes.stamp_of(a, count, period_ns), distance.stamp_of(d, count, period_ns)
        per_s = NANOSECONDS_PER_S / period_ns
        if late is None or early is None:
            return
        stride = int(count // max(_STRIDE_S * per_s, 1.0))
        judged, self._judged = self._judged, stride
        early_days = count - self._start < _FIRST_S * per_s
        if stride != judged:
            if not early_days:
                self._since, self._period_ns = count - _SPAN_S * per_s, period_ns
                self._judge()
            if not self._state.samples:
                self._wander.append(late - early)
        if not early_days:
            self._seen.append((count, late - early, of_axes, of_distance, late))
            self._odd |= abs(late - early) >= self._steady(period_ns) * period_ns

    def _judge(self) -> None:
        if not (self._odd or self._state.samples):
            return
        window = self._window()
        self._state = Slip() if window is None else self._verdict(window)
        self._odd = window is None or bool(np.any(abs(window) >= self._steady(self._period_ns)))
        self.found = self._state if self._state.samples else self.found

    def _window(self) -> FloatArray | None:
        """Return the skews to be judged [samples], None if they say nothing."""
        seen = np.array(self._seen, np.float64).reshape(-1, 5)
        starts = [np.flatnonzero(seen[:, column]) for column in (2, 3)]
        if min(map(len, starts)) < _LEAST_STAMPS:
            return None
        since = int(np.searchsorted(seen[:, 0], self._since))
        oldest = min(since, *(int(s[-_LEAST_STAMPS]) for s in starts))
        seen = seen[oldest:]
        if not _in_real_time(seen[:, 0] * self._period_ns, seen[:, 4]):
            return None
        return np.asarray(seen[:, 1] / self._period_ns)

    def _steady(self, period_ns: float) -> float:
        """Return the skew of stamps without scatter that is a slip [samples]."""
        return 0.5 + self._trigger.stamp_tolerance * NANOSECONDS_PER_S / period_ns

    def _limit(self, window: FloatArray) -> float:
        """Return the skew that is a slip [samples]."""
        wander = np.array(self._wander) / self._period_ns
        scatter = max(_spread(window), _spread(wander), _to_be_learnt(wander))
        return self._steady(self._period_ns) + _SEVERAL_TIMES * scatter

    def _verdict(self, window: FloatArray) -> Slip:
        skew, limit = _median(window), self._limit(window)
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
    return _END_OF_LINE * _spread(np.diff(wander)) * math.sqrt(len(wander))


def _in_real_time(counted: FloatArray, stamped: FloatArray) -> bool:
    """Return whether stamps [ns] advance about as the counts do [ns]."""
    elapsed = float(counted[-1] - counted[0])
    passed = float(stamped[-1] - stamped[0])
    return elapsed < _TIME_LAPSE * passed and passed < _TIME_LAPSE * elapsed


def _median(values: FloatArray) -> float:
    """Return the median; of so few values numpy's own takes ten times as long."""
    ordered, half = np.sort(values), len(values) // 2
    return float(ordered[half] + ordered[-1 - half]) / 2


def _spread(values: FloatArray) -> float:
    """Return the standard deviation of normal values, little moved by others among them."""
    return SIGMA_OF_MAD * _median(abs(values - _median(values)))
