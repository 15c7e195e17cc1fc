"""Correct a scan and evaluate it: cloud, summary and report in one folder."""

from __future__ import annotations

import platform
from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from importlib import metadata
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from omsm_ros import __version__
from omsm_ros.core.adjustment import Verdict, adjust
from omsm_ros.core.adjustment.families import OTHER_SPEED
from omsm_ros.core.adjustment.figures import POSE
from omsm_ros.core.adjustment.scan_data import within
from omsm_ros.core.adjustment.verdict import verdict_of
from omsm_ros.core.calibration.calibration import Calibration, age_at, excess_latency_text
from omsm_ros.core.calibration.calibration_set import CalibrationSet
from omsm_ros.core.calibration.latency import latency_summary
from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.core.correction.machine_sources import (
    NOTHING_STATED,
    RANDOM,
    MachineSources,
    excess_noise,
    scan_budget,
    with_assumed,
)
from omsm_ros.core.correction.predict import predict_error
from omsm_ros.core.correction.systematic import resolves_per_turn_waves, scan_fields
from omsm_ros.core.correction.uncertainty import SCAN_SCATTER, ErrorSources
from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.lti.discretisation import discretisation_error, discretise
from omsm_ros.core.surface.aperture import within_aperture
from omsm_ros.core.surface.deviation import mismatch
from omsm_ros.core.surface.posed import Pose, PosedSurface
from omsm_ros.core.surface.shape_parameters import with_parameters
from omsm_ros.errors import DataError, Notice
from omsm_ros.io.files import CLOUD, DEVIATION, FORM, REPORT, SUMMARY, SYSTEMATIC, save_json
from omsm_ros.io.results import save_fields
from omsm_ros.io.topics import AnyBag
from omsm_ros.pipelines.adjust import conformity_entry, figures_entry, priors_of, verdict_entry
from omsm_ros.pipelines.correct import STRICT, Admission, Correction, StampJoining, correct_bag
from omsm_ros.quantities import TEMPERATURE
from omsm_ros.report.verdict import registered_figures

if TYPE_CHECKING:
    from omsm_ros.pipelines.form import RegistrationOptions


# With a smaller share of corrected samples the map may miss defects of the surface.
_LEAST_SHARE_CORRECTED = 0.95


def with_sources(
    options: CorrectionOptions,
    calibration: Calibration,
    stated: MachineSources,
    nominal: Surface | None,
) -> CorrectionOptions:
    """Return ``options`` with the ``stated`` and assumed sources, and the surface ``nominal``."""
    known = options.sources or ErrorSources.of(calibration)
    arm = options.geometry.abbe_arm or stated.abbe_arm
    return replace(
        options,
        geometry=replace(options.geometry, abbe_arm=arm),
        sources=replace(known, **stated.point_uncertainties()),
        systematic=with_assumed(stated).scan_sources(),
        surface=nominal,
    )


def _budget(
    done: Correction, calibration: Calibration, options: CorrectionOptions, stated: MachineSources,
    discretisation: float, out: Path,
) -> dict[str, Any]:  # fmt: skip
    """Return ``budget`` for ``summary.json``, and keep the fields of systematic errors in ``out``.

    discretisation: rms of the digital filter's error on the scan's path [m]
    """
    traced = done.corrector.trace
    trace = traced.points()
    budget = scan_budget(
        calibration,
        options.sources or ErrorSources.of(calibration),
        {"discretisation": discretisation}
        | {n: size for n, size in done.budget.items() if size or n == SCAN_SCATTER},
        options.geometry,
        with_assumed(stated),
        trace.with_slopes(options.surface) if len(trace) else trace,
    )
    if len(trace) and resolves_per_turn_waves(trace):
        kept = scan_fields(budget.fields, traced.every, budget.bounds)
        save_fields(out / SYSTEMATIC, kept)
    return budget.entry()


