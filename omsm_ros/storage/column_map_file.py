"""``MAP.yaml``: which column of a foreign recording is which channel, in which unit."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omsm_ros.core.samples.foreign_columns import CHANNELS, Column, ColumnMap
from omsm_ros.errors import DataError, FileError
from omsm_ros.foreign_units import COUNT, UNITS
from omsm_ros.quantities import SIGNAL, shown
from omsm_ros.storage import strict_yaml
from omsm_ros.storage.files import read_text
from omsm_ros.storage.foreign.table import TableForm
from omsm_ros.storage.schemas import NUMBER, check_form, form

_MAX_BYTES = 100_000
_BY_PLACE = re.compile(r"\[\d{1,4}\]")

_TEXT = {"type": "string", "minLength": 1}
_LINES = {"type": "integer", "minimum": 0, "maximum": 1000}
_COLUMN = form(
    {"name": _TEXT, "unit": _TEXT, COUNT: NUMBER, "sign": {"enum": [1, -1]}, "constant": NUMBER}, ()
)
_MAP = form(
    {
        "columns": form(dict.fromkeys(CHANNELS, _COLUMN), ()),
        "sample_period": NUMBER,
        "start": NUMBER,
        "invalid": {"type": "array", "items": {"anyOf": [NUMBER, _TEXT]}, "maxItems": 100},
        "delimiter": {"type": "string", "minLength": 1, "maxLength": 1},
        "decimal": {"enum": [".", ","]},
        "zone": {"type": "string", "pattern": r"^(Z|[+-](0\d|1[0-4]):[0-5]\d)$"},
        "lines_before_names": _LINES,
        "lines_after_names": _LINES,
    },
    ("columns",),
)


def load_column_map(path: Path | str) -> tuple[ColumnMap, TableForm]:
    """Read ``MAP.yaml``; FileError for anything that is unclear, a unit above all."""
    what = f"map {str(path)!r}"
    text = read_text(path, _MAX_BYTES, FileError, "map")
    content = strict_yaml.mapping_of(text, FileError, what)
    check_form(content, _MAP, FileError, what)
    invalid = content.get("invalid", ())
    try:
        mapped = ColumnMap(
            {c: _column(c, given) for c, given in content["columns"].items()},
            content.get("sample_period"),
            float(content.get("start", 0.0)),
            tuple(float(value) for value in invalid if not isinstance(value, str)),
        )
    except DataError as err:
        raise FileError(f"{what}: {err}") from err
    written = TableForm(
        content.get("delimiter", ","),
        content.get("decimal", "."),
        content.get("lines_before_names", 0),
        content.get("lines_after_names", 0),
        _is_named(mapped),
        tuple(text for text in invalid if isinstance(text, str)),
        content.get("zone", ""),
    )
    if written.delimiter == written.decimal:
        raise FileError(
            f"{what}: {written.decimal!r} stands between columns and before the fraction; "
            "write delimiter: ';' or what the file has"
        )
    return mapped, written


def _is_named(mapped: ColumnMap) -> bool:
    """Return whether columns have names; where all are [0], [1], … a text has no line of them."""
    names = mapped.names(CHANNELS)
    return not names or not all(_BY_PLACE.fullmatch(name) for name in names)


def _column(channel: str, given: Mapping[str, Any]) -> Column:
    if ("name" in given) == ("constant" in given):
        raise DataError(f"{channel} needs a column's name, or a constant; give one of them")
    sign = float(given.get("sign", 1))
    if "constant" in given:
        if channel in ("trigger", "time"):
            raise DataError(
                f"{channel} is constant, which tells no sample from another; name its column, or "
                "leave it out"
            )
        constant = SIGNAL.checked(float(given["constant"]), DataError, f"{channel}: constant")
        return Column("", constant=constant and constant * _factor(channel, given, sign))
    return Column(given["name"], _factor(channel, given, sign), unit=given.get("unit", ""))


def _factor(channel: str, given: Mapping[str, Any], sign: float) -> float:
    """Return the SI value of a column's unit. One that is not written is never guessed."""
    units = UNITS[channel]
    if channel == "trigger":
        return 1.0
    unit = given.get("unit")
    if unit == COUNT:
        if COUNT not in given:
            raise DataError(
                f"{channel}: what is one count in SI? write it into the map, as count: 1e-9"
            )
        value = float(given[COUNT])
        if not 1e-15 <= abs(value) <= 1.0:
            raise DataError(
                f"{channel}: one count is {value:g} in SI, expected 1e-15 to 1 m or rad"
            )
        return value * sign
    if unit not in units:
        said = "has no unit" if unit is None else f"has the unit {shown(unit)}"
        raise DataError(f"{channel} {said}; write one of {[*units, COUNT]}")
    return units[unit] * sign
