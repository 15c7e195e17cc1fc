"""A finished measurement: its cloud, its summary and its page in one folder."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from omsm_ros import __version__
from omsm_ros.core.correction.calibration_set import CalibrationSet
from omsm_ros.core.correction.correct import CorrectionOptions
from omsm_ros.core.correction.machine_sources import NOTHING_STATED, MachineSources
from omsm_ros.core.correction.predict import predict_error
from omsm_ros.core.dynamics.calibration import Calibration, age_at
from omsm_ros.core.dynamics.discretisation import discretise
from omsm_ros.core.dynamics.discretisation_error import discretisation_error
from omsm_ros.core.dynamics.latency import beyond_lag, latency_of
from omsm_ros.core.machine.surface_height import Surface
from omsm_ros.core.registration.placement import Aperture
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.core.surface.deviation import unlike
from omsm_ros.errors import DataError
from omsm_ros.jobs.correct_bag import Correction, correct_bag
from omsm_ros.jobs.corrected_scan import Admission, ByStamps
from omsm_ros.jobs.judge_scan import Judgement, with_sources
from omsm_ros.jobs.progress import Progress, no_progress
from omsm_ros.quantities import TEMPERATURE
from omsm_ros.storage.files import CLOUD, DEVIATION, FORM, REPORT, SUMMARY, save_json
from omsm_ros.storage.recording.topics import AnyBag


@dataclass(frozen=True)
class Registering:
    """How a part is registered to its nominal surface, and judged.

    freedoms: of the fit, or "auto";  aperture: of the part, None for all points
    tolerance: of the peak to valley of 99.5 % [m], if there is one
    """

    freedoms: Sequence[str]
    aperture: Aperture | None = None
    tolerance: float | None = None


def measure(
    bag: AnyBag,
    calibration: Calibration,
    out: Path,
    *,
    nominal: Surface | None = None,
    options: CorrectionOptions | None = None,
    admission: Admission | None = None,
    lateral: float = 0.0,
    by_stamps: ByStamps | None = None,
    stated: MachineSources = NOTHING_STATED,
    accuracy: float | None = None,
    register: Registering | None = None,
    report: bool = True,
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Correct ``bag`` into ``out``: cloud.ply, summary.json, report.html; return the summary.

    Beside them systematic.npz, what the systematic errors do to the points, for ``omsm form``.

    lateral: lateral standard uncertainty of a point [m]; needs ``nominal`` for the slope
    by_stamps: see :func:`omsm_ros.jobs.correct_bag.correct_bag`
    stated: what is uncertain of the machine;  accuracy: asked for, k = 2 [m]
    register: how the points are registered to ``nominal``; None: they are not
    report: False writes no page, which takes longer than everything else

    Raises CalibrationError for a calibration that does not belong to the bag, unless overridden.
    """
    used = with_sources(options or CorrectionOptions(), calibration, stated, nominal)
    done = correct_bag(
        bag,
        calibration,
        out / CLOUD,
        options=used,
        admission=admission,
        nominal=nominal,
        lateral=lateral,
        by_stamps=by_stamps,
        progress=progress,
    )
    fitted = register.freedoms if register is not None else ()
    summary = summarise(bag, done, calibration, Judgement(used, stated, accuracy, out, fitted))
    if register is not None and nominal is not None and done.statistics:
        add_form(out, summary, nominal, register)
    if report:
        summary["files"]["report"] = REPORT
    save_json(out / SUMMARY, summary)
    if report:
        _publish(bag, out, done, summary, calibration, nominal)
    return summary


def _unlike(done: Correction, nominal: Surface | None) -> list[str]:
    if nominal is None:
        return []
    x, y = (done.points[name].astype(np.float64) for name in "xy")
    return unlike(x, y, done.points["height"], nominal)


def _publish(
    bag: Path,
    out: Path,
    done: Correction,
    summary: dict[str, Any],
    calibration: Calibration,
    nominal: Surface | None,
) -> None:
    # Here, because drawing takes longer to load than a scan to correct.
    from omsm_ros.jobs.publish import figures_of, map_of, publish, view_of

    view = view_of(done.points, done.sample_period)
    figures = figures_of(view, calibration, nominal, done.sample_period)
    surface = map_of(view, nominal, out)
    publish(out, f"Surface of {bag.name}", summary, calibration, figures, surface)


