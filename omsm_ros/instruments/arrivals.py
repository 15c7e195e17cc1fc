"""Arrivals of samples: they give the host's time of a device's clock, and show missed triggers.

No sample arrives before it was taken, and a busy host only delays arrivals. So host time is the
likeliest line ``offset + (1 + drift) · device time`` below the arrivals of half a minute: late ones
do not move it. It is fitted over a window, since crystals change with temperature.
"""

import math
from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.streams.stamps import (
    DRIFT_SIGMA,
    GROSS_DRIFT,
    LARGEST_CRYSTAL_DRIFT,
    SPAN_S,
    late_likelihood,
    line_below,
)
from omsm_ros.errors import ConfigurationError
from omsm_ros.instruments.counting import SteadyMotion
from omsm_ros.units import NANOSECOND_S, NANOSECONDS_PER_S

# Long enough to average jitter out, short enough to follow a crystal that warms up [s].
WINDOW_S = 30.0
# The drift of no crystal is shown after this time, or missed triggers would be taken for one [s].
_OTHER_RATE_S = 2.0
# A clock was set if all arrivals are late, by the first more than usual, for the second time [s].
_STEP_S, _STEP_AFTER_S = 0.02, 2.0
# A busy host delays its first arrivals by less than this, so an arrival that is earlier by more
# shows at once that a clock was set [s].
_EARLY_S = 1.0
# No device holds a sample back for longer than this before it sends it [s].
_OLDEST_S = 3600.0
# The drift is reported after this time of arrivals [s].
_LEAST_SPAN_S = 5.0
# Arrivals uneven by 20 ms determine a drift to 0.01 in 1 s.
_GROSS_SPAN_S = 1.0


class DeviceClock:
    """Converts device time to host time; the stamps rise strictly and evenly.

    If the clock of the device or the host is set, the stamps follow after two seconds, or at once
    if samples then arrive before they were taken.
    """

    def __init__(self) -> None:
        self._last_stamp = -(1 << 63)  # before any time
        self.restart()

    def restart(self) -> None:
        """Forget all arrivals, as after a restart of the device's clock; stamps still rise."""
        # After the origin: begin of each span [device], and of its earliest arrival time and delay.
        self._spans: deque[tuple[float, float, float]] = deque(maxlen=round(WINDOW_S / SPAN_S))
        self._origin = self._newest = (0, 0)
        self._offset = self._slope = self._usual = 0.0
        self._late_since: tuple[float, float, float] | None = None  # device, arrival, lateness [s]
        self._evenly_late = False  # as after a pause, not on a busy host

    @property
    def drift(self) -> float | None:
        """Return host seconds per device second, less one; None before it is known."""
        span = self._spans[-1][1] - self._spans[0][1] if self._spans else 0.0
        patience = _GROSS_SPAN_S if abs(self._slope) > GROSS_DRIFT else _LEAST_SPAN_S
        return self._slope if span >= patience else None

    def observe(self, device_ns: int, arrival_ns: int) -> None:
        """Enter the arrival at ``arrival_ns`` of a sample taken at ``device_ns``.

        The last one of samples that arrive together is enough.
        """
        if not self._spans:
            self._origin = (device_ns, arrival_ns)
        device = (device_ns - self._origin[0]) * NANOSECOND_S
        late = (arrival_ns - self._origin[1]) * NANOSECOND_S - device
        if self._stepped(device, late):
            self.restart()
            self.observe(device_ns, arrival_ns)
            return
        self._newest = (device_ns, arrival_ns)
        self._keep(device, late)

    def to_host(self, device_ns: int) -> int:
        """Return the host time [ns] of ``device_ns``, later than every stamp given before.

        A device time out of the possible range is replaced by that of the newest sample.
        """
        if not self._spans:
            raise ConfigurationError("DeviceClock.to_host before any arrival; call observe() first")
        age = (self._newest[0] - device_ns) * NANOSECOND_S
        if not -_EARLY_S < age < _OLDEST_S:
            device_ns = self._newest[0]
        since = device_ns - self._origin[0]
        late = self._offset + self._slope * (since * NANOSECOND_S)
        stamp = self._origin[1] + since + round(late * NANOSECONDS_PER_S)
        self._last_stamp = max(stamp, self._last_stamp + 1)
        return self._last_stamp

    def _keep(self, device: float, late: float) -> None:
        """Enter an arrival; the line is fitted when a span ends, and is never above an arrival."""
        if self._spans and 0 <= device - self._spans[-1][0] < SPAN_S:
            if late < self._spans[-1][2]:
                self._spans[-1] = (self._spans[-1][0], device, late)
        else:
            self._spans.append((device, device, late))
            while device + late - sum(self._spans[0][1:]) > WINDOW_S:
                self._spans.popleft()
            if not self._evenly_late:
                _, x, y = np.array(self._spans).T
                self._offset, self._slope, rest = line_below(x, y)
                self._usual = float(np.median(rest))
        self._offset += min(late - self._offset - self._slope * device, 0.0)

    def _stepped(self, device: float, late: float) -> bool:
        """Return whether arrivals have been late for too long, or one is too far off the line."""
        off = late - (self._offset + self._slope * device)
        if self._spans and not -_EARLY_S < off < _OLDEST_S:
            return True
        if not self._spans or off < _STEP_S + 2 * self._usual:
            self._late_since, self._evenly_late = None, False
            return False
        since, arrived, first = self._late_since = self._late_since or (device, device + late, off)
        self._evenly_late = abs(off - first) < _STEP_S and (self._evenly_late or off == first)
        return min(device - since, device + late - arrived) > _STEP_AFTER_S


