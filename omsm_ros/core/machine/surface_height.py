"""What a motion follows and a probe looks at: a height over the plane."""

from __future__ import annotations

from typing import Protocol

from omsm_ros.core.samples.blocks import FloatArray


class Surface(Protocol):
    """Anything with a height over the plane."""

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m], of their broadcast shape."""
        ...
