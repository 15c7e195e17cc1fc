"""JSON as RFC 8259 has it, and not more: no NaN, no Infinity, no number beyond a float's range.

Python's own reader takes all of these, nests without end, and lets the last of two equal names win.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any, TypeVar

from omsm_ros.errors import OmsmError
from omsm_ros.quantities import shown

MAX_DEPTH = 32
# An integer within 64 bits is an integer to every reader.
_INTEGERS = range(-(2**63), 2**64)

_T = TypeVar("_T")


def value_of(text: str, error: type[OmsmError], what: str) -> Any:
    """Return the value of a JSON text; raise ``error``, which calls the text ``what``."""
    try:
        value = json.loads(
            text,
            parse_constant=_no_constant,
            parse_float=finite_float,
            parse_int=bounded_integer,
            object_pairs_hook=_names_once,
        )
        _check_nest(value, MAX_DEPTH)
    except RecursionError as err:
        raise error(f"{what} is nested deeper than {MAX_DEPTH} levels; flatten it") from err
    except ValueError as err:
        raise error(f"{what} is not JSON: {str(err)[:200]}; write it as RFC 8259 has it") from err
    return value


def object_of(text: str, error: type[OmsmError], what: str) -> dict[str, Any]:
    """Return the object that a JSON text holds; raise ``error``, which calls the text ``what``."""
    value = value_of(text, error, what)
    if not isinstance(value, dict):
        raise error(f'{what} is {shown(value)}, expected a JSON object such as {{"name": 1}}')
    return value


def text_of(content: object, indent: int | None = None) -> str:
    """Return ``content`` as JSON; ValueError for a number that JSON cannot say."""
    return json.dumps(content, indent=indent, allow_nan=False)


def unknown_as_null(content: _T) -> _T | None:
    """Return ``content`` with null for each NaN and infinity: a number that nobody knows."""
    if isinstance(content, Mapping):
        return {key: unknown_as_null(value) for key, value in content.items()}  # type: ignore[return-value]
    if isinstance(content, list | tuple):
        return [unknown_as_null(value) for value in content]  # type: ignore[return-value]
    return None if isinstance(content, float) and not math.isfinite(content) else content


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is not a JSON number")


def finite_float(text: str) -> float:
    """Return the number that ``text`` writes; ValueError for one beyond the range of a float."""
    if not math.isfinite(value := float(text)):
        raise ValueError(f"{shown(text)} is beyond the range of a float")
    return value


def bounded_integer(text: str) -> int:
    """Return the integer that ``text`` writes; ValueError for one of more than 64 bits."""
    if len(text) > 20 or (value := int(text)) not in _INTEGERS:
        raise ValueError(f"the integer {shown(text)} has more than 64 bits")
    return value


def _names_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"the name {shown(twice)} stands twice in one object")
    return content


def _check_nest(value: object, left: int) -> None:
    if left < 0:
        raise ValueError(f"it is nested deeper than {MAX_DEPTH} levels")
    if isinstance(value, str):
        value.encode()  # half a character cannot be written again
    elif isinstance(value, dict | list):
        for part in (*value, *value.values()) if isinstance(value, dict) else value:
            _check_nest(part, left - 1)