# The first spans are shorter, so that the first second holds several [s].
_FIRST_S, _FIRST_SPANS = 0.05, 40
# The largest number of spans up to the last confirmation, and after it.
_SPANS, _LATEST = 50, 60
# The least number of spans to be judged, and without a confirming arrival among them; the number
# of the latest ones, in which no step can be excluded.
_LEAST_SPANS, _SHOWING, _OPEN = 8, 3, 5
# Missed triggers are excluded, not likelier than none, and of a certain number by this (log).
_EXCLUDED, _POSSIBLE, _CERTAIN = 6.0, 1.0, 12.0
# A trigger is missed at any time alike, so the largest share of a start in which one would not be
# seen is the largest chance that it was missed there.
_UNSEEN = 0.1
# Without a reference, so short a time before a pause is taken to be without missed triggers [s].
_UNKNOWN_S = 1.0
# The last sample of a portion may be nearly a period old: the lateness that confirms, and that of
# an age that stays [period].
_LATE_PERIODS, _AGE_PERIODS = 0.75, 0.25
# Parts by which the delay may change instead [period].
_PARTS = (-0.3, -0.2, -0.1, 0.1, 0.2, 0.3)
# Spans among whose earliest arrivals two are nearly in time, as a rule.
_WINDOW = 4


class MissedTriggerDetector:
    """Confirms by their arrivals the samples of a device without a clock, which may miss triggers.

    No sample arrives before it was taken, so a line below the earliest arrivals is even although
    others are late by chance. After a missed trigger all arrivals are late by a period. An arrival
    that is not late confirms all samples up to it; lateness alone proves nothing, so until then
    they wait. After a pause of the trigger all arrivals are late for good, after one of the host
    they return to the line. Axes that move steadily show the triggers without arrivals.

    resumed: first arrival after the last pause of the trigger [s]
    lost: triggers may have been missed, and arrivals do not show how many, so nothing is confirmed
        until a restart
    """

    def __init__(self, period: float, pause: float = math.inf, wraps: Sequence[int] = ()) -> None:
        """period: of the trigger [s];  pause: arrivals late by half of it may be after a pause.

        wraps: counts after which each encoder starts again at zero; 0 = never
        """
        self._period, self._pause = period, pause
        self.motion, self._portion = SteadyMotion(wraps), 0
        self._counted, self._ahead = 0, 0.0
        self.restart()

    def restart(self, ahead: float | None = None) -> None:
        """Forget all arrivals, as after a restart of the device.

        ahead: by how much a counter fell back that was reset in a running stream [s]; an arrival in
            time without the reset shows that no trigger was missed at it
        """
        self.resets = ahead is not None and self._reference.proven and self.trusts_last()
        if self.resets:  # until an arrival confirms that the trigger went on
            self._ahead += ahead or 0.0
            return
        self._reference: _Reference = _Reference(self._period, self.motion.count)
        self._after_pause: _Reference | None = None
        self._doubted = math.inf  # arrival at which the motion became doubtful [s]
        self._newest = self._paused = 0.0  # last arrival, and last one before the silence [s]
        self.resumed, self.lost = -math.inf, False

    def confirms(self, due: float, arrival: float, *, after_silence: bool = False) -> bool:
        """Return whether no trigger was missed before this arrival, as far as can be seen.

        due: count times period [s];  arrival: monotonic [s]
        after_silence: of the trigger, the line or the host
        """
        due += self._ahead
        excess = self._reference.excess(due, arrival)
        jumped = self._reference.proven and (self.resets or excess < 0)
        # The stamps of both devices show if more triggers were missed at a reset.
        if abs(excess) <= (_STEP_S if self.resets else self._pause / 2):
            self._after_pause = None
        elif after_silence or (jumped and not self._after_pause):
            self._paused = self._paused if self._after_pause else self._newest
            self._after_pause = _Reference(self._period, self._portion)
        self._newest, self._portion = arrival, self.motion.count
        doubtful = self.motion.doubtful or self.motion.found
        self._doubted = min(self._doubted, arrival) if doubtful else math.inf
        if self._after_pause is None:
            confirmed = self._reference.confirms(due, arrival, self.motion)
            self.lost |= self._reference.lost
            self.resets &= not confirmed
            return confirmed and not self.lost
        if not self._after_pause.confirms(due, arrival, self.motion):
            return False
        # Its line says nothing of triggers missed before the pause.
        self._counted += self._reference.missed
        self.lost |= not self._reference.trusted_until(self._paused)
        self._reference, self._after_pause, self.resets = self._after_pause, None, False
        self.resumed = self._reference.begin
        return not self.lost

    def trusts_last(self) -> bool:
        """Return whether no trigger was missed before the last arrival, if no other follows.

        So it is assumed of a short time; a longer one without an arrival in time is doubtful.
        """
        doubtful = self.lost or self._after_pause or self.motion.doubtful
        return not doubtful and self._reference.trusted_until(self._newest)

    @property
    def by_motion(self) -> bool:
        """Return whether motion alone confirms, so the last step is known after the next one."""
        return self._reference.confirmed > self._reference.in_time

    @property
    def missed(self) -> int:
        """Return the missed triggers that were found, and that the latest arrivals show."""
        return self._counted + self._reference.missed

    @property
    def least_missed(self) -> int:
        """Return the least number of missed triggers that arrivals show; 0 = none do."""
        return self._reference.least_missed

    def forget_missed(self) -> int:
        """Return the number of missed triggers if it is certain, else 0.

        Arrivals are then expected at the times of the triggers again, so their samples must be
        renumbered.
        """
        reference = self._after_pause or self._reference
        found, reference.found = reference.found, 0
        if self.motion.found and not found:
            found = self.motion.found
            reference.expect_missed(found, self._doubted)
        self.motion.found = 0
        self._counted += found
        self.lost |= self.resets and found > 0  # before the reset or after it
        return found


