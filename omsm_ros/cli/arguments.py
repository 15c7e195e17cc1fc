"""Arguments shared by commands; each number is checked against the table of quantities."""

from __future__ import annotations

import argparse
import difflib
import itertools
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

from omsm_ros.cli.words import OPTIONS
from omsm_ros.core.streams.trigger_slips import TWO_DRIVERS_S, CommonTrigger
from omsm_ros.errors import ConfigurationError, OmsmError, one_line, shortened
from omsm_ros.io import json_and_yaml
from omsm_ros.io.files import load_object
from omsm_ros.io.topics import TOPIC_TYPES, AnyBag, CellBag, relative
from omsm_ros.quantities import COUNTER_OFFSET, STAMP_TOLERANCE, Quantity, shown
from omsm_ros.units import units_of

_LONGEST_MESSAGE = 480
TABLE_SUFFIX = ".csv"
"""Suffix of a table, in lower or upper case; other paths are bags."""

ADDRESS = "OMSM_CATALOGUE"
"""Environment variable with the address of the default catalogue."""


class UsageError(ConfigurationError):
    """The command line is not valid."""


class OneLineParser(argparse.ArgumentParser):
    """A parser that reports errors in one line instead of printing the usage.

    word: the command whose help an error of the parser of all commands refers to
    """

    word = ""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse; a misspelt option is named before what is missing because of it."""
        own = () if self._subparsers else args or ()  # of a command, not of the program
        for text in itertools.takewhile("--".__ne__, own):
            option = text.partition("=")[0] if text.startswith("--") else ""
            near = difflib.get_close_matches(option, self._option_string_actions, 1)
            if near and not any(known.startswith(option) for known in self._option_string_actions):
                self.error(f"{option!r}: unknown option, did you mean {near[0]!r}?")
        return super().parse_known_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        """Raise UsageError instead of printing and exiting."""
        words = " ".join(filter(None, (self.prog, self.word)))
        message = shortened(one_line(message), _LONGEST_MESSAGE)  # it repeats the input
        raise UsageError(f"{message}; see '{words} --help'")


def number(quantity: Quantity) -> Callable[[str], Any]:
    """Return the argument type of a plausible value of ``quantity``."""

    def read(text: str) -> Any:
        try:
            value: object = int(text) if quantity.whole and len(text) <= 20 else float(text)
        except ValueError:
            value = text
        return quantity.checked(value, ConfigurationError)

    return read


def _as_argument(read: Callable[[str], Any]) -> Callable[[str], Any]:
    """Return ``read`` as the type of an argument: argparse prints the texts of our errors."""

    def typed(text: str) -> Any:
        try:
            return read(text)
        except OmsmError as err:
            raise argparse.ArgumentTypeError(str(err)) from err

    return typed


_MAX_YAML_BYTES = 65_536


def json_object(text: str) -> dict[str, object]:
    """Parse an argument as a JSON object, or read it from a file of YAML."""
    if text.endswith((".yaml", ".yml")):
        return load_object(text, "description", _MAX_YAML_BYTES, yaml=True)
    return json_and_yaml.object_of(text, ConfigurationError, shown(text))


PART_ENTRIES = ("title", "part", "drawing")
"""Entries of ``--origin`` that belong to a part, not to a calibration."""
_ORIGINS = (
    *PART_ENTRIES, "machine", "probe", "probe_serial_number", "target", "temperature_c",
    "operator", "laboratory", "customer", "method", "traceability",
)  # fmt: skip


def _origin(text: str) -> dict[str, object]:
    """Parse the title block of a report or certificate; one file serves all commands."""
    found = json_object(text)
    if unknown := sorted(set(found) - set(_ORIGINS)):
        raise ConfigurationError(f"{unknown!r}: unknown entries, expected {', '.join(_ORIGINS)}")
    return found


def _topics(text: str) -> dict[str, str]:
    known = {relative(topic): topic for topic in TOPIC_TYPES}
    found = dict(part.partition("=")[::2] for part in text.split(","))
    if wrong := [name for name, topic in found.items() if name not in known or not topic]:
        raise ConfigurationError(f"{wrong!r}: expected NAME=/TOPIC with one of {[*known]}")
    return {known[name]: topic for name, topic in found.items()}


def cell_of(path: Path, args: argparse.Namespace) -> AnyBag:
    """Return the bag at ``path``, with the cell selected by the options of :func:`add_bags`."""
    return CellBag(path, args.namespace, args.topics) if _asked_for(args) else path


def refuse_cell(path: Path, args: argparse.Namespace) -> None:
    """Raise ConfigurationError if a cell is selected although ``path`` is no bag."""
    if _asked_for(args):
        raise ConfigurationError(
            f"{str(path)!r} is not read as a bag and has no cells; leave out --namespace and "
            "--topics"
        )


def _asked_for(args: argparse.Namespace) -> bool:
    return bool(args.namespace or args.topics)


def values_of(args: argparse.Namespace, *names: str) -> dict[str, Any]:
    """Return the arguments ``names`` by their names."""
    return {name: getattr(args, name) for name in names}


def trigger_of(args: argparse.Namespace) -> CommonTrigger:
    """Return what is stated of the counters; ConfigurationError together with --by-stamps."""
    stated = (args.counter_offset, args.stamp_tolerance) != (0, TWO_DRIVERS_S)
    if args.by_stamps and stated:
        raise ConfigurationError(
            "--by-stamps uses no counters; leave out --counter-offset and --stamp-tolerance, or "
            "leave out --by-stamps"
        )
    return CommonTrigger(counter_offset=args.counter_offset, stamp_tolerance=args.stamp_tolerance)


_SHARED: dict[str, tuple[Any, dict[str, Any]]] = {
    "--by-stamps": (None, {}),
    "--channel": (str, {"metavar": "NAME|N"}),
    "--counter-offset": (COUNTER_OFFSET, {"default": 0, "metavar": "SAMPLES"}),
    "--namespace": (str, {"default": "", "metavar": "/CELL"}),
    "--origin": (
        _origin,
        {"text": f"title block: {', '.join(_ORIGINS)}", "default": {}, "metavar": "JSON|FILE.yaml"},
    ),
    "--override": (None, {}),
    "--polarity": (int, {"choices": (1, -1), "default": 1}),
    "--stamp-tolerance": (STAMP_TOLERANCE, {"default": TWO_DRIVERS_S, "metavar": "S"}),
    "--topics": (_topics, {"default": {}, "metavar": "axes=/x/axes,…"}),
    "--unit": (units_of, {"metavar": "UNIT[,HEIGHT_UNIT]"}),
}
TRIGGER = ("--counter-offset", "--stamp-tolerance", "--by-stamps")
"""What is stated of the trigger counters of axes and probe, or their lack."""


class Arguments:
    """Declares the arguments of a command: each call adds one, each method some that are shared."""

    def __init__(self, parser: argparse._ActionsContainer, command: str = "") -> None:
        self._parser, self._command = parser, command

    def __call__(self, name: str, kind: Any, text: str | None = None, **more: Any) -> None:
        """Add an argument with its help ``text`` and default; None: the text of ``words.OPTIONS``.

        kind: a Quantity for a plausible number, the placeholder of a path, None for a flag, or a
            function that parses the text;  more: as for ``add_argument``
        """
        if kind is None:
            more["action"] = "store_true"
        elif isinstance(kind, str):
            more |= {"type": Path, "metavar": kind}
        else:
            read = number(kind) if isinstance(kind, Quantity) else kind
            more["type"] = _as_argument(read) if kind not in (int, str, Path) else kind
        if text is None:
            text = OPTIONS.get(f"{self._command} {name}") or OPTIONS.get(name, "")
        default = more.get("default")
        if default and isinstance(default, str | int | float | Path) and "default" not in text:
            text = f"{text}; default: {default}".lstrip("; ")
        self._parser.add_argument(name, help=text, **more)

    def group(self, title: str) -> Arguments:
        """Return a group of arguments, which ``--help`` lists under its title."""
        return Arguments(self._parser.add_argument_group(title), self._command)

    def epilog(self, text: str) -> None:
        """Add a text to the end of ``--help``, its lines as they are."""
        self._parser.formatter_class = argparse.RawDescriptionHelpFormatter  # type: ignore[attr-defined]
        self._parser.epilog = text  # type: ignore[attr-defined]

    def bags(self, *names: str, help: str | None = None, **more: Any) -> None:
        """Add arguments that name bags, and options that select the topics of one cell.

        :func:`cell_of` returns the bag.
        """
        for name in names:
            self(name, Path, help, **more)
        self.shared("--namespace", "--topics")

    def shared(self, *names: str) -> None:
        """Add options that several commands have."""
        for name in names:
            kind, more = _SHARED[name]
            self(name, kind, **more)

    def catalogue(self) -> None:
        """Add ``--catalogue``, the database of calibrations and measurements."""
        self("--catalogue", str, f"catalogue (database) to add the result to; default: ${ADDRESS}",
             default=os.environ.get(ADDRESS, ""), metavar="FILE|URL")  # fmt: skip
