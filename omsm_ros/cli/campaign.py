"""The command batch: correct a folder of recordings."""

from __future__ import annotations

import argparse
import os
from dataclasses import asdict
from pathlib import Path
from urllib.parse import quote

from omsm_ros import quantities
from omsm_ros.cli.arguments import number
from omsm_ros.cli.command import (
    ADDRESS,
    CliCommand,
    Facts,
    declare_catalogue,
    progress_bar,
    say,
    table,
    written,
)
from omsm_ros.errors import ConfigurationError
from omsm_ros.io.calibration_file import load_calibration
from omsm_ros.io.files import REPORT, save_text
from omsm_ros.pipelines.campaign import DONE, Entry, load_summary, run_campaign
from omsm_ros.quantities import shown

_INDEX = "index.html"

# Options that the campaign sets for each bag, and the length of "--" with one letter, the shortest
# abbreviation that argparse accepts.
_DECIDED, _SHORTEST = ("--out", "--calibration"), 3


def _declare_batch(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("folder", type=Path, metavar="FOLDER", help="folder of bags, at any depth")
    sub.add_argument("--calibration", type=Path, required=True, metavar="CAL.json")
    sub.add_argument("--out", type=Path, required=True, metavar="DIR")
    sub.add_argument(
        "--jobs",
        type=number(quantities.PROCESSES),
        default=0,
        help="number of parallel processes; default: one per core",
    )
    sub.add_argument(
        "--scheduler",
        default="",
        metavar="URL",
        help="address of a Dask scheduler: tcp:// on this host, or tls://",
    )
    declare_catalogue(sub)
    sub.epilog = "Options of 'omsm correct' for every bag follow after '--'."


def _batch(args: argparse.Namespace) -> Facts:
    with progress_bar("correcting", args.json, " bags") as progress:
        entries = run_campaign(
            args.folder, args.calibration, args.out, _options(args),
            jobs=args.jobs, scheduler=args.scheduler, progress=progress,
        )  # fmt: skip
    _write_index(args.out, args.folder.name, entries, args.calibration)
    return {"out": str(args.out), "entries": [asdict(entry) for entry in entries]}


def _options(args: argparse.Namespace) -> list[str]:
    """Return the options of every correction, with the catalogue unless the environment names it.

    Raises ConfigurationError for options that the campaign sets for each bag.
    """
    for word in args.passed_on:
        if taken := next((o for o in _DECIDED if _is_abbreviation(word, o)), None):
            raise ConfigurationError(
                f"{taken} is given after '--' as {shown(word)}; give it before, once for all bags"
            )
    if args.catalogue == os.environ.get(ADDRESS, ""):
        return list(args.passed_on)
    return [*args.passed_on, "--catalogue", args.catalogue]


def _is_abbreviation(word: str, option: str) -> bool:
    """Return True if a ``word`` of the command line is ``option`` or an abbreviation of it."""
    name, _, _ = word.partition("=")
    return len(name) > _SHORTEST and option.startswith(name)


def _write_index(out: Path, title: str, entries: list[Entry], calibration: Path) -> None:
    # Imported on demand, because loading the figures takes a second.
    from omsm_ros.report.campaign import CampaignEntry, render

    measurements = [
        CampaignEntry(
            e.bag, e.state, e.said, e.recorded_ns,
            _link(out, e), load_summary(out, e) if e.state == DONE else {},
        )
        for e in entries
    ]  # fmt: skip
    save_text(
        out / _INDEX, render(f"Campaign {title}", measurements, load_calibration(calibration))
    )


def _link(out: Path, entry: Entry) -> str:
    """Return the link from the index to a bag's report; empty if it has none."""
    page = os.path.join(entry.folder, REPORT)
    return quote(page) if (out / page).exists() else ""


def _show_batch(facts: Facts) -> None:
    for entry in facts["entries"]:
        if entry["state"] != DONE:
            say(f"{entry['bag']}: {entry['state']}, {entry['said']}")
    done = sum(entry["state"] == DONE for entry in facts["entries"])
    say(f"{done} of {len(facts['entries'])} bags are done")
    table([written([_INDEX], facts["out"])])


def _undone(facts: Facts) -> str:
    others = [entry for entry in facts["entries"] if entry["state"] != DONE]
    if not others:
        return ""
    return (
        f"{len(others)} bags gave no result, first {others[0]['bag']!r}: {others[0]['said']}; "
        "the same command retries them"
    )


COMMANDS = (CliCommand("batch", _declare_batch, _batch, _show_batch, _undone),)