# Square of the mean resultant length of phases above which arrivals keep step with the trigger, or
# that multiple of what random phases have, which chance does not reach.
_LOCKED, _BY_CHANCE = 0.1, 12.0
# Arrivals on a grid of parts of a period are in step with the trigger, too. With parts below
# 1 - _LATE_PERIODS, a sample after a missed trigger still arrives too late to be confirmed.
_HARMONICS = np.arange(1, round(1 / (1 - _LATE_PERIODS)) + 1)
# Arrivals later than the earliest of their span by more were delayed [period].
_EARLY_PERIODS = 2.0


class _Phases:
    """Phases of arrivals within the period of the trigger, and whether they are locked to it.

    A host that polls at its own times sees each age of the last sample equally often. If its polls
    keep step with the trigger, or drift against it no faster than a crystal, the age stays, or
    changes slowly until it jumps by a whole period. That looks like a missed trigger. With the jump
    a poll takes a sample more or less, so equal steps before it show polls whose arrivals scatter.

    ages: arrivals are locked to it, and are polls: not all steps are multiples of a block
    """

    def __init__(self, period: float) -> None:
        self._period, self.last = period, 0  # count of the last sample
        # Greatest common divisor of the counts between arrivals, the first of these, their number.
        self._block, self._since, self._steps = 0, 0.0, 0
        self._begin, self._lates = -math.inf, list[float]()  # of the current span
        self._means: deque[tuple[complex, ...]] = deque(maxlen=_LATEST)  # [s], 1/n, harmonics
        self._in_step = self._polled = self._uneven = self.ages = False

    def add(self, due: float, arrival: float, excess: float) -> None:
        """Enter an arrival;  due: count times period [s];  excess: lateness over the earliest [s].

        A delayed one may be a part of a backlog, so its count is that of no poll.
        """
        sample, late = round(due / self._period), (arrival - due) / self._period
        if excess < _EARLY_PERIODS * self._period:
            self._block = math.gcd(self._block, sample - self.last) if self._steps else 0
            if self._block == 1:
                lasted = arrival - self._since > self._period / LARGEST_CRYSTAL_DRIFT
                self._polled |= lasted and self._steps > _CERTAIN / math.log(2)
                self._steps, self._uneven = 0, True
            self._since = self._since if self._steps else arrival
            self._steps, self.last = self._steps + 1, sample
        if arrival - self._begin >= SPAN_S:
            if self._lates:
                self._end_span(np.array(self._lates))
            self._begin, self._lates = arrival, []
        self._lates.append(late)
        self.ages = self._uneven and (self._in_step or self._polled)

    def _end_span(self, late: FloatArray) -> None:
        early = late[late < late.min() + _EARLY_PERIODS]  # a delay says nothing of the age
        mean = np.exp(2j * np.pi * np.outer(_HARMONICS, early)).mean(1)
        self._means.append((self._begin, 1 / len(early), *mean))
        begin, random, *means = np.array(self._means).T
        since = (begin - begin[0]).real / self._period
        most = 5 * DRIFT_SIGMA  # crystals differ by less
        drifts = np.linspace(-most, most, 8 * math.ceil(2 * most * since[-1]) + 1)
        turn = np.exp(-2j * np.pi * np.outer(drifts, since))
        common = [turn**harmonic @ mean for harmonic, mean in zip(_HARMONICS, means, strict=True)]
        limit = min(_LOCKED, _BY_CHANCE * random.mean().real / len(since))
        self._in_step = len(since) > 1 and (np.max(np.abs(common)) / len(since)) ** 2 > limit


