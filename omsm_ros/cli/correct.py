"""Commands for a scan: predict, correct, report."""

import argparse
from argparse import SUPPRESS
from dataclasses import asdict

from omsm_ros.cli.arguments import (
    TABLE_SUFFIX,
    TRIGGER,
    Arguments,
    cell_of,
    json_object,
    refuse_cell,
    trigger_of,
)
from omsm_ros.cli.command import LIMIT, CliCommand, Facts, Rows, written
from omsm_ros.cli.fit_option import declare_fit, declare_tolerance, form_rows, registration_of
from omsm_ros.core.correction.correct import CorrectionOptions
from omsm_ros.core.correction.machine_sources import MachineSources, declared_sources
from omsm_ros.core.correction.predict import DEFAULT_BUDGET_M, predict_error
from omsm_ros.core.kinematics.limits import FASTEST
from omsm_ros.errors import ConfigurationError
from omsm_ros.io import json_and_yaml
from omsm_ros.io.calibration_file import load_calibration
from omsm_ros.io.descriptions import (
    load_geometry,
    load_limits,
    load_pitch,
    load_sources,
    load_surface,
)
from omsm_ros.io.files import MEASUREMENT_FILES, result_folder
from omsm_ros.messages import rows_from, text_from
from omsm_ros.pipelines.correct import Admission, StampJoining
from omsm_ros.pipelines.history import keep_measurement, record_in_catalogue
from omsm_ros.pipelines.measure import measure
from omsm_ros.pipelines.recording import scan_path_of
from omsm_ros.quantities import BUDGET, EXPOSURE, LAG, STAMP_DELAY, UNCERTAINTY
from omsm_ros.readable import plain, rounded_down
from omsm_ros.report.verdict import headline, next_steps


def sources_of(text: str | None) -> MachineSources:
    """Return the uncertainty sources of the machine, from a file or from JSON text."""
    if text is not None and text.lstrip().startswith("{"):
        return declared_sources(json_and_yaml.object_of(text, ConfigurationError, "--sources"))
    return load_sources(text)


def _declare_correct(add: Arguments) -> None:
    add.bags("bag")
    add("--calibration", "CAL.json", required=True)
    add("--out", "DIR", required=True)
    add("--nominal", "SURFACE.yaml")
    add("--geometry", "GEOMETRY.yaml", "from 'omsm align'")
    add("--pitch", "PITCH.csv")
    add("--probe-latency", LAG)
    add("--lateral-lag", LAG, SUPPRESS, dest="probe_latency")  # its former name
    add("--sources", str, metavar="SOURCES.yaml")
    add("--accuracy", BUDGET)
    add("--lateral", UNCERTAINTY, "standard uncertainty of x and y [m]", default=0.0)
    add("--settings", json_object, "settings of this scan", metavar="JSON")
    add("--delay", STAMP_DELAY, default=0.0)
    add("--exposure", EXPOSURE, "exposure time of the probe [s]", default=0.0)
    add.shared(*TRIGGER)
    add("--no-report", None, "write cloud and summary only")
    add.shared("--polarity", "--override", "--origin")
    declare_fit(add, None)
    declare_tolerance(add)
    add.catalogue()


def _check_options(args: argparse.Namespace) -> None:
    """Raise ConfigurationError for options that need others."""
    if args.fit and args.nominal is None:
        raise ConfigurationError("--fit needs the nominal surface; give --nominal SURFACE.yaml")
    if args.lateral and args.nominal is None:
        raise ConfigurationError(
            "--lateral needs the slope of the surface; give --nominal SURFACE.yaml"
        )
    if args.tolerance and not args.fit:
        raise ConfigurationError("--tolerance needs the pose of the part removed; give --fit auto")
    if (args.aperture or args.placement) and not args.fit:
        raise ConfigurationError("--aperture and --placement limit the fit; give --fit auto")
    if (args.delay or args.exposure) and not args.by_stamps:
        raise ConfigurationError(
            "--delay and --exposure apply to stamps only; give --by-stamps, or leave them out"
        )


