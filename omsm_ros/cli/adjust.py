"""The command that adjusts scans of one part together: adjust."""

import argparse

from omsm_ros.cli.arguments import Arguments, cell_of
from omsm_ros.cli.command import CliCommand, Facts, Rows, written
from omsm_ros.core.correction.correct import CorrectionOptions
from omsm_ros.io.calibration_file import load_calibration
from omsm_ros.io.descriptions import load_geometry, load_sources, load_surface
from omsm_ros.messages.verdict import SOURCE_NAMES
from omsm_ros.pipelines.adjust import adjust_bags, adjustment_facts, write_adjustment
from omsm_ros.pipelines.correct import Admission
from omsm_ros.quantities import ANGLE, UNCERTAINTY
from omsm_ros.report.verdict import headline, next_steps


def _declare(add: Arguments) -> None:
    add.bags("scans", nargs="+", metavar="SCAN", help="scans of one part; two or more verify it")
    add("--calibration", "CAL.json", required=True)
    add("--out", "DIR", required=True)
    add("--nominal", "SURFACE.yaml")
    add("--geometry", "GEOMETRY.yaml", "from 'omsm align'")
    add("--sources", "SOURCES.yaml", "declared error sources, the priors of the fit")
    add("--clocking", ANGLE, nargs="+", default=[])
    add("--clamping", int, nargs="+", default=[])
    add("--accuracy", UNCERTAINTY, "largest expanded uncertainty of PV accepted, k = 2 [m]")
    add("--tolerance", UNCERTAINTY, "tolerance of the peak to valley [m]")
    add(
        "--accept",
        str,
        f"accept the found value of a source; names as in adjustment.json, such as "
        f"{next(iter(SOURCE_NAMES))}",
        nargs="+",
        default=[],
        metavar="SOURCE",
    )
    add.shared("--override")
    add("--no-report", None, "no page")
    add.shared("--origin", "--polarity")


def _adjust(args: argparse.Namespace) -> Facts:
    geometry, calibration = load_geometry(args.geometry), load_calibration(args.calibration)
    found, scans = adjust_bags(
        [cell_of(path, args) for path in args.scans],
        calibration,
        nominal=load_surface(args.nominal) if args.nominal else None,
        options=CorrectionOptions(polarity=args.polarity, geometry=geometry),
        stated=load_sources(args.sources),
        clockings=args.clocking,
        clampings=args.clamping,
        accuracy=args.accuracy,
        accepted=args.accept,
        admission=Admission(override=args.override),
    )
    facts = adjustment_facts(found, scans, calibration, args.tolerance)
    if args.origin:
        facts["origin"] = args.origin
    write_adjustment(args.out, facts, found, scans, report=not args.no_report)
    return {**facts, "out": str(args.out)}


def _show(facts: Facts) -> Rows:
    # Here, because the page's module loads what draws.
    from omsm_ros.report.adjustment import source_table, tested_text

    return [
        ("result", headline(facts)),
        ("verdict", facts["verdict"]["text"]),
        *(("", text) for text in next_steps(facts["verdict"])),
        *((name, f"{'' if declared.startswith('not') else 'declared '}{declared}, "
           f"{'' if found.startswith('not') else 'found '}{found}"
           + (f": {status}" if status else ""))
          for name, declared, found, _, status in source_table(facts).rows),
        ("", tested_text(facts)),
        written(facts["files"].values(), facts["out"]),
    ]  # fmt: skip


COMMANDS = (CliCommand("adjust", _declare, _adjust, _show),)
