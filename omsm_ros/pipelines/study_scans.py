"""Determine dynamics, latency and probe position from whole scans."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from omsm_ros.core.adjustment.resolved_calibration import (
    Reversal,
    after_step_test,
    from_scans_alone,
    resolved,
    reversal,
    unit_calibration,
    without_step_test,
)
from omsm_ros.core.adjustment.self_calibration import SelfCalibration, self_calibrate
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
from omsm_ros.pipelines.adjust import read_scan
from omsm_ros.pipelines.correct import CorrectedScan
from omsm_ros.pipelines.recording import Recording

# The probe latency is what these tasks estimate, so it must not be corrected before.
_UNCORRECTED_LAG = CorrectionOptions(probe_latency=0.0)


def reversal_of(
    bag_paths: Sequence[AnyBag], calibration: Calibration
) -> tuple[Reversal, list[Account]]:
    """Return the lag of the probe against X and C from scans with opposite spindle directions.

    Also return the account of the samples of each scan.
    """
    scans = [read_scan(p, calibration, _UNCORRECTED_LAG) for p in bag_paths]
    return reversal([s.data for s in scans], calibration), [s.account for s in scans]


def self_calibration_of(
    bag_paths: Sequence[AnyBag],
    step_test: Calibration | None,
    *,
    harmonics: int,
    clocking: float,
    polarity: int,
    static_gain: float,
    gain_uncertainty: float,
    settings: Mapping[str, object],
) -> tuple[SelfCalibration, Calibration, list[Account]]:
    """Estimate the dynamics from scans of one part; return the estimate and a calibration.

    step_test: from the same machine; None uses the scans alone
    harmonics: highest harmonic of the surface in a turn
    clocking: standard uncertainty of C between the scans [rad], 10 if the part was re-mounted
    polarity, static_gain, gain_uncertainty, settings: of the probe, used without a step test;
        the uncertainty is relative to the gain
    Also return the account of the samples of each scan.
    """
    with Recording(bag_paths[0]) as first:
        period = first.sample_period()
    base = step_test or unit_calibration(period, static_gain)
    how = replace(_UNCORRECTED_LAG, polarity=polarity)
    scans = [read_scan(path, base, how) for path in bag_paths]
    accounts = [scan.account for scan in scans]
    prior = after_step_test(base) if step_test else without_step_test(gain_uncertainty)
    found = self_calibrate(
        [scan.data for scan in scans], replace(prior, clocking=clocking), harmonics
    )
    if step_test:
        return found, resolved(step_test, found), accounts
    return found, from_scans_alone(found, period, static_gain, settings), accounts


def alignment_of(
    path: AnyBag, calibration: Calibration, radius: float, geometry: Geometry
) -> tuple[Alignment, Account]:
    """Estimate spindle centre and beam direction from a scan of a sphere of ``radius`` [m].

    Also return the account of the samples of the scan.
    """
    with Recording(path) as recording:
        scan = CorrectedScan(recording, calibration, _UNCORRECTED_LAG, most_traced=MOST_POINTS)
        for _ in scan.steps():
            pass
        scan.check_points()
        return align_on_sphere(
            SphereScan.of(scan.corrector.trace.points()), radius, geometry
        ), scan.account
