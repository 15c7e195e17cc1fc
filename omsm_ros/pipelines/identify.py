"""Read tables to identify sampled models from, and models; write certificates."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from omsm_ros import __version__
from omsm_ros.core.estimation.parallel_sections import HOLDS
from omsm_ros.core.estimation.sampled_fit import SampledRecord
from omsm_ros.core.estimation.sampled_model import SCHEMA, SCHEMA_1, SampledModel
from omsm_ros.core.identification.fitted_record import fitted_record
from omsm_ros.core.identification.identify import Identification
from omsm_ros.errors import CalibrationError, DataError, FileError, named_errors
from omsm_ros.io.files import load_object, result_folder, save_json, save_text
from omsm_ros.io.json_and_yaml import NUMBER, check_form, form
from omsm_ros.io.tables.text_table import PLAIN, TextTable, load_columns
from omsm_ros.readable import now_text, quantity
from omsm_ros.units import seconds_of

# Ten times the difference between the clocks of two computers.
_PERIOD_TOLERANCE = 5e-3
# Step of the time column, in sample periods, that means a missing row; times that are written
# with few digits scatter by one period.
_GAP_PERIODS = 2.5


def record_of_table(
    path: Path, inputs: Sequence[str], output: str, period: float, duration: float = 0.0
) -> SampledRecord:
    """Read columns of a CSV file, one row a ``period`` [s]; ``duration`` [s], 0 = all.

    Readings of the output may be missing. Raises DataError if a time column contradicts the period.
    """
    _check_time(path, period)
    columns = load_columns(path, (*inputs, output), may_miss=(output,))
    lines = round(duration / period) or len(columns[0])
    *drives, read = (column[:lines] for column in columns)
    return SampledRecord(np.column_stack(drives), read, np.isfinite(read))


def _check_time(path: Path, period: float) -> None:
    """Raise DataError if a time column with a unit contradicts the ``period`` [s] or has gaps.

    A wrong period scales all frequencies by one factor, which no residual shows.
    """
    named = {
        name: one for name in TextTable(path, PLAIN).names if (one := seconds_of(name)) is not None
    }
    for name, second in named.items():
        try:
            (time,) = load_columns(path, (name,))
        except FileError:  # not numbers, such as dates
            continue
        steps = np.diff(time) * second
        mean, most = float(np.mean(steps)), float(np.max(steps))
        even = abs(float(np.median(steps)) / period - 1) < _PERIOD_TOLERANCE
        if even and most > _GAP_PERIODS * period:
            raise DataError(
                f"table {str(path)!r}: {name!r} steps by {quantity(most, 's')} after row "
                f"{int(np.argmax(steps)) + 1}, expected {quantity(period, 's')}: rows are missing; "
                "cut the record there"
            )
        if abs(mean / period - 1) > _PERIOD_TOLERANCE:
            raise DataError(
                f"table {str(path)!r}: rows are {mean:.6g} s apart in {name!r}, {period:.6g} s are "
                "stated; give the period of the record, or correct the unit in that column's name"
            )


PAGE, DCC = "certificate.html", "certificate_dcc.xml"


def write_certificate(out: Path, identified: Identification, *, source: str = "") -> Path:
    """Write certificate.html and certificate_dcc.xml into ``out``; return the page's path.

    source: name of the recording, as the page states it
    """
    # Imported on demand, because loading the figures takes a second.
    from omsm_ros.report.certificate.figures import certificate_figures_of
    from omsm_ros.report.certificate.page import render
    from omsm_ros.report.certificate.tables import render_dcc
    from omsm_ros.report.page_parts import Issue

    calibration = identified.calibration
    with result_folder(out, (PAGE, DCC)) as folder:
        figures = certificate_figures_of(calibration, fitted_record(identified))
        issue = Issue(date=now_text(), source=source, version=__version__, figures=figures)
        save_text(folder / DCC, render_dcc(calibration, __version__))
        save_text(folder / PAGE, render(calibration, issue))
    return out / PAGE


_MAX_BYTES = 8_000_000
# 40 poles of eight inputs.
_MOST_SECTIONS, _MOST_INPUTS, _MOST_COVARIANCE = 40, 8, 450**2
_NUMBERS = {"type": "array", "items": NUMBER, "maxItems": _MOST_INPUTS}
_PAIR = {"type": "array", "items": NUMBER, "minItems": 2, "maxItems": 2}
_PAIRS = {"type": "array", "items": _PAIR, "maxItems": _MOST_SECTIONS}
_PROPERTIES = {
    "schema": {"const": SCHEMA},
    "hold": {"enum": list(HOLDS)},
    "sample_period": NUMBER,
    "denominators": _PAIRS,
    "numerators": {"type": "array", "items": _PAIRS, "minItems": 1, "maxItems": _MOST_INPUTS},
    "direct": _NUMBERS,
    "delays": _NUMBERS,
    "covariance": {"type": ["array", "null"], "items": NUMBER, "maxItems": _MOST_COVARIANCE},
    "working_point": {"type": "array", "items": NUMBER, "minItems": 2, "maxItems": 9},
    "valid": {"type": "array", "items": _PAIR, "minItems": 1, "maxItems": _MOST_INPUTS},
    "certificate": {"type": "object"},
}
_FORM = form(_PROPERTIES, tuple(_PROPERTIES))
# Schema 1: one input, polynomials of 20 poles.
_COEFFICIENTS = {"type": "array", "items": NUMBER, "minItems": 1, "maxItems": 21}


def _ratio_of(delay: str, kind: str) -> dict[str, object]:
    parts = {
        "numerator": _COEFFICIENTS,
        "denominator": _COEFFICIENTS,
        delay: {"type": kind},
        "covariance": {"type": ["array", "null"], "items": NUMBER, "maxItems": 42**2},
    }
    return {**form(parts, tuple(parts)), "type": ["object", "null"]}


_PROPERTIES_1 = {
    "schema": {"const": SCHEMA_1},
    "hold": _PROPERTIES["hold"],
    "sample_period": NUMBER,
    "discrete": _ratio_of("delay_samples", "integer"),
    "continuous": _ratio_of("delay", "number"),
    "working_point": _PAIR,
    "valid_from": NUMBER,
    "valid_up_to": NUMBER,
    "certificate": {"type": "object"},
}
_FORM_1 = form(_PROPERTIES_1, tuple(_PROPERTIES_1))


def save_model(path: Path | str, model: SampledModel) -> None:
    """Write ``MODEL.json`` (schema "omsm-model/2")."""
    save_json(path, model.content())


def load_model(path: Path | str) -> SampledModel:
    """Read ``MODEL.json``; CalibrationError if malformed or not to be computed with."""
    what = f"model {str(path)!r}"
    content = load_object(path, "model", _MAX_BYTES, error=CalibrationError)
    old = content.get("schema") == SCHEMA_1
    check_form(content, _FORM_1 if old else _FORM, CalibrationError, what)
    with named_errors(CalibrationError, what, CalibrationError):
        return SampledModel.from_content(content)
