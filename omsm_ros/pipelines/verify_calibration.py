"""Does a calibration hold on a free path? The paper's Fig. 9 from a bag."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.calibration.verification import PathCheck, check_path
from omsm_ros.core.correction.counter_offset import CounterOffset, counter_offset
from omsm_ros.core.correction.predict import Prediction, predict_error
from omsm_ros.core.estimation.preparation import check_gain
from omsm_ros.core.estimation.steps import check_usable
from omsm_ros.core.kinematics.scan_path import ScanPath
from omsm_ros.core.lti.discretisation import discretise
from omsm_ros.core.lti.recursion import through
from omsm_ros.core.streams.blocks import AxisBlock, Block, DistanceBlock, FloatArray
from omsm_ros.core.streams.motion_record import MotionRecord
from omsm_ros.core.streams.trigger_slips import EQUAL_COUNTS, CommonTrigger
from omsm_ros.errors import CalibrationError, DataError
from omsm_ros.io import bags
from omsm_ros.io.topics import AnyBag
from omsm_ros.linear_algebra import least_squares
from omsm_ros.pipelines.identify import motion_of_bag
from omsm_ros.pipelines.progress import Progress, no_progress
from omsm_ros.pipelines.recording import path_in, read_blocks
from omsm_ros.quantities import POSITION, SAMPLE_PERIOD
from omsm_ros.units import NANOSECONDS_PER_S


def path_check_of(
    path: AnyBag,
    calibration: Calibration,
    progress: Progress = no_progress,
    trigger: CommonTrigger = EQUAL_COUNTS,
    by_stamps: bool = False,
) -> PathCheck:
    """Return the paper's Fig. 9: errors and phase lags of a free path on a fixed target.

    trigger: what is stated of the counters of axes and distance
    by_stamps: join both by their stamps, not by their counters
    """
    record = motion_of_bag(path, trigger=trigger, by_stamps=by_stamps, progress=progress)
    check_usable(record)
    predicted = through(discretise(calibration.dynamics, record.sample_period), record.z)
    distance = _bridged(record)
    _check_follows(predicted, -distance / calibration.static_gain)
    return check_path(
        record.z,
        distance,
        predicted,
        calibration.static_gain,
        record.sample_period,
    )


def _check_follows(predicted: FloatArray, seen: FloatArray) -> None:
    """Raise DataError unless the probe sees the motion: before a part it sees the surface.

    predicted: where the probe is, by the model;  seen: by its own readings, both (n,) [m]
    """
    columns = np.column_stack([predicted - np.mean(predicted)])
    gain = float(least_squares(columns, seen - np.mean(seen))[0])
    check_gain(gain)
    if gain < 0:
        raise DataError(
            "the distance goes the other way with Z than in the step test of the calibration; turn "
            "its sign, in the driver or the map"
        )


def _bridged(record: MotionRecord) -> FloatArray:
    """Return the distance, dropouts bridged by lines: a Hilbert transform has no use for gaps."""
    index = np.arange(len(record))
    return np.interp(index, index[record.ok], record.distance[record.ok])


# The offset of two trigger counters, established by the motion in a bag.

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


# What will a motion cost? The prediction for a bag or for positions.


def predict_from(
    calibration: Calibration | None, bag: str, z: FloatArray, sample_period: float
) -> Prediction:
    """Predict the dynamic error of the motion in ``bag``, or of ``z`` [m] if that is empty."""
    if calibration is None:
        raise CalibrationError("no calibration in use; call identify or load one")
    if bag:
        return predict_error(calibration, path_in(bag))
    SAMPLE_PERIOD.checked(sample_period, name="sample_period")
    positions = POSITION.checked_all(np.asarray(z, np.float64), name="z")
    return predict_error(calibration, ScanPath(z=positions, sample_period=sample_period))
