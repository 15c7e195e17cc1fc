"""Levels of vibration in a message: a JSON object in a ``std_msgs/String``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from omsm_ros.errors import BagError
from omsm_ros.storage import strict_json
from omsm_ros.storage.schemas import NUMBER, check_form, form

MAX_CHARACTERS = 100_000
_MOST_BANDS = 100
_LEVEL: Mapping[str, Any] = {"type": "number", "minimum": 0}
_LEVELS: Mapping[str, Any] = {"type": "array", "items": _LEVEL, "maxItems": _MOST_BANDS}
_BAND: Mapping[str, Any] = {"type": "array", "items": NUMBER, "minItems": 2, "maxItems": 2}
_SHAPE = {
    "bands": {"type": "array", "items": _BAND, "minItems": 1, "maxItems": _MOST_BANDS},
    "rms": form(dict.fromkeys("xyz", _LEVELS), tuple("xyz")),
    "line": form(
        {"axis": {"enum": list("xyz")}, "frequency": _LEVEL, "amplitude": _LEVEL},
        ("axis", "frequency", "amplitude"),
    ),
    "height": {"anyOf": [_LEVELS, {"type": "null"}]},
    "height_total": {"anyOf": [_LEVEL, {"type": "null"}]},
    "windows": {"type": "integer", "minimum": 1},
    "alarm": {"type": "boolean"},
    "limit": _LEVEL,
}
_LINE_OF_HEIGHT = form(
    dict.fromkeys(("frequency", "amplitude"), _LEVEL), ("frequency", "amplitude")
)
# Older recordings do not say what moves the height most.
_SCHEMA = form({**_SHAPE, "height_line": _LINE_OF_HEIGHT}, tuple(_SHAPE))


def vibration_levels(message: Any) -> dict[str, Any]:
    """Return what the vibration monitor told, see ``VibrationLevels.entry``; alarm and limit, too.

    BagError for a text that says something else.
    """
    text = message.data
    if len(text) > MAX_CHARACTERS:
        raise BagError(
            f"vibration of {len(text)} characters, at most {MAX_CHARACTERS} are read; record the "
            "topic of the vibration monitor"
        )
    found = strict_json.object_of(text, BagError, "vibration")
    check_form(found, _SCHEMA, BagError, "vibration")
    lists = [*found["rms"].values(), *([found["height"]] if found["height"] is not None else [])]
    lengths = {len(levels) for levels in lists}
    if lengths != {len(found["bands"])}:
        raise BagError(
            f"vibration has {len(found['bands'])} bands and {sorted(lengths)} levels, expected one "
            "of each; record the topic of the vibration monitor"
        )
    return found
