"""``form.json`` and ``curves.json`` of a registered part, read again: what a page uses of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.errors import FileError
from omsm_ros.quantities import SIGNAL
from omsm_ros.storage.files import said
from omsm_ros.storage.result_folder import read_result
from omsm_ros.storage.schemas import (
    CONFORMITY,
    FIGURE,
    TEXT,
    TEXTS,
    check_form,
    each,
    group,
    or_none,
    ranged,
    rows,
)

_NUMBER = ranged(SIGNAL)
_SQUARE = {"type": "number", "minimum": 0, "maximum": SIGNAL.high}
_ARRAY = {"type": "array"}
_AGAIN = "register the part again"

_REMOVED = group(
    {},
    fitted=TEXTS,
    notes=TEXTS,
    not_evaluated=TEXTS,
    held=each(TEXT),
    not_determined=each(TEXT),
    pose_uncertainty=each(each(_NUMBER)),
)
_TERM = {"n": {"type": "integer"}, "m": {"type": "integer"}, **FIGURE["properties"]}
_FORM = group(
    {"zernike": rows(_TERM)},
    deviation=each(FIGURE),
    pose=each(FIGURE),
    removed=_REMOVED,
    conformity=or_none(group(CONFORMITY)),
)
_COLUMNS = ("position", "value", "uncertainty")
_CURVE = group(dict.fromkeys(_COLUMNS, _ARRAY))
_DENSITY = group(
    {
        "radial": _CURVE,
        "azimuthal": _CURVE,
        "mean_square": _SQUARE,
        "mean_square_in_band": _SQUARE,
        "band": {"type": "array", "items": _NUMBER, "minItems": 2, "maxItems": 2},
    },
    areal=group(dict.fromkeys(("x", "y", "value"), _ARRAY)),
)
_CURVES = group({}, profiles=each(_CURVE), psd=or_none(_DENSITY))


def read_form(path: Path) -> dict[str, Any]:
    """Return the content of ``form.json``: lengths [m], angles [rad].

    FileError where it is not there, too large, no JSON, or where something that is read from it
    is of another kind than a registration writes.
    """
    form, what = read_result(path, "form"), f"form {str(path)!r}"
    check_form(form, _FORM, FileError, what)
    removed = form.get("removed", {})
    for source, shares in removed.get("pose_uncertainty", {}).items():
        for name in removed.get("fitted", ()):
            if name not in shares:
                raise FileError(
                    f"{what}: pose_uncertainty.{source} lacks {name}, which was fitted; {_AGAIN}"
                )
    return form


def read_curves(path: Path) -> dict[str, Any]:
    """Return the content of ``curves.json``: profiles [m], densities [m⁴].

    FileError as :func:`read_form`, and for columns of a curve that do not fit each other.
    """
    curves, what = read_result(path, "curves"), f"curves {str(path)!r}"
    check_form(curves, _CURVES, FileError, what)
    density = curves.get("psd") or {}
    parts = {n: density[n] for n in ("radial", "azimuthal") if n in density}
    for name, curve in (curves.get("profiles", {}) | parts).items():
        lengths = {len(_numbers(curve[column], f"{what}: {name}", 1)) for column in _COLUMNS}
        if len(lengths) > 1:
            raise FileError(f"{what}: {name} has columns of {sorted(lengths)} values; {_AGAIN}")
    if areal := density.get("areal"):
        x, y = (_numbers(areal[axis], f"{what}: areal.{axis}", 1) for axis in "xy")
        shape = _numbers(areal["value"], f"{what}: areal.value", 2).shape
        if shape != (len(y), len(x)):
            raise FileError(
                f"{what}: areal.value has {shape[0]} × {shape[1]} values at {len(y)} × {len(x)} "
                f"frequencies; {_AGAIN}"
            )
    return curves


def _numbers(values: object, what: str, axes: int) -> FloatArray:
    try:
        found = np.array(values, np.float64)
    except (TypeError, ValueError) as err:
        raise FileError(f"{what} is no row of numbers: {said(err)}; {_AGAIN}") from err
    if found.ndim != axes or not found.size or not np.all(np.isfinite(found)):
        raise FileError(f"{what} has shape {found.shape!r} or what is no number; {_AGAIN}")
    return found
