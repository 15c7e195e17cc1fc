"""``CAL.json``: a calibration as a file, its schema and its id checked."""

from __future__ import annotations

from pathlib import Path

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


def save_calibration(path: Path | str, calibration: Calibration) -> None:
    """Write ``CAL.json`` (schema "omsm-calibration/1")."""
    save_json(path, {"id": calibration.id, **calibration.content()})


def load_calibration(path: Path | str) -> Calibration:
    """Read ``CAL.json``; CalibrationError if it is malformed, altered or not plausible."""
    text = read_text(path, MAX_CALIBRATION_BYTES, CalibrationError, "calibration")
    what = f"calibration {str(path)!r}"
    content = strict_json.object_of(text, CalibrationError, what)
    check_form(content, _FORM, CalibrationError, what)
    stored = content.pop("id")
    if stored != content_id(content):
        raise CalibrationError(
            f"{what} was altered after it was made: id {stored!r} does not match its "
            f"content {content_id(content)!r}; identify it again"
        )
    try:
        return Calibration.from_content(content)
    except CalibrationError as err:
        raise CalibrationError(f"{what}: {err}") from err
