"""``CAL.json``: a calibration as a file, its schema and its id checked."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema

from omsm_ros.core.dynamics.calibration import SCHEMA, Calibration, content_id
from omsm_ros.errors import CalibrationError, FileError
from omsm_ros.storage.files import whole_file


def read_text(path: Path, limit: int, error: type[FileError], what: str) -> str:
    try:
        size = path.stat().st_size
        if size > limit:
            raise error(f"{what} {str(path)!r} has {size} bytes, at most {limit} are accepted")
        return path.read_text(encoding="utf-8")
    except FileNotFoundError as err:
        raise error(f"no {what} at {str(path)!r}; check the path") from err
    except (OSError, UnicodeDecodeError) as err:
        raise error(f"{what} {str(path)!r} cannot be read as text: {err}") from err


MAX_CALIBRATION_BYTES = 4_000_000

_COEFFICIENTS = {"type": "array", "items": {"type": "number"}, "minItems": 1, "maxItems": 64}
_CALIBRATION_SCHEMA = {
    "type": "object",
    "additionalProperties": False,
    "properties": {
        "schema": {"const": SCHEMA},
        "id": {"type": "string", "pattern": "^[0-9a-f]{64}$"},
        "numerator": _COEFFICIENTS,
        "denominator": _COEFFICIENTS,
        "delay": {"type": "number", "minimum": 0},
        "static_gain": {"type": "number"},
        "sample_period": {"type": "number", "exclusiveMinimum": 0},
        "valid_up_to": {"type": "number", "exclusiveMinimum": 0},
        "covariance": {"type": "array", "items": {"type": "number"}, "maxItems": 16384},
        "settings": {"type": "object"},
        "certificate": {"type": "object"},
    },
}
_CALIBRATION_SCHEMA["required"] = list(_CALIBRATION_SCHEMA["properties"])  # type: ignore[call-overload]


# --------------------------------------------------------------------------- calibration


def save_calibration(path: Path | str, calibration: Calibration) -> None:
    """Write ``CAL.json`` (schema "omsm-calibration/1")."""
    with whole_file(path, "w") as stream:
        json.dump({"id": calibration.id, **calibration.content()}, stream, indent=1)
        stream.write("\n")


def load_calibration(path: Path | str) -> Calibration:
    """Read ``CAL.json``; CalibrationError if it is malformed, altered or unstable."""
    path = Path(path)
    text = read_text(path, MAX_CALIBRATION_BYTES, CalibrationError, "calibration")
    try:
        content = json.loads(text, parse_constant=_no_constant)
        jsonschema.validate(content, _CALIBRATION_SCHEMA)
    except jsonschema.ValidationError as err:
        raise CalibrationError(
            f"{str(path)!r} is not a calibration: {err.json_path}: {err.message[:200]}"
        ) from err
    except (ValueError, RecursionError) as err:
        raise CalibrationError(
            f"{str(path)!r} is not a calibration: not JSON ({err}); make one with 'omsm identify'"
        ) from err
    stored = content.pop("id")
    if stored != content_id(content):
        raise CalibrationError(
            f"{str(path)!r} was altered after it was made: id {stored!r} does not match its "
            f"content {content_id(content)!r}; identify it again"
        )
    try:
        return Calibration.from_content(content)
    except CalibrationError as err:
        raise CalibrationError(f"{str(path)!r}: {err}") from err


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is not a JSON number")
