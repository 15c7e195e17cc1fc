"""The points of a measurement as the figures want them."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.core.surface.area_weights import area_weights
from omsm_ros.errors import DataError


@dataclass(frozen=True, eq=False, kw_only=True)
class CloudView:
    """Corrected points in the order they were taken, each array of shape (n,), SI.

    time: since the start of the scan [s]
    x, y: position in the workpiece frame [m]
    height: corrected [m] (Eq. 10)
    raw_height: encoder plus probe as read, uncorrected [m] (Eq. 2)
    dynamic_error: (1 - G_m) X_d [m] (Eq. 5), what the correction took away
    uncertainty: standard uncertainty of height [m], k = 1
    """

    time: FloatArray
    x: FloatArray
    y: FloatArray
    height: FloatArray
    raw_height: FloatArray
    dynamic_error: FloatArray
    uncertainty: FloatArray

    def __post_init__(self) -> None:
        lengths = {name: len(getattr(self, name)) for name in (f.name for f in fields(self))}
        if len(set(lengths.values())) != 1 or not len(self.x):
            raise DataError(f"cloud of {lengths!r} values, expected one length, 1 or more")

    def __len__(self) -> int:
        return len(self.x)

    @cached_property
    def area(self) -> FloatArray:
        """The area that each point stands for, (n,), of mean 1."""
        return area_weights(self.x, self.y)
