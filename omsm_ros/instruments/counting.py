"""Converts device counters that wrap into one trigger count, and detects missed triggers."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.streams.blocks import FloatArray, IntArray
from omsm_ros.units import NANOSECOND_S

SAMPLE = np.dtype(
    [
        ("counter", "<i8"),  # as the device sends it, wraps
        ("time", "<i8"),  # of the device [ns], does not wrap; 0 where it has none
        ("distance", "<f8"),  # [m], NaN = none
        ("intensity", "<f4"),  # 0-1, NaN = not reported
        ("status", "u1"),  # Status
        ("counts", "<i8", (5,)),  # encoders X, Y, Z, B, C
    ]
)
Samples: TypeAlias = NDArray[np.void]
"""Structured array of shape (n,), dtype ``SAMPLE``: the common form of all devices' samples."""


class WireCounts(SimpleNamespace):
    """Counts of a decoder: ``bytes_received = in samples + bytes_discarded + bytes_pending``."""

    def __init__(self, received: int, kept: int, pending: int, **counts: int) -> None:
        """kept: bytes that were decoded;  counts: number of what they held, by name."""
        discarded = received - kept - pending
        super().__init__(
            bytes_received=received, bytes_discarded=discarded, bytes_pending=pending, **counts
        )


class PacketFinder:
    """Finds packets in bytes of any portions; it never raises, memory is a packet and a portion.

    The result does not depend on the portions. So a packet without a check of its own waits until
    the next one has begun, or for :meth:`settle`: bytes lost or added inside it show there. A
    protocol states ``magics`` (beginnings of packets, of one length), ``head`` and ``longest``
    [bytes], and implements ``_measure`` and ``_take``.
    """

    magics: tuple[bytes, ...] = ()
    longest = 0
    head: struct.Struct

    def __init__(self) -> None:
        self._buffer = b""
        self._received = self._understood = self._packets = self._malformed = 0

    def reset(self) -> None:
        """Discard an incomplete packet, as after a new connection."""
        self._buffer = b""

    def feed(self, data: bytes) -> list[Any]:
        """Return what the packets completed by ``data`` hold, in order."""
        self._received += len(data)
        self._buffer += data
        found: list[Any] = []
        start = 0
        while (place := self._find(start)) >= 0:
            size = self._size(place)
            if size is None:
                start = place
                break
            start = place + self._take(place, size, found)
        else:
            start = max(start, len(self._buffer) - len(self.magics[0]) + 1)
        self._flush(found)
        self._buffer = self._buffer[start:]
        return found

    def settle(self) -> list[Any]:
        """Return what the packet holds that waited for the next one."""
        size = len(self._buffer)
        if self._find(0) != 0 or self._size(0, last=True) != size:
            return []
        found: list[Any] = []
        self._buffer = self._buffer[self._take(0, size, found) :]
        self._flush(found)
        return found

    @property
    def statistics(self) -> WireCounts:
        """Return the counts of bytes, packets, and malformed ones."""
        counts = {"packets": self._packets, "malformed": self._malformed}
        return WireCounts(self._received, self._understood, len(self._buffer), **counts)

    def _measure(self, place: int) -> tuple[int, bool]:
        """Return the length by the head at ``place``, 0 = no head, and whether it has to wait."""
        raise NotImplementedError

    def _take(self, place: int, size: int, found: list[Any]) -> int:
        """Add the content of a packet to ``found``; return how many bytes to go on.

        size: of the packet at ``place``; 0 = there is none
        """
        raise NotImplementedError

    def _flush(self, found: list[Any]) -> None:
        """Add content that waited for further packets of the same portion."""

    def _find(self, start: int, end: int | None = None) -> int:
        places = [self._buffer.find(magic, start, end) for magic in self.magics]
        return min((place for place in places if place >= 0), default=-1)

    def _size(self, place: int, *, last: bool = False) -> int | None:
        """Return the bytes of the packet at ``place``; 0 = no packet; None = wait for more.

        last: no bytes follow it
        """
        if place + self.head.size > len(self._buffer):
            return None
        size, waits = self._measure(place)
        end = place + size
        if not 0 < size <= self.longest or self._cut_off(place, end, waits):
            return 0
        if end > len(self._buffer):
            return None
        after = self._buffer[end : end + len(self.magics[0])]
        if not waits or after in self.magics or (last and not after):
            return size
        return None if any(magic.startswith(after) for magic in self.magics) else 0

    def _cut_off(self, place: int, end: int, waits: bool) -> bool:
        """Return whether the next packet begins inside the one up to ``end``: its end is missing.

        Bytes that have not arrived must not change the answer, so only those before ``end`` are
        used. At the end of a packet that does not wait, the next one shows by its magic alone.
        """
        inside = self._find(place + 1, end)
        while 0 <= inside <= min(end, len(self._buffer)) - self.head.size:
            if self._measure(inside)[0]:
                return True
            inside = self._find(inside + 1, end)
        return not waits and inside > end - self.head.size


