"""Arguments shared by commands; each number is checked against the table of quantities."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

from omsm_ros.core.streams.trigger_slips import TWO_DRIVERS_S, CommonTrigger
from omsm_ros.errors import ConfigurationError, FileError, one_line, shortened
from omsm_ros.io import json_and_yaml
from omsm_ros.io.topics import TOPIC_TYPES, AnyBag, CellBag, relative
from omsm_ros.quantities import COUNTER_OFFSET, STAMP_TOLERANCE, Quantity, shown
from omsm_ros.units import LengthUnits, units_of

_LONGEST_MESSAGE = 480
TABLE_SUFFIX = ".csv"
"""Suffix of a table, in lower or upper case; other paths are bags."""


OVERRIDE = "ignore a settings mismatch of the calibration (logged)"
"""Help of ``--override``."""


class UsageError(ConfigurationError):
    """The command line is not valid."""


class OneLineParser(argparse.ArgumentParser):
    """A parser that reports errors in one line instead of printing the usage.

    word: the command whose help an error of the parser of all commands refers to
    """

    word = ""

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
        try:
            return quantity.checked(value, ConfigurationError)
        except ConfigurationError as err:
            raise argparse.ArgumentTypeError(str(err)) from err

    return read


def json_object(text: str) -> dict[str, object]:
    """Parse an argument as a JSON object."""
    try:
        return json_and_yaml.object_of(text, ConfigurationError, shown(text))
    except ConfigurationError as err:
        raise argparse.ArgumentTypeError(str(err)) from err


def add_bags(sub: argparse.ArgumentParser, *names: str, **described: Any) -> None:
    """Add arguments that name bags, and options that select the topics of one cell.

    described: options of ``add_argument`` for each;  :func:`cell_of` returns the bag
    """
    for name in names:
        sub.add_argument(name, type=Path, **described)
    sub.add_argument(
        "--namespace", default="", metavar="/CELL", help="namespace of the cell in a bag of several"
    )
    sub.add_argument(
        "--topics",
        type=_topics,
        default={},
        metavar="axes=/x/axes,…",
        help="names of the cell's topics in the bag, if they are not the default ones",
    )


def _topics(text: str) -> dict[str, str]:
    known = {relative(topic): topic for topic in TOPIC_TYPES}
    found = dict(part.partition("=")[::2] for part in text.split(","))
    if wrong := [name for name, topic in found.items() if name not in known or not topic]:
        raise argparse.ArgumentTypeError(f"{wrong!r}: expected NAME=/TOPIC with one of {[*known]}")
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


def add_trigger(sub: argparse.ArgumentParser) -> None:
    """Add the options for the trigger counters of axes and probe."""
    sub.add_argument(
        "--counter-offset",
        type=number(COUNTER_OFFSET),
        default=0,
        metavar="SAMPLES",
        help="axes' trigger count minus the distance's trigger count",
    )
    sub.add_argument(
        "--stamp-tolerance",
        type=number(STAMP_TOLERANCE),
        default=TWO_DRIVERS_S,
        metavar="S",
        help="largest difference between the stamps of axes and probe for one trigger [s]",
    )


def add_polarity(sub: argparse.ArgumentParser) -> None:
    """Add the option for the sign of the distance."""
    sub.add_argument(
        "--polarity",
        type=int,
        choices=(1, -1),
        default=1,
        help="1: the distance decreases as Z increases; -1: it increases",
    )


def add_by_stamps(sub: argparse.ArgumentParser) -> None:
    """Add the option to join axes and probe by their stamps."""
    sub.add_argument(
        "--by-stamps",
        action="store_true",
        help="join probe and axes by their stamps: they share no trigger counter",
    )


def trigger_of(args: argparse.Namespace) -> CommonTrigger:
    """Return what is stated of the counters; ConfigurationError together with --by-stamps."""
    stated = (args.counter_offset, args.stamp_tolerance) != (0, TWO_DRIVERS_S)
    if args.by_stamps and stated:
        raise ConfigurationError(
            "--by-stamps uses no counters; leave out --counter-offset and --stamp-tolerance, or "
            "leave out --by-stamps"
        )
    return CommonTrigger(counter_offset=args.counter_offset, stamp_tolerance=args.stamp_tolerance)


def _unit(text: str) -> LengthUnits:
    """Parse the units of a file that does not state them."""
    try:
        return units_of(text)
    except FileError as err:
        raise argparse.ArgumentTypeError(str(err)) from err


UNIT: dict[str, Any] = {
    "type": _unit,
    "metavar": "UNIT[,HEIGHT_UNIT]",
    "help": "unit of files that do not state it, such as mm, or mm,nm",
}
