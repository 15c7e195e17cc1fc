"""Commands for the form of a part: form, compensate, surface."""

from __future__ import annotations

import argparse
from pathlib import Path

from omsm_ros import quantities
from omsm_ros.cli.arguments import UNIT, add_bags, cell_of, number, refuse_cell
from omsm_ros.cli.command import CliCommand, Facts, progress_bar, table, written
from omsm_ros.cli.fit_option import declare_fit, declare_tolerance, form_rows
from omsm_ros.core.kinematics.limits import MachineLimits
from omsm_ros.core.registration.pose_parameters import AUTO
from omsm_ros.io.calibration_file import load_calibration
from omsm_ros.io.descriptions import load_limits, load_surface
from omsm_ros.io.files import CURVES, DEVIATION, FORM, REPORT
from omsm_ros.io.folders import FORM_FILES, MEASUREMENT_FILES, result_folder
from omsm_ros.pipelines.form import draw_form, judge_form, open_measurement
from omsm_ros.pipelines.surface_tools import COMPENSATION, PATH, Scan, compensate_form, show_surface
from omsm_ros.readable import count, plain, quantity
from omsm_ros.units import DEGREE_RAD


def _declare_form(sub: argparse.ArgumentParser) -> None:
    add_bags(sub, "measured", help="result folder, cloud or map; or a scan with --calibration")
    sub.add_argument("--nominal", type=Path, required=True, metavar="SURFACE.yaml")
    sub.add_argument("--out", type=Path, required=True, metavar="DIR")
    sub.add_argument(
        "--calibration", type=Path, metavar="CAL.json", help="calibration to correct a scan with"
    )
    sub.add_argument("--unit", **UNIT)
    declare_fit(sub, (AUTO,))
    declare_tolerance(sub)
    sub.add_argument("--no-report", action="store_true", help="write results without a report")
    for name, what in (("s", "shorter"), ("l", "longer")):
        sub.add_argument(
            f"--{name}-filter",
            type=number(quantities.SPACING),
            metavar="WAVELENGTH",
            help=f"remove {what} wavelengths from the texture [m] (ISO 25178)",
        )


def _form(args: argparse.Namespace) -> Facts:
    surface, filters = load_surface(args.nominal), (args.s_filter, args.l_filter)
    with result_folder(args.out, MEASUREMENT_FILES if args.calibration else FORM_FILES) as out:
        source = args.measured
        if args.calibration:
            # Imported on demand, because it takes longer to load than many forms to evaluate.
            from omsm_ros.pipelines.measure import measure

            calibration = load_calibration(args.calibration)
            with progress_bar("correcting", args.json) as progress:
                bag = cell_of(source, args)
                measure(bag, calibration, out, nominal=surface, report=False, progress=progress)
            source = out
        else:
            refuse_cell(source, args)
        points = open_measurement(source, args.unit)
        facts = judge_form(points, surface, out, args.fit, args.aperture, filters, args.tolerance)
        if not args.no_report:
            draw_form(source, out)
            facts = {**facts, "report": REPORT}
    return {**facts, "out": str(args.out)}


def _show_form(facts: Facts) -> None:
    verdict = []
    if held := facts.get("conformity"):
        verdict = [("tolerance", f"{held['verdict']}, {quantity(held['tolerance'], 'm')}")]
    files = [FORM, CURVES, DEVIATION, *([facts["report"]] if "report" in facts else [])]
    table([*verdict, *form_rows(facts), written(files, facts["out"])])


