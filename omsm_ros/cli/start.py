"""Commands to begin with: twin, completion."""

import argparse

from omsm_ros.cli.arguments import Arguments
from omsm_ros.cli.command import CliCommand, Facts, say, say_lines
from omsm_ros.core.adjustment.source_evaluation import PASSES, SPHERE, STAND_OFFS, STILL, TURNED
from omsm_ros.errors import ConfigurationError
from omsm_ros.pipelines.record_bags import record_sources, record_twin
from omsm_ros.quantities import FEED, LENGTH, RADIUS, SEED, SPEED
from omsm_ros.twin.scenario import Scenario


def _declare_twin(add: Arguments) -> None:
    usual = Scenario()
    add("--out", "DIR", required=True)
    add("--radius", RADIUS, default=2e-3)
    add("--rpm", SPEED, "spindle speed [rpm]", default=usual.spindle_speed)
    add("--feed", FEED, "feed per turn [m]", default=usual.feed_per_turn)
    add("--disturbances", "FILE", "errors of the machine")
    add("--seed", SEED, "seed of noise and part", default=1)
    add("--outward", None, "scan from the centre outward")
    add("--beyond", LENGTH, "way of X on the other side of the centre [m]", default=0.0)
    add("--recordings", str, nargs="*", choices=(SPHERE, STILL, TURNED, PASSES, STAND_OFFS))
    add("--part", SEED, "seed of the part alone, for several scans of one part")


def _twin(args: argparse.Namespace) -> Facts:
    scenario = Scenario(
        seed=args.seed,
        spindle_speed=args.rpm,
        feed_per_turn=args.feed,
        start_radius=args.radius,
        part_seed=args.part,
        outward=args.outward,
        beyond=args.beyond,
    )
    if args.recordings is not None:
        kinds = args.recordings or (SPHERE, STILL, TURNED, PASSES, STAND_OFFS)
        return {"recordings": record_sources(args.out, scenario, kinds, args.disturbances)}
    return record_twin(args.out, scenario, args.disturbances)


def _show_twin(facts: Facts) -> None:
    if "recordings" in facts:
        for path, samples in facts["recordings"].items():
            say(f"{path}: {samples} samples")
        return
    say(f"{facts['steps']}: {facts['step_samples']} samples of a step test on a flat")
    say(f"{facts['scan']}: {facts['scan_samples']} samples of a scan of {facts['nominal']}")


def _declare_completion(add: Arguments) -> None:
    add("shell", str, choices=("bash", "zsh", "tcsh"))


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


COMMANDS = (
    CliCommand("twin", _declare_twin, _twin, _show_twin),
    CliCommand(
        "completion", _declare_completion, _completion, lambda facts: say_lines(facts["script"])
    ),
)
