"""Commands about ripple: spectrum."""

from __future__ import annotations

import argparse
from pathlib import Path

from omsm_ros import quantities
from omsm_ros.cli.arguments import add_bags, add_polarity, cell_of, json_object, number
from omsm_ros.cli.command import CliCommand, Facts, progress_bar, say, table, written
from omsm_ros.io.calibration_file import load_calibration
from omsm_ros.io.descriptions import load_surface
from omsm_ros.pipelines.correct import Admission
from omsm_ros.readable import plain, quantity


def _declare_spectrum(sub: argparse.ArgumentParser) -> None:
    add_bags(sub, "scans", nargs="+", metavar="SCAN", help="bags of one part")
    sub.add_argument("--calibration", type=Path, metavar="CAL.json", help="to correct with")
    sub.add_argument("--out", type=Path, required=True, metavar="DIR")
    sub.add_argument("--nominal", type=Path, metavar="SURFACE.yaml", help="taken off before")
    sub.add_argument(
        "--stop",
        type=number(quantities.FREQUENCY),
        nargs=2,
        action="append",
        default=[],
        metavar=("FROM_HZ", "TO_HZ"),
        help="take this band out of the heights, without phase; may be repeated",
    )
    sub.add_argument("--settings", type=json_object, metavar="JSON", help="of these scans")
    add_polarity(sub)
    sub.add_argument("--no-report", action="store_true", help="results only")
    sub.add_argument(
        "--override", action="store_true", help="use a calibration that does not belong; recorded"
    )


def _spectrum(args: argparse.Namespace) -> Facts:
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
            say(f"band stop, no phase: {quantity(stopped['rms_before'], 'm')} → "
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


COMMANDS = (CliCommand("spectrum", _declare_spectrum, _spectrum, _show_spectrum),)
