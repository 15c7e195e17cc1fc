"""What is learnt from whole scans: the lateral delay, and how the probe sits."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from omsm_ros.core.correction.correct import CorrectionOptions, Corrector, join_points
from omsm_ros.core.correction.surface_points import SurfacePoints
from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.machine.kinematics import Geometry
from omsm_ros.core.samples.blocks import AxisBlock, DistanceBlock
from omsm_ros.core.surface.alignment import Alignment, align_on_sphere, sphere_scan_of
from omsm_ros.core.verification.reversal import SidewaysLag, sideways_lag
from omsm_ros.errors import BagError
from omsm_ros.jobs.read_bag import Progress, no_progress, read_blocks
from omsm_ros.storage import bags

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
