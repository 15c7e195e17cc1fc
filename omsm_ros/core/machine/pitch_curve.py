"""How does the Z slide pitch along its way? A measured curve, and what it does over an arm.

An encoder that sits ``arm`` beside the beam sees the slide's motion and ``arm · α`` more (Abbe).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.errors import ConfigurationError


@dataclass(frozen=True, eq=False)
class PitchCurve:
    """Pitch ``angle`` (k,) [rad] at ``position`` (k,) of Z [m]; straight between, level beyond.

    Raises ConfigurationError unless the positions increase.
    """

    position: FloatArray
    angle: FloatArray

    def __post_init__(self) -> None:
        if len(self.position) < 2 or np.any(np.diff(self.position) <= 0):
            raise ConfigurationError(
                "positions of the pitch do not increase; sort them, each once, two or more"
            )

    def over(self, arm: float, z: FloatArray) -> FloatArray:
        """Return what an encoder ``arm`` [m] beside the beam reads too much at ``z`` (n,) [m]."""
        return np.asarray(arm * np.interp(z, self.position, self.angle), np.float64)
