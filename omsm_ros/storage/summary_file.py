"""``summary.json`` of a measurement, read again: its kinds, where a page or a table uses them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from omsm_ros.errors import FileError
from omsm_ros.quantities import COUNTER, SAMPLE_PERIOD, SIGNAL, STAMP
from omsm_ros.storage.result_folder import read_result
from omsm_ros.storage.schemas import (
    CONFORMITY,
    FIGURE,
    KNOWN_OR_NOT,
    TEXT,
    TEXTS,
    check_form,
    each,
    group,
    or_none,
    ranged,
    rows,
)

_ANY = {"type": "object"}
_COUNT, _NUMBER = ranged(COUNTER), ranged(SIGNAL)
_ERROR = group({"rms": KNOWN_OR_NOT, "peak_to_valley": KNOWN_OR_NOT})
_DEVIATION = group({"peak_to_valley": KNOWN_OR_NOT, "rms_area_weighted": KNOWN_OR_NOT})
_STREAM = group(
    {
        "received": _COUNT,
        "corrected": _COUNT,
        "counted": each(_COUNT),
    },
    pending=_COUNT,
)
_SOURCE = {
    "source": TEXT, "says": TEXT, "kind": TEXT, "status": TEXT, "unit": TEXT,
    "reason": TEXT, "standard_uncertainty": KNOWN_OR_NOT, "height": KNOWN_OR_NOT,
}  # fmt: skip
_LIMIT = {
    "name": TEXT, "unit": TEXT, "value": KNOWN_OR_NOT, "allowed": KNOWN_OR_NOT,
    "speed_factor": _NUMBER,
}  # fmt: skip
_LIGHT = {
    "level": {"enum": ["green", "amber", "red"]},
    "word": TEXT,
    "reasons": rows({"what": TEXT, "remedy": TEXT}),
}
_FORM = group(
    {},
    bag=TEXT,
    calibration=TEXT,
    sample_period=ranged(SAMPLE_PERIOD),
    samples=each(_STREAM),
    warnings=TEXTS,
    settings=_ANY,
    versions=_ANY,
    files=_ANY,
    admission=or_none(_ANY),
    conditions=group(
        {},
        recorded_ns=or_none(ranged(STAMP)),
        calibration_age=KNOWN_OR_NOT,
        temperature=or_none(_ANY),
    ),
    prediction=or_none(
        group(
            {},
            limits=rows(_LIMIT),
            not_evaluated=TEXTS,
            speed_factor=KNOWN_OR_NOT,
        )
    ),
    dynamic_error_before=or_none(_ERROR),
    dynamic_error_after=or_none(_ERROR),
    deviation=or_none(group({}, raw=or_none(_DEVIATION), corrected=or_none(_DEVIATION))),
    uncertainty=group({}, median=KNOWN_OR_NOT, largest=KNOWN_OR_NOT),
    budget=or_none(group({}, sources=rows(_SOURCE))),
    light=or_none(group(_LIGHT)),
    form=or_none(
        group(
            {},
            deviation=each(FIGURE),
            conformity=or_none(group(CONFORMITY)),
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
