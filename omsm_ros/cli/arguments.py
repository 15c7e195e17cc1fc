"""The door for arguments: each is held against the table of quantities as it is read."""

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
"""By which a table is told from a bag, in small or capital letters."""


class UsageError(ConfigurationError):
    """The command line cannot be understood."""


class OneLineParser(argparse.ArgumentParser):
    """Refuses in one line instead of repeating how it is used.

    word: the command whose help is of use, where the parser of all commands refuses
    """

    word = ""

    def error(self, message: str) -> NoReturn:
        """Raise UsageError instead of printing and exiting."""
        words = " ".join(filter(None, (self.prog, self.word)))
        message = shortened(one_line(message), _LONGEST_MESSAGE)  # it repeats what it was given
        raise UsageError(f"{message}; see '{words} --help'")


def number(quantity: Quantity) -> Callable[[str], Any]:
    """Return the argument type: a plausible value of ``quantity``."""

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
    """Return the argument type: a JSON object."""
    try:
        return json_and_yaml.object_of(text, ConfigurationError, shown(text))
    except ConfigurationError as err:
        raise argparse.ArgumentTypeError(str(err)) from err


def add_bags(sub: argparse.ArgumentParser, *names: str, **described: Any) -> None:
    """Add arguments that name bags, and the options that say which of their topics are the cell's.

    described: of each, as for ``add_argument``; :func:`cell_of` says what they name
    """
    for name in names:
        sub.add_argument(name, type=Path, **described)
    sub.add_argument(
        "--namespace", default="", metavar="/CELL", help="of the cell, in a bag of several"
    )
    sub.add_argument(
        "--topics",
        type=_topics,
        default={},
        metavar="axes=/x/axes,…",
        help="what the bag calls topics of the cell, where otherwise than it would by itself",
    )


def _topics(text: str) -> dict[str, str]:
    known = {relative(topic): topic for topic in TOPIC_TYPES}
    found = dict(part.partition("=")[::2] for part in text.split(","))
    if wrong := [name for name, topic in found.items() if name not in known or not topic]:
        raise argparse.ArgumentTypeError(f"{wrong!r}: expected NAME=/TOPIC with one of {[*known]}")
    return {known[name]: topic for name, topic in found.items()}


def cell_of(path: Path, args: argparse.Namespace) -> AnyBag:
    """Return the bag at ``path``, with the cell that was asked for of :func:`add_bags`."""
    return CellBag(path, args.namespace, args.topics) if _asked_for(args) else path


def refuse_cell(path: Path, args: argparse.Namespace) -> None:
    """Raise ConfigurationError if a cell was asked for in ``path``, which is no bag."""
    if _asked_for(args):
        raise ConfigurationError(
            f"{str(path)!r} is read as no bag and has no cells; leave out --namespace and --topics"
        )


def _asked_for(args: argparse.Namespace) -> bool:
    return bool(args.namespace or args.topics)


def add_trigger(sub: argparse.ArgumentParser) -> None:
    """Declare what is stated of the counters of axes and probe."""
    sub.add_argument(
        "--counter-offset",
        type=number(COUNTER_OFFSET),
        default=0,
        metavar="SAMPLES",
        help="added to the distance's trigger count, it gives the axes' count",
    )
    sub.add_argument(
        "--stamp-tolerance",
        type=number(STAMP_TOLERANCE),
        default=TWO_DRIVERS_S,
        metavar="S",
        help="by how much axes and probe may stamp one trigger differently [s]",
    )


def add_polarity(sub: argparse.ArgumentParser) -> None:
    """Declare which way the distance of a bag goes."""
    sub.add_argument(
        "--polarity",
        type=int,
        choices=(1, -1),
        default=1,
        help="1: the distance falls as z rises; -1: it rises",
    )


def add_by_stamps(sub: argparse.ArgumentParser) -> None:
    """Declare that axes and probe share no counter."""
    sub.add_argument(
        "--by-stamps", action="store_true", help="probe and axes have clocks or rates of their own"
    )


def trigger_of(args: argparse.Namespace) -> CommonTrigger:
    """Return what is stated of the counters; ConfigurationError where none are used."""
    stated = (args.counter_offset, args.stamp_tolerance) != (0, TWO_DRIVERS_S)
    if args.by_stamps and stated:
        raise ConfigurationError(
            "--by-stamps uses no counters; leave out --counter-offset and --stamp-tolerance, or it"
        )
    return CommonTrigger(counter_offset=args.counter_offset, stamp_tolerance=args.stamp_tolerance)


def _unit(text: str) -> LengthUnits:
    """Return the argument type: the unit of a file that does not carry it."""
    try:
        return units_of(text)
    except FileError as err:
        raise argparse.ArgumentTypeError(str(err)) from err


UNIT: dict[str, Any] = {
    "type": _unit,
    "metavar": "UNIT[,HEIGHT_UNIT]",
    "help": "of files that do not carry it, as mm, or mm,nm",
}
