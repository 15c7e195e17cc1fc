"""Corrected surface points and their layout in ``/omsm/points`` and ``cloud.ply``."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.streams.blocks import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SurfacePoints:
    """Corrected surface points, each array of shape (n,).

    sample: trigger counter (int64)
    x, y: position in the workpiece frame [m]
    height: surface height [m] (Eq. 10)
    dynamic_error: (1 - G_m) X_d [m] (Eq. 5)
    uncertainty: standard uncertainty of height [m], k = 1
    intensity: 0-1, NaN where the device does not report it (float32)
    stamp_ns: stamp of the first point by the axes [ns]; 0 if there is none
    """

    sample: IntArray
    x: FloatArray
    y: FloatArray
    height: FloatArray
    dynamic_error: FloatArray
    uncertainty: FloatArray
    intensity: NDArray[np.float32]
    stamp_ns: int = 0

    def __len__(self) -> int:
        return len(self.sample)

    def part(self, place: slice | BoolArray) -> SurfacePoints:
        """Return the points at ``place``, without the stamp."""
        return SurfacePoints(**{name: getattr(self, name)[place] for name in _COLUMNS})


_COLUMNS = tuple(field.name for field in fields(SurfacePoints) if field.name != "stamp_ns")
_KINDS = {"sample": np.int64, "intensity": np.float32}
_NO_POINTS = SurfacePoints(
    **{name: np.empty(0, _KINDS.get(name, np.float64)) for name in _COLUMNS}, stamp_ns=0
)


def join_points(parts: Iterable[SurfacePoints | None]) -> SurfacePoints:
    """Return all points of ``parts`` in their order; None stands for no points."""
    present = [part for part in parts if part is not None and len(part)] or [_NO_POINTS]
    columns = {name: np.concatenate([getattr(p, name) for p in present]) for name in _COLUMNS}
    return SurfacePoints(**columns, stamp_ns=present[0].stamp_ns)


CLOUD_FIELDS: tuple[tuple[str, str], ...] = (
    ("x", "<f4"),
    ("y", "<f4"),
    ("z", "<f4"),
    ("height", "<f8"),
    ("dynamic_error", "<f4"),
    ("uncertainty", "<f4"),
    ("intensity", "<f4"),
    ("sample", "<u4"),
)
"""Name and little-endian type of each field; lengths in metres."""

# Aligned like a C struct, because viewers cast pointers into the buffer.
POINT_DTYPE = np.dtype(list(CLOUD_FIELDS), align=True)
"""One point of a PointCloud2 message."""


def pack_points(points: SurfacePoints, dtype: np.dtype[np.void] = POINT_DTYPE) -> NDArray[np.void]:
    """Return the points as a structured array (n,) of ``dtype``, of the contract's fields.

    z repeats height for viewers.
    """
    packed = np.zeros(len(points), dtype)
    # A cloud keeps the low 32 bits of the 64-bit trigger counter.
    special = {"z": points.height, "sample": points.sample & 0xFFFFFFFF}
    for name, _ in CLOUD_FIELDS:
        packed[name] = special[name] if name in special else getattr(points, name)
    return packed
