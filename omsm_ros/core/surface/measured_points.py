"""What any instrument delivers of a surface: heights at places, in metres."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.samples.blocks import BoolArray, FloatArray, IntArray
from omsm_ros.errors import DataError
from omsm_ros.quantities import COUNTER, POSITION, UNCERTAINTY


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MeasuredPoints:
    """Heights over a plane, scattered or on a grid, in the frame of the instrument.

    x, y, height: [m], each (n,)
    uncertainty: standard uncertainty of each height [m], k = 1, (n,); None where nobody states it
    sample: place of each point in the order of the scan, (n,); None where nobody states it
    missing: how many places of a map have no height; they are left out
    notes: what a reader of the results should know about how the file was understood

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
        columns = {"x": self.x, "y": self.y, "height": self.height}
        optional = (("uncertainty", self.uncertainty), ("sample", self.sample))
        shapes = {name: np.shape(column) for name, column in columns.items()}
        shapes |= {name: np.shape(column) for name, column in optional if column is not None}
        if len(set(shapes.values())) != 1 or self.x.ndim != 1:
            raise DataError(f"points of {shapes!r} values, expected one row of one length each")
        if not len(self.x):
            raise DataError("a surface of no points; give one that has heights")
        for name, column in columns.items():
            POSITION.checked_all(column, DataError, name)
        if self.uncertainty is not None:
            UNCERTAINTY.checked_all(self.uncertainty, DataError, "uncertainty")
        if self.sample is not None:
            COUNTER.checked_all(self.sample, DataError, "sample")

    def __len__(self) -> int:
        return len(self.x)

    def part(self, place: BoolArray | IntArray) -> MeasuredPoints:
        """Return the points at ``place``: which of them (n,), or their numbers."""
        return MeasuredPoints(
            x=self.x[place],
            y=self.y[place],
            height=self.height[place],
            uncertainty=None if self.uncertainty is None else self.uncertainty[place],
            sample=None if self.sample is None else self.sample[place],
            missing=self.missing,
            notes=self.notes,
        )


def measured(
    x: FloatArray,
    y: FloatArray,
    height: FloatArray,
    uncertainty: FloatArray | None = None,
    notes: tuple[str, ...] = (),
    *,
    sample: NDArray[Any] | None = None,
) -> MeasuredPoints:
    """Return the points (n,) [m] whose height is a number; those that have none are counted."""
    known = np.isfinite(height)
    order = None if sample is None else COUNTER.checked_all(sample[known], DataError, "sample")
    return MeasuredPoints(
        x=np.ascontiguousarray(x[known], np.float64),
        y=np.ascontiguousarray(y[known], np.float64),
        height=np.ascontiguousarray(height[known], np.float64),
        uncertainty=None if uncertainty is None else np.asarray(uncertainty[known], np.float64),
        sample=None if order is None else order.astype(np.int64),
        missing=int(np.sum(~known)),
        notes=notes,
    )
