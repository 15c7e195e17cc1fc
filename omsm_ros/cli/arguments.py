"""The door for arguments: each is held against the table of quantities as it is read."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any, NoReturn

from omsm_ros.errors import ConfigurationError
from omsm_ros.quantities import Quantity, shown
from omsm_ros.storage import strict_json


class UsageError(ConfigurationError):
    """The command line cannot be understood."""


class OneLineParser(argparse.ArgumentParser):
    """Refuses in one line instead of repeating how it is used."""

    def error(self, message: str) -> NoReturn:
        """Raise UsageError instead of printing and exiting."""
        raise UsageError(f"{message}; see '{self.prog} --help'")


def number(quantity: Quantity) -> Callable[[str], Any]:
    """Argument type: a plausible value of ``quantity``."""

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
    """Argument type: a JSON object."""
    try:
        return strict_json.object_of(text, ConfigurationError, shown(text))
    except ConfigurationError as err:
        raise argparse.ArgumentTypeError(str(err)) from err
