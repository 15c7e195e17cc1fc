"""A chromatic confocal probe: when it looks, and what it makes of the distance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from omsm_ros.core.samples.blocks import DistanceBlock, FloatArray, Status
from omsm_ros.errors import ConfigurationError
from omsm_ros.twin.plant import PAPER_STATIC_GAIN
from omsm_ros.twin.quantities import check_numbers
from omsm_ros.units import MICROMETRE_M, NANOMETRE_M

# Gauss-Legendre on six points is exact to the eleventh power of time within an exposure, and
# within 1e-6 of the amplitude for a vibration of up to one period in it.
_EXPOSURE_NODES = 6


@dataclass(frozen=True, slots=True)
class Probe:
    """A chromatic confocal probe of the paper's kind.

    scale: reading per true distance [1]; the paper's static error is placed here
    noise: standard deviation of the reading [m];  resolution: of the reading [m]
    half_range: beyond it the probe sees no target [m]
    """

    scale: float = PAPER_STATIC_GAIN
    noise: float = 10 * NANOMETRE_M
    resolution: float = 10 * NANOMETRE_M
    half_range: float = 50 * MICROMETRE_M


@dataclass(frozen=True, slots=True, kw_only=True)
class ProbeErrors:
    """Of time and of distance; nothing by default.

    latency_s: from the end of the exposure to the trigger that the reading is given to
    exposure_s, averages: the reading is the mean over ``averages`` exposures on end
    noise_m: more noise, added in quadrature
    """

    latency_s: float = 0.0
    exposure_s: float = 0.0
    averages: int = 1
    noise_m: float = 0.0

    def __post_init__(self) -> None:
        check_numbers(self, not_negative=("latency_s", "exposure_s", "noise_m"))
        if self.averages < 1:
            raise ConfigurationError(
                f"ProbeErrors: averages is {self.averages!r}, expected 1 or more"
            )

    @property
    def window_s(self) -> float:
        """How long a reading looks."""
        return self.exposure_s * self.averages

    @property
    def lag_s(self) -> float:
        """How late a reading is: its latency and half its window."""
        return self.latency_s + self.window_s / 2

    def looks(self) -> tuple[FloatArray, FloatArray]:
        """Instants before the trigger [s] and their weights, (k,), that stand for the exposure."""
        if not self.window_s:
            return np.array([self.latency_s]), np.ones(1)
        node, weight = np.polynomial.legendre.leggauss(_EXPOSURE_NODES)
        return self.lag_s + self.window_s / 2 * node, weight / 2


def read(
    probe: Probe,
    errors: ProbeErrors,
    true_distance: FloatArray,
    period: float,
    random: np.random.Generator,
) -> DistanceBlock:
    """What the probe reports of ``true_distance`` (n,) [m]."""
    samples = len(true_distance)
    noise = probe.noise if not errors.noise_m else float(np.hypot(probe.noise, errors.noise_m))
    noisy = probe.scale * true_distance + random.normal(0.0, noise, samples)
    resolution = probe.resolution
    reading = np.round(noisy / resolution) * resolution if resolution else noisy
    in_range = abs(true_distance) <= probe.half_range
    return DistanceBlock(
        stamp_ns=0,
        first_sample=0,
        sample_period=period,
        distance=np.where(in_range, reading, np.nan),
        intensity=np.where(in_range, 0.5, 0.0).astype(np.float32),
        status=np.where(in_range, Status.OK, Status.NO_TARGET).astype(np.uint8),
    )
