"""Is the lag latency, or mechanics? Two scans in opposite directions decide.

A late probe looks where the workpiece was a moment ago: each height belongs to a point
``lag`` earlier on the path, and turning the spindle the other way shifts it to the other
side. A mechanical lag of Z alone does not. It is :func:`self_calibrate` with a step test
before it, and two directions for two speeds.

Where Z follows the surface, an error of the calibration's own delay leaves the same mark. The
estimate cannot be better than that delay is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.verification.resolved_calibration import after_step_test, resolved
from omsm_ros.core.verification.scan_model import LATENCY
from omsm_ros.core.verification.scan_reader import ScanColumns
from omsm_ros.core.verification.self_calibration import DEFAULT_HARMONICS, self_calibrate
from omsm_ros.errors import DataError


@dataclass(frozen=True)
class Reversal:
    """What scans in opposite directions say: how late the probe's reading is against X and C.

    lag, uncertainty: [s], k = 1;  lag_of_z: of the calibration at low frequency [s]
    residual: rms that lag and surface leave [m];  used: points fitted
    latency: True if the lag of Z is latency, False if mechanical, None if neither within 3 u
    calibration: with what was found in it
    """

    lag: float
    uncertainty: float
    lag_of_z: float
    residual: float
    used: int
    latency: bool | None
    calibration: Calibration


def reversal(
    scans: Sequence[ScanColumns], calibration: Calibration, harmonics: int = DEFAULT_HARMONICS
) -> Reversal:
    """Return the lag of the probe against X and C from scans in opposite directions.

    scans: corrected with ``calibration``, two or more, of one surface
    harmonics: of the surface in a turn; more for a rougher surface

    Raises DataError if the scans turn the same way, are too short, or the surface has no
    slope along the path.
    """
    turns = [float(scan.angular_rate.sum()) for scan in scans]
    if len(scans) > 1 and not min(turns) < 0 < max(turns):
        raise DataError("both scans turn the same way; reverse the spindle for one of them")
    found = self_calibrate(scans, after_step_test(calibration), harmonics)
    lag, of_z = float(found.values[LATENCY]), calibration.dynamics.low_frequency_delay
    uncertainty = float(found.covariance[LATENCY, LATENCY] ** 0.5)
    return Reversal(
        lag=lag,
        uncertainty=uncertainty,
        lag_of_z=of_z,
        residual=found.residual,
        used=found.points,
        latency=_verdict(lag, uncertainty, of_z),
        calibration=resolved(calibration, found),
    )


def _verdict(lag: float, uncertainty: float, lag_of_z: float) -> bool | None:
    late, prompt = abs(lag - lag_of_z) <= 3 * uncertainty, abs(lag) <= 3 * uncertainty
    return late if late != prompt else None
