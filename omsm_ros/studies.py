"""What is learnt from whole recordings: motions to identify from, lags, alignments.

Apart from :mod:`omsm_ros.offline` because these load several times as long as a correction.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from omsm_ros import bags
from omsm_ros.core.align import Alignment, align_on_sphere, sphere_scan_of
from omsm_ros.core.calibration import Calibration
from omsm_ros.core.correct import CorrectionOptions, Corrector, join_points
from omsm_ros.core.discretise import discretise
from omsm_ros.core.kinematics import Geometry
from omsm_ros.core.motion_record import MotionRecord, assemble
from omsm_ros.core.records import AxisBlock, Block, DistanceBlock, FloatArray, SurfacePoints
from omsm_ros.core.recursion import Recursion, past_motion
from omsm_ros.core.reversal import SidewaysLag, sideways_lag
from omsm_ros.core.validate import PathCheck, check_path
from omsm_ros.errors import BagError
from omsm_ros.offline import Progress, no_progress, read_blocks

_START_SAMPLES = 12

# ------------------------------------------------------------------------ identification


def motion_of_bag(
    path: Path, *, duration: float = 0.0, progress: Progress = no_progress
) -> MotionRecord:
    """The motion in a bag, its first ``duration`` seconds (0 = all), ready to identify from.

    The reference sensor is used where it was recorded.
    """
    topics = [bags.AXES_TOPIC, bags.DISTANCE_TOPIC]
    with bags.BagReader(path) as bag:
        if any(t.topic == bags.REFERENCE_TOPIC and t.messages for t in bag.topics()):
            topics.append(bags.REFERENCE_TOPIC)
    blocks = read_blocks(path, topics, progress)
    if not blocks[bags.AXES_TOPIC] or not blocks[bags.DISTANCE_TOPIC]:
        raise BagError(f"{str(path)!r} has its topics but no samples on them; record a step test")
    axes, distance, *reference = (_beginning(blocks[topic], duration) for topic in topics)
    return assemble(axes, distance, *reference)  # type: ignore[arg-type]


def _beginning(blocks: list[Block], duration: float) -> list[Block]:
    if duration == 0 or not blocks:
        return blocks
    end = blocks[0].first_sample + duration / blocks[0].sample_period
    return [block for block in blocks if block.first_sample < end]


# ------------------------------------------------------------------- scans as a whole


def scan_points(
    path: Path,
    calibration: Calibration,
    options: CorrectionOptions,
    progress: Progress = no_progress,
) -> tuple[SurfacePoints, list[AxisBlock]]:
    """All corrected points of a bag in memory, and the axes they came from."""
    blocks = read_blocks(path, [bags.AXES_TOPIC, bags.DISTANCE_TOPIC], progress)
    axes = [b for b in blocks[bags.AXES_TOPIC] if isinstance(b, AxisBlock)]
    corrector = Corrector(calibration, options)
    for block in axes:
        corrector.push_axes(block)
    for reading in blocks[bags.DISTANCE_TOPIC]:
        if isinstance(reading, DistanceBlock):
            corrector.push_distance(reading)
    points = join_points([corrector.take(), corrector.finish()])
    if not len(points):
        raise BagError(
            f"{str(path)!r} gives no surface point: {corrector.account.as_dict()!r}; "
            "look at it with 'omsm inspect'"
        )
    return points, axes


def sideways_lag_of(
    bag_paths: Sequence[Path], calibration: Calibration, progress: Progress = no_progress
) -> SidewaysLag:
    """Lag of the probe against X and C from scans with opposite spindle directions."""
    options = CorrectionOptions(lateral_lag=0.0)
    scans = [scan_points(path, calibration, options, progress)[0] for path in bag_paths]
    return sideways_lag(scans, calibration)


def alignment_of(
    path: Path,
    calibration: Calibration,
    radius: float,
    geometry: Geometry,
    progress: Progress = no_progress,
) -> Alignment:
    """Spindle centre and lean of the beam from a scan of a sphere of ``radius`` [m]."""
    options = CorrectionOptions(lateral_lag=0.0)
    points, axes = scan_points(path, calibration, options, progress)
    return align_on_sphere(sphere_scan_of(points, axes), radius, geometry)


def path_check_of(
    path: Path, calibration: Calibration, progress: Progress = no_progress
) -> PathCheck:
    """The paper's Fig. 9: errors and phase lags of a free path on a fixed target."""
    record = motion_of_bag(path, progress=progress)
    recursion = Recursion(discretise(calibration.dynamics, record.sample_period))
    recursion.start(past_motion(record.z[:_START_SAMPLES]))
    return check_path(
        record.z,
        _bridged(record),
        recursion.run(record.z),
        calibration.static_gain,
        record.sample_period,
    )


def _bridged(record: MotionRecord) -> FloatArray:
    """Distance with its dropouts bridged by straight lines: the Hilbert transform needs no gaps."""
    index = np.arange(len(record))
    return np.interp(index, index[record.ok], record.distance[record.ok])
