"""The offset of two trigger counters, established by the motion in a bag."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.samples.blocks import AxisBlock, Block, DistanceBlock, FloatArray
from omsm_ros.core.verification.counter_offset import CounterOffset, counter_offset
from omsm_ros.errors import DataError
from omsm_ros.jobs.progress import Progress, no_progress
from omsm_ros.jobs.read_bag import read_blocks
from omsm_ros.storage import bags
from omsm_ros.storage.recording.topics import AnyBag
from omsm_ros.units import NANOSECONDS_PER_S

# As far as stamps may be off: a link that delivers late, and a clock that still learns [s].
_STAMPS_S = 0.25
# A session of an hour at 1 kHz; longer ones say no more.
_MOST_SAMPLES = 4_000_000


def established_offset(
    path: AnyBag, calibration: Calibration, progress: Progress = no_progress
) -> CounterOffset:
    """Return the offset that lets the distance of a bag answer to its Z, before a fixed target.

    calibration: its lag is what the distance comes late by anyway

    The stamps say where to search, a quarter of a second to either side. Raises DataError where
    the motion does not say which offset it is.
    """
    topics = (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)
    blocks = read_blocks(path, topics, progress)
    axes, distance = ([b for b in blocks[topic] if len(b)] for topic in topics)
    if not axes or not distance:
        raise DataError(f"{str(path)!r} lacks samples of axes or distance; record a motion")
    period = float(axes[0].sample_period)
    guess = _by_stamps(axes, distance, period)
    first = axes[0].first_sample
    z = _column(axes, first, [b.z for b in axes if isinstance(b, AxisBlock)])
    d = _column(
        distance,
        first - guess,
        [np.where(b.ok, b.distance, np.nan) for b in distance if isinstance(b, DistanceBlock)],
    )
    both = min(len(z), len(d))
    z, d = z[:both], d[:both]
    known = np.flatnonzero(np.isfinite(z))
    if not len(known):
        raise DataError(f"{str(path)!r} has no position of Z beside its distance; record a motion")
    z = np.interp(np.arange(both), known, z[known])
    found = counter_offset(
        z,
        d,
        np.isfinite(d),
        most=min(round(_STAMPS_S / period), both // 8),
        lag=calibration.dynamics.low_frequency_delay / period,
        lag_uncertainty=calibration.low_frequency_delay_uncertainty / period,
    )
    return replace(found, samples=guess + found.samples)


def _by_stamps(axes: Sequence[Block], distance: Sequence[Block], period: float) -> int:
    """Return the offset by the stamps alone [samples]."""
    starts = np.array([(b.stamp_ns, b.first_sample) for b in axes], np.int64)
    near = [int(np.argmin(abs(starts[:, 0] - b.stamp_ns))) for b in distance]
    apart = [
        int(starts[i, 1])
        - b.first_sample
        + (b.stamp_ns - int(starts[i, 0])) / (period * NANOSECONDS_PER_S)
        for i, b in zip(near, distance, strict=True)
    ]
    return round(float(np.median(apart)))


def _column(blocks: Sequence[Block], first: int, values: Sequence[FloatArray]) -> FloatArray:
    """Return the values by count from ``first`` on (n,), NaN where there is none."""
    length = max(b.end for b in blocks) - first
    if not 0 < length <= _MOST_SAMPLES:
        raise DataError(
            f"counters of axes and distance span {length} samples, expected 1 to {_MOST_SAMPLES}: "
            "two recordings in one, or streams of different times; use one motion"
        )
    found = np.full(length, np.nan)
    for block, column in zip(blocks, values, strict=True):
        start = block.first_sample - first
        if start + len(column) > 0:
            found[max(0, start) : start + len(column)] = column[max(0, -start) :]
    return found
