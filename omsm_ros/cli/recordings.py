"""Commands for recordings: inspect, import."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from omsm_ros.cli.arguments import add_bags, cell_of
from omsm_ros.cli.command import CliCommand, Facts, progress_bar, say, table, written
from omsm_ros.pipelines.recording import Inspection, inspect_bag
from omsm_ros.readable import quantity


def _declare_inspect(sub: argparse.ArgumentParser) -> None:
    add_bags(sub, "bag")
    sub.add_argument(
        "--repair",
        action="store_true",
        help="copy the intact part of a damaged MCAP bag to <bag>.repaired.mcap; the bag itself "
        "is not changed",
    )


def _inspect(args: argparse.Namespace) -> Facts:
    if args.repair:
        return _repaired(args.bag)
    with progress_bar("reading", args.json) as progress:
        found: Inspection = inspect_bag(cell_of(args.bag, args), progress)
    return {"bag": str(args.bag), **found.entry()}


def _repaired(bag: Path) -> Facts:
    from omsm_ros.io.bag_repair import repair  # rarely used and slow to load

    made = repair(bag)
    return {
        "bag": str(bag),
        "repaired": str(made.path),
        "messages": dict(made.messages),
        "lost": made.lost,
        "lost_unnamed": made.unnamed,
    }


def _show_inspect(facts: Facts) -> None:
    if "repaired" in facts:
        saved = [(topic, f"{count} messages saved") for topic, count in facts["messages"].items()]
        lost = [("lost", text) for text in facts["lost"]] or [("lost", "nothing")]
        if more := facts["lost_unnamed"]:
            lost.append(("lost", f"and {more} more places"))
        table([written([facts["repaired"]]), *saved, *lost])
        return
    row = "{topic:<22} {messages:>9} {samples:>11} {rate:>9} {gaps:>6} {restarts:>8} {invalid:>8}"
    names = ("topic", "messages", "samples", "gaps", "restarts", "invalid")
    say(row.format(rate="rate Hz", **{name: name for name in names}))
    for topic in facts["topics"]:
        period = topic["sample_period"]
        say(row.format(rate=f"{1 / period:g}" if period else "-", **topic))
    faults = [("fault", text) for text in facts["faults"]] or [("faults", "none found")]
    table([*_vibration(facts["vibration"]), *faults])


def _vibration(found: Facts | None) -> list[tuple[str, str]]:
    """Return rows of the largest levels by band, as the vibration monitor reported them."""
    if found is None:
        return []
    rows = []
    for place, (low, high) in enumerate(found["bands"]):
        levels = ", ".join(f"{a} {quantity(v[place], 'm/s²')}" for a, v in found["rms"].items())
        effect = quantity(found["height"][place], "m") if found["height"] else "not evaluated"
        rows.append((f"{low:g} to {high:g} Hz", f"at most {levels}; on a height {effect} rms"))
    total = found["height_total"]
    said = "not evaluated: no calibration" if total is None else f"{quantity(total, 'm')} rms"
    raised = f"alarm in {found['alarms']} of {found['spectra']} spectra"
    return [("vibration", f"on a height at most {said}; {raised}"), *rows]


def _declare_import(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("files", type=Path, nargs="+", metavar="FILE")
    sub.add_argument(
        "--map", type=Path, required=True, metavar="MAP.yaml", help="columns, units, signs, period"
    )
    sub.add_argument("--out", type=Path, required=True, metavar="BAG.mcap")


def _import(args: argparse.Namespace) -> Facts:
    # Imported on demand, because 'inspect' does not need the readers of foreign tables.
    from omsm_ros.io.tables.table import load_column_map
    from omsm_ros.pipelines.import_recording import import_recording

    mapped, form = load_column_map(args.map)
    with progress_bar("importing", args.json, " samples") as progress:
        found = import_recording(args.files, mapped, form, args.out, progress)
    return {"bag": str(args.out), "files": [asdict(file) for file in found]}


def _show_import(facts: Facts) -> None:
    for file in facts["files"]:
        kinds = " and ".join(kind for kind in ("axes", "distance") if file[kind])
        say(f"{file['file']}: {file['rows']} rows of {kinds} at {1 / file['sample_period']:g} Hz")
        for count, meaning in (
            ("missing", "missing trigger numbers"),
            ("invalid", "invalid probe readings"),
            ("lost", "rows with an axis that is not a number"),
            ("repeated_names", "repeated header lines"),
            ("passed_over", "messages without any of the columns"),
        ):
            if file[count]:
                say(f"    {meaning}: {file[count]}")
    if any(file["own_clock"] for file in facts["files"]):
        say("probe and axes have separate clocks: identify and correct with --by-stamps")
    table([written([facts["bag"]]), ("next", "check the bag with 'omsm inspect'")])


COMMANDS = (
    CliCommand("inspect", _declare_inspect, _inspect, _show_inspect),
    CliCommand("import", _declare_import, _import, _show_import),
)