class _Reference:
    """The line below the arrivals since the start, or since a pause of the trigger.

    begin: of its first span [s];  confirmed: last arrival that was not late [s]
    proven: no step by missed triggers explains the arrivals
    lost: the age of arrivals in step with the trigger changed by a period, or triggers were missed
    found: number of missed triggers, if it became certain with the last arrival
    """

    def __init__(self, period: float, mark: int) -> None:
        """mark: number of the first sample."""
        self._period, self._mark = period, mark  # then of the last confirmed sample
        self._earliest: list[tuple[float, float]] = []  # begin and lateness of each span [s]
        self._line = 0.0, 0.0  # lateness of the earliest at 0, drift
        self.least_missed = 1
        self.proven = self.lost = False
        self.begin = self.confirmed = self.in_time = self._judged = 0.0  # the third by arrivals
        self.found = 0
        self._phases = _Phases(period)

    def confirms(self, due: float, arrival: float, motion: SteadyMotion) -> bool:
        """Return whether no trigger was missed before this arrival, as far as can be seen."""
        late = arrival - due
        self._phases.add(due, arrival, self.excess(due, arrival))
        width = _FIRST_S if not self.proven and len(self._earliest) < _FIRST_SPANS else SPAN_S
        before, least = self._earliest[-1] if self._earliest else (-math.inf, 0.0)
        goes_on = arrival - before < width
        if goes_on:
            self._earliest[-1] = (before, min(least, late))
        else:
            if self._earliest:
                self._judge()
            known = sum(begin <= self.confirmed for begin, _ in self._earliest)
            begun = max(known, _FIRST_SPANS)  # a step soon after the start is still to be seen
            del self._earliest[begun : max(len(self._earliest) - _LATEST, begun)]
            del self._earliest[: max(known - _SPANS, 0)]
            self._earliest.append((arrival, late - self.found * self._period))
        self.begin = self.begin or arrival
        excess = self.excess(due, arrival)
        # The drift of crystals makes a line uncertain that is not confirmed any more.
        limit = (_AGE_PERIODS if self._phases.ages else _LATE_PERIODS) * self._period
        limit -= 2 * DRIFT_SIGMA * (arrival - self.in_time)
        beyond = self.least_missed > 0 and (excess > limit or limit <= 0)
        # Triggers that are missed regularly are steps of equal size, too, but at a gross drift.
        shown = motion.shown_from <= self._mark and excess < GROSS_DRIFT * (arrival - self.begin)
        in_time = self.proven and not beyond
        if self.found or self.lost or motion.found or motion.doubtful or not (shown or in_time):
            if goes_on and before <= self.confirmed > self.in_time:
                # The earliest one of a span that was late must not be after a missed trigger.
                self._earliest[-1:] = [(before, least), (arrival, late)]
            return False
        self.confirmed, self._mark = arrival, motion.count - (1 if in_time else 2)
        self.in_time = arrival if in_time else self.in_time
        if self.proven:
            self._line = (self._line[0] + min(excess, 0.0), self._line[1])
        return True

    def expect_missed(self, missed: int, since: float) -> None:
        """Expect the arrivals since ``since`` [s] earlier, because triggers were missed then."""
        ahead = missed * self._period
        self._phases.last += missed
        self._earliest = [(begin, y - ahead * (begin >= since)) for begin, y in self._earliest]

    def excess(self, due: float, arrival: float) -> float:
        """Return by how much an arrival is later than the earliest ones [s]."""
        late = arrival - due
        if not self.proven:
            return late - min((least for _, least in self._earliest), default=late)
        return late - self._line[0] - self._line[1] * arrival

    @property
    def missed(self) -> int:
        """Return the missed triggers that the latest arrivals show if none confirms; else 0."""
        since = [span for span in self._earliest if span[0] > self.confirmed]
        if not self.proven or len(since) < _SHOWING:
            return 0
        begin, late = np.array(since[-_WINDOW:]).T
        excess = float((late - self._line[0] - self._line[1] * begin).min())
        return max(math.floor(excess / self._period + _AGE_PERIODS), 0)

    def trusted_until(self, arrival: float) -> bool:
        """Return whether arrivals until then need not be confirmed, because the time is short."""
        waited = arrival - max(self.confirmed, self.begin)
        return waited <= (SPAN_S if self.proven else _UNKNOWN_S)

    def _judge(self) -> None:
        """Lay the line below the arrivals; look for missed triggers if none is confirmed.

        Arrivals after missed triggers are renumbered if their number is certain.
        """
        begin, late = np.array(self._earliest).T
        known = int(np.searchsorted(begin, self.confirmed, "right"))
        if self.proven:
            self._set_line(known)
            rest = (late - self._line[0] - self._line[1] * begin)[known:][-_SHOWING:] / self._period
            if self._phases.ages and len(rest) == _SHOWING:
                self.lost |= rest.min() > 1 - _AGE_PERIODS and np.ptp(rest) < _AGE_PERIODS
        shown = not self.proven and known == len(begin)  # by steady motion
        if self.lost or len(begin) < max(_LEAST_SPANS, 0 if shown else known + _SHOWING):
            return
        waited = float(begin[-1]) - (self.confirmed if self.proven else self.begin)
        if begin[-1] - self._judged < max(SPAN_S, waited / 10):
            return
        self._judged = float(begin[-1])
        _, drift, rest = line_below(begin - begin[-1], late)
        if not self.proven and abs(drift) > GROSS_DRIFT:  # a backlog, or played in time lapse
            if waited < 0.7 * _UNKNOWN_S:  # else the end of a recording stays in doubt
                return
            self.least_missed = 0
        elif not self.proven:
            windows = np.sort(sliding_window_view(rest, _WINDOW), axis=1)
            scatter = 2 * float(np.median(windows[:, 1] - windows[:, 0]))
            self.least_missed = max(math.ceil(scatter / self._period + 0.5), 1)
            if abs(drift) > LARGEST_CRYSTAL_DRIFT and waited < _OTHER_RATE_S:
                return  # missed triggers would look alike
        locked = self._phases.ages or abs(drift) > LARGEST_CRYSTAL_DRIFT
        missed = self._settle(known, locked) if self.least_missed and not shown else 0
        if missed == 0 or (missed and self.proven):
            self.proven, self.in_time = True, self._judged
            self.confirmed = max(self.confirmed, self._judged)
            self.least_missed = min(self.least_missed, 1)
            self._set_line(len(begin))
        self.found = missed or 0

    def _settle(self, first: int, locked: bool) -> int | None:
        """Return how many triggers were missed from a span on, None if that is not certain.

        Arrivals after them are expected earlier from then on.

        locked: a change by a period may be one of the age, so one for a short time is excluded, too
        """
        begin, late = np.array(self._earliest).T
        since, periods = begin - begin[-1], late / self._period

        def shifted(at: int, missed: float, end: int | None = None) -> tuple[float, FloatArray]:
            moved = periods.copy()
            moved[at:end] -= missed
            return late_likelihood(since, moved, self._period)

        none, rest = shifted(0, 0)
        steps = range(max(first, 1), len(late))
        level = periods - self._line[1] / self._period * since
        rise = max(level[at:].min() - level[:at].min() for at in steps)
        likely: dict[int, FloatArray] = {}
        wanted = {1, max(math.floor(rise + _AGE_PERIODS), 1)}
        while wanted:  # the best number has neighbours that are less likely
            likely |= {n: np.array([shifted(at, n)[0] - none for at in steps]) for n in wanted}
            best = max(likely, key=lambda each: float(likely[each].max()))
            wanted = {max(best - 1, 1), best + 1} - likely.keys()
        most, at = float(likely[best].max()), steps[int(np.argmax(likely[best]))]
        other = max([0.0, *(float(each.max()) for n, each in likely.items() if n != best)])
        if most - other > _CERTAIN and not locked:
            # No other change of the delay explains the step better than missed triggers.
            if max(shifted(at, best + part)[0] for part in _PARTS) - none - most > _EXCLUDED:
                return None
            self.expect_missed(best, float(begin[at]))
            return best
        seen = np.max([*likely.values()], axis=0) < -_EXCLUDED
        off = np.flatnonzero(sliding_window_view(rest, _SHOWING).min(axis=1) > _AGE_PERIODS)
        aged = (shifted(first, 1, first + _SHOWING)[0] - none > -_EXCLUDED for first in off)
        sure = most < _POSSIBLE and not (locked and any(aged)) and seen[-_OPEN:].any()
        unseen = np.diff(begin)[steps.start - 1 :][:-_OPEN] @ ~seen[:-_OPEN]
        return 0 if sure and unseen <= _UNSEEN * (begin[-1] - begin[0]) else None

    def _set_line(self, known: int) -> None:
        """Lay the highest line below the earliest arrivals of the first spans."""
        begin, late = np.array(self._earliest[:known]).T
        least, drift, _ = line_below(begin - begin[-1], late)
        self._line = (least - drift * float(begin[-1]), drift)
