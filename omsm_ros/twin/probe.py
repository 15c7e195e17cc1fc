"""Simulate a chromatic confocal probe: exposure, linearity, light and noise."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from omsm_ros.core.kinematics.kinematics import Surface, slopes_by_differences, workpiece_xy
from omsm_ros.core.streams.blocks import DistanceBlock, FloatArray, Status
from omsm_ros.errors import ConfigurationError
from omsm_ros.quantities import COUNT, LENGTH, PROBABILITY, CheckedRecord
from omsm_ros.twin.plant import PAPER_STATIC_GAIN
from omsm_ros.twin.record_checks import ANY, LAG, SIZE, SLOPE_LIMIT, WIDTH
from omsm_ros.units import MICROMETRE_M, NANOMETRE_M

# Gauss-Legendre nodes of an exposure: within 1e-5 of the mean where up to 1.2 waves pass in it,
# and 2e-3 where two pass.
_EXPOSURE_NODES = 6
# Step of the difference for the slope: small against any form, large against rounding.
_SLOPE_STEP_M = 1e-6
_FULL_INTENSITY = 0.5
# Least intensity over that of a flat surface, to bound the noise.
_LEAST_INTENSITY = 1e-4


@dataclass(frozen=True, slots=True)
class Probe:
    """Chromatic confocal probe as in the paper.

    scale: reading over true distance [1], which holds the static error of the paper
    noise: standard deviation of the reading [m];  resolution: of the reading [m]
    half_range: largest distance from zero with a reading [m]
    """

    scale: float = PAPER_STATIC_GAIN
    noise: float = 10 * NANOMETRE_M
    resolution: float = 10 * NANOMETRE_M
    half_range: float = 50 * MICROMETRE_M


@dataclass(frozen=True, slots=True, kw_only=True)
class ProbeErrors(CheckedRecord):
    """Errors of timing, distance and light; none by default.

    spot_m: diameter of the spot, a disc over which the height of the part is averaged
    latency_s: from the end of the exposure to the trigger of the reading
    exposure_s, averages: the reading is the mean over ``averages`` successive exposures
    noise_m: additional noise, added in quadrature
    cubic_m: linearity error at the end of the range, ``cubic_m · (d / half range)³``
    periodic_m, period_m: linearity error ``periodic_m · sin(2π d / period_m)``
    slope_error_m_per_rad: error per slope of the surface along X, as of an inclined beam
    slope_error_m_per_rad2: error per squared slope, in any direction
    intensity_slope_rad: slope at which 1/e of the light returns; noise grows as 1/√intensity
    dropout_slope_rad: largest slope with a reading
    dropout_probability: probability of a random dropout [1]
    """

    spot_m: float = SIZE.of_field(0.0)
    latency_s: float = LAG.of_field(0.0)
    exposure_s: float = LAG.of_field(0.0)
    averages: int = COUNT.of_field(1)
    noise_m: float = SIZE.of_field(0.0)
    cubic_m: float = LENGTH.of_field(0.0)
    periodic_m: float = LENGTH.of_field(0.0)
    period_m: float = WIDTH.of_field(10 * MICROMETRE_M)
    slope_error_m_per_rad: float = ANY.of_field(0.0)
    slope_error_m_per_rad2: float = ANY.of_field(0.0)
    intensity_slope_rad: float | None = SLOPE_LIMIT.of_field(None)
    dropout_slope_rad: float | None = SLOPE_LIMIT.of_field(None)
    dropout_probability: float = PROBABILITY.of_field(0.0)

    def __post_init__(self) -> None:
        CheckedRecord.__post_init__(self)
        if self.window_s > LAG.high:
            raise ConfigurationError(
                f"exposure_s is {self.exposure_s!r} and averages {self.averages!r}; expected "
                f"{LAG.high:g} s at most together"
            )

    @property
    def window_s(self) -> float:
        """Duration of the exposures of a reading."""
        return self.exposure_s * self.averages

    @property
    def lag_s(self) -> float:
        """Delay of a reading: its latency and half its window."""
        return self.latency_s + self.window_s / 2

    @property
    def is_slope_sensitive(self) -> bool:
        """True if readings depend on the slope of the surface."""
        sizes = (self.slope_error_m_per_rad, self.slope_error_m_per_rad2)
        limits = (self.intensity_slope_rad, self.dropout_slope_rad)
        return any(sizes) or any(limit is not None for limit in limits)

    def exposure_instants(self) -> tuple[FloatArray, FloatArray]:
        """Return times before the trigger [s] and weights (k,) of the nodes of the exposure."""
        if not self.window_s:
            return np.array([self.latency_s]), np.ones(1)
        node, weight = np.polynomial.legendre.leggauss(_EXPOSURE_NODES)
        return self.lag_s + self.window_s / 2 * node, weight / 2


class Slope(NamedTuple):
    """Slope of the surface under the probe, along X and Y of the machine [1], each (n,)."""

    x: FloatArray
    y: FloatArray

    @property
    def steepness(self) -> FloatArray:
        """Magnitude [1], (n,)."""
        return np.asarray(np.hypot(self.x, self.y), np.float64)


def slope_of(surface: Surface, x: FloatArray, y: FloatArray, c: FloatArray) -> Slope:
    """Return the slope of ``surface`` at x, y [m] of the chuck, rotated by ``c`` [rad]."""
    return Slope(*workpiece_xy(*slopes_by_differences(surface, x, y, _SLOPE_STEP_M), -c))


LEVEL = Slope(np.zeros(1), np.zeros(1))


def read(
    probe: Probe,
    errors: ProbeErrors,
    true_distance: FloatArray,
    slope: Slope,
    period: float,
    random: Mapping[str, np.random.Generator],
) -> DistanceBlock:
    """Return the readings for ``true_distance`` (n,) [m] to a surface of ``slope``.

    random: generators of the noise, "probe", and of lost readings, "dropout"
    """
    samples, light = len(true_distance), np.ones(1)
    if errors.intensity_slope_rad is not None:
        steep = slope.steepness / errors.intensity_slope_rad
        light = np.maximum(np.exp(-(steep**2)), _LEAST_INTENSITY)
    noise = probe.noise if not errors.noise_m else float(np.hypot(probe.noise, errors.noise_m))
    off = (
        errors.cubic_m * (true_distance / probe.half_range) ** 3
        + errors.periodic_m * np.sin(2 * np.pi * true_distance / errors.period_m)
        + errors.slope_error_m_per_rad * slope.x
        + errors.slope_error_m_per_rad2 * slope.steepness**2
    )
    seen = probe.scale * (true_distance + off)
    noisy = seen + random["probe"].normal(0.0, noise, samples) / np.sqrt(light)
    resolution = probe.resolution
    reading = np.round(noisy / resolution) * resolution if resolution else noisy
    there = abs(true_distance) <= probe.half_range
    if errors.dropout_slope_rad is not None:
        there &= slope.steepness <= errors.dropout_slope_rad
    if errors.dropout_probability:
        there &= random["dropout"].random(samples) >= errors.dropout_probability
    return DistanceBlock(
        stamp_ns=0,
        first_sample=0,
        sample_period=period,
        distance=np.where(there, reading, np.nan),
        intensity=np.where(there, _FULL_INTENSITY * light, 0.0).astype(np.float32),
        status=np.where(there, Status.OK, Status.NO_TARGET).astype(np.uint8),
    )
