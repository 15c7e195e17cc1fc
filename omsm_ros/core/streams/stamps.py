"""Where were the axes when the probe looked, if no trigger joins them?

Two devices with rates and clocks of their own are joined by their time stamps. The stamps
of a device's blocks jitter, its sample clock does not: a line through the stamps of a
session gives the time of every sample. Between its samples an axis is a quintic spline,
which follows a motion below a tenth of the sample rate to parts in a million. The result
are axis blocks as the probe's own trigger would have latched them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from omsm_ros.core.streams.blocks import (
    AngleUnwrapper,
    AxisBlock,
    Block,
    DistanceBlock,
    FloatArray,
    uninterrupted,
    without_first_message,
)
from omsm_ros.core.streams.continuity import TriggerCount
from omsm_ros.errors import ConfigurationError, DataError
from omsm_ros.readable import quantity
from omsm_ros.units import NANOSECONDS_PER_S

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

# A cubic would be off by 2.6 nm on the paper's motion, a quintic is not (test_motion_record.py).
_SPLINE_DEGREE = 5
# Gauss and Legendre: nodes in half exposures, and their weights.
_EXPOSURE_NODES = np.array([-np.sqrt(0.6), 0.0, np.sqrt(0.6)])
_EXPOSURE_WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18
# Sample clocks are quartz; stamps that disagree more with the stated period are wrong.
_MAX_RATE_ERROR = 1e-3
_AXES = ("x", "y", "z", "b", "c")
_C = _AXES.index("c")

B = TypeVar("B", AxisBlock, DistanceBlock)


@dataclass(frozen=True, slots=True)
class StampClock:
    """Time of the sample ``count``: ``start + (count - first) · period``.

    first, start_ns: a sample and its time, whole and below [ns];  period_ns: [ns]
    jitter: standard deviation of the stamps about the line [s]
    """

    first: int
    start_ns: int
    offset_ns: float
    period_ns: float
    jitter: float

    def since(self, count: FloatArray, origin_ns: int) -> FloatArray:
        """Return the times of samples ``count`` (n,) after ``origin_ns`` [s]."""
        whole = self.start_ns - origin_ns
        fine = self.offset_ns + (count - self.first) * self.period_ns
        return np.asarray((whole + fine) / NANOSECONDS_PER_S, np.float64)


def fit_clock(blocks: Sequence[Block]) -> StampClock:
    """Return the line through the stamps of one session's blocks, its first sample the reference.

    Raises DataError if the stamps contradict the blocks' sample period.
    """
    nominal = blocks[0].sample_period * NANOSECONDS_PER_S
    stamps = np.concatenate([block.stamps for block in blocks])
    first, start = stamps[0].tolist()
    count, since = (stamps - stamps[0]).T.astype(np.float64)
    late = since - count * nominal
    if np.ptp(count) == 0:
        return StampClock(first, start, float(late.mean()), nominal, 0.0)
    centred = count - count.mean()
    drift = float(centred @ late / (centred @ centred))
    offset = float(late.mean() - drift * count.mean())
    jitter = float(np.std(late - offset - drift * count)) / NANOSECONDS_PER_S
    uncertain = jitter * NANOSECONDS_PER_S / np.sqrt(float(centred @ centred))
    if abs(drift) > _MAX_RATE_ERROR * nominal + 5 * uncertain:
        raise DataError(
            f"stamps advance by {nominal + drift!r} ns a sample, the blocks state {nominal!r} ns; "
            "stamps of a recording in time lapse cannot join two clocks"
        )
    if abs(drift) > _MAX_RATE_ERROR * nominal:
        # Few blocks with jitter say little about the rate: the stated one stands.
        offset, drift = float(late.mean()), 0.0
    return StampClock(first, start, offset, nominal + drift, jitter)


def axes_at_probe(
    axes: Iterable[AxisBlock],
    distance: Iterable[DistanceBlock],
    *,
    delay: float = 0.0,
    exposure: float = 0.0,
) -> Iterator[AxisBlock]:
    """Return an axis block for every distance block, of the same counts, stamps and period.

    delay: from the probe's stamp to the middle of its exposure, on the axes' clock [s]
    exposure: over which the probe averages, and so is the motion [s]

    A message of the probe of which samples were there before has none. Samples that no run of axis
    samples covers are NaN. Raises DataError if there is nothing
    to interpolate, ConfigurationError for an exposure that is negative or not finite.
    """
    if not (np.isfinite(delay) and 0 <= exposure < np.inf):
        raise ConfigurationError(
            f"delay {delay!r} s and exposure {exposure!r} s, expected a number and zero or more"
        )
    tracks = [_Track.of(run, clock) for run, clock in _runs(axes)]
    if not any(track.spline for track in tracks):
        raise DataError(
            f"no {_SPLINE_DEGREE + 1} axis samples on end are finite, so none can be interpolated; "
            "check that the axes were recorded without gaps"
        )
    nodes = delay + (0.5 * exposure * _EXPOSURE_NODES if exposure else np.zeros(1))
    weights = _EXPOSURE_WEIGHTS if exposure else np.ones(1)
    clocks = [(fit_clock(session), session) for session in _sessions(distance)]
    return (
        _at(block, clock, tracks, nodes, weights) for clock, session in clocks for block in session
    )


@dataclass(frozen=True, eq=False)
class _Track:
    """Consecutive axis samples: a spline over seconds after ``origin_ns``, ``begin`` to ``end``."""

    origin_ns: int
    begin: float
    end: float
    spline: BSpline | None

    @classmethod
    def of(cls, run: Sequence[AxisBlock], clock: StampClock) -> _Track:
        values = np.stack([np.concatenate([getattr(b, name) for b in run]) for name in _AXES], 1)
        count = run[0].first_sample + np.arange(len(values), dtype=np.float64)
        time = clock.since(count, run[0].stamp_ns)
        # Here, because it takes longer to load than a scan to correct, and few need it.
        from scipy.interpolate import make_interp_spline

        usable = len(values) > _SPLINE_DEGREE and bool(np.all(np.isfinite(values)))
        if usable:
            values[:, _C] = AngleUnwrapper().of(values[:, _C])
        spline = make_interp_spline(time, values, _SPLINE_DEGREE) if usable else None
        return cls(run[0].stamp_ns, float(time[0]), float(time[-1]), spline)


def _at(
    block: DistanceBlock,
    clock: StampClock,
    tracks: Sequence[_Track],
    nodes: FloatArray,
    weights: FloatArray,
) -> AxisBlock:
    count = block.first_sample + np.arange(len(block), dtype=np.float64)
    values = np.full((len(block), len(_AXES)), np.nan)
    for track in tracks:
        begin, end = clock.since(count[[0, -1]], track.origin_ns) + nodes[[0, -1]]
        if track.spline is None or end < track.begin or begin > track.end:
            continue
        time = clock.since(count, track.origin_ns)
        inside = (time + nodes.min() >= track.begin) & (time + nodes.max() <= track.end)
        if inside.any():
            seen = [track.spline(time[inside] + node) for node in nodes]
            values[inside] = np.average(seen, axis=0, weights=weights)
    channels = {name: values[:, i].copy() for i, name in enumerate(_AXES)}
    return AxisBlock(
        stamp_ns=block.stamp_ns,
        first_sample=block.first_sample,
        sample_period=block.sample_period,
        parts=block.parts,
        **channels,
    )


def _sessions(blocks: Iterable[B]) -> list[list[B]]:
    """Return the blocks by session, without messages that overlap or come late."""
    count, placed = TriggerCount(), []
    for block in blocks:
        arrival = count.place(block, len(block))
        again = int(np.searchsorted(block.stamps[:, 0], arrival.first + arrival.skip))
        if again < len(block.stamps):
            placed.append((arrival.session, without_first_message(block, again)))
    return [[b for _, b in group] for _, group in groupby(placed, key=lambda item: item[0])]


def _runs(blocks: Iterable[AxisBlock]) -> list[tuple[list[AxisBlock], StampClock]]:
    """Return uninterrupted runs of blocks, each with the clock of its session."""
    runs: list[tuple[list[AxisBlock], StampClock]] = []
    for session in _sessions(blocks):
        clock = fit_clock(session)
        runs += [(run, clock) for run in uninterrupted(session)]
    return runs


# Does the sample period that a device writes agree with the time that its samples took?

# Clocks of two computers differ by a tenth of this; a motion's lag by less than 1 %.
_GREATEST_DIFFERENCE = 5e-3
# Standard uncertainties of the stamped period that must lie between it and the written one.
_CLEARLY = 5.0
# A line through fewer does not know how uncertain it is.
_LEAST_BLOCKS = 5


def stamped_period(blocks: Sequence[Block]) -> tuple[float, float] | None:
    """Return the sample period by the stamps and its standard uncertainty [s], relative to none.

    A line through the stamps over the trigger count; None with too few blocks for one.
    """
    return _line(*_marks(blocks))


def _marks(blocks: Sequence[Block]) -> tuple[FloatArray, FloatArray]:
    """Return the counts and stamps [s] of first samples, each (n,), from those of the first."""
    count = np.array([block.first_sample - blocks[0].first_sample for block in blocks], np.float64)
    stamp = np.array([block.stamp_ns - blocks[0].stamp_ns for block in blocks]) / NANOSECONDS_PER_S
    return count, stamp


def _line(count: FloatArray, stamp: FloatArray) -> tuple[float, float] | None:
    if len(count) < _LEAST_BLOCKS:
        return None
    spread = float(np.sum((count - count.mean()) ** 2))
    if spread == 0:
        return None
    slope = float((count - count.mean()) @ stamp) / spread
    residual = stamp - stamp.mean() - slope * (count - count.mean())
    return slope, float(np.sqrt(residual @ residual / (len(count) - 2) / spread))


def check_period(name: str, blocks: Sequence[Block], time_lapse: float = 1.0) -> None:
    """Raise DataError where the stamps of ``blocks`` clearly contradict their sample period.

    time_lapse: how much faster than real time the recording was played [1]
    Frequencies and lags would all be wrong by the same factor, and no residual would show it.
    """
    if not blocks:
        return
    said = contradiction(name, *_marks(blocks), blocks[0].sample_period, time_lapse)
    if said is not None:
        raise DataError(said)


def contradiction(
    name: str, count: FloatArray, stamp: FloatArray, written: float, time_lapse: float = 1.0
) -> str | None:
    """Return what the stamps say against the ``written`` sample period [s], None if nothing.

    count, stamp: of first samples of blocks, (n,) and (n,) [s];  time_lapse: see `check_period`
    """
    stamped = _line(count, stamp)
    if stamped is None:
        return None
    period, uncertainty = stamped[0] * time_lapse, stamped[1] * time_lapse
    off = abs(period - written)
    if period <= 0 or off <= max(_GREATEST_DIFFERENCE * written, _CLEARLY * uncertainty):
        return None
    if (jumped := _jump(count, stamp, written / time_lapse)) is not None:
        place, size = jumped
        return (
            f"{name} blocks: the stamps jump by {quantity(size, 's')} at sample {place:.0f} of the "
            f"recording, and agree with a sample period of {written:.6g} s elsewhere: the clock "
            "was set meanwhile; record again, once it is set"
        )
    return (
        f"{name} blocks state a sample period of {written:.6g} s, but by their stamps it is "
        f"{period:.6g} s: correct sample_period of the driver and record again (or declare "
        'settings {"time_lapse": …} for a recording that was not made in real time)'
    )


def _jump(count: FloatArray, stamp: FloatArray, period: float) -> tuple[float, float] | None:
    """Return where and by how much [s] the stamps jump, None unless one jump explains them."""
    samples, passed = np.diff(count), np.diff(stamp)
    ahead = passed - samples * period
    place = int(np.argmax(np.abs(ahead)))
    others = np.delete(np.arange(len(ahead)), place)
    rest = float(np.sum(ahead[others])), float(np.sum(samples[others])) * period
    if abs(rest[0]) > _GREATEST_DIFFERENCE * abs(rest[1]):
        return None
    return float(count[place + 1]), float(ahead[place])


# What has happened lately, as against ever? A fault of this morning is history, not a state.
#
# All times come from the caller [s], from a clock that only goes forward.

# As long as somebody who looks up at an alarm needs to find its cause still named.
WINDOW_S = 10.0


class RecentIncrease:
    """By how much counts rose within the last ``window`` [s].

    What was counted before the first look counts as new then.
    """

    def __init__(self, window: float = WINDOW_S) -> None:
        self._window = window
        self._looks: deque[tuple[float, dict[str, float]]] = deque()

    def update(self, counts: Mapping[str, float], now: float) -> dict[str, float]:
        """Return name → increase, of those that rose; a count that fell began anew at zero."""
        self._looks.append((now, dict(counts)))
        while len(self._looks) > 1 and self._looks[1][0] <= now - self._window:
            self._looks.popleft()
        since, before = self._looks[0]
        base = before if since <= now - self._window else {}
        rises = {
            name: value - earlier if value >= (earlier := base.get(name, 0)) else value
            for name, value in counts.items()
        }
        return {name: rise for name, rise in rises.items() if rise > 0}


class SampleFlow:
    """Samples that come: how many a second, and since when none."""

    def __init__(self, window: float = WINDOW_S) -> None:
        self._window = window
        self._looks: deque[tuple[float, int]] = deque()
        self._last: float | None = None

    def update(self, samples: int, now: float) -> None:
        """Note the number of ``samples`` that came in all."""
        if samples > (self._looks[-1][1] if self._looks else 0):
            self._last = now
        self._looks.append((now, samples))
        while len(self._looks) > 2 and self._looks[1][0] <= now - self._window:
            self._looks.popleft()

    def silent(self, now: float) -> float | None:
        """Return the time since a sample was last seen to have come; None if none ever did."""
        return None if self._last is None else now - self._last

    @property
    def rate(self) -> float:
        """Samples a second over the window [1/s]."""
        if len(self._looks) < 2:
            return 0.0
        (start, before), (end, after) = self._looks[0], self._looks[-1]
        return (after - before) / (end - start) if end > start else 0.0


# When is a recorded message due, played at another rate, paused, and begun later?


class Playback:
    """Time of a recording against a clock that only goes forward, whose readings are given [s].

    begin_ns: time of the recording with which it begins [ns]
    rate: seconds of the recording a second; 0 for all at once
    """

    def __init__(self, begin_ns: int, rate: float) -> None:
        self._begin_ns, self._rate = begin_ns, rate
        self._played = 0.0  # seconds of the recording, up to the last resumption
        self._since: float | None = None

    @property
    def paused(self) -> bool:
        """Whether time stands still."""
        return self._since is None

    def resume(self, now: float) -> None:
        """Let time go on, if it stands."""
        if self._since is None:
            self._since = now

    def pause(self, now: float) -> None:
        """Stop time, if it goes on."""
        self._played, self._since = self._seconds(now), None

    def go_to(self, stamp_ns: int, now: float) -> None:
        """Continue from another time of the recording."""
        self._played = (stamp_ns - self._begin_ns) / NANOSECONDS_PER_S
        self._since = None if self._since is None else now

    def time_ns(self, now: float) -> int:
        """Return the time of the recording [ns]."""
        return self._begin_ns + round(self._seconds(now) * NANOSECONDS_PER_S)

    def late(self, stamp_ns: int, now: float) -> float | None:
        """Return for how long a message of ``stamp_ns`` has been due [s]; None if it is not yet.

        At rate 0 nothing is ever late.
        """
        if self.paused:
            return None
        if not self._rate:
            return 0.0
        overdue = (self.time_ns(now) - stamp_ns) / (NANOSECONDS_PER_S * self._rate)
        return overdue if overdue >= 0 else None

    def _seconds(self, now: float) -> float:
        return self._played + (0.0 if self._since is None else (now - self._since) * self._rate)
