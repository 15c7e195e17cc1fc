"""Reads ``DISTURBANCES.yaml``: the errors of the simulated machine.

Its names are those of :class:`~omsm_ros.twin.disturbances.Disturbances` and of the records in it,
and its schema is derived from them; a record that is left out is switched off.
"""

import types
import typing
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any

from omsm_ros.errors import ConfigurationError, FileError
from omsm_ros.io import json_and_yaml
from omsm_ros.io.files import read_text
from omsm_ros.io.json_and_yaml import NUMBER, check_form, form
from omsm_ros.twin.disturbances import Disturbances

MAX_BYTES = 100_000
# More than the lines or harmonics of any machine; each costs time at each sample.
_MOST_ITEMS = 100


def load_disturbances(path: Path | str) -> Disturbances:
    """Read ``DISTURBANCES.yaml``; FileError for unknown names and invalid values."""
    what = f"disturbances {str(path)!r}"
    content = json_and_yaml.mapping_of(
        read_text(path, MAX_BYTES, FileError, "disturbances"), FileError, what
    )
    check_form(content, _schema_of(Disturbances), FileError, what)
    try:
        made: Disturbances = _made(Disturbances, content)
    except ConfigurationError as err:
        raise FileError(f"{what}: {err}") from err
    return made


def _schema_of(kind: Any) -> dict[str, Any]:
    """Return the JSON schema of a field's type: record, row of records, number, any or none."""
    kind = _without_none(kind)
    if is_dataclass(kind):
        hints = typing.get_type_hints(kind)
        required = [
            f.name for f in fields(kind) if f.default is MISSING and f.default_factory is MISSING
        ]
        return form({name: _schema_of(hints[name]) for name in _names(kind)}, required)
    if typing.get_origin(kind) is tuple:
        items = _schema_of(typing.get_args(kind)[0])
        return {"type": "array", "items": items, "maxItems": _MOST_ITEMS}
    return {"type": "integer"} if kind is int else dict(NUMBER)


def _made(kind: Any, content: Any) -> Any:
    kind = _without_none(kind)
    if is_dataclass(kind):
        hints = typing.get_type_hints(kind)
        make: Any = kind
        return make(**{name: _made(hints[name], value) for name, value in content.items()})
    if typing.get_origin(kind) is tuple:
        return tuple(_made(typing.get_args(kind)[0], item) for item in content)
    return kind(content)


def _names(kind: Any) -> Mapping[str, None]:
    return dict.fromkeys(field.name for field in fields(kind))


def _without_none(kind: Any) -> Any:
    if typing.get_origin(kind) in (types.UnionType, typing.Union):
        (kind,) = (k for k in typing.get_args(kind) if k is not types.NoneType)
    return kind
