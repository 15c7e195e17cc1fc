"""Counts of encoders and readings of probes, to and from metres and radians.

The ranges of these figures are those of the drivers' parameters, which check them.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from omsm_ros.core.streams.blocks import FloatArray, IntArray
from omsm_ros.errors import DataError
from omsm_ros.units import MICROMETRE_M

AXES = ("x", "y", "z", "b", "c")


def whole_counts(name: str, values: FloatArray, kind: type[np.signedinteger[Any]]) -> FloatArray:
    """Return ``values`` (n,); DataError, which calls them ``name``, if they do not fit ``kind``."""
    lowest = float(np.iinfo(kind).min)
    outside = ~((values >= lowest) & (values < -lowest))  # also true for NaN
    if outside.any():
        raise DataError(
            f"{name} of {float(values[outside][0])!r} counts does not fit {kind.__name__}"
        )
    return values


@dataclass(frozen=True, slots=True)
class AxisScaling:
    """``value = offset + sign · counts / counts_per_unit``.

    counts_per_unit: counts per metre or per radian;  sign: +1 or -1
    offset: position at count zero [m or rad]
    wrap: counts after which the encoder starts again at zero; 0 = it never does
    """

    counts_per_unit: float
    sign: int = 1
    offset: float = 0.0
    wrap: int = 0

    def values(self, counts: IntArray) -> FloatArray:
        """Return the positions [m or rad] of unwrapped ``counts`` (n,)."""
        return self.offset + counts / (self.sign * self.counts_per_unit)

    def counts(self, values: FloatArray) -> IntArray:
        """Return what the encoder reports at ``values`` [m or rad] (n,), in whole counts."""
        scaled = np.rint((values - self.offset) * (self.sign * self.counts_per_unit))
        whole = whole_counts("axis position", scaled, np.int64).astype(np.int64)
        return whole % self.wrap if self.wrap else whole


@dataclass(frozen=True, slots=True)
class ProbeReading:
    """``distance = polarity · (reading - zero)``.

    full_scale: measuring range, of which 16-bit distances are parts [m] (`$SCA`)
    zero: reading that is distance zero [m]
    polarity: +1 if the reading falls as the probe nears the target; -1 if it grows
    intensity_full_scale: reading that is intensity 1
    """

    full_scale: float = 100 * MICROMETRE_M
    zero: float = 0.0
    polarity: int = 1
    intensity_full_scale: float = 100.0

    def distance(self, raw: FloatArray) -> FloatArray:
        """Return the distance [m] of a reading [m]."""
        return self.polarity * (raw - self.zero)

    def raw(self, distance: FloatArray) -> FloatArray:
        """Return the reading [m] at a distance [m]."""
        return self.zero + self.polarity * distance
