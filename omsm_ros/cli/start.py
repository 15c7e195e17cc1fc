"""The first commands on a new computer: doctor, and twin, to have something to work on."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from omsm_ros import quantities
from omsm_ros.cli.arguments import number
from omsm_ros.cli.command import CliCommand, Facts, say
from omsm_ros.pipelines.examine_host import DOUBTFUL, FAULTY, FINE, examine_host
from omsm_ros.pipelines.record_twin import record_twin
from omsm_ros.twin.scenario import Scenario

_MARKS = {FINE: "ok", DOUBTFUL: "??", FAULTY: "NO"}


def _declare_doctor(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("--port", default="", metavar="PATH", help="a serial port that must be there")
    sub.add_argument("--folder", type=Path, default=Path(), metavar="DIR", help="of recordings")


def _doctor(args: argparse.Namespace) -> Facts:
    return {"checks": [asdict(check) for check in examine_host(args.folder, args.port)]}


def _show_doctor(facts: Facts) -> None:
    for check in facts["checks"]:
        say(f"{_MARKS[check['state']]}  {check['name']:<18} {check['found']}")
        if check["remedy"]:
            say(f"    {'':<18} → {check['remedy']}")


def _faulty(facts: Facts) -> str:
    names = [check["name"] for check in facts["checks"] if check["state"] == FAULTY]
    return f"not ready: {', '.join(names)}; each has its remedy above" if names else ""


def _declare_twin(sub: argparse.ArgumentParser) -> None:
    usual = Scenario()
    sub.add_argument("--out", type=Path, required=True, metavar="DIR")
    sub.add_argument(
        "--radius",
        type=number(quantities.RADIUS),
        default=2e-3,
        help="where the spiral starts [m]; 0.002 takes 40 s of scanning, the whole mirror 0.0127",
    )
    sub.add_argument(
        "--rpm", type=number(quantities.SPEED), default=usual.spindle_speed, help="of the spindle"
    )
    sub.add_argument(
        "--feed", type=number(quantities.FEED), default=usual.feed_per_turn, help="[m] a turn"
    )
    sub.add_argument("--disturbances", type=Path, metavar="FILE", help="what is wrong with it")
    sub.add_argument("--seed", type=number(quantities.SEED), default=1, help="of noise and part")
    sub.add_argument(
        "--part",
        type=number(quantities.SEED),
        help="seed of the part alone: one part, two scans",
    )


def _twin(args: argparse.Namespace) -> Facts:
    scenario = Scenario(
        seed=args.seed,
        spindle_speed=args.rpm,
        feed_per_turn=args.feed,
        start_radius=args.radius,
        part_seed=args.part,
    )
    return asdict(record_twin(args.out, scenario, args.disturbances))


def _show_twin(facts: Facts) -> None:
    say(f"{facts['steps']}: {facts['step_samples']} samples of a step test on a flat")
    say(f"{facts['scan']}: {facts['scan_samples']} samples of a scan of {facts['nominal']}")


COMMANDS = (
    CliCommand("twin", _declare_twin, _twin, _show_twin),
    CliCommand("doctor", _declare_doctor, _doctor, _show_doctor, _faulty),
)
