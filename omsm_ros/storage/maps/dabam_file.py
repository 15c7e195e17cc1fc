"""Profiles of the DABAM collection: columns in ``NAME.dat``, what they are in ``NAME.txt``.

``FILE_FORMAT`` 1 has slopes in the second column, 2 heights; 3 and 4 the same in pairs of columns.
Further columns (residuals) are derived, and are left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.core.surface.measured_points import MeasuredPoints, measured
from omsm_ros.errors import FileError
from omsm_ros.storage import strict_json
from omsm_ros.storage.files import open_regular, read_text
from omsm_ros.storage.table_file import rows_in

_MAX_HEADER_BYTES = 100_000
_MAX_DATA_BYTES = 200_000_000
_SLOPES, _HEIGHTS = (1, 3), (2, 4)


@dataclass(frozen=True, slots=True, eq=False)
class DabamProfile:
    """A profile as it was stored.

    position: [m], (n,);  value: heights [m] or slopes [rad], (n,)
    slopes: whether ``value`` is slopes
    header: what the text beside it says
    """

    position: FloatArray
    value: FloatArray
    slopes: bool
    header: Mapping[str, Any]


def has_dabam_header(path: Path) -> bool:
    """Tell whether a text beside ``path`` describes it as a profile of DABAM."""
    beside = path.with_suffix(".txt")
    if path.suffix.lower() != ".dat" or beside == path or not beside.is_file():
        return False
    try:
        return "FILE_FORMAT" in _header(beside)
    except FileError:
        return False


def _header(path: Path) -> dict[str, Any]:
    text = read_text(path, _MAX_HEADER_BYTES, FileError, "header")
    return strict_json.object_of(text, FileError, f"header {str(path)!r}")


def load_dabam(path: Path) -> DabamProfile:
    """Read columns and header; FileError where they do not fit each other."""
    what = f"profile {str(path)!r}"
    header = _header(path.with_suffix(".txt"))
    form, skip = header.get("FILE_FORMAT"), header.get("FILE_HEADER_LINES")
    factors = [header.get(key) for key in ("X1_FACTOR", "Y1_FACTOR")]
    numbers = [n for n in factors if isinstance(n, float | int) and n > 0]
    known = form in (*_SLOPES, *_HEIGHTS) and isinstance(skip, int) and 0 <= skip <= 1000
    if not known or len(numbers) != 2:
        raise FileError(
            f"{what}: its header says FILE_FORMAT {form!r}, FILE_HEADER_LINES {skip!r}, factors "
            f"{factors!r}; expected 1 to 4, a count, and numbers above zero"
        )
    with open_regular(path, FileError, "profile") as stream:
        lines = stream.read(_MAX_DATA_BYTES).decode("utf-8", "replace").splitlines()[skip:]
    table = rows_in(lines, what, "check FILE_HEADER_LINES", above=skip, usecols=(0, 1))
    if not len(table):
        raise FileError(
            f"{what} has no points after its {skip} lines of header; check FILE_HEADER_LINES"
        )
    position, value = (table[:, i] * float(numbers[i]) for i in (0, 1))
    return DabamProfile(position, value, form in _SLOPES, header)


def read_dabam(path: Path) -> MeasuredPoints:
    """Read a profile as points along x at y = 0; slopes are integrated by the trapezoidal rule.

    Raises FileError where columns and header do not fit each other.
    """
    profile = load_dabam(path)
    height, notes = profile.value, ("a profile along x",)
    if profile.slopes:
        # Here, because to load it takes half a second, and every map passes through this module.
        from scipy.integrate import cumulative_trapezoid

        height = cumulative_trapezoid(profile.value, profile.position, initial=0.0)
        notes = ("a profile along x; its slopes were integrated",)
    return measured(profile.position, np.zeros_like(height), height, notes=notes)
