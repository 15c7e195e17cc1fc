"""A finished measurement: its cloud, its summary and its page in one folder."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from omsm_ros import __version__
from omsm_ros.core.correction.applicability import admit, objections
from omsm_ros.core.correction.correct import CorrectionOptions
from omsm_ros.core.correction.predict import predict_error
from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.dynamics.discretisation import discretise
from omsm_ros.core.dynamics.discretisation_error import discretisation_error
from omsm_ros.core.machine.surface_height import Surface
from omsm_ros.core.surface import deviation as form
from omsm_ros.errors import DataError
from omsm_ros.jobs.correct_bag import ByStamps, Correction, correct_bag
from omsm_ros.jobs.read_bag import Progress, motion_in, no_progress, sample_period_of
from omsm_ros.storage.cloud_file import CloudFile
from omsm_ros.storage.files import CLOUD, REPORT, SUMMARY, save_json

# Bound the memory whatever the length of a scan.
_MOST_SORTED = 1_000_000
_MOST_JUDGED = 2_000_000


@dataclass(frozen=True)
class Admission:
    """May a calibration be used here?

    settings: of this scan, to be compared with the calibration's; None = not known
    override: use it all the same; what spoke against it is written into every result
    """

    settings: Mapping[str, object] | None = None
    override: bool = False


def measure(
    bag: Path,
    calibration: Calibration,
    out: Path,
    *,
    nominal: Surface | None = None,
    options: CorrectionOptions | None = None,
    admission: Admission | None = None,
    lateral: float = 0.0,
    by_stamps: ByStamps | None = None,
    report: bool = True,
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Correct ``bag`` into ``out``: cloud.ply, summary.json, report.html; return the summary.

    lateral: standard uncertainty of a point sideways [m]; needs ``nominal`` for the slope
    by_stamps: see :func:`omsm_ros.jobs.correct_bag.correct_bag`
    report: False leaves out the page, which takes longer than everything else

    Raises CalibrationError for a calibration that does not belong to the bag, unless overridden.
    """
    options, asked = options or CorrectionOptions(), admission or Admission()
    period = sample_period_of(bag)
    reasons = objections(
        calibration, sample_period=period, settings=asked.settings, polarity=options.polarity
    )
    admitted = admit(calibration, reasons, asked.override)
    comment = "; ".join(["OVERRIDDEN", *reasons]) if reasons else ""
    done = correct_bag(
        bag,
        calibration,
        out / CLOUD,
        options=options,
        nominal=nominal,
        lateral=lateral,
        by_stamps=by_stamps,
        comment=comment,
        progress=progress,
    )
    cloud = CloudFile(out / CLOUD)
    summary = summarise(bag, done, cloud, calibration, nominal)
    summary["admission"] = admitted
    summary["warnings"] += [f"overridden: {reason}" for reason in reasons]
    if report:
        summary["files"]["report"] = REPORT
    save_json(out / SUMMARY, summary)
    if report:
        _draw(out, bag, cloud, summary, calibration, nominal, period)
    return summary


def _draw(
    out: Path,
    bag: Path,
    cloud: CloudFile,
    summary: dict[str, Any],
    calibration: Calibration,
    nominal: Surface | None,
    period: float,
) -> None:
    # Here, because drawing takes longer to load than a scan to correct.
    from omsm_ros.jobs.publish import MOST_DRAWN, figures_of, publish

    figures = figures_of(cloud.read(MOST_DRAWN), calibration, nominal, period)
    publish(out, f"Surface of {bag.name}", summary, calibration, figures)


def summarise(
    bag: Path,
    done: Correction,
    cloud: CloudFile,
    calibration: Calibration,
    nominal: Surface | None,
) -> dict[str, Any]:
    """What ``summary.json`` says of every measurement; lengths in metres."""
    summary: dict[str, Any] = {
        "schema": "omsm-summary/1",
        "bag": str(bag),
        "calibration": calibration.id,
        "samples": done.account,
        "uncertainty_budget": done.budget,
        "stamp_skew": done.stamp_skew,
        "settings": dict(calibration.settings),
        "versions": {
            "omsm_ros": __version__,
            "python": platform.python_version(),
            **{name: metadata.version(name) for name in ("numpy", "scipy", "rosbags")},
        },
        "files": {"cloud": CLOUD, "summary": SUMMARY},
    }
    if not cloud.points:
        return summary | {"warnings": ["not one sample could be corrected; see the reasons"]}
    return summary | _motion_judged(bag, calibration) | _figures_of_merit(cloud, nominal)


def _motion_judged(bag: Path, calibration: Calibration) -> dict[str, Any]:
    """Was the scan slow enough to be trusted, and how good was H on its motion?"""
    try:
        z, period = motion_in(bag, most=_MOST_JUDGED)
        prediction = predict_error(calibration, z, period)
        digital = discretise(calibration.dynamics, period)
        rms, spread = discretisation_error(
            calibration.dynamics, digital, z, calibration.valid_up_to
        )
    except DataError as err:
        return {"warnings": [f"the motion could not be judged: {err}"]}
    return {
        "warnings": [] if prediction.safe else [prediction.message],
        "prediction": asdict(prediction),
        "discretisation": {"rms": rms, "peak_to_valley": spread},
    }


def _figures_of_merit(cloud: CloudFile, nominal: Surface | None) -> dict[str, Any]:
    running = {name: form.RunningStatistics() for name in ("error", "raw", "corrected")}
    largest = 0.0
    for part in cloud.portions():
        x, y, height, error = (
            part[name].astype(np.float64) for name in ("x", "y", "height", "dynamic_error")
        )
        largest = max(largest, float(part["uncertainty"].max()))
        running["error"].add(x, y, error)
        if nominal is not None:
            deviation = form.deviation(x, y, height, nominal)
            running["corrected"].add(x, y, deviation)
            running["raw"].add(x, y, deviation + error)
    median = float(np.median(cloud.read(_MOST_SORTED)["uncertainty"]))
    removed = running["error"].statistics()
    spread = {"peak_to_valley": removed.peak_to_valley, "rms": removed.rms_area_weighted}
    found: dict[str, Any] = {
        "dynamic_error_before": spread,
        "uncertainty": {"median": median, "largest": largest},
    }
    if nominal is not None:
        found["deviation"] = {
            name: asdict(running[name].statistics()) for name in ("raw", "corrected")
        }
    return found
