"""What is learnt from whole scans: the lateral delay, and how the probe sits."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from omsm_ros.core.correction.correct import CorrectionOptions
from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.machine.kinematics import Geometry
from omsm_ros.core.samples.accounts import Account
from omsm_ros.core.samples.blocks import AxisBlock
from omsm_ros.core.surface.alignment import Alignment, SphereScanReader, align_on_sphere
from omsm_ros.core.verification.reversal import ScanPath, SidewaysLag, sideways_lag
from omsm_ros.errors import BagError
from omsm_ros.jobs.corrected_scan import CorrectedScan
from omsm_ros.jobs.read_bag import Progress, no_progress

# What is to be found must not be in the points already.
_PLAIN = CorrectionOptions(lateral_lag=0.0)


def sideways_lag_of(
    bag_paths: Sequence[Path], calibration: Calibration, progress: Progress = no_progress
) -> tuple[SidewaysLag, list[Account]]:
    """Lag of the probe against X and C from scans with opposite spindle directions.

    Also return where every sample of each scan has gone.
    """
    paths, accounts = [], []
    for bag in bag_paths:
        with CorrectedScan(bag, calibration, _PLAIN, progress=progress) as scan:
            path = ScanPath(scan.sample_period)
            for _, points in scan.steps():
                if points is not None:
                    path.add(points)
            _check_points(scan)
            paths.append(path)
            accounts.append(scan.account)
    return sideways_lag(paths, calibration), accounts


def alignment_of(
    path: Path,
    calibration: Calibration,
    radius: float,
    geometry: Geometry,
    progress: Progress = no_progress,
) -> tuple[Alignment, Account]:
    """Spindle centre and lean of the beam from a scan of a sphere of ``radius`` [m].

    Also return where every sample of the scan has gone.
    """
    reader = SphereScanReader()
    with CorrectedScan(path, calibration, _PLAIN, progress=progress) as scan:
        for block, points in scan.steps():
            if isinstance(block, AxisBlock):
                reader.add_axes(block)
            if points is not None:
                reader.add(points)
        _check_points(scan)
        return align_on_sphere(reader.scan(), radius, geometry), scan.account


def _check_points(scan: CorrectedScan) -> None:
    if not scan.account.axes.corrected:
        raise BagError(
            f"{str(scan.path)!r} gives no surface point: {scan.account.as_dict()!r}; "
            "look at it with 'omsm inspect'"
        )
