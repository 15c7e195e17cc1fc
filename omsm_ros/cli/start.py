"""Commands to begin with: twin, doctor, completion."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from omsm_ros import quantities
from omsm_ros.cli.arguments import number
from omsm_ros.cli.command import CliCommand, Facts, say, say_lines
from omsm_ros.errors import ConfigurationError
from omsm_ros.pipelines.examine_host import DOUBTFUL, FAULTY, FINE, examine_host
from omsm_ros.pipelines.record_twin import record_twin
from omsm_ros.twin.scenario import Scenario

_MARKS = {FINE: "ok", DOUBTFUL: "??", FAULTY: "NO"}


def _declare_doctor(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("--port", default="", metavar="PATH", help="serial port that must exist")
    sub.add_argument(
        "--folder", type=Path, default=Path(), metavar="DIR", help="folder for recordings"
    )


def _doctor(args: argparse.Namespace) -> Facts:
    return {"checks": [asdict(check) for check in examine_host(args.folder, args.port)]}


def _show_doctor(facts: Facts) -> None:
    for check in facts["checks"]:
        say(f"{_MARKS[check['state']]}  {check['name']:<18} {check['found']}")
        if check["remedy"]:
            say(f"    {'':<18} → {check['remedy']}")


def _faulty(facts: Facts) -> str:
    names = [check["name"] for check in facts["checks"] if check["state"] == FAULTY]
    return f"not ready: {', '.join(names)}; see the remedies above" if names else ""


def _declare_twin(sub: argparse.ArgumentParser) -> None:
    usual = Scenario()
    sub.add_argument("--out", type=Path, required=True, metavar="DIR")
    sub.add_argument(
        "--radius",
        type=number(quantities.RADIUS),
        default=2e-3,
        help="start radius of the spiral [m]; 0.002 scans for 40 s, 0.0127 the whole mirror",
    )
    sub.add_argument(
        "--rpm",
        type=number(quantities.SPEED),
        default=usual.spindle_speed,
        help="spindle speed [rpm]",
    )
    sub.add_argument(
        "--feed",
        type=number(quantities.FEED),
        default=usual.feed_per_turn,
        help="feed per turn [m]",
    )
    sub.add_argument("--disturbances", type=Path, metavar="FILE", help="errors of the machine")
    sub.add_argument(
        "--seed", type=number(quantities.SEED), default=1, help="seed of noise and part"
    )
    sub.add_argument(
        "--part",
        type=number(quantities.SEED),
        help="seed of the part alone, for several scans of one part",
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


def _declare_completion(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("shell", choices=("bash", "zsh", "tcsh"))


def _completion(args: argparse.Namespace) -> Facts:
    try:
        import shtab
    except ImportError as err:
        raise ConfigurationError("completion needs shtab: pip install shtab") from err
    # Imported on demand, because command_line loads this module.
    from omsm_ros.cli.command_line import parser_of
    from omsm_ros.cli.words import WORDS

    parser = parser_of(WORDS)
    _prepare(parser, shtab.FILE)
    return {"script": shtab.complete(parser, args.shell)}


def _prepare(parser: argparse.ArgumentParser, files: object) -> None:
    """Complete every argument without choices as a file, and list every command.

    shtab omits commands without help in argparse's own list; ours are listed by task instead.
    """
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            named = action._ChoicesPseudoAction
            action._choices_actions = [
                named(name, (), sub.description) for name, sub in action.choices.items()
            ]
            for sub in action.choices.values():
                _prepare(sub, files)
        elif not action.choices and action.nargs != 0:
            action.complete = files  # type: ignore[attr-defined]


def _show_completion(facts: Facts) -> None:
    say_lines(facts["script"])


COMMANDS = (
    CliCommand("twin", _declare_twin, _twin, _show_twin),
    CliCommand("doctor", _declare_doctor, _doctor, _show_doctor, _faulty),
    CliCommand("completion", _declare_completion, _completion, _show_completion),
)
