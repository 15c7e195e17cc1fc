"""The command inspect: streams and faults of a bag, and its repair."""

from __future__ import annotations

import argparse
from pathlib import Path

from omsm_ros.cli.arguments import Arguments, cell_of
from omsm_ros.cli.command import CliCommand, Facts, progress_bar, say, table, written
from omsm_ros.pipelines.recording import Inspection, inspect_bag
from omsm_ros.readable import quantity


def _declare_inspect(add: Arguments) -> None:
    add.bags("bag")
    add(
        "--repair",
        None,
        "copy the intact part of a damaged MCAP bag to <bag>.repaired.mcap; the bag itself "
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


COMMANDS = (CliCommand("inspect", _declare_inspect, _inspect, _show_inspect),)