def _correct(args: argparse.Namespace) -> Facts:
    calibration = load_calibration(args.calibration)
    nominal = load_surface(args.nominal, args.fit or ()) if args.nominal else None
    _check_options(args)
    options = CorrectionOptions(
        polarity=args.polarity,
        accept_other_rate=args.override,
        probe_latency=args.probe_latency,
        geometry=load_geometry(args.geometry),
        pitch=load_pitch(args.pitch) if args.pitch else None,
        trigger=trigger_of(args),
    )
    if options.pitch is not None and not options.geometry.abbe_arm:
        raise ConfigurationError(
            "--pitch has no effect without an Abbe arm; give abbe_arm in --geometry GEOMETRY.yaml"
        )
    with result_folder(args.out, MEASUREMENT_FILES) as out:
        summary = measure(
            cell_of(args.bag, args),
            calibration,
            out,
            nominal=nominal,
            options=options,
            admission=Admission(args.settings, args.override),
            lateral=args.lateral,
            by_stamps=StampJoining(args.delay, args.exposure) if args.by_stamps else None,
            stated=sources_of(args.sources),
            accuracy=args.accuracy,
            register=registration_of(args) if args.fit else None,
            report=not args.no_report,
            origin=args.origin,
        )
    warnings = record_in_catalogue(
        args.catalogue, lambda: keep_measurement(args.catalogue, args.out, args.bag)
    )
    warnings = [*summary["warnings"], *warnings]
    return {**summary, "warnings": warnings, "out": str(args.out)}


def _show_correct(summary: Facts) -> Rows:
    rows = []
    for stream, account in summary["samples"].items():
        reasons = "".join(f", {count} {name}" for name, count in account["counted"].items())
        text = f"{account['received']} received, {account['corrected']} corrected{reasons}"
        rows.append((stream, text))
    if summary.get("figures"):
        rows.append(("form deviation", headline(summary)))
        reasons = (summary.get("conformity") or {}).get("reasons", ())
        rows += [("reason", text) for text in reasons]
    if verdict := summary.get("verdict"):  # absent if no sample was corrected
        rows.append(("verdict", verdict["text"]))
        rows += [("", text) for text in next_steps(verdict)]
    rows += [("warning", text) for text in summary.get("warnings", [])]
    if "form" in summary:
        rows += form_rows(summary["form"], summary.get("figures"))
    return [*rows, written(summary["files"].values(), summary["out"])]


def _declare_predict(add: Arguments) -> None:
    add.bags("motion", help="a bag, or a planned motion as CSV time_s,z_m")
    add("--calibration", "CAL.json", required=True)
    add("--budget", BUDGET, "allowed residual error, k = 2 [m]", default=DEFAULT_BUDGET_M)
    add("--limits", "LIMITS.yaml")


def _predict(args: argparse.Namespace) -> Facts:
    calibration = load_calibration(args.calibration)
    if args.motion.suffix.lower() == TABLE_SUFFIX:
        refuse_cell(args.motion, args)
    path = scan_path_of(cell_of(args.motion, args))
    return asdict(predict_error(calibration, path, args.budget, load_limits(args.limits)))


_PREDICTED = {
    "dynamic error": "{peak_to_valley:m/4} PV, {rms:m/4} rms",
    "after correction": "{residual:m} (k = 1)",
    "  undetected model error": "{residual_undetected:m}",
    "Z above the valid band": "{outside_band_rms:m/2} rms, noise of the encoder included",
}


def _show_predict(facts: Facts) -> Rows:
    return [
        ("verdict", "safe" if facts["safe"] else "NOT safe"),
        *rows_from(facts, _PREDICTED),
        ("maximum speed", f"{_times(facts['speed_factor'])} this motion, limited by "
                          f"{facts['binding']}"),
        *((f"  limit: {one['name']}", text_from(LIMIT, one)
           + f", maximum speed {_times(one['speed_factor'])}") for one in facts["limits"]),
        ("not evaluated", ", ".join(facts["not_evaluated"]) or "nothing"),
        *((name, facts[key]) for name, key in (("not judged", "left_out"), ("advice", "advice"))
          if facts[key]),
    ]  # fmt: skip


def _times(factor: float) -> str:
    return f"{'≥ ' if factor >= FASTEST else ''}{plain(rounded_down(factor))} ×"


def _declare_report(add: Arguments) -> None:
    add("result", "DIR", "result folder of 'omsm correct'")
    add("--calibration", "CAL.json", required=True)
    add("--nominal", "SURFACE.yaml", "nominal surface of the correction")


def _report(args: argparse.Namespace) -> Facts:
    # Imported on demand, because loading the figures takes a second.
    from omsm_ros.pipelines.publish import report_again

    nominal = load_surface(args.nominal) if args.nominal else None
    page = report_again(args.result, load_calibration(args.calibration), nominal)
    return {"report": str(page)}


COMMANDS = (
    CliCommand("predict", _declare_predict, _predict, _show_predict),
    CliCommand("correct", _declare_correct, _correct, _show_correct),
    CliCommand("report", _declare_report, _report, lambda facts: [written([facts["report"]])]),
)