# Beyond this a pose is not linear, and the surface is moved before the scan is adjusted.
_SMALL_ANGLE_RAD, _SMALL_SHIFT_M = 1e-4, 1e-5


def add_verdict(
    summary: dict[str, Any],
    done: Correction,
    calibration: Calibration,
    options: CorrectionOptions,
    stated: MachineSources,
    accuracy: float | None,
    register: RegistrationOptions | None,
) -> None:
    """Add ``verdict`` and ``figures`` of a single scan to its summary: its adjustment alone.

    options: of the correction;  stated: uncertainty sources of the machine
    accuracy: required expanded uncertainty, k = 2 [m]
    register: aperture and tolerance of the registration, if there was one

    The pose that ``summary["form"]`` aligned is removed; without it piston, tip and tilt. A scan
    that is no spiral is not adjusted: its heights are not verified, and its figures are those of
    the registration.
    """
    scan, form, nominal = done.scan, summary.get("form"), options.surface
    tolerance = None if register is None else register.tolerance
    area = None
    if register is not None and nominal is not None:
        _, area = within_aperture(nominal, register.aperture)
    if scan is not None and area is not None:
        try:
            scan = within(scan, area)
        except DataError:
            scan = None
    doubts: list[str] = []
    if nominal is not None:
        x, y = (done.points[name].astype(np.float64) for name in "xy")
        doubts += map(str, mismatch(x, y, done.points["height"], nominal))
    doubts += done.faults
    doubts += map(str, _losses(done))
    if scan is None or not scan.is_spiral:
        systematic = summary["budget"]["systematic"]
        verdict = untested_verdict(2 * systematic, accuracy, calibration)
        if form is not None:
            summary["figures"] = registered_figures(form)
    else:
        found = adjust(
            [scan],
            priors_of(stated, options.geometry.abbe_arm),
            calibration=calibration,
            nominal=nominal if form is None or nominal is None else _posed(nominal, form),
            accuracy=accuracy,
            removed=POSE if form is None else _aligned(form["removed"]),
        )
        verdict = found.verdict
        if nominal is not None:
            summary["figures"] = figures_entry(found.form)
    if tolerance is not None and (figures := summary.get("figures")):
        summary["conformity"] = conformity_entry(figures, tolerance, (form or {}).get("open", ()))
    summary["verdict"] = verdict_entry(verdict, doubts=doubts)


def untested_verdict(expanded: float, accuracy: float | None, calibration: Calibration) -> Verdict:
    """Return the verdict on heights of one scan that was not adjusted.

    expanded: uncertainty of the heights, k = 2 [m];  accuracy: asked for [m], None: none
    """
    return verdict_of((), (), (), False, expanded, accuracy, lambda: (OTHER_SPEED, np.nan),
                      calibration)  # fmt: skip


# Degrees of freedom that an adjustment can remove; all of a pose, but no power.
_DOFS = ("piston", "tip", "tilt", "x", "y", "clocking")


def _aligned(removed: Mapping[str, Any]) -> list[str]:
    """Return the pose parameters whose uncertainty shall not make that of form larger."""
    every = {*removed["fitted"], *removed["held"], *removed["not_determined"]}
    return [name for name in _DOFS if name in every]


def _posed(nominal: Surface, form: Mapping[str, Any]) -> Surface:
    """Return the surface in the shape and pose that were found; a small pose is left out."""
    pose, shape = form["pose"], form.get("shape", {})
    nominal = with_parameters(nominal, {name: v["value"] for name, v in shape.items()})
    found = Pose(**{name: float(pose[name]["value"] or 0.0) for name in _DOFS})
    angles, shifts = (found.tip, found.tilt, found.clocking), (found.x, found.y)
    small = max(map(abs, angles)) < _SMALL_ANGLE_RAD and max(map(abs, shifts)) < _SMALL_SHIFT_M
    return nominal if small else PosedSurface(nominal, found)