# Arrivals are uneven, so a gap and the time that passed may differ by this much [s].
_SLACK_S = 0.5
# Least number of steps of time whose scatter is known, and the largest scatter of a step over
# missed triggers that still shows their number [period].
_STEPS, _UNCLEAR = 32, 0.25
# Copies of samples that were sent before are recognised this far back.
_RECENT_SAMPLES = 1024


@dataclass(frozen=True, slots=True, eq=False)
class CountedRun:
    """Samples (n,) with consecutive trigger counts from ``first_sample``.

    restarted: the device was restarted just before
    """

    samples: Samples
    first_sample: int
    restarted: bool


@dataclass(frozen=True, slots=True)
class Counting:
    """How a device counts.

    modulus: after which its counter starts again at zero
    timed: its samples carry the time of its own clock
    checked: a checksum protects the counter; without one, a counter that jumps ahead and comes
        back with the next sample marks a spoilt telegram
    period: of a free-running device, whose counter advances with time in a silence [s];
        0 = triggered: its counter waits for the next trigger
    """

    modulus: int
    timed: bool = True
    checked: bool = True
    period: float = 0.0


class SequenceTracker:
    """Cuts samples in the order of arrival into runs, and counts missing and repeated ones.

    A repeated sample or number is a duplicate. A counter or time that falls back, or a counter at
    zero after a silence, is a restart of the device; its own number counts from there. Any other
    number that is not the next one is a gap, and so are triggers that the time shows as missed.
    """

    def __init__(self, counting: Counting, period: float = math.inf, pause: float = 0.0) -> None:
        """period: of a trigger, so that times show which ones were missed;  pause: of it [s]."""
        self.duplicates = self.lost = self.gaps = self.restarts = self.spoilt = 0
        self.missed_by_time = 0
        self._counting = counting
        watched = counting.timed and not counting.period
        self._trigger = period / NANOSECOND_S if watched else math.inf  # period [ns]
        self._most = pause / NANOSECOND_S / 2 / self._trigger  # missed triggers in a row
        self._uneven = np.empty(0)  # deviations of the latest steps of time from a period, (n,)
        self._raw = self._time = self._counter = 0
        self._begun = self._anew = False
        self._held = np.empty(0, SAMPLE)
        self._recent = np.zeros(_RECENT_SAMPLES, SAMPLE)
        self._recent["counter"] = -1

    @property
    def held(self) -> int:
        """Return the number of samples that wait for their successor."""
        return len(self._held)

    def restart_count(self) -> None:
        """Count from the device's next number, as after a known restart."""
        self._anew = self._begun

    def split(
        self, samples: Samples, elapsed: float = 0.0, *, broken: bool = False
    ) -> Iterator[CountedRun]:
        """Yield the runs of ``samples`` (n,), in order.

        elapsed: silence before the samples [s]
        broken: it was longer than the pause between samples, or the line was down
        """
        samples, self._held = np.concatenate([self._held, samples]), np.empty(0, SAMPLE)
        pause = _StreamBreak(elapsed, broken)
        while len(samples):
            count, one = 0 if broken or self._anew else self._in_order(samples), len(samples) == 1
            if count:
                yield self._accept(samples[:count], self._counter + 1, False)
            elif one and (self._counter_jumps(samples[0]) or self._missed(samples)[0]):
                self._held = samples.copy()
                return
            else:
                yield from self._one(samples, pause)
                pause, broken, count = _StreamBreak(), False, 1
            samples = samples[count:]

    def settle(self) -> Iterator[CountedRun]:
        """Yield the sample held back, when nothing came after it."""
        held, self._held = self._held, np.empty(0, SAMPLE)
        if len(held):
            yield from self._one(held, _StreamBreak())

    def _in_order(self, samples: Samples) -> int:
        """Return how many samples at the beginning have consecutive counters."""
        if not self._begun:
            return 0
        if self._trigger < math.inf and len(self._uneven) < _STEPS:
            samples = samples[:_STEPS]  # their scatter judges the next ones
        steps = np.diff(samples["counter"], prepend=self._raw) % self._counting.modulus
        good = steps == 1
        if self._counting.timed:
            # A time that falls back while the counter goes on is a spoilt time.
            restarts = samples["counter"] == 0 if not self._counting.checked else True
            good &= ~((np.diff(samples["time"], prepend=self._time) < 0) & restarts)
            good &= self._missed(samples) == 0
        return len(good) if good.all() else int(np.argmin(good))

    def _missed(self, samples: Samples) -> IntArray:
        """Return the triggers missed before each of ``samples`` (n,), as its time shows.

        A damaged time falls back with the next sample; a longer step is a pause.
        """
        beyond = self._beyond(samples)
        missed = np.rint(beyond)
        unclear = (2 + missed) * self._uneven.max(initial=0.0) + 2 / self._trigger
        good = (abs(beyond - missed) <= unclear) & (unclear < _UNCLEAR)
        good &= (missed > 0) & (missed <= self._most) & np.append(beyond[1:] > -0.5, True)
        return np.where(good & (len(self._uneven) >= _STEPS), missed, 0).astype(np.int64)

    def _beyond(self, samples: Samples) -> FloatArray:
        """Return the periods of time before each of ``samples`` (n,) that were not counted."""
        counted = np.diff(samples["counter"], prepend=self._raw) % self._counting.modulus
        return np.asarray(np.diff(samples["time"], prepend=self._time) / self._trigger - counted)

    def _accept(self, samples: Samples, first: int, restarted: bool) -> CountedRun:
        if self._begun and first == self._counter + 1:
            uneven = abs(self._beyond(samples))
            self._uneven = np.append(self._uneven, uneven[uneven <= self._most])[-_RECENT_SAMPLES:]
        self._begun, self._anew = True, False
        self._raw, self._time = int(samples["counter"][-1]), int(samples["time"][-1])
        self._counter = first + len(samples) - 1
        self._recent[samples["counter"] % _RECENT_SAMPLES] = samples
        return CountedRun(samples, first, restarted)

    def _counter_jumps(self, sample: np.void) -> bool:
        if self._counting.checked or not self._begun or self._anew:
            return False
        return self._step(int(sample["counter"])) != 1 and not self._is_repeated(sample)

    def _is_corrupted_counter(self, samples: Samples) -> bool:
        """Return whether the counter jumps or stops at the first sample and is back at the next."""
        if len(samples) < 2 or not self._counter_jumps(samples[0]):
            return False
        here, after = (self._step(int(counter)) for counter in samples["counter"][:2])
        return after <= here if here else after == 2

    def _step(self, raw: int) -> int:
        return (raw - self._raw) % self._counting.modulus

    def _one(self, samples: Samples, pause: _StreamBreak) -> Iterator[CountedRun]:
        sample, alone = samples[0], samples[:1]
        raw = int(sample["counter"])
        if not self._begun:
            yield self._accept(alone, raw, False)
            return
        step, advance = self._step(raw), int(sample["time"]) - self._time
        spoilt_time = advance < 0 and not (self._counting.checked or pause.broken or raw == 0)
        advance = 0 if step == 1 and spoilt_time else advance
        if self._counting.timed:  # the device's own clock, not arrivals, which the host may delay
            pause = _StreamBreak(max(advance, 0) * NANOSECOND_S, pause.broken)
        # After a restart, samples without time may equal earlier ones by chance.
        may_repeat = (self._counting.timed or not pause.broken) and not self._anew
        if self._is_corrupted_counter(samples):
            self.spoilt += 1
        elif may_repeat and (step != 1 or advance < 0) and self._is_repeated(sample):
            self.duplicates += 1
        elif self._anew or self._counter_fell_back(raw, step, advance, pause):
            self.restarts += 1
            yield self._accept(alone, raw, True)
        elif (step := step + self._turns(step, pause) * self._counting.modulus) == 0:
            self.duplicates += 1
            self._time += advance
        else:
            self.missed_by_time += (missed := int(self._missed(samples[:2])[0]))
            self.lost += step - 1
            self.gaps += step > 1
            yield self._accept(alone, self._counter + step + missed, False)

    def _is_repeated(self, sample: np.void) -> bool:
        previous = self._recent[int(sample["counter"]) % _RECENT_SAMPLES]
        return bool(previous.tobytes() == sample.tobytes())

    def _counter_fell_back(self, raw: int, step: int, advance: int, pause: _StreamBreak) -> bool:
        if step == 1:
            return advance < 0
        if advance < 0 or (pause.broken and raw == 0):
            return True
        period = self._counting.period
        whole = step + self._turns(step, pause) * self._counting.modulus
        uneven = abs(pause.elapsed - whole * period) > _SLACK_S
        if step == 0:  # without a silence, only a counter reset at this number repeats it
            return advance > 0 and (uneven or (raw == 0 and self._counter > 0))
        if not period:
            return step >= self._counting.modulus // 2
        if self._counting.timed:
            return step * period > advance * NANOSECOND_S + 2 * period
        return uneven if pause.broken else (step - 1) * period > pause.elapsed + _SLACK_S

    def _turns(self, step: int, pause: _StreamBreak) -> int:
        """Return the whole turns of the counter in a silence."""
        period, known = self._counting.period, self._counting.timed or pause.broken
        turns = (pause.elapsed / period - step) / self._counting.modulus if period and known else 0
        return max(0, round(turns))


