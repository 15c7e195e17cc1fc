"""``summary.json`` of a measurement, read again: its kinds, where a page or a table uses them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omsm_ros.errors import FileError
from omsm_ros.quantities import COUNTER, SAMPLE_PERIOD, SIGNAL, STAMP
from omsm_ros.storage.result_folder import read_result
from omsm_ros.storage.schemas import check_form, ranged

_TEXT = {"type": "string"}
_TEXTS = {"type": "array", "items": _TEXT}
_ANY = {"type": "object"}
_COUNT, _NUMBER = ranged(COUNTER), ranged(SIGNAL)


def _group(needed: Mapping[str, Any], **others: Any) -> dict[str, Any]:
    """Return the schema of an object; it may hold more, which nobody reads."""
    return {"type": "object", "properties": {**needed, **others}, "required": list(needed)}


def _rows(needed: Mapping[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": _group(needed)}


def _or_none(schema: Mapping[str, Any]) -> dict[str, Any]:
    return {**schema, "type": [schema["type"], "null"]}


# What a correction could not know it writes as null.
_KNOWN_OR_NOT = _or_none(_NUMBER)
_ERROR = _group({"rms": _KNOWN_OR_NOT, "peak_to_valley": _KNOWN_OR_NOT})
_DEVIATION = _group({"peak_to_valley": _KNOWN_OR_NOT, "rms_area_weighted": _KNOWN_OR_NOT})
_FIGURE = _group({"value": _KNOWN_OR_NOT, "uncertainty": _KNOWN_OR_NOT})
_STREAM = _group(
    {
        "received": _COUNT,
        "corrected": _COUNT,
        "counted": {"type": "object", "additionalProperties": _COUNT},
    },
    pending=_COUNT,
)
_SOURCE = {
    "source": _TEXT, "says": _TEXT, "kind": _TEXT, "status": _TEXT, "unit": _TEXT,
    "reason": _TEXT, "standard_uncertainty": _KNOWN_OR_NOT, "height": _KNOWN_OR_NOT,
}  # fmt: skip
_LIMIT = {
    "name": _TEXT, "unit": _TEXT, "value": _KNOWN_OR_NOT, "allowed": _KNOWN_OR_NOT,
    "speed_factor": _NUMBER,
}  # fmt: skip
_LIGHT = {
    "level": {"enum": ["green", "amber", "red"]},
    "word": _TEXT,
    "reasons": _rows({"what": _TEXT, "remedy": _TEXT}),
}
_CONFORMITY = {"verdict": {"enum": ["holds", "fails", "cannot tell"]}, "tolerance": _NUMBER}
_FORM = _group(
    {},
    bag=_TEXT,
    calibration=_TEXT,
    sample_period=ranged(SAMPLE_PERIOD),
    samples={"type": "object", "additionalProperties": _STREAM},
    warnings=_TEXTS,
    settings=_ANY,
    versions=_ANY,
    files=_ANY,
    admission=_or_none(_ANY),
    conditions=_group(
        {},
        recorded_ns=_or_none(ranged(STAMP)),
        calibration_age=_KNOWN_OR_NOT,
        temperature=_or_none(_ANY),
    ),
    prediction=_or_none(
        _group(
            {},
            limits=_rows(_LIMIT),
            not_evaluated=_TEXTS,
            speed_factor=_KNOWN_OR_NOT,
        )
    ),
    dynamic_error_before=_or_none(_ERROR),
    dynamic_error_after=_or_none(_ERROR),
    deviation=_or_none(_group({}, raw=_or_none(_DEVIATION), corrected=_or_none(_DEVIATION))),
    uncertainty=_group({}, median=_KNOWN_OR_NOT, largest=_KNOWN_OR_NOT),
    budget=_or_none(_group({}, sources=_rows(_SOURCE))),
    light=_or_none(_group(_LIGHT)),
    form=_or_none(
        _group(
            {},
            deviation={"type": "object", "additionalProperties": _FIGURE},
            conformity=_or_none(_group(_CONFORMITY)),
        )
    ),
)


def read_summary(path: Path) -> dict[str, Any]:
    """Return the content of ``summary.json``: lengths [m], times [s], stamps [ns].

    FileError where it is not there, too large, no JSON, or where something that is read from it
    is of another kind than ``omsm correct`` writes.
    """
    summary = read_result(path, "summary")
    check_form(summary, _FORM, FileError, f"summary {str(path)!r}")
    return summary
