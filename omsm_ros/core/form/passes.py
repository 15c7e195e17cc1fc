"""Where does a path come past its own neighbourhood again: turns of a spiral, lines of a raster?"""

from __future__ import annotations

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray, IntArray

# Of the span, on either side of its middle: what jitters there has not passed it.
_NEAR_MIDDLE = 0.05
# Points in no order pass the middle every fourth point.
_LEAST_POINTS, _LEAST_PASSES = 16, 8


def passes(x: FloatArray, y: FloatArray) -> IntArray | None:
    """Return where each pass of the path x, y (n,) begins, (g,), the first at zero.

    A pass is from one upward crossing of the middle to the next, along the axis that has more of
    them. None for fewer than eight, or points that follow no path.
    """
    crossed = max(_crossings(x), _crossings(y), key=len)
    if len(crossed) < 2:
        return None
    # From the first point on, so that no pass but the last is a part of one.
    begins = np.append(crossed, 2 * crossed[-1] - crossed[-2]) - crossed[0]
    begins = begins[begins < len(x)]
    enough = len(begins) >= _LEAST_PASSES and len(x) >= _LEAST_POINTS * len(begins)
    return begins if enough else None


def _crossings(position: FloatArray) -> IntArray:
    """Return the points (g,) at which ``position`` (n,) has come from below to above its middle."""
    low, high = float(position.min()), float(position.max())
    middle, near = (low + high) / 2, _NEAR_MIDDLE * (high - low)
    aside = np.flatnonzero(np.abs(position - middle) > near)
    above = position[aside] > middle
    return np.asarray(aside[1:][above[1:] & ~above[:-1]], np.int64)
