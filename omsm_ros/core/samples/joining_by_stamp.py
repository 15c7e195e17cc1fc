"""Where were the axes when the probe looked, if no trigger joins them?

Two devices with rates and clocks of their own are joined by their time stamps. The stamps
of a device's blocks jitter, its sample clock does not: a line through the stamps of a
session gives the time of every sample. Between its samples an axis is a quintic spline,
which follows a motion below a tenth of the sample rate to parts in a million. The result
are axis blocks as the probe's own trigger would have latched them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from omsm_ros.core.samples.blocks import AxisBlock, Block, CountingOn, DistanceBlock, FloatArray
from omsm_ros.core.samples.continuity import TriggerCount
from omsm_ros.core.samples.merging import uninterrupted, without_first
from omsm_ros.errors import ConfigurationError, DataError
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
class Clock:
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


def fit_clock(blocks: Sequence[Block]) -> Clock:
    """Return the line through the stamps of one session's blocks, its first sample the reference.

    Raises DataError if the stamps contradict the blocks' sample period.
    """
    nominal = blocks[0].sample_period * NANOSECONDS_PER_S
    stamps = np.concatenate([block.stamps for block in blocks])
    first, start = stamps[0].tolist()
    count, since = (stamps - stamps[0]).T.astype(np.float64)
    late = since - count * nominal
    if np.ptp(count) == 0:
        return Clock(first, start, float(late.mean()), nominal, 0.0)
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
    return Clock(first, start, offset, nominal + drift, jitter)


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
    def of(cls, run: Sequence[AxisBlock], clock: Clock) -> _Track:
        values = np.stack([np.concatenate([getattr(b, name) for b in run]) for name in _AXES], 1)
        count = run[0].first_sample + np.arange(len(values), dtype=np.float64)
        time = clock.since(count, run[0].stamp_ns)
        # Here, because it takes longer to load than a scan to correct, and few need it.
        from scipy.interpolate import make_interp_spline

        usable = len(values) > _SPLINE_DEGREE and bool(np.all(np.isfinite(values)))
        if usable:
            values[:, _C] = CountingOn().of(values[:, _C])
        spline = make_interp_spline(time, values, _SPLINE_DEGREE) if usable else None
        return cls(run[0].stamp_ns, float(time[0]), float(time[-1]), spline)


def _at(
    block: DistanceBlock,
    clock: Clock,
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
            placed.append((arrival.session, without_first(block, again)))
    return [[b for _, b in group] for _, group in groupby(placed, key=lambda item: item[0])]


def _runs(blocks: Iterable[AxisBlock]) -> list[tuple[list[AxisBlock], Clock]]:
    """Return uninterrupted runs of blocks, each with the clock of its session."""
    runs: list[tuple[list[AxisBlock], Clock]] = []
    for session in _sessions(blocks):
        clock = fit_clock(session)
        runs += [(run, clock) for run in uninterrupted(session)]
    return runs