class _StreamBreak(NamedTuple):
    elapsed: float = 0.0
    broken: bool = False


# Relative difference below which successive steps are equal, the number of equal steps that is not
# due to noise of the encoder, and the largest deviation of a step from a whole multiple of them.
_STEADY_PART, _STEADY_STEPS, _WHOLE_PART = 1 / 8, 32, 1 / 4
_NO_WRAP = 1 << 62


class SteadyMotion:
    """Shows by the steps of moving axes that no trigger was missed, or how many were.

    No axis doubles its speed from one sample to the next. So nearly equal steps are of one trigger
    each, and a step that is a multiple of those before and after it is of several.

    count: number of samples so far
    doubtful: the last uneven step may be one of several triggers, as the next samples will show
    found: number of missed triggers, if it became certain with the last samples
    """

    def __init__(self, wraps: Sequence[int]) -> None:
        """wraps: counts after which each encoder starts again at zero; 0 = never."""
        self._wraps = np.array([wrap or _NO_WRAP for wrap in wraps], np.int64)
        self.count = self.found = 0
        self.follow(np.empty((0, len(wraps)), np.int64), linked=False)

    @property
    def shown_from(self) -> int:
        """Return the number of the sample since which all triggers are known."""
        run = int(self._runs.max(initial=0))
        return self.count - (run + 1 if run >= _STEADY_STEPS else -1)

    def follow(self, counts: IntArray, *, linked: bool) -> None:
        """Enter the counts of consecutive samples, (n, axes);  linked: to those before."""
        if not linked:
            self._last: IntArray | None = None
            self._begun = self.count
            self._step, self._runs = np.zeros((2, len(self._wraps)), np.int64)
            # Axis, number of even steps before the jump, the last one, missed triggers, sample.
            self._jump, self.doubtful = (0, 0, 0, 0, 0), False
        for start in range(0, len(counts), _STEADY_STEPS):
            self._follow(counts[start : start + _STEADY_STEPS, : len(self._wraps)])
            if self.doubtful:
                self._settle(*self._jump)

    def _follow(self, counts: IntArray) -> None:
        half, before = self._wraps // 2, counts[:1] if self._last is None else self._last
        steps = (np.diff(counts, axis=0, prepend=before) + half) % self._wraps - half
        steps = np.concatenate([[self._step], steps])
        least = _STEADY_PART * np.minimum(np.abs(steps[1:]), np.abs(steps[:-1]))
        # Smaller steps are uneven by the resolution of the encoder.
        uneven = (least < 1) | (np.abs(np.diff(steps, axis=0)) > least)
        uneven[: max(self._begun + 2 - self.count, 0)] = False  # no step, and none before it
        for axis, places in enumerate(map(np.flatnonzero, uneven.T)):
            run = int(self._runs[axis]) + int([*places, len(counts)][0])
            self._runs[axis] = len(counts) - 1 - places[-1] if len(places) else run
            if len(places) and run >= _STEADY_STEPS:
                step, jump = (int(value) for value in steps[places[0] : places[0] + 2, axis])
                times = round(jump / step)
                whole = times > 1 and abs(jump / step - times) <= _WHOLE_PART
                if whole and not (self.doubtful and run <= self._jump[1]):
                    self._jump = (axis, run, step, times - 1, self.count + int(places[0]))
                    self.doubtful = True
        self._last, self._step = counts[-1:], steps[-1]
        self.count += len(counts)

    def _settle(self, axis: int, run: int, step: int, missed: int, sample: int) -> None:
        """Decide whether the jump was of several triggers: if even steps as before follow it.

        If another axis made no jump, and none after it, it was of one.
        """
        even, since = int(self._runs[axis]), self.count - 1 - sample
        self.doubtful = even == max(since - 1, 0)
        if self.doubtful and even >= _STEADY_STEPS:
            self.doubtful = False
            alike = abs(self._step[axis] - step) <= _STEADY_PART * abs(step)
            if alike and self.shown_from >= sample:
                self.found += missed
                self._runs[axis] += run + 2
