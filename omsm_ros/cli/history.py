"""The command history: past calibrations and measurements."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from omsm_ros.cli.arguments import Arguments
from omsm_ros.cli.command import CliCommand, Facts, Rows, say, table, written
from omsm_ros.core.calibration.repeatability import LinearTrend
from omsm_ros.errors import ConfigurationError
from omsm_ros.io.json_and_yaml import unknown_as_null
from omsm_ros.quantities import shown
from omsm_ros.readable import NOTHING, count, expanded, measured, plain, quantity
from omsm_ros.units import DAY_S

_SHOWN_ROWS = 20
_MOST_DRAWN = 30
_USUAL = "catalogue.sqlite"
_NO_NAME = """(machine not named; identify and correct with --settings '{"machine": "…"}')"""


def _declare_history(add: Arguments) -> None:
    add.catalogue()
    add("--machine", str, "list this machine only", default="")
    add("--add", "CAL.json|DIR", nargs="+", default=[])
    add("--plot", "FILE.png", "draw lag, gain and form over time")


def _history(args: argparse.Namespace) -> Facts:
    from omsm_ros.pipelines.history import history, keep

    address = args.catalogue or _USUAL
    if not args.catalogue and not args.add and not Path(_USUAL).exists():
        raise ConfigurationError(
            f"no catalogue is given, and there is no {_USUAL!r} here; give --catalogue, set "
            "OMSM_CATALOGUE, or create one with --add"
        )
    if not args.add and "://" not in address and not Path(address).exists():
        raise ConfigurationError(
            f"no catalogue at {shown(address)}; check the path, or create one with --add"
        )
    added = sum(keep(address, path) for path in args.add)
    machines, older = history(address, args.machine)
    if args.plot is not None:
        from omsm_ros.io.files import save_bytes
        from omsm_ros.report.campaign import draw

        if len(machines) > _MOST_DRAWN:
            raise ConfigurationError(
                f"--plot of {count(len(machines))} machines, expected {_MOST_DRAWN} at most; "
                "choose one with --machine"
            )
        save_bytes(args.plot, draw(machines))
    return {
        "catalogue": address.rpartition("@")[2],
        "added": added,
        **({"figure": str(args.plot)} if args.plot is not None else {}),
        "older": older,
        "machines": [_with_times_as_text(machine) for machine in machines],
    }


def _with_times_as_text(machine: Facts) -> Facts | None:
    for row in (*machine["calibrations"], *machine["measurements"]):
        for name in ("recorded_at", "added_at"):
            row[name] = row[name] and row[name].isoformat(timespec="seconds")
    return unknown_as_null(machine)


def _show_history(facts: Facts) -> Rows:
    if not facts["machines"]:
        say(f"{facts['catalogue']} is empty; add to it with --add, or with --catalogue")
    for machine in facts["machines"]:
        say(machine["machine"] or _NO_NAME)
        for row in machine["calibrations"][-_SHOWN_ROWS:]:
            say(
                f"  {_when(row)}  calibration {row['id'][:8]}  "
                f"lag {measured(row['delay'], row['delay_uncertainty'], 's')}  "
                f"gain {plain(row['static_gain'], 6)}  {row['verdict']}"
            )
        for row in machine["measurements"][-_SHOWN_ROWS:]:
            rms = expanded(row["deviation_rms"], row["deviation_rms_uncertainty"], "m")
            say(
                f"  {_when(row)}  {Path(row['bag']).name}  form {rms} rms  "
                f"by {row['calibration'][:8]}"
            )
        counts = (count(len(machine[kind])) for kind in ("calibrations", "measurements"))
        table(
            [
                ("  calibrations, measurements", ", ".join(counts)),
                ("  drift of the lag per day", _drift(machine["delay"], "s")),
                ("  drift of the static gain per day", _drift(machine["static_gain"], "")),
                ("  drift of the form's rms per day", _drift(machine["deviation"], "m")),
            ]
        )
    if facts["older"]:
        say(
            f"{count(facts['older'])} older calibrations and measurements are neither listed nor "
            "in the drifts; --machine lists one machine"
        )
    return [written([facts["figure"]])] if "figure" in facts else []


def _when(row: dict[str, Any]) -> str:
    """Return when a row was recorded; if unknown, when it was added."""
    return f"{row['recorded_at']} UTC" if row["recorded_at"] else f"added {row['added_at']} UTC"


def _drift(found: dict[str, float] | None, unit: str) -> str:
    if found is None:
        return f"{NOTHING} (not evaluated: fewer than five values, or times unknown)"
    drift = LinearTrend(**found)
    low, high = (
        quantity(s * DAY_S, unit) if unit else plain(s * DAY_S) for s in (drift.low, drift.high)
    )
    return f"{low} to {high} (95 %)" + ("" if drift.significant else ", not significant")


COMMANDS = (CliCommand("history", _declare_history, _history, _show_history),)
