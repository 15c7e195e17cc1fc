"""The commands that hand points and maps to other programs: export."""

from __future__ import annotations

import argparse
from pathlib import Path

from omsm_ros import quantities
from omsm_ros.cli.arguments import UNIT, number
from omsm_ros.cli.command import CliCommand, Facts, table, written
from omsm_ros.pipelines.export_points import export
from omsm_ros.readable import count, quantity


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
        "--spacing", type=number(quantities.SPACING), help="of a map of scattered points [m]"
    )


def _export(args: argparse.Namespace) -> Facts:
    return {"source": str(args.source), **export(args.source, args.out, args.unit, args.spacing)}


def _show_export(facts: Facts) -> None:
    rows = [("points", count(facts["points"]))]
    if "resampling" in facts:
        spacing = " × ".join(quantity(part, "m", 4) for part in facts["spacing"])
        rows += [
            ("map", f"{facts['columns']} × {facts['rows']} places of {spacing}, "
                    f"{count(facts['missing'])} without a height"),
            ("resampling", facts["resampling"]),
            ("its error", f"at most {quantity(facts['interpolation_error'], 'm', 2)} rms"),
        ]  # fmt: skip
    table([*rows, written([facts["file"]])])


COMMANDS = (CliCommand("export", _declare_export, _export, _show_export),)
