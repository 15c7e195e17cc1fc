"""Is this motion safe to measure with, and how fast may it be run?

From a planned or recorded motion: the dynamic error that it would cause, what the correction
leaves of it, and how much faster the same path may be run. The error is that of the path in
time, and its bound is that of the worst place, not the mean of the scan. What lies beyond the
frequency to which the calibration is trusted counts as not corrected at all. The speed is the
least of all limits, and the one that binds is named.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from omsm_ros.core.correction.motion_filter import SETTLED
from omsm_ros.core.correction.motion_residual import Residual, running_mean
from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.dynamics.discretisation import discretise
from omsm_ros.core.dynamics.discretisation_error import checked_motion, velocity_spectrum
from omsm_ros.core.dynamics.recursion import START_SAMPLES, through
from omsm_ros.core.dynamics.transfer_function import TransferFunction
from omsm_ros.core.machine.limits import (
    FASTEST,
    MachineLimits,
    SpeedLimit,
    highest_factor,
    speed_limits,
)
from omsm_ros.core.machine.scan_path import ScanPath
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.errors import ConfigurationError, DataError
from omsm_ros.readable import plain, quantity
from omsm_ros.units import NANOMETRE_M

# To be stated for the part; this is a twenty-fifth of the dynamic error in the paper of 1.23 µm.
DEFAULT_BUDGET_M = 50 * NANOMETRE_M
DYNAMICS = "dynamics"
"""Name of the limit that the calibration itself sets."""

# The speed is sought on the worst stretches of the path and proved on the whole of it.
_STRETCH_SAMPLES = 8192


@dataclass(frozen=True)
class Prediction:
    """What a motion does to the measurement.

    peak_to_valley, rms: of the dynamic error (1 - G) z without correction [m]
    residual: largest standard uncertainty that the correction leaves on the path [m], k = 1
    residual_hidden: the part of it that the step test could not have shown [m], k = 1
    outside_band_fraction: share of the mean square velocity above the trusted band [1]
    speed_factor: how much faster the path may be run within all limits, at most 100;
        0 if it may not be run at any speed
    safe: no limit is exceeded;  binding: name of the limit that is reached first
    limits: all that were evaluated, that of the dynamics first;  not_evaluated: the others
    left_out: samples of the recording that were not judged, in words; empty if all were
    message: the same for a reader
    """

    peak_to_valley: float
    rms: float
    residual: float
    residual_hidden: float
    outside_band_fraction: float
    speed_factor: float
    safe: bool
    binding: str
    limits: tuple[SpeedLimit, ...]
    not_evaluated: tuple[str, ...]
    left_out: str
    message: str


def predict_error(
    calibration: Calibration,
    path: ScanPath,
    budget: float = DEFAULT_BUDGET_M,
    limits: MachineLimits | None = None,
) -> Prediction:
    """Judge a motion against the allowed error ``budget`` [m], k = 2, and the machine's limits.

    Raises DataError for a motion that is too short or not finite, ConfigurationError for a
    budget that is not positive.
    """
    if not 0 < budget < np.inf:
        raise ConfigurationError(f"budget {budget!r} m, expected a positive length")
    path = replace(path, z=checked_motion(path.z))
    error = dynamic_error(calibration.dynamics, path.z, path.sample_period)
    spread = float(np.ptp(error))
    dynamics, hidden = _dynamics_limit(calibration, path, budget)
    others, missing = speed_limits(
        path, limits or MachineLimits(), calibration.valid_up_to, budget, calibration.dynamics
    )
    every = (dynamics, *others)
    binding = min(every, key=lambda limit: limit.speed_factor)
    message = _message(calibration, spread, (dynamics.value, hidden), budget, binding)
    return Prediction(
        peak_to_valley=spread,
        rms=float(np.std(error)),
        residual=dynamics.value,
        residual_hidden=hidden,
        outside_band_fraction=_outside_fraction(calibration, path),
        speed_factor=binding.speed_factor,
        safe=binding.speed_factor >= 1,
        binding=binding.name,
        limits=every,
        not_evaluated=tuple(missing),
        left_out=path.left_out,
        message="; ".join(filter(None, (message, path.left_out))),
    )


def dynamic_error(dynamics: TransferFunction, z: FloatArray, sample_period: float) -> FloatArray:
    """Return (1 - G) z [m] (Eq. 5) after the filter has settled, shape (n - settling,)."""
    digital = discretise(dynamics, sample_period)
    settling = max(digital.settling_samples(SETTLED), START_SAMPLES)
    if len(z) <= 2 * settling:
        raise DataError(
            f"motion of {len(z)} samples, expected more than {2 * settling}: the filter needs "
            f"{settling} to settle; give a longer motion"
        )
    return (z - through(digital, z))[settling:]


def _dynamics_limit(
    calibration: Calibration, path: ScanPath, budget: float
) -> tuple[SpeedLimit, float]:
    """Return the limit that the correction's residual sets.

    With it the part of that residual, as the path is, that could hide in the step test [m].
    """
    z, period, allowed = path.z, path.sample_period, budget / 2
    known, hidden = Residual(calibration, period).variances(z)
    here = np.sqrt(known + hidden)
    residual = float(np.max(here))
    stretches = _worst_stretches(z, here)

    def worst(factor: float) -> float:
        faster = Residual(calibration, period / factor)
        return max(map(faster.largest, stretches))

    factor = highest_factor(worst, allowed, residual)
    if 0 < factor < FASTEST or (factor == FASTEST and residual > 0):
        # A path of which a stretch is within the budget need not be so as a whole.
        whole = Residual(calibration, period / factor).largest(z)
        factor *= min(allowed / whole, 1.0) if whole > 0 else 1.0
    limit = SpeedLimit(DYNAMICS, residual, allowed, "m", float(factor))
    return limit, float(np.sqrt(hidden[np.argmax(known + hidden)]))


def _worst_stretches(z: FloatArray, residual: FloatArray) -> list[FloatArray]:
    """Return the parts of ``z`` around its largest residual, its fastest and its most curved."""
    if len(z) <= 2 * _STRETCH_SAMPLES:
        return [z]
    starts = set()
    for signal in (residual, np.abs(np.diff(z)), np.abs(np.diff(z, 2))):
        level = running_mean(signal, _STRETCH_SAMPLES // 8)
        middle = int(np.argmax(level)) + len(z) - len(signal)
        starts.add(int(np.clip(middle - _STRETCH_SAMPLES // 2, 0, len(z) - _STRETCH_SAMPLES)))
    return [z[start : start + _STRETCH_SAMPLES] for start in sorted(starts)]


def _outside_fraction(calibration: Calibration, path: ScanPath) -> float:
    frequency, velocity = velocity_spectrum(path.z, path.sample_period)
    power = np.abs(velocity) ** 2
    total = float(power.sum())
    return float(power[frequency > calibration.valid_up_to].sum()) / total if total > 0 else 0.0


def _what_could_hide(calibration: Calibration, hidden: float) -> str:
    """Return the name the part of the residual that the step test could not have shown."""
    mostly = calibration.certificate.get("hidden_mostly")
    if hidden == 0 or not isinstance(mostly, str):
        return ""
    return (
        f"; {quantity(2 * hidden, 'm')} of it are what the step test could not have shown, "
        f"mostly {mostly}"
    )


def _better_calibration(
    calibration: Calibration, residuals: tuple[float, float], budget: float
) -> str:
    """Say which step test would leave less: what slow motion leaves open falls with its length.

    The noise of a slow term falls with the square root of the test's duration, and so does
    the largest relaxation that it would miss.
    """
    residual, hidden = residuals
    plateau = calibration.certificate.get("plateau_s")
    if type(plateau) is not float or not hidden**2 > 0.5 * residual**2:
        return "calibrate better (longer plateaus and more steps, omsm plan steps)"
    longer = plateau * (2 * residual / budget) ** 2
    return f"calibrate with rests of {longer:.2g} s or more (omsm plan steps --dwell {longer:.2g})"


def _message(
    calibration: Calibration,
    peak_to_valley: float,
    residuals: tuple[float, float],
    budget: float,
    binding: SpeedLimit,
) -> str:
    residual, hidden = residuals
    verdict = "within" if 2 * residual <= budget else "beyond"
    factor = binding.speed_factor
    if factor == 0 and binding.name == DYNAMICS:
        better = _better_calibration(calibration, residuals, budget)
        advice = f"{better}: no speed of this path is within the limit of dynamics"
    elif factor == 0:
        advice = f"no speed of this path is within the limit of {binding.name}"
    elif factor >= FASTEST:
        advice = f"it may be run {FASTEST:g} times as fast, further was not tried"
    elif factor >= 1:
        advice = f"it may be run up to {plain(factor)} times as fast; then {binding.name} binds"
    elif binding.name == DYNAMICS:
        better = _better_calibration(calibration, residuals, budget)
        advice = f"{better}, or run it at {plain(factor)} times this speed"
    else:
        advice = f"run it at {plain(factor)} times this speed or slower: {binding.name} binds"
    return (
        f"dynamic error {quantity(peak_to_valley, 'm')} peak to valley; corrected within "
        f"{quantity(2 * residual, 'm')} (k = 2, largest on the path"
        f"{_what_could_hide(calibration, hidden)}), {verdict} the budget "
        f"of {quantity(budget, 'm')}; {advice} (trusted up to "
        f"{quantity(calibration.valid_up_to, 'Hz')})"
    )
