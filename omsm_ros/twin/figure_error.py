"""What a turned mirror really looks like: its nominal shape and a figure error on top.

Closed-form and smooth: primary astigmatism (the grip of the chuck), trefoil (three-point
mounting) and concentric ripple (the slow-tool servo), each oriented by the seed. Tool marks, if
there are any, are the scallops that a round tool leaves turn by turn.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from omsm_ros.core.machine.surface_height import Surface
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.errors import ConfigurationError
from omsm_ros.units import MICROMETRE_M, MILLIMETRE_M, NANOMETRE_M


@dataclass(frozen=True, slots=True)
class FigureError:
    """A surface: ``nominal`` plus a seeded figure error.

    radius: of the aperture [m], where astigmatism and trefoil reach their full size
    seed: of the orientations of astigmatism and trefoil
    astigmatism, trefoil, ripple: peak to valley of each part over the aperture [m]
    ripple_pitch: from crest to crest of the rings [m]
    tool_marks: peak to valley of the scallops [m];  tool_feed: from one to the next [m]
    """

    nominal: Surface
    radius: float
    seed: int = 1
    astigmatism: float = 80 * NANOMETRE_M
    trefoil: float = 40 * NANOMETRE_M
    ripple: float = 8 * NANOMETRE_M
    ripple_pitch: float = 1.6 * MILLIMETRE_M
    tool_marks: float = 0.0
    tool_feed: float = 15 * MICROMETRE_M

    def __post_init__(self) -> None:
        for name in ("radius", "ripple_pitch", "tool_feed"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ConfigurationError(
                    f"figure error: {name} is {value!r} m, expected a positive number"
                )

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m], of their broadcast shape."""
        return self.nominal.height(x, y) + self.error(x, y)

    def error(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height above the nominal surface [m] at x, y [m], of their broadcast shape."""
        radius, angle = np.hypot(x, y), np.arctan2(y, x)
        rho = radius / self.radius
        first, second = np.random.default_rng(self.seed).uniform(0.0, 2 * np.pi, 2)
        # The even cosine keeps the rings smooth at the centre.
        error = np.asarray(
            self.astigmatism / 2 * rho**2 * np.cos(2 * angle - first)
            + self.trefoil / 2 * rho**3 * np.cos(3 * angle - second)
            + self.ripple / 2 * np.cos(2 * np.pi * radius / self.ripple_pitch),
            np.float64,
        )
        return error + self.scallops(radius) if self.tool_marks else error

    def scallops(self, radius: FloatArray) -> FloatArray:
        """Return the height of tool marks [m] at ``radius`` [m]: a parabola from cusp to cusp."""
        turn = radius / self.tool_feed
        return np.asarray(self.tool_marks * 4 * (turn - np.rint(turn)) ** 2, np.float64)
