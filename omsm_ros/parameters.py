"""What can be set on a node or a device: name, type, unit, range and meaning, each stated once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from omsm_ros.errors import ConfigurationError
from omsm_ros.quantities import Quantity, shown

_EXACT = 2**53  # beyond it a float is another number
_KINDS = {bool: "true or false", int: "a whole number", float: "a number", str: "a text"}


@dataclass(frozen=True, slots=True)
class Parameter:
    """One thing that can be set; the same name in ROS, YAML and here.

    default: its type is the parameter's
    quantity: range and unit of a number;  choices: the only values, where they can be listed
    unset: value that means "not stated", outside the range;  required: the default will not do
    fixed: read once, when the node starts
    """

    name: str
    default: bool | int | float | str
    description: str
    quantity: Quantity | None = None
    choices: tuple[int | str, ...] = ()
    unset: int | float | str | None = None
    required: bool = False
    fixed: bool = False

    @property
    def text(self) -> str:
        """Meaning, range and choices in words."""
        parts = [self.description]
        if self.quantity is not None:
            parts.append(self.quantity.range_text)
        if self.choices:
            parts.append(f"one of {', '.join(map(repr, self.choices))}")
        if self.required:
            parts.append("must be given")
        return "; ".join(parts)

    def checked(self, value: object) -> Any:
        """Return ``value`` in the parameter's type; raise ConfigurationError if it will not do.

        A whole number is taken where a number is expected, never the other way round.
        """
        called = f"parameter {self.name!r} ({self.description})"
        kind = type(self.default)
        if kind is float and type(value) is int and abs(value) < _EXACT:
            value = float(value)
        if type(value) is not kind:
            raise ConfigurationError(f"{called} is {shown(value)}, expected {_KINDS[kind]}")
        if self.required and value == self.default:
            raise ConfigurationError(f"{called} must be given; it has no default")
        if self.choices and value not in self.choices:
            raise ConfigurationError(f"{called} is {shown(value)}, expected {self.choices!r}")
        if self.quantity is None or (self.unset is not None and value == self.unset):
            return value
        return self.quantity.checked(value, ConfigurationError, called)
