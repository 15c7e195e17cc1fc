"""Is this motion safe to measure with?

From a planned or recorded Z motion: the dynamic error it would cause, what the correction
leaves of it, and how much faster the same path may be run. What lies beyond the frequency
to which the calibration is trusted counts as not corrected at all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import polynomial

from omsm_ros.core.correction.motion_filter import SETTLED
from omsm_ros.core.correction.uncertainty import sensitivity_numerators
from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.dynamics.discretisation import discretise
from omsm_ros.core.dynamics.discretisation_error import checked_motion, velocity_spectrum
from omsm_ros.core.dynamics.recursion import Recursion, past_motion
from omsm_ros.core.dynamics.transfer_function import TransferFunction
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.errors import ConfigurationError, DataError
from omsm_ros.units import NANOMETRE_M

DEFAULT_BUDGET_M = 50 * NANOMETRE_M
FASTEST = 100.0
_START_SAMPLES = 12
_SINGLE_LINES = 2000
# Ten to the fourth between the ends: known to a hundredth of a per cent.
_BISECTIONS = 16


@dataclass(frozen=True)
class Prediction:
    """What a motion does to the measurement.

    peak_to_valley, rms: of the dynamic error (1 - G) z without correction [m]
    residual: standard uncertainty that the correction leaves [m]
    outside_band_fraction: share of the mean square velocity above the trusted band [1]
    speed_factor: how much faster the path may be run with 2 residual <= budget, at most 100;
        0 if it may not be run at any speed
    safe: 2 residual <= budget;  message: the same for a reader
    """

    peak_to_valley: float
    rms: float
    residual: float
    outside_band_fraction: float
    speed_factor: float
    safe: bool
    message: str


def predict_error(
    calibration: Calibration,
    z: FloatArray,
    sample_period: float,
    budget: float = DEFAULT_BUDGET_M,
) -> Prediction:
    """Judge the motion ``z`` (n,) [m] sampled every ``sample_period`` [s] against ``budget`` [m].

    Raises DataError for a motion that is too short or not finite, ConfigurationError for a
    budget that is not positive.
    """
    if not 0 < budget < np.inf:
        raise ConfigurationError(f"budget {budget!r} m, expected a positive length")
    motion = checked_motion(z)
    error = dynamic_error(calibration.dynamics, motion, sample_period)
    spectrum = _Spectrum(calibration, motion, sample_period)
    residual = spectrum.residual(1.0)
    factor = spectrum.highest_speed(budget / 2)
    safe = 2 * residual <= budget
    peak_to_valley = float(np.ptp(error))
    return Prediction(
        peak_to_valley=peak_to_valley,
        rms=float(np.std(error)),
        residual=residual,
        outside_band_fraction=spectrum.outside_fraction,
        speed_factor=factor,
        safe=safe,
        message=_message(calibration, peak_to_valley, residual, budget, factor),
    )


def dynamic_error(dynamics: TransferFunction, z: FloatArray, sample_period: float) -> FloatArray:
    """(1 - G) z [m] (Eq. 5) after the filter has settled, shape (n - settling,)."""
    digital = discretise(dynamics, sample_period)
    settling = max(digital.settling_samples(SETTLED), _START_SAMPLES)
    if len(z) <= 2 * settling:
        raise DataError(
            f"motion of {len(z)} samples, expected more than {2 * settling}: the filter needs "
            f"{settling} to settle"
        )
    recursion = Recursion(digital)
    recursion.start(past_motion(z[:_START_SAMPLES]))
    return (z - recursion.run(z))[settling:]


class _Spectrum:
    """The motion's velocity over frequency, and what the calibration makes of it."""

    def __init__(self, calibration: Calibration, z: FloatArray, sample_period: float) -> None:
        self._calibration = calibration
        self._numerators = sensitivity_numerators(calibration)
        frequency, velocity = velocity_spectrum(z, sample_period)
        power = abs(velocity) ** 2 / 2
        outside = frequency > calibration.valid_up_to
        total = float(power.sum())
        self.outside_fraction = float(power[outside].sum()) / total if total > 0 else 0.0
        self._frequency, self._power = _gathered(frequency, power)

    def residual(self, speed: float) -> float:
        """Standard uncertainty after correction [m] if the path is run ``speed`` times faster."""
        frequency = np.maximum(self._frequency, self._frequency[1] / 2) * speed
        s = 2j * np.pi * frequency
        trusted = frequency <= self._calibration.valid_up_to
        g = self._calibration.dynamics
        weight = np.empty(len(s))
        denominator = polynomial.polyval(s[trusted], g.denominator) ** 2
        sensitivities = polynomial.polyval(s[trusted], self._numerators.T) / denominator
        weight[trusted] = np.sum(abs(sensitivities) ** 2, axis=0)
        weight[~trusted] = abs(1 - g.at(s[~trusted])) ** 2
        # The power is that of dz/dt at speed 1; faster, it is the same path in less time.
        return float(np.sqrt(np.sum(weight * self._power / abs(s / speed) ** 2)))

    def highest_speed(self, allowed: float) -> float:
        if self.residual(FASTEST) <= allowed:
            return FASTEST
        low, high = 1 / FASTEST, FASTEST
        if self.residual(low) > allowed:
            return 0.0
        for _ in range(_BISECTIONS):
            middle = float(np.sqrt(low * high))
            low, high = (middle, high) if self.residual(middle) <= allowed else (low, middle)
        return low


def _gathered(frequency: FloatArray, power: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The spectrum with lines nearer than half a per cent taken together, at their mean.

    The sensitivities are smooth over so little; the search for a speed looks at every line
    many times.
    """
    ends = np.geomspace(_SINGLE_LINES, len(frequency), int(200 * np.log(len(frequency)))).astype(
        int
    )
    starts = np.unique(np.r_[np.arange(_SINGLE_LINES), ends])
    starts = starts[starts < len(frequency)]
    together = np.add.reduceat(power, starts)
    counts = np.diff(np.r_[starts, len(frequency)])
    mean = np.add.reduceat(frequency, starts) / counts
    return mean, together


def _message(
    calibration: Calibration, peak_to_valley: float, residual: float, budget: float, factor: float
) -> str:
    verdict = "within" if 2 * residual <= budget else "beyond"
    if factor == 0:
        advice = "no speed of this path is within it; calibrate better"
    elif factor >= FASTEST:
        advice = "any practical speed is within it"
    else:
        advice = f"the path may be run up to {factor:.3g} times as fast"
    return (
        f"dynamic error {peak_to_valley / NANOMETRE_M:.0f} nm peak to valley; corrected within "
        f"{2 * residual / NANOMETRE_M:.1f} nm (k = 2), {verdict} the budget of "
        f"{budget / NANOMETRE_M:.1f} nm; {advice} (trusted up to {calibration.valid_up_to:.3g} Hz)"
    )
