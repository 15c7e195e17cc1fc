"""The layout of a surface point, the same in ``/omsm/points`` and in ``cloud.ply``."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.records import SurfacePoints

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