def live_verdict(
    corrector: Corrector, calibration: Calibration, stated: MachineSources, accuracy: float | None
) -> dict[str, Any]:
    """Return the verdict on the points so far, and their uncertainty (k = 2, rms) [m]."""
    shared = [size for name, size in corrector.budget.items() if name not in RANDOM]
    expanded = 2 * sum(size**2 for size in shared) ** 0.5
    noise = excess_noise(corrector.budget)
    doubts = [str(noise)] if noise else []
    lateral = {
        s.name for s in stated.scan_sources() if s.kind.needs_slope and s.standard_uncertainty
    }
    missing = sorted(lateral - set(corrector.budget))
    if missing and corrector.trace.seen:
        doubts.append(
            f"{', '.join(missing)} not in the uncertainty of the points: slopes are unknown; give "
            "the corrector the part's surface (parameter 'nominal')"
        )
    verdict = untested_verdict(expanded, accuracy, calibration)
    return verdict_entry(verdict, doubts=doubts) | {"uncertainty": expanded}


def _losses(done: Correction) -> Iterator[str | Notice]:
    if (noise := excess_noise(done.budget)) is not None:
        yield noise
    for text in done.reasons:
        yield (
            f"the calibration was used although {text}; identify with the settings of the scan, "
            "and correct with that calibration"
        )
    account = done.account.as_dict()
    if beyond := account["axes"]["counted"].get("beyond"):
        yield (
            f"{beyond} samples lie beyond the range of the calibration set; calibrate there, too, "
            "and make a new set with 'omsm calset'"
        )
    for name, stream in account.items():
        lost = stream["received"] - stream["corrected"]
        if lost > (1 - _LEAST_SHARE_CORRECTED) * stream["received"]:
            share = 100 * lost / stream["received"]
            yield (
                f"{name}: {lost} samples ({share:.1f} %) gave no point; see the account of the "
                "samples; scan slower if the probe lost its target"
            )


def measure(
    bag: AnyBag,
    calibration: Calibration,
    out: Path,
    *,
    nominal: Surface | None = None,
    options: CorrectionOptions | None = None,
    admission: Admission = STRICT,
    lateral: float = 0.0,
    by_stamps: StampJoining | None = None,
    stated: MachineSources = NOTHING_STATED,
    accuracy: float | None = None,
    register: RegistrationOptions | None = None,
    report: bool = True,
    origin: Mapping[str, Any] = MappingProxyType({}),
) -> dict[str, Any]:
    """Correct ``bag`` into ``out``: cloud.ply, summary.json, report.html; return the summary.

    Also writes systematic.npz, the fields of the systematic errors, for ``omsm form``.

    lateral: standard uncertainty of x and y [m]; needs ``nominal`` for the slope
    by_stamps: see :func:`omsm_ros.pipelines.correct.correct_bag`
    stated: uncertainty sources;  accuracy: required expanded uncertainty, k = 2 [m]
    register: options of a registration to ``nominal``, or None;  report: False writes no report
    origin: entries of the report's title block

    Raises CalibrationError for a calibration that does not match the scan, unless overridden.
    """
    used = with_sources(options or CorrectionOptions(), calibration, stated, nominal)
    done = correct_bag(
        bag, calibration, out / CLOUD, options=used, admission=admission, nominal=nominal,
        lateral=lateral, by_stamps=by_stamps,
    )  # fmt: skip
    summary = _summarise(bag, done, calibration, used, stated, out)
    summary["settings"] |= admission.settings or {}
    if done.statistics:
        if register is not None and nominal is not None:
            # Imported on demand, because most corrections do not register.
            from omsm_ros.pipelines.form import judge_form, open_measurement

            how = replace(register, tolerance=None)
            form = judge_form(open_measurement(out), nominal, out, how)
            summary["form"] = {name: form[name] for name in _OF_FORM}
            summary["files"] |= {"form": FORM, "deviation": DEVIATION}
        add_verdict(summary, done, calibration, used, stated, accuracy, register)
    summary |= {"origin": dict(origin)} if origin else {}
    if report:
        summary["files"]["report"] = REPORT
        # Imported on demand, because loading the figures takes longer than correcting a scan.
        from omsm_ros.pipelines.publish import publish_scan

        publish_scan(out, summary, calibration, nominal, done.points)
    save_json(out / SUMMARY, summary)
    return summary


