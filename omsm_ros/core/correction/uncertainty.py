"""Standard uncertainty of each height (GUM, first order, k = 1).

``height = H(z) + distance / g``. The covariance Σ = L Lᵀ of the parameters of G is propagated
through the filter: the variance of H(z) is ``Σ_r |F_r z|²``, where ``F_r = Σ_j L_jr ∂G/∂θ_j`` is
again a transfer function. A probe latency that is wrong by δ moves the point along the path. Where
Z follows the surface, this is a height error of ``δ dH(z)/dt``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import polynomial

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.correction.surface_points import SurfacePoints
from omsm_ros.core.kinematics.kinematics import Surface, slopes_by_differences
from omsm_ros.core.lti.discretisation import DigitalFilter, bilinear, discretise
from omsm_ros.core.lti.recursion import POLYNOMIAL_DEGREE
from omsm_ros.core.lti.transfer_function import ComplexArray, TransferFunction
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import DataError
from omsm_ros.quantities import (
    ANGLE_UNCERTAINTY,
    GAIN_UNCERTAINTY,
    TIME_UNCERTAINTY,
    UNCERTAINTY,
    CheckedRecord,
)

# Name of the scatter of a scan beyond the stated sources of single readings.
SCAN_SCATTER = "scan_scatter"
# Share of the variance below which a direction of the covariance is left out.
_NEGLIGIBLE = 1e-6
# Order of interpolation; a sensitivity is a derivative of the motion, which loses one order.
_ORDER = 5


@dataclass(frozen=True, kw_only=True)
class ErrorSources(CheckedRecord):
    """Standard uncertainties of single points, except those of the dynamics.

    probe_noise: of a reading [m];  probe_resolution: step of a reading [m]
    encoder_noise: of z [m];  encoder_resolution: step of z [m]
    static_gain: of the calibration's static gain [1]
    probe_latency: of the delay of X, Y, B and C [s]; it shifts the points along the path
    motion_error: of non-linear parts of the motion, such as backlash [m]
    discretisation: of H against G on this motion [m]
    vibration: of the probe against the part while the spindle turns, rms [m]
    pitch: of the Z slide's pitch [rad], which acts through the Abbe arm
    """

    probe_noise: float = UNCERTAINTY.of_field(0.0)
    probe_resolution: float = UNCERTAINTY.of_field(0.0)
    encoder_noise: float = UNCERTAINTY.of_field(0.0)
    encoder_resolution: float = UNCERTAINTY.of_field(0.0)
    static_gain: float = GAIN_UNCERTAINTY.of_field(0.0)
    probe_latency: float = TIME_UNCERTAINTY.of_field(0.0)
    motion_error: float = UNCERTAINTY.of_field(0.0)
    discretisation: float = UNCERTAINTY.of_field(0.0)
    vibration: float = UNCERTAINTY.of_field(0.0)
    pitch: float = ANGLE_UNCERTAINTY.of_field(0.0)

    @classmethod
    def of(cls, calibration: Calibration) -> ErrorSources:
        """Return the sources that the calibration's certificate states, zero for the others.

        An unresolved latency may be any part of the lag. The noise is that of readings at
        standstill, which includes the resolution of the probe.
        """
        return cls(
            probe_noise=calibration.certificate.residual.noise_m or 0.0,
            static_gain=calibration.static_gain_uncertainty,
            motion_error=calibration.certificate.model_errors.motion_error_m or 0.0,
            probe_latency=calibration.latency.unshared_s,
        )


def reading_variances(
    sources: ErrorSources, noise_gain: float, static_gain: float
) -> dict[str, float]:
    """Return the variances of a height [m²] by the sources of single readings.

    noise_gain: of H for white noise
    """
    return {
        "probe_noise": (sources.probe_noise / static_gain) ** 2,
        "probe_resolution": (sources.probe_resolution / static_gain) ** 2 / 12,
        "encoder_noise": (noise_gain * sources.encoder_noise) ** 2,
        "encoder_resolution": (noise_gain * sources.encoder_resolution) ** 2 / 12,
        "vibration": sources.vibration**2,
    }


def with_lateral_uncertainty(
    points: SurfacePoints, surface: Surface, lateral: float
) -> SurfacePoints:
    """Return the points with the height uncertainty from a lateral uncertainty added.

    lateral: standard uncertainty in each of two directions [m], multiplied by the slopes of
        ``surface``
    """
    slope_x, slope_y = slopes_by_differences(surface, points.x, points.y)
    variance = points.uncertainty**2 + lateral**2 * (slope_x**2 + slope_y**2)
    return replace(points, uncertainty=np.sqrt(variance))


def covariance_parts(calibration: Calibration) -> tuple[Calibration, Calibration]:
    """Return the calibration with the covariance of noise, and of undetected model error."""
    undetected = calibration.undetected_error_covariance
    alone = replace(calibration, further={}, joint=np.zeros((0, 0)))
    return (
        replace(calibration, covariance=calibration.covariance - undetected),
        replace(alone, covariance=undetected),
    )


def sensitivity_filters(
    calibration: Calibration, sample_period: float
) -> list[dict[str, DigitalFilter]]:
    """Return filters F_r of each axis with ``variance of H = Σ_r (Σ_axes F_r)²``.

    There are none for a zero covariance.
    """
    g = calibration.dynamics
    square = np.asarray(polynomial.polymul(g.denominator, g.denominator), np.float64)
    combined, poles = sensitivity_numerators(calibration), np.tile(g.poles(), 2)
    height, slow = combined["z"], static_until(calibration)
    if slow > 0:
        # G(0) = 1 exactly: an uncertain gain acts on motion only, see static_until.
        combined["z"] = slow * np.column_stack([np.zeros(len(height)), height])
        square = np.asarray(polynomial.polymul(square, [1.0, slow]), np.float64)
        poles = np.append(poles, -1 / slow)
    band = 2j * np.pi * np.linspace(0.0, calibration.valid_up_to, 64)
    shares = []
    for numerators in combined.values():
        power = np.abs(polynomial.polyval(band, numerators.T)) ** 2
        shares.append(power / np.maximum(power.sum(axis=0), np.finfo(np.float64).tiny))
    kept = np.flatnonzero(np.max(shares, axis=(0, 2), initial=0.0) > _NEGLIGIBLE)
    return [
        {
            axis: derivative_filter(numerators[row], square, g.delay, sample_period, poles)
            for axis, numerators in combined.items()
            if np.any(numerators[row])
        }
        for row in kept
    ]


def static_until(calibration: Calibration) -> float:
    """Return the time constant [s] below which an uncertain gain acts; 0 if there is none.

    The variance of the gain of a calibration, which stands for unknown slow relaxations, holds
    above the frequency ``valid_from`` of its certificate.
    """
    lowest = calibration.certificate.validity.from_hz or 0.0
    return 1 / (2 * np.pi * lowest) if lowest > 0 and calibration.covariance[0, 0] > 0 else 0.0


def past_degree(calibration: Calibration) -> int:
    """Return the degree of the motion before the first samples that sensitivity filters assume.

    A filter with a time constant of a minute needs a standstill: a parabola through some samples
    would be metres of travel so long before.
    """
    return 0 if static_until(calibration) > 0 else POLYNOMIAL_DEGREE


def derivative_filter(
    numerator: FloatArray,
    denominator: FloatArray,
    delay: float,
    sample_period: float,
    poles: ComplexArray,
) -> DigitalFilter:
    """Return a filter for a ratio whose numerator may exceed the denominator by one degree.

    Such a ratio, the derivative of a response that does not fall, gets a pole above the Nyquist
    frequency, which changes its magnitude by 1 % at a tenth of that. Where a resonance would alias
    to slow motion the bilinear transform is used, which does not alias.
    """
    used = np.trim_zeros(numerator, "b")
    if len(used) > len(denominator):
        fast = np.array([1.0, sample_period / 4])
        denominator = np.asarray(polynomial.polymul(denominator, fast), np.float64)
        poles = np.append(poles, -4 / sample_period)
    ratio = TransferFunction(used, denominator, delay)
    try:
        return discretise(ratio, sample_period, _ORDER, poles)
    except DataError:
        return bilinear(ratio, sample_period, poles)


def sensitivity_numerators(calibration: Calibration) -> dict[str, FloatArray]:
    """Return F_r times denominator² of each axis, ascending powers of s, rows for directions r."""
    g, size = calibration.dynamics, len(calibration.covariance)
    every, further = calibration.covariance, calibration.further
    if further and np.any(every):
        # The covariance of noise, which alone correlates the axes.
        every = calibration.joint.copy()
        every[:size, :size] = calibration.covariance
    factor = _factor(every).T
    per_z = _sensitivity_numerators(g.numerator, g.denominator)
    found, first = {"z": factor[:, :size] @ per_z}, size
    for axis, numerator in further.items() if len(every) > size else ():
        own = slice(first, first + len(numerator))
        per_axis = _sensitivity_numerators(numerator, g.denominator)
        shared = factor[:, len(g.numerator) : size] @ per_axis[len(numerator) :]
        found[axis] = shared + factor[:, own] @ per_axis[: len(numerator)]
        first = own.stop
    return found


def _sensitivity_numerators(numerator: FloatArray, denominator: FloatArray) -> FloatArray:
    """Return ∂G/∂θ_j times denominator², ascending powers of s, one row for each parameter."""
    m, n = len(numerator) - 1, len(denominator) - 1
    rows = np.zeros((m + n + 2, max(2 * n, m + n + 1) + 1))
    for i in range(m + 1):
        rows[i, i : i + n + 1] = denominator
    for i in range(1, n + 1):
        rows[m + i, i : i + m + 1] = -numerator
    rows[-1, 1 : m + n + 2] = -np.convolve(numerator, denominator)
    return rows


def _factor(covariance: FloatArray) -> FloatArray:
    """Return L with L Lᵀ = covariance, (p, rank); scaled, because variances span many decades."""
    deviations = np.sqrt(np.diag(covariance))
    free = np.flatnonzero(deviations)
    correlation = covariance[np.ix_(free, free)] / np.outer(deviations[free], deviations[free])
    values, vectors = np.linalg.eigh(correlation)
    factor = np.zeros((len(covariance), len(free)))
    factor[free] = deviations[free, np.newaxis] * vectors * np.sqrt(np.maximum(values, 0.0))
    return factor
