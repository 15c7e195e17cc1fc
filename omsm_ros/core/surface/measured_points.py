"""Measured points of a surface from any instrument, in metres."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.streams.blocks import BoolArray, FloatArray, IntArray
from omsm_ros.errors import DataError, Notice
from omsm_ros.quantities import COUNTER, POSITION, UNCERTAINTY

_COLUMNS = {"x": POSITION, "y": POSITION, "height": POSITION,
            "uncertainty": UNCERTAINTY, "sample": COUNTER}  # fmt: skip
# Odd multiplier of the hash, 2⁶⁴ divided by the golden ratio (Knuth).
_MIXED = np.uint64(0x9E3779B97F4A7C15)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MeasuredPoints:
    """Heights over a plane, scattered or on a grid, in the frame of the instrument.

    x, y, height: [m], each (n,)
    uncertainty: standard uncertainty of each height [m], k = 1, (n,); None if not stated
    sample: position of each point in the order of the scan, (n,); None if not stated
    missing: number of places of a map without a height, which are left out
    notes: for the user, about the interpretation of the file

    Raises DataError for lengths that differ, no points at all, or implausible coordinates.
    """

    x: FloatArray
    y: FloatArray
    height: FloatArray
    uncertainty: FloatArray | None = None
    sample: IntArray | None = None
    missing: int = 0
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        columns = {name: getattr(self, name) for name in _COLUMNS}
        shapes = {name: np.shape(v) for name, v in columns.items() if v is not None}
        if len(set(shapes.values())) != 1 or self.x.ndim != 1:
            raise DataError("surface.columns", shapes=shapes)
        if not len(self.x):
            raise DataError("surface.empty_surface")
        for name in shapes:
            _COLUMNS[name].checked_all(columns[name], DataError, name)

    def __len__(self) -> int:
        return len(self.x)

    def part(self, place: BoolArray | IntArray) -> MeasuredPoints:
        """Return the points at ``place``, a mask (n,) or indices."""
        columns = {name: getattr(self, name) for name in _COLUMNS}
        return replace(self, **{n: v[place] for n, v in columns.items() if v is not None})


def measured(
    x: FloatArray, y: FloatArray, height: FloatArray, uncertainty: FloatArray | None = None,
    notes: tuple[str, ...] = (), *, sample: NDArray[Any] | None = None,
) -> MeasuredPoints:  # fmt: skip
    """Return the points (n,) [m] that have a position and a height; others count as missing."""
    with np.errstate(invalid="ignore"):  # a signalling NaN of single precision is a NaN too
        x, y, height = (np.ascontiguousarray(v, np.float64) for v in (x, y, height))
    known = np.isfinite(height) & ~np.isnan(x) & ~np.isnan(y)
    order = None if sample is None else COUNTER.checked_all(sample[known], DataError, "sample")
    return MeasuredPoints(
        x=x[known], y=y[known], height=height[known],
        uncertainty=None if uncertainty is None else np.asarray(uncertainty[known], np.float64),
        sample=None if order is None else order.astype(np.int64), missing=int(np.sum(~known)),
        notes=notes,
    )  # fmt: skip


def without_duplicates(points: MeasuredPoints) -> MeasuredPoints:
    """Return the points without exact duplicates, whose number is added as a note.

    A point that a program has written twice is no second measurement.
    """
    # A 64-bit hash of each point: of 20 million points two collide in one file of 100 000.
    number = np.zeros(len(points), np.uint64)
    for values in (points.x, points.y, points.height):
        number = (number ^ values.view(np.uint64)) * _MIXED
        number ^= number >> np.uint64(32)
    ordered = np.sort(number)
    if np.all(ordered[1:] != ordered[:-1]):
        return points
    _, first = np.unique(number, return_index=True)
    note = str(Notice("surface.duplicates", points=len(points) - len(first)))
    return replace(points.part(np.sort(first)), notes=(*points.notes, note))