def add_form(out: Path, summary: dict[str, Any], nominal: Surface, register: Registering) -> None:
    """Register the cloud in ``out``, and say in the ``summary`` what came of it."""
    # Here, because most corrections do without.
    from omsm_ros.jobs.judge_form import judge_form
    from omsm_ros.jobs.measured_portions import open_measurement

    facts = judge_form(
        open_measurement(out),
        nominal,
        out,
        register.freedoms,
        register.aperture,
        tolerance=register.tolerance,
    )
    summary["form"] = {name: facts[name] for name in ("pose", "deviation", "removed", "points")}
    summary["files"] |= {"form": FORM, "deviation": DEVIATION}
    if register.tolerance is not None:
        summary["form"]["conformity"] = facts["conformity"]


def summarise(
    bag: AnyBag, done: Correction, calibration: Calibration, judgement: Judgement
) -> dict[str, Any]:
    """Return what ``summary.json`` says of every measurement; lengths in metres."""
    summary: dict[str, Any] = {
        "schema": "omsm-summary/1",
        "bag": str(bag),
        "calibration": calibration.id,
        **_places(calibration),
        "samples": done.account,
        "uncertainty_budget": done.budget,
        "sample_period": done.sample_period,
        "stamp_skew": done.stamp_skew,
        "conditions": conditions(done, calibration),
        "settings": dict(calibration.settings),
        "latency": latency_of(calibration).entry(),
        "versions": {
            "omsm_ros": __version__,
            "python": platform.python_version(),
            **{name: metadata.version(name) for name in ("numpy", "scipy", "rosbags")},
        },
        "files": {"cloud": CLOUD, "summary": SUMMARY},
        "admission": done.admission,
        "warnings": [
            *(f"overridden: {reason}" for reason in done.reasons),
            *_implausible(done.temperatures),
        ],
    }
    if not done.statistics:
        summary["warnings"] += [*done.faults, "not one sample could be corrected; see the reasons"]
        return summary
    judged = _motion_judged(done, calibration)
    summary["warnings"] += judged.pop("warnings")
    summary["warnings"] += _unlike(done, judgement.options.surface)
    if (late := beyond_lag(calibration, judgement.options.lateral_lag or 0.0)) is not None:
        summary["warnings"].append(late)
    of_filter = judged.get("discretisation", {}).get("rms", 0.0)
    return summary | judged | _figures_of_merit(done) | judgement.of(done, calibration, of_filter)


def conditions(done: Correction, calibration: Calibration) -> dict[str, Any]:
    """Return when a scan was made, how old its calibration was then [s], and how warm it was [°C].

    Each is None where nobody recorded it.
    """
    told = done.temperatures[np.isfinite(done.temperatures)]
    return {
        "recorded_ns": done.recorded_ns,
        "calibration_age": age_at(calibration, done.recorded_ns),
        "temperature": None
        if not len(told)
        else {
            "mean": float(np.mean(told)),
            "lowest": float(np.min(told)),
            "highest": float(np.max(told)),
            "change": float(told[-1] - told[0]),
        },
    }


def _implausible(temperatures: FloatArray) -> list[str]:
    lost = int(np.sum(~np.isfinite(temperatures)))
    said = (
        f"{lost} of {len(temperatures)} temperatures cannot be, expected "
        f"{TEMPERATURE.range_text}; {TEMPERATURE.remedy}"
    )
    return [said] * bool(lost)


def _places(calibration: Calibration) -> dict[str, Any]:
    """Return where the members of a calibration set were made."""
    if not isinstance(calibration, CalibrationSet):
        return {}
    places = {"along": calibration.along, "positions": list(calibration.positions)}
    return {"calibration_set": places}


def _motion_judged(done: Correction, calibration: Calibration) -> dict[str, Any]:
    """Return whether the scan was slow enough to be trusted, and how good H was on its motion."""
    try:
        prediction = predict_error(calibration, done.path)
        digital = discretise(calibration.dynamics, done.sample_period)
        rms, spread = discretisation_error(
            calibration.dynamics, digital, done.path.z, calibration.valid_up_to
        )
    except DataError as err:
        return {"warnings": [f"the motion could not be judged: {err}"]}
    return {
        "warnings": [] if prediction.safe else [prediction.message],
        "prediction": asdict(prediction),
        "discretisation": {"rms": rms, "peak_to_valley": spread},
    }


def _figures_of_merit(done: Correction) -> dict[str, Any]:
    removed = done.statistics["error"]
    found: dict[str, Any] = {
        "dynamic_error_before": {
            "peak_to_valley": removed.peak_to_valley,
            "rms": removed.rms_area_weighted,
        },
        "uncertainty": {
            "median": float(np.median(done.points["uncertainty"])),
            "largest": done.largest_uncertainty,
        },
    }
    deviations = {n: asdict(s) for n, s in done.statistics.items() if n != "error"}
    return found | ({"deviation": deviations} if deviations else {})
