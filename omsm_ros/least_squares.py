"""Linear least squares whose columns may have any units: each is scaled to unit length first."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
# Of columns that are factorised at a time.
_ROWS = 65_536


def unit_columns(columns: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return ``columns`` (n, q) over their lengths, and the lengths (q,); 1 for a zero column."""
    scale = np.linalg.norm(columns, axis=0)
    scale[scale == 0] = 1.0
    return columns / scale, scale


def least_squares(
    columns: FloatArray, values: FloatArray, tolerance: float | None = None
) -> FloatArray:
    """Return the coefficients (q,) with which ``columns`` (n, q) come nearest to ``values`` (n,).

    tolerance: singular values below this part of the largest count as zero; None for rounding
    """
    unit, scale = unit_columns(columns)
    return np.asarray(np.linalg.lstsq(unit, values, rcond=tolerance)[0] / scale)


def orthonormal(columns: FloatArray, tolerance: float) -> FloatArray:
    """Return a basis (n, r) of what ``columns`` (n, q) span.

    tolerance: directions weaker than this part of the strongest are left out
    """
    left, values, _ = np.linalg.svd(unit_columns(columns)[0], full_matrices=False)
    return np.asarray(left[:, values > tolerance * values[0]])


def triangle(*parts: FloatArray) -> FloatArray:
    """Return R (q, q) of the columns of all ``parts`` (n, …), side by side, without making Q.

    Block by block, so that a long record's columns are never in memory twice.
    """
    found = np.zeros((0, sum(part.shape[1] for part in parts)))
    for first in range(0, len(parts[0]), _ROWS):
        block = np.column_stack([part[first : first + _ROWS] for part in parts])
        found = np.linalg.qr(np.concatenate([found, block]), mode="r")
    return np.asarray(found)
