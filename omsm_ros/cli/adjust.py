"""The command that adjusts scans of one part together: adjust."""

from __future__ import annotations

import argparse
from pathlib import Path

from omsm_ros import quantities
from omsm_ros.cli.arguments import add_bags, add_polarity, cell_of, number
from omsm_ros.cli.command import CliCommand, Facts, progress_bar, table, written
from omsm_ros.core.correction.correct import CorrectionOptions
from omsm_ros.core.correction.machine_sources import NOTHING_STATED
from omsm_ros.io.calibration_file import load_calibration
from omsm_ros.io.descriptions import load_geometry, load_sources, load_surface
from omsm_ros.messages.verdict import SOURCE_NAMES
from omsm_ros.pipelines.adjust import adjust_bags, adjustment_facts, write_adjustment
from omsm_ros.pipelines.correct import Admission


def _declare(sub: argparse.ArgumentParser) -> None:
    add_bags(sub, "scans", nargs="+", metavar="SCAN", help="of one part, two or more")
    sub.add_argument("--calibration", type=Path, required=True, metavar="CAL.json")
    sub.add_argument("--out", type=Path, required=True, metavar="DIR")
    sub.add_argument("--nominal", type=Path, metavar="SURFACE.yaml")
    sub.add_argument("--geometry", type=Path, metavar="GEOMETRY.yaml", help="from 'omsm align'")
    sub.add_argument(
        "--sources", type=Path, metavar="SOURCES.yaml", help="declared sources: the priors"
    )
    sub.add_argument(
        "--clocking",
        type=number(quantities.ANGLE),
        nargs="+",
        default=[],
        help="angle by which the part is turned on the chuck in each scan [rad]",
    )
    sub.add_argument(
        "--clamping",
        type=int,
        nargs="+",
        default=[],
        help="number of the clamping of each scan, where the part was taken off",
    )
    sub.add_argument("--accuracy", type=number(quantities.UNCERTAINTY), help="asked for, k = 2 [m]")
    sub.add_argument(
        "--tolerance", type=number(quantities.UNCERTAINTY), help="of the peak to valley [m]"
    )
    sub.add_argument(
        "--accept",
        nargs="+",
        default=[],
        metavar="SOURCE",
        help=f"accept what was found of a source; names as in adjustment.json, such as "
        f"{next(iter(SOURCE_NAMES))}",
    )
    sub.add_argument("--override", action="store_true", help="ignore a settings mismatch (logged)")
    sub.add_argument("--no-report", action="store_true", help="no page")
    add_polarity(sub)


def _adjust(args: argparse.Namespace) -> Facts:
    options = CorrectionOptions(polarity=args.polarity)
    if args.geometry:
        options = CorrectionOptions(polarity=args.polarity, geometry=load_geometry(args.geometry))
    calibration = load_calibration(args.calibration)
    with progress_bar("reading", args.json) as progress:
        found, scans = adjust_bags(
            [cell_of(path, args) for path in args.scans],
            calibration,
            nominal=load_surface(args.nominal) if args.nominal else None,
            options=options,
            stated=load_sources(args.sources) if args.sources else NOTHING_STATED,
            clockings=args.clocking,
            clampings=args.clamping,
            accuracy=args.accuracy,
            accepted=args.accept,
            admission=Admission(override=args.override),
            progress=progress,
        )
    facts = adjustment_facts(found, scans, calibration, args.tolerance)
    write_adjustment(args.out, facts, found, scans, report=not args.no_report)
    return {**facts, "out": str(args.out)}


def _show(facts: Facts) -> None:
    # Here, because the page's module loads what draws.
    from omsm_ros.report.adjustment import headline, next_steps, source_table, tested_text

    table(
        [
            ("result", headline(facts)),
            ("verdict", facts["verdict"]["text"]),
            *(("", text) for text in next_steps(facts)),
            *((name, f"{'' if declared.startswith('not') else 'declared '}{declared}, found {found}"
               + (f": {status}" if status else ""))
              for name, declared, found, _, status in source_table(facts).rows),
            ("", tested_text(facts)),
            written(facts["files"].values(), facts["out"]),
        ]
    )  # fmt: skip


COMMANDS = (CliCommand("adjust", _declare, _adjust, _show),)
