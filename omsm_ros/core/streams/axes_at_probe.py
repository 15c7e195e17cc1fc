"""Axis positions at the instants of the probe's samples, for devices without a common trigger.

Each device has its own sample clock, whose line through the stamps gives the time of every sample
(:mod:`omsm_ros.core.streams.stamps`). Between its samples an axis is a quintic spline, which
reproduces a motion below a tenth of the sample rate to parts in a million. The results are axis
blocks as if the probe's trigger had latched them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import TypeVar

import numpy as np
import scipy  # whose parts are loaded when they are used

from omsm_ros.core.streams.blocks import (
    AngleUnwrapper,
    AxisBlock,
    DistanceBlock,
    FloatArray,
    uninterrupted,
    without_first_message,
)
from omsm_ros.core.streams.continuity import TriggerCount
from omsm_ros.core.streams.stamps import StampClock, fit_clock
from omsm_ros.errors import ConfigurationError, DataError

# A cubic spline would be off by 2.6 nm on the motion in test_motion_record.py, a quintic is not.
_SPLINE_DEGREE = 5
# Gauss-Legendre quadrature over the exposure: nodes in half exposures, and their weights.
_EXPOSURE_NODES = np.array([-np.sqrt(0.6), 0.0, np.sqrt(0.6)])
_EXPOSURE_WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18
_AXES = ("x", "y", "z", "b", "c")
_C = _AXES.index("c")

B = TypeVar("B", AxisBlock, DistanceBlock)


def axes_at_probe(
    axes: Iterable[AxisBlock],
    distance: Iterable[DistanceBlock],
    *,
    delay: float = 0.0,
    exposure: float = 0.0,
) -> Iterator[AxisBlock]:
    """Return an axis block for every distance block, of the same counts, stamps and period.

    delay: from the probe's stamp to the middle of its exposure, on the axes' clock [s]
    exposure: time over which the probe averages; the motion is averaged alike [s]

    Messages of the probe with samples that came before are left out. Samples outside all runs of
    axis samples are NaN. Raises DataError if no run can be interpolated, ConfigurationError for a
    delay that is not finite or an exposure that is negative or not finite.
    """
    if not (np.isfinite(delay) and 0 <= exposure < np.inf):
        raise ConfigurationError("streams.exposure", delay=delay, exposure=exposure)
    tracks = [
        _Track.of(run, clock)
        for session in _sessions(axes)
        for clock in [fit_clock(session)]
        for run in uninterrupted(session)
    ]
    if not any(track.spline for track in tracks):
        raise DataError("streams.no_axis_run", least=_SPLINE_DEGREE + 1)
    nodes = delay + (0.5 * exposure * _EXPOSURE_NODES if exposure else np.zeros(1))
    weights = _EXPOSURE_WEIGHTS if exposure else np.ones(1)
    clocks = [(fit_clock(session), session) for session in _sessions(distance)]
    return (
        _at(block, clock, tracks, nodes, weights) for clock, session in clocks for block in session
    )


@dataclass(frozen=True, eq=False)
class _Track:
    """A spline through a run of axis samples, ``begin`` to ``end`` [s] after ``origin_ns``."""

    origin_ns: int
    begin: float
    end: float
    spline: scipy.interpolate.BSpline | None

    @classmethod
    def of(cls, run: Sequence[AxisBlock], clock: StampClock) -> _Track:
        values = np.stack([np.concatenate([getattr(b, name) for b in run]) for name in _AXES], 1)
        count = run[0].first_sample + np.arange(len(values), dtype=np.float64)
        time = clock.since(count, run[0].stamp_ns)
        spline = None
        if len(values) > _SPLINE_DEGREE and bool(np.all(np.isfinite(values))):
            values[:, _C] = AngleUnwrapper().of(values[:, _C])
            spline = scipy.interpolate.make_interp_spline(time, values, _SPLINE_DEGREE)
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
    common = {n: getattr(block, n) for n in ("stamp_ns", "first_sample", "sample_period", "parts")}
    return AxisBlock(**common | {name: values[:, i].copy() for i, name in enumerate(_AXES)})


def _sessions(blocks: Iterable[B]) -> list[list[B]]:
    """Return the blocks of each session, without messages that overlap or come late."""
    count, placed = TriggerCount(), []
    for block in blocks:
        arrival = count.place(block, len(block))
        again = int(np.searchsorted(block.stamps[:, 0], arrival.first + arrival.skip))
        if again < len(block.stamps):
            placed.append((arrival.session, without_first_message(block, again)))
    return [[b for _, b in group] for _, group in groupby(placed, key=lambda item: item[0])]
