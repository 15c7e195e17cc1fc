"""Dataclasses to JSON values and back, each value checked against the type of its field."""

import math
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from functools import lru_cache
from types import NoneType, UnionType
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from omsm_ros.errors import CalibrationError, OmsmError

Record = TypeVar("Record")
_SCALARS = {str: "a text", bool: "true or false", int: "a whole number", float: "a finite number"}


def to_json(value: Any) -> Any:
    """Return ``value`` as JSON values; fields that are None or empty are left out."""
    if is_dataclass(value):
        found = ((field.name, to_json(getattr(value, field.name))) for field in fields(value))
        return {name: item for name, item in found if item is not None and item not in ([], {}, "")}
    if isinstance(value, Mapping):
        return {str(key): to_json(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return [to_json(item) for item in value] if isinstance(value, tuple | list) else value


def from_json(kind: type[Record], content: object, name: str) -> Record:
    """Return the dataclass ``kind`` of JSON values; messages call it ``name``.

    Raises CalibrationError for a missing, unknown or mistyped field.
    """
    return _read(kind, content, name)  # type: ignore[no-any-return]


def _read(kind: Any, content: Any, name: str) -> Any:
    if kind in (Any, object):
        return content
    if is_dataclass(kind):
        return _read_fields(kind, content, name)
    outer, inner = get_origin(kind), get_args(kind)
    if outer in (Union, UnionType):
        wanted = next(part for part in inner if part is not NoneType)
        return None if content is None else _read(wanted, content, name)
    if outer is tuple:
        _check(isinstance(content, list | tuple), content, name, "a list")
        return tuple(_read(inner[0], item, f"{name}[{i}]") for i, item in enumerate(content))
    if outer is not None and issubclass(outer, Mapping):
        _check(isinstance(content, Mapping), content, name, "an object")
        return {str(key): _read(inner[1], v, f"{name}.{key}") for key, v in content.items()}
    _check(_fits(kind, content), content, name, _SCALARS[kind])
    return kind(content)


def _fits(kind: type, content: object) -> bool:
    if kind is float:
        number = isinstance(content, int | float) and not isinstance(content, bool)
        return number and math.isfinite(content)  # type: ignore[arg-type]
    return type(content) is kind


def _read_fields(kind: Any, content: Any, name: str) -> Any:
    _check(isinstance(content, Mapping), content, name, "an object")
    types, required = _form(kind)
    if unknown := content.keys() - types.keys():
        raise CalibrationError("calibration.unknown_field", name=f"{name}.{min(unknown)}")
    if missing := required - content.keys():
        raise CalibrationError("calibration.missing_field", name=f"{name}.{min(missing)}")
    values = {key: _read(types[key], item, f"{name}.{key}") for key, item in content.items()}
    try:
        return kind(**values)
    except CalibrationError:
        raise
    except OmsmError as err:
        raise CalibrationError("calibration.wrong_field", name=name, why=str(err)) from err


@lru_cache
def _form(kind: Any) -> tuple[Mapping[str, Any], frozenset[str]]:
    required = (
        f.name for f in fields(kind) if f.default is MISSING and f.default_factory is MISSING
    )
    hints = get_type_hints(kind)
    return {f.name: hints[f.name] for f in fields(kind)}, frozenset(required)


def _check(right: bool, content: object, name: str, expected: str) -> None:
    if not right:
        raise CalibrationError(
            "calibration.mistyped", name=name, value=repr(content)[:80], expected=expected
        )
