"""Commands that draw again what is there: report."""

from __future__ import annotations

import argparse
from pathlib import Path

from omsm_ros.cli.command import CliCommand, Facts, table, written
from omsm_ros.io.calibration_file import load_calibration
from omsm_ros.io.descriptions import load_surface


def _declare_report(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("result", type=Path, metavar="DIR", help="that 'omsm correct' wrote")
    sub.add_argument("--calibration", type=Path, required=True, metavar="CAL.json")
    sub.add_argument(
        "--nominal", type=Path, metavar="SURFACE.yaml", help="as it was corrected with"
    )


def _report(args: argparse.Namespace) -> Facts:
    # Here, because drawing takes long to load.
    from omsm_ros.pipelines.publish import report_again

    nominal = load_surface(args.nominal) if args.nominal else None
    page = report_again(args.result, load_calibration(args.calibration), nominal)
    return {"report": str(page)}


def _show_report(facts: Facts) -> None:
    table([written([facts["report"]])])


COMMANDS = (CliCommand("report", _declare_report, _report, _show_report),)
