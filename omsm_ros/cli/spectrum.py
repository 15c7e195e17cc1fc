"""The command spectrum: lines in scans of one part, and their sources."""

import argparse

from omsm_ros.cli.arguments import Arguments, cell_of, json_object, values_of
from omsm_ros.cli.command import CliCommand, Facts, Rows, say, table, written
from omsm_ros.core.ripple.lines import MOST_LINES
from omsm_ros.io.calibration_file import load_calibration
from omsm_ros.io.descriptions import load_surface
from omsm_ros.io.files import SPECTRUM
from omsm_ros.messages import text_from
from omsm_ros.pipelines.correct import Admission
from omsm_ros.pipelines.spectrum import SpectrumOptions, publish_spectra
from omsm_ros.quantities import EXPOSURE, FREQUENCY, SPOT
from omsm_ros.readable import plain, quantity


def _declare_spectrum(add: Arguments) -> None:
    add.bags("scans", nargs="+", metavar="SCAN", help="bags of one part")
    add("--calibration", "CAL.json", "correct the scans with it first")
    add("--out", "DIR", required=True)
    add("--nominal", "SURFACE.yaml", "surface to subtract first")
    add("--stop", FREQUENCY, nargs=2, action="append", default=[], metavar=("FROM_HZ", "TO_HZ"))
    add("--remove-vibration", None, "remove lines of the bag's accelerometer, in their phase")
    add("--exposure", EXPOSURE, "exposure of a reading [s]; estimated from scans at two speeds")
    add("--spot", SPOT, "diameter of the probe's spot [m], for the amplitude of marks", default=0.0)
    add("--settings", json_object, "settings of these scans", metavar="JSON")
    add.shared("--polarity")
    add("--no-report", None, "write results without a report")
    add.shared("--override")


def _spectrum(args: argparse.Namespace) -> Facts:
    options = SpectrumOptions(
        calibration=load_calibration(args.calibration) if args.calibration else None,
        admission=Admission(args.settings, args.override),
        nominal=load_surface(args.nominal) if args.nominal else None,
        stop=tuple((low, high) for low, high in args.stop),
        **values_of(args, "polarity", "remove_vibration", "exposure", "spot"),
    )
    bags = [cell_of(path, args) for path in args.scans]
    facts = publish_spectra(bags, options, args.out, report=not args.no_report)
    return {**facts, "out": str(args.out)}


def _show_spectrum(facts: Facts) -> Rows:
    if facts["exposure"] is not None:
        say(facts["exposure"]["finding"])
    for scan in facts["scans"]:
        say(
            text_from(
                "{name}: {samples[analysed]} points, {noise[rms]:m} rms without its lines", scan
            )
        )
        peaks = scan["peaks"]
        rows = [_peak_row(peak) for peak in peaks[:_MOST_SHOWN]] or [("", "no line beyond 3 σ")]
        if more := len(peaks) - _MOST_SHOWN:
            rows += [("", f"{more} further lines are in {SPECTRUM}")] * (more > 0)
        table(rows)
        if scan["lines_limited"]:
            say(f"weaker lines than the {MOST_LINES} strongest were not sought")
        table([("  vibration", one["finding"]) for one in scan["vibration_removed"]])
        if stopped := scan["band_stop"]:
            say(text_from("band stop, zero phase: {rms_before:m} → {rms_after:m} rms", stopped))
    return [written(facts["files"].values(), facts["out"])]


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
    if peak["amplitude_on_part"] is not None:
        on_part = " (on the part {amplitude_on_part:m} ± {amplitude_on_part_uncertainty:m/2})"
        size += text_from(on_part, peak)
    return f"  {where}", f"{size}, {plain(peak['significance'])} σ: {what}: {why}"


# Lines of a scan on the terminal.
_MOST_SHOWN = 40

COMMANDS = (CliCommand("spectrum", _declare_spectrum, _spectrum, _show_spectrum),)
