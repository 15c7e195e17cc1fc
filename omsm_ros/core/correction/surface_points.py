"""The layout of a surface point, the same in ``/omsm/points`` and in ``cloud.ply``."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.samples.blocks import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SurfacePoints:
    """Corrected surface points, each array of shape (n,).

    sample: trigger counter (int64)
    x, y: position in the workpiece frame [m]
    height: surface height [m] (Eq. 10)
    dynamic_error: (1 - G_m) X_d [m] (Eq. 5)
    uncertainty: standard uncertainty of height [m], k = 1
    intensity: 0-1, NaN where the device does not tell (float32)
    """

    sample: IntArray
    x: FloatArray
    y: FloatArray
    height: FloatArray
    dynamic_error: FloatArray
    uncertainty: FloatArray
    intensity: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.sample)


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

# Eight-byte alignment: viewers cast pointers into the buffer.
POINT_DTYPE = np.dtype(
    {
        "names": [name for name, _ in CLOUD_FIELDS],
        "formats": [kind for _, kind in CLOUD_FIELDS],
        "offsets": [0, 4, 8, 16, 24, 28, 32, 36],
        "itemsize": 40,
    }
)
"""One point of a PointCloud2 message."""


def pack_points(points: SurfacePoints) -> NDArray[np.void]:
    """Points as a structured array (n,) of :data:`POINT_DTYPE`; z repeats height for viewers."""
    packed = np.zeros(len(points), POINT_DTYPE)
    packed["z"] = points.height
    # The counter of the trigger is 64 bits wide; a cloud keeps its low half.
    packed["sample"] = points.sample & 0xFFFFFFFF
    for name in ("x", "y", "height", "dynamic_error", "uncertainty", "intensity"):
        packed[name] = getattr(points, name)
    return packed
