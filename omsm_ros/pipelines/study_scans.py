"""Determine the position of the probe from a whole scan."""

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.correction.correct import CorrectionOptions
from omsm_ros.core.kinematics.kinematics import Geometry
from omsm_ros.core.registration.probe_alignment import (
    MOST_POINTS,
    Alignment,
    SphereScan,
    align_on_sphere,
)
from omsm_ros.core.streams.blocks import Account
from omsm_ros.io.topics import AnyBag
from omsm_ros.pipelines.correct import CorrectedScan
from omsm_ros.pipelines.recording import Recording

UNCORRECTED_LAG = CorrectionOptions(probe_latency=0.0)
"""Options of tasks that estimate the latency of the probe, which must not be corrected before."""


def alignment_of(
    path: AnyBag, calibration: Calibration, radius: float, geometry: Geometry
) -> tuple[Alignment, Account]:
    """Estimate spindle centre and beam direction from a scan of a sphere of ``radius`` [m].

    Also return the account of the samples of the scan.
    """
    with Recording(path) as recording:
        scan = CorrectedScan(recording, calibration, UNCORRECTED_LAG, most_traced=MOST_POINTS)
        for _ in scan.steps():
            pass
        scan.check_points()
        return align_on_sphere(
            SphereScan.of(scan.corrector.trace.points()), radius, geometry
        ), scan.account
