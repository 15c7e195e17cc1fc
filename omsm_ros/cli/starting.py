"""The first command on a new computer: doctor."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from omsm_ros.cli.command import Command, Facts
from omsm_ros.jobs.examine_host import DOUBTFUL, FAULTY, FINE, examine_host

_MARKS = {FINE: "ok", DOUBTFUL: "??", FAULTY: "NO"}


def _declare_doctor(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("--port", default="", metavar="PATH", help="a serial port that must be there")
    sub.add_argument("--folder", type=Path, default=Path(), metavar="DIR", help="of recordings")


def _doctor(args: argparse.Namespace) -> Facts:
    return {"checks": [asdict(check) for check in examine_host(args.folder, args.port)]}


def _show_doctor(facts: Facts) -> None:
    for check in facts["checks"]:
        print(f"{_MARKS[check['state']]}  {check['name']:<18} {check['found']}")
        if check["remedy"]:
            print(f"    {'':<18} → {check['remedy']}")


def _faulty(facts: Facts) -> str:
    names = [check["name"] for check in facts["checks"] if check["state"] == FAULTY]
    return f"not ready: {', '.join(names)}; each has its remedy above" if names else ""


COMMANDS = [
    Command(
        "doctor",
        "is this computer ready to run a cell? What to do where it is not",
        _declare_doctor,
        _doctor,
        _show_doctor,
        _faulty,
    ),
]
