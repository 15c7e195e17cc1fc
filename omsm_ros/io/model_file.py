"""``MODEL.json``: a model between any two sampled quantities."""

from __future__ import annotations

from pathlib import Path

from omsm_ros.core.estimation.sampled_model import SCHEMA, SampledModel
from omsm_ros.core.identification.sampled_identification import HOLDS
from omsm_ros.errors import CalibrationError
from omsm_ros.io import json_and_yaml
from omsm_ros.io.files import read_text, save_json
from omsm_ros.io.json_and_yaml import NUMBER, check_form, form

_MAX_BYTES = 4_000_000

# 20 poles.
_COEFFICIENTS = {"type": "array", "items": NUMBER, "minItems": 1, "maxItems": 21}
_COVARIANCE = {"type": "array", "items": NUMBER, "maxItems": 42**2}
_DISCRETE = {
    "numerator": _COEFFICIENTS,
    "denominator": _COEFFICIENTS,
    "delay_samples": {"type": "integer"},
    "covariance": _COVARIANCE,
}
_CONTINUOUS = {
    "numerator": _COEFFICIENTS,
    "denominator": _COEFFICIENTS,
    "delay": NUMBER,
    "covariance": {**_COVARIANCE, "type": ["array", "null"]},
}
_PROPERTIES = {
    "schema": {"const": SCHEMA},
    "hold": {"enum": list(HOLDS)},
    "sample_period": NUMBER,
    "discrete": {**form(_DISCRETE, tuple(_DISCRETE)), "type": ["object", "null"]},
    "continuous": {**form(_CONTINUOUS, tuple(_CONTINUOUS)), "type": ["object", "null"]},
    "working_point": {"type": "array", "items": NUMBER, "minItems": 2, "maxItems": 2},
    "valid_from": NUMBER,
    "valid_up_to": NUMBER,
    "certificate": {"type": "object"},
}
_FORM = form(_PROPERTIES, tuple(_PROPERTIES))


def save_model(path: Path | str, model: SampledModel) -> None:
    """Write ``MODEL.json`` (schema "omsm-model/1")."""
    save_json(path, model.content())


def load_model(path: Path | str) -> SampledModel:
    """Read ``MODEL.json``; CalibrationError if it is malformed or cannot be computed with."""
    what = f"model {str(path)!r}"
    text = read_text(path, _MAX_BYTES, CalibrationError, "model")
    content = json_and_yaml.object_of(text, CalibrationError, what)
    check_form(content, _FORM, CalibrationError, what)
    try:
        return SampledModel.from_content(content)
    except CalibrationError as err:
        raise CalibrationError(f"{what}: {err}") from err
