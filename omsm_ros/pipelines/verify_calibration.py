"""Verify a calibration on a free path, find counter offsets, and predict errors of a motion."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.calibration.verification import PathCheck, check_path
from omsm_ros.core.correction.counter_offset import CounterOffset, offset_of_motion
from omsm_ros.core.correction.predict import Prediction, predict_error
from omsm_ros.core.estimation.preparation import check_gain
from omsm_ros.core.estimation.steps import check_usable
from omsm_ros.core.kinematics.scan_path import ScanPath
from omsm_ros.core.lti.discretisation import discretise
from omsm_ros.core.lti.recursion import through
from omsm_ros.core.streams.blocks import AxisBlock, Block, DistanceBlock, FloatArray, on_counts
from omsm_ros.core.streams.trigger_slips import EQUAL_COUNTS, CommonTrigger
from omsm_ros.errors import CalibrationError, DataError
from omsm_ros.io.topics import AnyBag
from omsm_ros.linear_algebra import least_squares
from omsm_ros.pipelines.recording import SCAN_TOPICS, Recording
from omsm_ros.quantities import POSITION, SAMPLE_PERIOD
from omsm_ros.units import NANOSECONDS_PER_S


def path_check_of(
    path: AnyBag,
    calibration: Calibration,
    trigger: CommonTrigger = EQUAL_COUNTS,
    by_stamps: bool = False,
) -> PathCheck:
    """Return errors and phase lags of a free path on a fixed target (the paper's Fig. 9).

    trigger: what is stated of the counters of axes and distance
    by_stamps: join both by their stamps, not by their counters
    """
    with Recording(path) as recording:
        record = recording.motion(trigger=trigger, by_stamps=by_stamps)
    check_usable(record)
    predicted = through(discretise(calibration.dynamics, record.sample_period), record.z)
    index = np.arange(len(record))
    distance = np.interp(index, index[record.ok], record.distance[record.ok])
    # The probe's readings must follow the motion, as on a fixed target.
    seen = -distance / calibration.static_gain
    columns = np.column_stack([predicted - np.mean(predicted)])
    gain = float(least_squares(columns, seen - np.mean(seen))[0])
    check_gain(gain)
    if gain < 0:
        raise DataError(
            "the distance changes with Z in the other direction than in the calibration's step "
            "test; invert its sign in the driver or the map"
        )
    return check_path(record.z, distance, predicted, calibration.static_gain, record.sample_period)


# Bounds memory: an hour at 1 kHz.
_MOST_SAMPLES = 4_000_000


def established_offset(path: AnyBag, calibration: Calibration) -> CounterOffset:
    """Return the counter offset for which the distance follows Z, on a fixed target.

    calibration: the distance is expected to follow by its lag

    The search covers a quarter of a second around the offset of the stamps. Raises DataError if
    the motion does not determine the offset.
    """
    with Recording(path) as recording:
        blocks = recording.recorded(*SCAN_TOPICS)
    return offset_in(path, blocks, calibration)


def offset_in(
    path: AnyBag, blocks: Mapping[str, Sequence[Block]], calibration: Calibration
) -> CounterOffset:
    """Return the counter offset in ``blocks``, by topic, of the bag ``path``."""
    axes, distance = ([b for b in blocks[topic] if len(b)] for topic in SCAN_TOPICS)
    if not axes or not distance:
        raise DataError(f"{str(path)!r} lacks samples of axes or distance; record a motion")
    period = float(axes[0].sample_period)
    guess = _by_stamps(axes, distance, period)
    first = axes[0].first_sample
    ends = [max(b.end for b in axes), max(b.end for b in distance) + guess]
    for end in ends:
        if not 0 < end - first <= _MOST_SAMPLES:
            raise DataError(
                f"counters of axes and distance span {end - first} samples, expected 1 to "
                f"{_MOST_SAMPLES}: the bag holds two recordings, or streams of different times; "
                "use one motion"
            )
    z = ((b.first_sample, b.z) for b in axes if isinstance(b, AxisBlock))
    d = (
        (b.first_sample + guess, np.where(b.ok, b.distance, np.nan))
        for b in distance
        if isinstance(b, DistanceBlock)
    )
    z_on_counts, d_on_counts = (on_counts(parts, first, min(ends)) for parts in (z, d))
    if not np.any(np.isfinite(z_on_counts)):
        raise DataError(
            f"{str(path)!r} has no position of Z at the times of its distance; record a motion"
        )
    found = offset_of_motion(z_on_counts, d_on_counts, calibration, period)
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


def predict_from(
    calibration: Calibration | None,
    bag: str,
    z: FloatArray,
    sample_period: float,
    progress: Callable[[str], object] = lambda stage: None,
) -> Prediction:
    """Predict the dynamic error of the motion in ``bag``, or of ``z`` [m] if that is empty.

    progress: called with "predicting" once the motion is read
    """
    if calibration is None:
        raise CalibrationError("no calibration in use; call identify or load one")
    if bag:
        with Recording(bag) as recording:
            path = recording.scan_path()
    elif len(z):
        SAMPLE_PERIOD.checked(sample_period, name="sample_period")
        positions = POSITION.checked_all(np.asarray(z, np.float64), name="z")
        path = ScanPath(z=positions, sample_period=sample_period)
    else:
        raise DataError("no motion is given: name a bag, or give z and its sample_period")
    progress("predicting")
    return predict_error(calibration, path)
