"""Commands that analyse measurements: difference, spectrum, export."""

from __future__ import annotations

import argparse
from pathlib import Path

from omsm_ros import quantities
from omsm_ros.cli.arguments import (
    OVERRIDE,
    UNIT,
    add_bags,
    add_polarity,
    cell_of,
    json_object,
    number,
)
from omsm_ros.cli.command import CliCommand, Facts, progress_bar, say, table, written
from omsm_ros.cli.fit_option import dofs
from omsm_ros.core.comparison.matching import MATCHING_PARAMETERS, SEATED, ordered_dofs
from omsm_ros.errors import ConfigurationError
from omsm_ros.io.calibration_file import load_calibration
from omsm_ros.io.descriptions import load_surface
from omsm_ros.io.files import DIFFERENCE, REPORT
from omsm_ros.io.folders import result_folder
from omsm_ros.readable import count, figure, percent, plain, quantity


def _dof_argument(text: str) -> tuple[str, ...]:
    """Parse the degrees of freedom in which the second measurement is moved onto the first."""
    if text == "auto":
        return tuple(name for name in MATCHING_PARAMETERS if name != "power")
    try:
        return ordered_dofs(tuple(filter(None, text.split(","))))
    except ConfigurationError as err:
        raise argparse.ArgumentTypeError(str(err)) from err


