"""Commands for the shell: completion."""

from __future__ import annotations

import argparse

from omsm_ros.cli.command import CliCommand, Facts, say_lines
from omsm_ros.errors import ConfigurationError

SHELLS = ("bash", "zsh", "tcsh")


def _declare_completion(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("shell", choices=SHELLS)


def _completion(args: argparse.Namespace) -> Facts:
    try:
        import shtab
    except ImportError as err:
        raise ConfigurationError("completion needs shtab: pip install shtab") from err
    from omsm_ros.cli.command_line import parser_of  # which knows of this module
    from omsm_ros.cli.words import WORDS

    parser = parser_of(WORDS)
    _prepare(parser, shtab.FILE)
    return {"script": shtab.complete(parser, args.shell)}


def _prepare(parser: argparse.ArgumentParser, files: object) -> None:
    """Let every argument without choices be a file, and show every command.

    shtab leaves out commands without a line in argparse's own list, where ours have none: they
    are listed by task.
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


COMMANDS = (CliCommand("completion", _declare_completion, _completion, _show_completion),)