def _declare_compensate(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("measured", type=Path, help="result folder, cloud or map")
    sub.add_argument("--nominal", type=Path, required=True, metavar="SURFACE.yaml")
    sub.add_argument(
        "--low-pass",
        type=number(quantities.SPACING),
        required=True,
        metavar="WAVELENGTH",
        help="cutoff wavelength, of which half is compensated [m]; shorter waves remain",
    )
    sub.add_argument("--out", type=Path, required=True, metavar="DIR")
    sub.add_argument("--unit", **UNIT)
    sub.add_argument(
        "--spiral",
        type=number(quantities.SPACING),
        metavar="FEED",
        help=f"feed per turn of the next cut [m]: write {PATH}, G-code of Z offsets over X, C",
    )
    sub.add_argument(
        "--per-turn",
        type=number(quantities.SPIRAL_PLACES),
        default=360,
        help="points per turn of the spiral",
    )
    declare_fit(sub, (AUTO,))


def _compensate(args: argparse.Namespace) -> Facts:
    surface = load_surface(args.nominal)
    spiral = (args.spiral, int(args.per_turn)) if args.spiral else None
    with result_folder(args.out, (COMPENSATION, PATH)) as out:
        points = open_measurement(args.measured, args.unit)
        facts = compensate_form(
            points, surface, out, args.low_pass, args.fit, args.aperture, spiral
        )
    return {**facts, "out": str(args.out)}


def _show_compensate(facts: Facts) -> None:
    lengths = ("rms_before", "rms_after", "largest_offset", "largest_uncertainty", "low_pass")
    rows = [(name.replace("_", " "), quantity(facts[name], "m")) for name in lengths]
    rows += [("warning", text) for text in facts["warnings"]]
    rows += [("not evaluated", text) for text in facts["not_evaluated"]]
    rows.append(("points", count(facts["places"])))
    files = [facts["file"]]
    if "path" in facts:
        rows.append(("points on the spiral", count(facts["path_places"])))
        files.append(facts["path"])
    table([*rows, ("sign", facts["sign"]), written(files, facts["out"])])


def _declare_surface(sub: argparse.ArgumentParser) -> None:
    sub.add_argument(
        "what",
        choices=("show",),
        help="show: extent, slopes, and whether probe and axes can follow",
    )
    sub.add_argument("surface", type=Path, metavar="SURFACE.yaml")
    radius, speed = number(quantities.STEP), number(quantities.SPEED)
    sub.add_argument("--radius", type=radius, required=True, help="radius of the disc [m]")
    sub.add_argument(
        "--feed", type=number(quantities.FEED), default=1e-4, help="feed per turn of the spiral [m]"
    )
    sub.add_argument("--rpm", type=speed, default=30.0, help="spindle speed [rpm]")
    sub.add_argument(
        "--limits", type=Path, metavar="LIMITS.yaml", help="machine limits, as of 'omsm predict'"
    )
    sub.add_argument(
        "--probe-angle",
        type=number(quantities.PROBE_ANGLE),
        help="largest angle to the surface normal at which the probe reads [rad]",
    )
    sub.add_argument("--out", type=Path, metavar="DIR", help="folder for a figure")


def _surface(args: argparse.Namespace) -> Facts:
    limits = load_limits(args.limits) if args.limits else MachineLimits()
    scan = Scan(args.radius, args.feed, args.rpm)
    facts = show_surface(load_surface(args.surface), scan, limits, args.probe_angle, args.out)
    where = {"out": str(args.out)} if args.out is not None else {}
    return {"surface": str(args.surface), **facts, **where}


_FOLLOWS = {True: "can follow", False: "CANNOT follow", None: "not evaluated"}


def _show_surface(facts: Facts) -> None:
    x, y = (quantity(part, "m") for part in facts["steepest_at"])
    angle = f"{plain(facts['steepest_angle'] / DEGREE_RAD)}°"
    drawn = [written([facts["figure"]], facts["out"])] if "figure" in facts else []
    table(
        [
            ("peak to valley", quantity(facts["peak_to_valley"], "m")),
            ("steepest", f"{angle} at x = {x}, y = {y}"),
            ("probe", _FOLLOWS[facts["probe_can_follow"]]),
            ("axes", _FOLLOWS[facts["axes_can_follow"]]),
            *((f"  {limit['name']}", f"{quantity(limit['value'], limit['unit'])} of "
               f"{quantity(limit['allowed'], limit['unit'])}") for limit in facts["limits"]),
            ("not evaluated", ", ".join(facts["not_evaluated"])),
            *drawn,
        ]
    )  # fmt: skip


COMMANDS = (
    CliCommand("form", _declare_form, _form, _show_form),
    CliCommand("compensate", _declare_compensate, _compensate, _show_compensate),
    CliCommand("surface", _declare_surface, _surface, _show_surface),
)