def _declare_difference(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("a", type=Path, help="a result folder, a cloud or a map of any format")
    sub.add_argument("b", type=Path, help="another of the same part, moved onto the first")
    sub.add_argument("--out", type=Path, required=True, metavar="DIR")
    sub.add_argument(
        "--fit",
        type=_dof_argument,
        default=SEATED,
        metavar="PARAMETERS",
        help=f"pose parameters to fit, of {','.join(MATCHING_PARAMETERS)}; 'auto': all but power "
        f"that the surface determines; default {','.join(SEATED)}",
    )
    sub.add_argument(
        "--nominal", type=Path, metavar="SURFACE.yaml", help="surface to subtract from both first"
    )
    sub.add_argument(
        "--register",
        type=dofs,
        metavar="PARAMETERS",
        help="register each to the nominal surface first, as 'omsm form' does: 'auto', or of "
        "piston,tip,tilt,x,y,clocking,power",
    )
    sub.add_argument(
        "--uncertainty",
        type=number(quantities.UNCERTAINTY),
        help="standard uncertainty of the heights of a file that states none [m]",
    )
    sub.add_argument(
        "--drift",
        type=number(quantities.UNCERTAINTY),
        help="standard deviation of the drift at the end of a scan [m]; default: from its sources, "
        "or estimated from the difference",
    )
    sub.add_argument("--unit", **UNIT)
    sub.add_argument(
        "--spacing", type=number(quantities.SPACING), help="spacing of the compared grid [m]"
    )
    sub.add_argument(
        "--correlation-length",
        type=number(quantities.SPACING),
        help="correlation length of errors of unknown form [m]; default: half the radius",
    )


def _difference(args: argparse.Namespace) -> Facts:
    # Imported on demand, because the other commands here do not compare.
    from omsm_ros.pipelines.compare_measurements import (
        MAP,
        ComparisonOptions,
        compare_measurements,
        write_difference,
    )

    if args.register and args.nominal is None:
        raise ConfigurationError("--register needs the surface; give --nominal SURFACE.yaml")
    options = ComparisonOptions(
        dofs=args.fit,
        uncertainty=args.uncertainty,
        drift=args.drift,
        units=args.unit,
        spacing=args.spacing,
        length=args.correlation_length,
        register=args.register,
    )
    nominal = load_surface(args.nominal) if args.nominal else None
    found, facts = compare_measurements(args.a, args.b, options, nominal)
    with result_folder(args.out, (MAP, REPORT, DIFFERENCE)) as out:
        write_difference(out, found, facts)
    files = {"difference": DIFFERENCE, "map": MAP, "report": REPORT}
    return {**facts, "files": files, "out": str(args.out)}


def _show_difference(facts: Facts) -> None:
    found = facts["difference"]
    rows = [("verdict", facts["verdict"])]
    rows += [("because", text) for text in facts["reasons"]]
    rows += [("but", text) for text in facts["reservations"]]
    rows += [
        ("difference", f"{_length(found['peak_to_valley'])} PV, "
                       f"{_length(found['robust_peak_to_valley'])} PV of 99.5 %, "
                       f"{_length(found['rms'])} rms"),
        ("uncertainty", "not evaluated" if found["uncertainty"] is None else
                        f"{_length(found['uncertainty'])} rms (k = 1)"),
        ("grid", f"{count(found['places'])} places, {_length(facts['resampling']['spacing'])} "
                 f"apart, on {percent(found['shared_area'], 3)} of the smaller area"),
    ]  # fmt: skip
    for name, n in facts["e_n"].items():
        words = (
            "not evaluated"
            if n["e_n"] is None
            else f"{plain(n['e_n'])} (U {_length(n['expanded'])})"
        )
        label = f"E_n of {figure(name)}"
        rows.append((label, f"{words}: {_length(n['a'])} and {_length(n['b'])}"))
    if facts["within"] is not None:
        rows.append(("points", f"|E_n| < 1 on {percent(facts['within'], 3)} of the area"))
    for name in ("a", "b"):
        rows += [(f"note on {name.upper()}", text) for text in facts[name]["notes"]]
    table([*rows, written(facts["files"].values(), facts["out"])])


def _length(value: float) -> str:
    return quantity(value, "m", 4)


def _declare_spectrum(sub: argparse.ArgumentParser) -> None:
    add_bags(sub, "scans", nargs="+", metavar="SCAN", help="bags of one part")
    sub.add_argument(
        "--calibration", type=Path, metavar="CAL.json", help="correct the scans with it first"
    )
    sub.add_argument("--out", type=Path, required=True, metavar="DIR")
    sub.add_argument(
        "--nominal", type=Path, metavar="SURFACE.yaml", help="surface to subtract first"
    )
    sub.add_argument(
        "--stop",
        type=number(quantities.FREQUENCY),
        nargs=2,
        action="append",
        default=[],
        metavar=("FROM_HZ", "TO_HZ"),
        help="remove this band from the heights, with zero phase; may be repeated",
    )
    sub.add_argument("--settings", type=json_object, metavar="JSON", help="settings of these scans")
    add_polarity(sub)
    sub.add_argument("--no-report", action="store_true", help="write results without a report")
    sub.add_argument("--override", action="store_true", help=OVERRIDE)


def _spectrum(args: argparse.Namespace) -> Facts:
    # Imported on demand, because the other commands here do not read scans.
    from omsm_ros.pipelines.correct import Admission
    from omsm_ros.pipelines.publish import publish_spectra
    from omsm_ros.pipelines.spectrum import SpectrumOptions

    options = SpectrumOptions(
        calibration=load_calibration(args.calibration) if args.calibration else None,
        admission=Admission(args.settings, args.override),
        nominal=load_surface(args.nominal) if args.nominal else None,
        stop=tuple((low, high) for low, high in args.stop),
        polarity=args.polarity,
    )
    with progress_bar("reading", args.json) as progress:
        bags = [cell_of(path, args) for path in args.scans]
        facts = publish_spectra(
            bags, options, args.out, report=not args.no_report, progress=progress
        )
    return {**facts, "out": str(args.out)}


def _show_spectrum(facts: Facts) -> None:
    for scan in facts["scans"]:
        say(f"{scan['name']}: {scan['samples']['analysed']} points, "
              f"{quantity(scan['noise']['rms'], 'm')} rms without its lines")  # fmt: skip
        table([_peak_row(peak) for peak in scan["peaks"]] or [("", "no line beyond 3 σ")])
        if stopped := scan["band_stop"]:
            say(f"band stop, zero phase: {quantity(stopped['rms_before'], 'm')} → "
                  f"{quantity(stopped['rms_after'], 'm')} rms")  # fmt: skip
    table([written(facts["files"].values(), facts["out"])])


def _peak_row(peak: Facts) -> tuple[str, str]:
    where = quantity(peak["frequency"], "Hz", 5)
    if peak["frequency"] is None:
        where = quantity(peak["wavelength_along_path"], "m", 4)
    true = peak["true_frequency"]
    what = f"{peak['kind']} ({quantity(true, 'Hz', 5)})" if true else peak["kind"]
    if peak["true_wavelength"]:
        what += f" ({quantity(peak['true_wavelength'], 'm', 4)})"
    why = "; ".join([*peak["evidence"], *([peak["needs"]] if peak["needs"] else [])])
    size = quantity(peak["amplitude"], "m")
    return f"  {where}", f"{size}, {plain(peak['significance'])} σ: {what}: {why}"


def _declare_export(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("source", type=Path, help="a result folder, a cloud or a map of any format")
    sub.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="FILE",
        help="points: .csv .xyz .h5 .ply .pcd; a map: .x3p, .dat (grid sag)",
    )
    sub.add_argument("--unit", **UNIT)
    sub.add_argument(
        "--spacing", type=number(quantities.SPACING), help="grid spacing for scattered points [m]"
    )


def _export(args: argparse.Namespace) -> Facts:
    # Imported on demand, because the other commands here do not export.
    from omsm_ros.pipelines.export_points import export

    return {"source": str(args.source), **export(args.source, args.out, args.unit, args.spacing)}


def _show_export(facts: Facts) -> None:
    rows = [("points", count(facts["points"]))]
    if "resampling" in facts:
        spacing = " × ".join(quantity(part, "m", 4) for part in facts["spacing"])
        rows += [
            ("map", f"{facts['columns']} × {facts['rows']} pixels of {spacing}, "
                    f"{count(facts['missing'])} without a height"),
            ("resampling", facts["resampling"]),
            ("resampling error", f"at most {quantity(facts['interpolation_error'], 'm', 2)} rms"),
        ]  # fmt: skip
    table([*rows, written([facts["file"]])])


COMMANDS = (
    CliCommand("difference", _declare_difference, _difference, _show_difference),
    CliCommand("spectrum", _declare_spectrum, _spectrum, _show_spectrum),
    CliCommand("export", _declare_export, _export, _show_export),
)
