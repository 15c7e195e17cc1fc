"""Commands that bring other programs' data in: import."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from omsm_ros.cli.command import CliCommand, Facts, progress_bar, say, table, written
from omsm_ros.io.tables.table import load_column_map
from omsm_ros.pipelines.import_recording import import_recording


def _declare_import(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("files", type=Path, nargs="+", metavar="FILE")
    sub.add_argument(
        "--map", type=Path, required=True, metavar="MAP.yaml", help="columns, units, signs, period"
    )
    sub.add_argument("--out", type=Path, required=True, metavar="BAG.mcap")


def _import(args: argparse.Namespace) -> Facts:
    mapped, form = load_column_map(args.map)
    with progress_bar("importing", args.json, " samples") as progress:
        found = import_recording(args.files, mapped, form, args.out, progress)
    return {"bag": str(args.out), "files": [asdict(file) for file in found]}


def _show_import(facts: Facts) -> None:
    for file in facts["files"]:
        kinds = " and ".join(kind for kind in ("axes", "distance") if file[kind])
        say(f"{file['file']}: {file['rows']} rows of {kinds} at {1 / file['sample_period']:g} Hz")
        for count, meaning in (
            ("missing", "trigger numbers that are missing"),
            ("invalid", "readings that are none"),
            ("lost", "rows where an axis is no number"),
            ("repeated_names", "lines that repeat the names"),
            ("passed_over", "messages with none of the columns"),
        ):
            if file[count]:
                say(f"    {meaning}: {file[count]}")
    if any(file["own_clock"] for file in facts["files"]):
        say("probe and axes have clocks of their own: identify and correct with --by-stamps")
    table([written([facts["bag"]]), ("next", "look at it with 'omsm inspect'")])


COMMANDS = (CliCommand("import", _declare_import, _import, _show_import),)
