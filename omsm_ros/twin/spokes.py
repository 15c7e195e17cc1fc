"""Marks of a tool that moved outward: a circle crosses one every wavelength."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from omsm_ros.core.machine.surface_height import Surface
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.errors import ConfigurationError
from omsm_ros.units import MICROMETRE_M, NANOMETRE_M


@dataclass(frozen=True, slots=True)
class Spokes:
    """A surface: ``nominal`` plus waves across every circle about the spindle axis.

    wavelength: along the circle of ``radius`` [m], rounded to a whole number a turn
    rms: of the first wave [m];  second: of the second harmonic, as a share of the first
    """

    nominal: Surface
    radius: float
    wavelength: float = 15 * MICROMETRE_M
    rms: float = 11 * NANOMETRE_M
    second: float = 0.0

    def __post_init__(self) -> None:
        for name in ("radius", "wavelength"):
            if not getattr(self, name) > 0:
                raise ConfigurationError(
                    f"spokes: {name} is {getattr(self, name)!r} m, expected a positive number"
                )

    @property
    def count(self) -> int:
        """Waves a turn."""
        return max(round(2 * np.pi * self.radius / self.wavelength), 1)

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the height [m] at x, y [m], of their broadcast shape."""
        phase = self.count * np.arctan2(y, x)
        waves = np.cos(phase) + self.second * np.cos(2 * phase)
        return np.asarray(self.nominal.height(x, y) + 2**0.5 * self.rms * waves, np.float64)