# Entries of the registration that the summary keeps.
_OF_FORM = ("pose", "shape", "deviation", "removed", "points", "open")


def _summarise(
    bag: AnyBag, done: Correction, calibration: Calibration, options: CorrectionOptions,
    stated: MachineSources, out: Path,
) -> dict[str, Any]:  # fmt: skip
    """Return the content of ``summary.json``; lengths in metres."""
    places: dict[str, Any] = {}
    if isinstance(calibration, CalibrationSet):
        at = {"along": calibration.along, "positions": list(calibration.positions)}
        places = {"calibration_set": at}
    summary: dict[str, Any] = {
        "schema": "omsm-summary/2",
        "bag": str(bag),
        "calibration": calibration.id,
        **places,
        "samples": done.account.as_dict(),
        "uncertainty_budget": done.budget,
        "sample_period": done.sample_period,
        "stamp_skew": done.corrector.pairing.stamp_skew,
        "conditions": conditions(done, calibration),
        "settings": dict(calibration.settings),
        "latency": latency_summary(calibration.latency),
        "versions": {
            "omsm_ros": __version__,
            "python": platform.python_version(),
            **{name: metadata.version(name) for name in ("numpy", "scipy", "rosbags")},
        },
        "files": {"cloud": CLOUD, "summary": SUMMARY},
        "admission": done.admitted,
        "warnings": [*(f"overridden: {reason}" for reason in done.reasons)],
    }
    if lost := int(np.sum(~np.isfinite(done.temperatures))):
        summary["warnings"].append(
            f"{lost} of {len(done.temperatures)} temperatures are implausible, expected "
            f"{TEMPERATURE.range_text}; {TEMPERATURE.remedy}"
        )
    if not done.statistics:
        summary["warnings"] += [*done.faults, "no sample could be corrected; see the account"]
        return summary
    judged = _motion_judged(done, calibration)
    summary["warnings"] += judged.pop("warnings")
    if (late := excess_latency_text(calibration, options.probe_latency or 0.0)) is not None:
        summary["warnings"].append(str(late))
    of_filter = judged.get("discretisation", {}).get("rms", 0.0)
    budget = _budget(done, calibration, options, stated, of_filter, out)
    return summary | judged | _figures_of_merit(done) | {"budget": budget}


def conditions(done: Correction, calibration: Calibration) -> dict[str, Any]:
    """Return time of the scan, age of its calibration [s], temperatures [°C]; None if unknown."""
    valid_temperatures = done.temperatures[np.isfinite(done.temperatures)]
    return {
        "recorded_ns": done.recorded_ns,
        "calibration_age": age_at(calibration, done.recorded_ns),
        "temperature": None
        if not len(valid_temperatures)
        else {
            "mean": float(np.mean(valid_temperatures)),
            "lowest": float(np.min(valid_temperatures)),
            "highest": float(np.max(valid_temperatures)),
            "change": float(valid_temperatures[-1] - valid_temperatures[0]),
        },
    }


def _motion_judged(done: Correction, calibration: Calibration) -> dict[str, Any]:
    """Return the predicted error of the scan's motion, and that of the digital filter on it."""
    try:
        prediction = predict_error(calibration, done.path)
        digital = discretise(calibration.dynamics, done.sample_period)
        rms, spread = discretisation_error(
            calibration.dynamics, digital, done.path.z, calibration.valid_up_to
        )
    except DataError as err:
        return {"warnings": [f"the motion could not be evaluated: {err}"]}
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
