"""``CAL.json``: a calibration as a file, its schema and its id checked."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from omsm_ros.core.correction.calibration_set import (
    AXES,
    MOST_MEMBERS,
    SET_SCHEMA,
    set_from_content,
)
from omsm_ros.core.dynamics import plausibility
from omsm_ros.core.dynamics.calibration import SCHEMA, Calibration, content_id
from omsm_ros.errors import CalibrationError
from omsm_ros.storage import strict_json
from omsm_ros.storage.files import read_text, save_json
from omsm_ros.storage.schemas import NUMBER, check_form, form

MAX_CALIBRATION_BYTES = 4_000_000

_COEFFICIENTS = {"type": "array", "items": NUMBER, "minItems": 1, "maxItems": 64}
_PROPERTIES = {
    "schema": {"const": SCHEMA},
    "id": {"type": "string", "pattern": "^[0-9a-f]{64}$"},
    "numerator": _COEFFICIENTS,
    "denominator": _COEFFICIENTS,
    "delay": NUMBER,
    "static_gain": NUMBER,
    "sample_period": NUMBER,
    "valid_up_to": NUMBER,
    "covariance": {"type": "array", "items": NUMBER, "maxItems": 16384},
    "settings": {"type": "object"},
    "certificate": {"type": "object"},
}
_FORM = form(_PROPERTIES, tuple(_PROPERTIES))


_MEMBER = form({"position": NUMBER, "calibration": _FORM}, ("position", "calibration"))
_SET_PROPERTIES = {
    "schema": {"const": SET_SCHEMA},
    "id": _PROPERTIES["id"],
    "along": {"enum": list(AXES)},
    "members": {"type": "array", "items": _MEMBER, "maxItems": MOST_MEMBERS},
    "certificate": {"type": "object"},
}
_SET_FORM = form(_SET_PROPERTIES, tuple(_SET_PROPERTIES))


def save_calibration(path: Path | str, calibration: Calibration) -> None:
    """Write ``CAL.json`` (schema "omsm-calibration/1"), or a set of them."""
    save_json(path, {"id": calibration.id, **calibration.content()})


def load_calibration(path: Path | str) -> Calibration:
    """Read ``CAL.json``, or a set of them; CalibrationError if malformed, altered, implausible."""
    return _calibration_in(_text_of(path), path)


def load_for_others(path: Path | str) -> Calibration:
    """Read ``CAL.json`` for who may not see the file; no error shows what stands in it.

    Raises CalibrationError.
    """
    text = _text_of(path)
    try:
        return _calibration_in(text, path)
    except CalibrationError:
        # Without its cause, which would be in the log that everybody can subscribe to.
        raise CalibrationError(
            f"{str(path)!r} is there, but no calibration that can be used; on that computer, "
            f"'omsm compare {str(path)!r} {str(path)!r}' says why"
        ) from None


def _text_of(path: Path | str) -> str:
    return read_text(path, MAX_CALIBRATION_BYTES, CalibrationError, "calibration")


def _calibration_in(text: str, path: Path | str) -> Calibration:
    what = f"calibration {str(path)!r}"
    return calibration_of(strict_json.object_of(text, CalibrationError, what), what)


def calibration_of(content: dict[str, Any], what: str) -> Calibration:
    """Return the calibration, or the set, of a file's ``content``, which messages call ``what``.

    Raises CalibrationError if it is malformed, altered or implausible.
    """
    is_set = content.get("schema") == SET_SCHEMA
    check_form(content, _SET_FORM if is_set else _FORM, CalibrationError, what)
    try:
        return _set_of(content) if is_set else _calibration_of(content)
    except CalibrationError as err:
        raise CalibrationError(f"{what}: {err}") from err


def _calibration_of(content: dict[str, Any]) -> Calibration:
    _check_id(content)
    return Calibration.from_content(content)


def _set_of(content: dict[str, Any]) -> Calibration:
    _check_id(content)
    plausibility.check_certificate(content["certificate"])
    members = [_calibration_of(dict(member["calibration"])) for member in content["members"]]
    return set_from_content(content, members)


def _check_id(content: dict[str, Any]) -> None:
    """Take the id away from ``content``, and raise CalibrationError if it is not its own."""
    stored = content.pop("id")
    if stored != content_id(content):
        raise CalibrationError(
            f"it was altered after it was made: id {stored!r} does not match its content "
            f"{content_id(content)!r}; identify it again"
        )
