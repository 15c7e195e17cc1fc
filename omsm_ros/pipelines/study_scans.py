"""What is learnt from whole scans: dynamics and latency, and how the probe sits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from omsm_ros.core.adjustment.resolved_calibration import (
    Reversal,
    after_step_test,
    from_scans_alone,
    resolved,
    reversal,
    unit_calibration,
    without_step_test,
)
from omsm_ros.core.adjustment.scan_reader import ScanColumns, ScanReader
from omsm_ros.core.adjustment.self_calibration import (
    DEFAULT_CLOCKING_RAD,
    DEFAULT_HARMONICS,
    UNINFORMATIVE_GAIN,
    SelfCalibration,
    self_calibrate,
)
from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.correction.correct import CorrectionOptions
from omsm_ros.core.kinematics.kinematics import Geometry
from omsm_ros.core.registration.probe_alignment import Alignment, SphereScanReader, align_on_sphere
from omsm_ros.core.streams.blocks import Account, AxisBlock
from omsm_ros.errors import BagError
from omsm_ros.io.topics import AnyBag
from omsm_ros.pipelines.correct import CorrectedScan
from omsm_ros.pipelines.progress import Progress, no_progress
from omsm_ros.pipelines.recording import sample_period_in
from omsm_ros.readable import counts_text

# What is to be found must not be in the points already.
_PLAIN = CorrectionOptions(lateral_lag=0.0)


def reversal_of(
    bag_paths: Sequence[AnyBag], calibration: Calibration, progress: Progress = no_progress
) -> tuple[Reversal, list[Account]]:
    """Return the lag of the probe against X and C from scans with opposite spindle directions.

    Also return where every sample of each scan has gone.
    """
    scans, accounts = _read_scans(bag_paths, calibration, _PLAIN, progress)
    return reversal(scans, calibration), accounts


@dataclass(frozen=True, kw_only=True)
class SelfCalibrationOptions:
    """How to calibrate on the part itself.

    harmonics: highest of the surface in a turn
    clocking: standard uncertainty of C from scan to scan [rad], 10 if the part was re-mounted
    polarity, static_gain, gain_uncertainty, settings: of the probe, where no step test
        finds them; the uncertainty is a share of the gain
    """

    harmonics: int = DEFAULT_HARMONICS
    clocking: float = DEFAULT_CLOCKING_RAD
    polarity: int = 1
    static_gain: float = 1.0
    gain_uncertainty: float = UNINFORMATIVE_GAIN
    settings: Mapping[str, object] = field(default_factory=dict)


def self_calibration_of(
    bag_paths: Sequence[AnyBag],
    step_test: Calibration | None,
    options: SelfCalibrationOptions,
    progress: Progress = no_progress,
) -> tuple[SelfCalibration, Calibration, list[Account]]:
    """Return what scans of one part say of the dynamics, and a calibration from it.

    step_test: from the same machine; None takes the scans alone
    Also return where every sample of each scan has gone.
    """
    period = sample_period_in(bag_paths[0])
    base = step_test or unit_calibration(period, options.static_gain)
    prior = after_step_test(base) if step_test else without_step_test(options.gain_uncertainty)
    plain = replace(_PLAIN, polarity=options.polarity)
    scans, accounts = _read_scans(bag_paths, base, plain, progress)
    found = self_calibrate(scans, replace(prior, clocking=options.clocking), options.harmonics)
    if step_test:
        return found, resolved(step_test, found), accounts
    alone = from_scans_alone(found, period, options.static_gain, options.settings)
    return found, alone, accounts


def _read_scans(
    bag_paths: Sequence[AnyBag],
    calibration: Calibration,
    options: CorrectionOptions,
    progress: Progress,
) -> tuple[list[ScanColumns], list[Account]]:
    scans, accounts = [], []
    for bag in bag_paths:
        with CorrectedScan(bag, calibration, options, progress=progress) as scan:
            reader = ScanReader(scan.sample_period)
            for block, points in scan.steps():
                if isinstance(block, AxisBlock):
                    reader.add_axes(block)
                if points is not None:
                    reader.add(points)
            _check_points(scan)
            scans.append(reader.columns())
            accounts.append(scan.account)
    return scans, accounts


def alignment_of(
    path: AnyBag,
    calibration: Calibration,
    radius: float,
    geometry: Geometry,
    progress: Progress = no_progress,
) -> tuple[Alignment, Account]:
    """Find spindle centre and lean of the beam from a scan of a sphere of ``radius`` [m].

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
            f"{str(scan.path)!r} gives no surface point: of {scan.account.distance.received} "
            f"readings {counts_text(scan.account.distance.counted)}, of "
            f"{scan.account.axes.received} axis samples {counts_text(scan.account.axes.counted)}; "
            "look at it with 'omsm inspect'"
        )
