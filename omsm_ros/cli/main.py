"""Takes the command line apart, runs one command, and answers with an exit status."""

from __future__ import annotations

import argparse
import importlib
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from omsm_ros import __version__
from omsm_ros.cli.command import Command, positive
from omsm_ros.errors import OmsmError

DONE, BAD_INPUT, INTERRUPTED = 0, 2, 130

# A correction takes a quarter of a second; loading what identifies would take twice that.
WORDS = {
    "omsm_ros.cli.measuring": ("inspect", "predict", "correct"),
    "omsm_ros.cli.aligning": ("reversal", "align"),
    "omsm_ros.cli.calibrating": ("plan", "identify", "verify", "compare"),
}


def _commands(word: str) -> list[Command]:
    """The commands of the module that knows ``word``; all of them if none does."""
    wanted = [module for module, words in WORDS.items() if word in words] or list(WORDS)
    return [c for module in wanted for c in importlib.import_module(module).COMMANDS]


def _parser(word: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="omsm", description="Identify, correct and judge recorded measurements."
    )
    parser.add_argument("--version", action="version", version=__version__)
    words = parser.add_subparsers(required=True, metavar="command", dest="command")
    for command in _commands(word):
        sub = words.add_parser(command.name, help=command.help, description=command.help)
        sub.add_argument("--json", action="store_true", help="print one JSON object, in SI units")
        sub.set_defaults(run=command)
        command.declare(sub)
    demo = words.add_parser("demo", help="calibrate and measure on the digital twin (needs ROS)")
    demo.add_argument("--json", action="store_true", help="print one JSON object, in SI units")
    demo.add_argument("--out", type=Path, default=Path("out/demo"), metavar="DIR")
    demo.add_argument("--time-lapse", type=positive, default=20.0, help="times faster than real")
    demo.add_argument("--seed", type=int, default=1, help="of the twin's noise")
    return parser


def _demo(args: argparse.Namespace) -> int:
    # The demonstration runs real nodes, so it is one; ROS is imported only there.
    command = [sys.executable, "-m", "omsm_ros.nodes.cell_demo_node", "--out", str(args.out)]
    command += ["--time-lapse", str(args.time_lapse), "--seed", str(args.seed)]
    return subprocess.call([*command, *(["--json"] if args.json else [])])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    args = _parser(given[0] if given else "").parse_args(given)
    try:
        if args.command == "demo":
            return _demo(args)
        facts = args.run.act(args)
        if args.json:
            print(json.dumps(facts))
        else:
            args.run.show(facts)
    except OmsmError as err:
        print(f"omsm: {err}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("omsm: interrupted; no unfinished file was left", file=sys.stderr)
        return INTERRUPTED
    return DONE
