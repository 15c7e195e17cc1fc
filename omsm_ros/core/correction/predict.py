"""Prediction of the dynamic error of a motion, and of the speed at which it may be run.

For a planned or recorded motion: the dynamic error, the residual after the correction, and the
speed factor at which the path stays within all limits. Residuals are the largest along the path,
not the mean. Motion above the frequency to which the calibration is valid counts as not corrected.

The residual consists of the calibration's covariance below that frequency, the whole (1 - G) z
above it, and non-linear errors everywhere.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import signal  # which a live node loads here, before samples come

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.correction.motion_filter import SETTLED
from omsm_ros.core.correction.uncertainty import (
    ErrorSources,
    covariance_parts,
    past_degree,
    sensitivity_filters,
)
from omsm_ros.core.kinematics.limits import (
    FASTEST,
    MachineLimits,
    SpeedLimit,
    highest_factor,
    speed_limits,
)
from omsm_ros.core.kinematics.scan_path import ScanPath
from omsm_ros.core.lti.discretisation import (
    DigitalFilter,
    checked_motion,
    discretise,
    velocity_spectrum,
)
from omsm_ros.core.lti.recursion import START_SAMPLES, Recursion, past_motion, through
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import ConfigurationError, DataError, Notice
from omsm_ros.readable import rounded_down, rounded_up
from omsm_ros.units import NANOMETRE_M

# The low-pass that separates the valid band falls between this share of its end and its end.
_PASSED_SHARE = 0.8
# Attenuation of its stop band: of a millimetre of travel ten nanometres pass.
_ATTENUATION_DB = 100.0
# Time over which the error above the band is averaged as rms [s].
_RUNNING_S = 0.1
# Default accuracy for a part; a twenty-fifth of the dynamic error of 1.23 µm in the paper.
DEFAULT_BUDGET_M = 50 * NANOMETRE_M
DYNAMICS = "dynamics"
"""Name of the limit that the calibration sets."""


def residual_variances(
    calibration: Calibration, sample_period: float, z: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the variance of the residual of ``z`` (n,) after settling [m²], in two parts.

    The second part is that of undetected model error, the first that of all other sources. Within
    the valid band they follow from the calibration's covariance; above it the residual is the whole
    (1 - G) z, as rms over a tenth of a second. Near the ends of the record, at most a quarter of
    its length, the value next to them is used.
    """
    digital = discretise(calibration.dynamics, sample_period)
    noise, undetected = (
        _variance(part, sample_period, z) for part in covariance_parts(calibration)
    )
    known = noise + ErrorSources.of(calibration).motion_error ** 2
    known += _missed_above(calibration.valid_up_to, digital, z)
    settling = max(digital.settling_samples(SETTLED), START_SAMPLES)
    settling = min(settling, len(z) // 4)
    return known[settling:], undetected[settling:]


def largest_residual(calibration: Calibration, sample_period: float, z: FloatArray) -> float:
    """Return the largest standard uncertainty of the residual of ``z`` (n,) [m]."""
    return float(np.sqrt(np.max(sum(residual_variances(calibration, sample_period, z)))))


def _variance(part: Calibration, sample_period: float, z: FloatArray) -> FloatArray:
    """Return the variance of G z [m²] by the covariance of ``part``, (n,)."""
    variance = np.zeros(len(z))
    before = past_motion(z[:START_SAMPLES], past_degree(part))
    for row in sensitivity_filters(part, sample_period):
        if "z" in row:
            recursion = Recursion(row["z"])
            recursion.start(before)
            variance += recursion.run(z) ** 2
    return variance


def _missed_above(up_to: float, digital: DigitalFilter, z: FloatArray) -> FloatArray:
    """Return the mean square of (1 - G) z above ``up_to`` [Hz], running over the record, (n,)."""
    kernel = _band_kernel(up_to, digital.sample_period, len(z))
    half = len(kernel) // 2
    if not half:
        return np.zeros(len(z))
    centred = z - z[0]
    # Cut by the length of the kernel, where the ends of the record would count as motion.
    fast = centred[half:-half] - signal.oaconvolve(centred, kernel, "valid")
    span = round(_RUNNING_S / digital.sample_period)
    missed = running_mean((fast - through(digital, fast)) ** 2, span)
    return np.pad(missed, half, mode="edge")


def _band_kernel(up_to: float, sample_period: float, samples: int) -> FloatArray:
    """Return a linear-phase low-pass that falls from 0.8 ``up_to`` to ``up_to`` [Hz].

    It has a Kaiser window of 100 dB, or what fits into half of ``samples``. One tap if ``up_to`` is
    above the Nyquist frequency.
    """
    if up_to >= 0.5 / sample_period:
        return np.ones(1)
    taps, beta = signal.kaiserord(_ATTENUATION_DB, 2 * (1 - _PASSED_SHARE) * up_to * sample_period)
    half = min(taps // 2, samples // 4)
    cutoff = (1 + _PASSED_SHARE) / 2 * up_to
    kernel = signal.firwin(2 * half + 1, cutoff, window=("kaiser", beta), fs=1 / sample_period)
    return np.asarray(kernel, np.float64)


def running_mean(values: FloatArray, width: int) -> FloatArray:
    """Return the mean of the nearest ``width`` values, (n,)."""
    width = int(np.clip(width, 1, len(values)))
    total = np.concatenate([[0.0], np.cumsum(values)])
    means = np.maximum(total[width:] - total[:-width], 0.0) / width
    before = width // 2
    return np.pad(means, (before, len(values) - len(means) - before), mode="edge")


@dataclass(frozen=True)
class Prediction:
    """Predicted dynamic error and speed of a motion.

    peak_to_valley, rms: of the dynamic error (1 - G) z without correction [m]
    residual: largest standard uncertainty after the correction [m], k = 1
    residual_undetected: its part from undetected model error [m], k = 1; a key of summary.json
    outside_band_fraction: share of the mean square velocity above the valid band [1]
    outside_band_rms: of Z above the valid band [m], noise of the encoder included
    speed_factor: of the path within all limits, at most 100; 0 if it may not be run at any speed
    safe: True if no limit is exceeded;  binding: name of the limit that is reached first
    limits: evaluated ones, that of the dynamics first;  not_evaluated: names of the others
    left_out, advice: samples that were not judged, and what to do if not safe; each may be empty
    message: a sentence with all the above
    """

    peak_to_valley: float
    rms: float
    residual: float
    residual_undetected: float
    outside_band_fraction: float
    outside_band_rms: float
    speed_factor: float
    safe: bool
    binding: str
    limits: tuple[SpeedLimit, ...]
    not_evaluated: tuple[str, ...]
    left_out: str
    advice: str
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
        raise ConfigurationError("correction.budget", budget=budget)
    path = replace(path, z=checked_motion(path.z))
    error = dynamic_error(calibration.dynamics, path.z, path.sample_period)
    spread = float(np.ptp(error))
    dynamics, undetected = _dynamics_limit(calibration, path, budget)
    others, missing = speed_limits(
        path, limits or MachineLimits(), calibration.valid_up_to, budget, calibration.dynamics
    )
    every = (dynamics, *others)
    binding = min(every, key=lambda limit: limit.speed_factor)
    residuals, left_out = (dynamics.value, undetected), path.left_out
    advice = _advice(calibration, residuals, budget, binding)
    message = _message(calibration, spread, residuals, budget, advice)
    outside, outside_rms = _outside_band(calibration, path)
    return Prediction(
        peak_to_valley=spread,
        rms=float(np.std(error)),
        residual=dynamics.value,
        residual_undetected=undetected,
        outside_band_fraction=outside,
        outside_band_rms=outside_rms,
        speed_factor=binding.speed_factor,
        safe=binding.speed_factor >= 1,
        binding=binding.name,
        limits=every,
        not_evaluated=tuple(missing),
        left_out="" if left_out is None else str(left_out),
        advice="" if binding.speed_factor >= 1 else str(advice),
        message="; ".join(str(part) for part in (message, left_out) if part is not None),
    )


def dynamic_error(dynamics: TransferFunction, z: FloatArray, sample_period: float) -> FloatArray:
    """Return (1 - G) z [m] (Eq. 5) after the filter has settled, shape (n - settling,)."""
    digital = discretise(dynamics, sample_period)
    settling = max(digital.settling_samples(SETTLED), START_SAMPLES)
    if len(z) <= 2 * settling:
        raise DataError(
            "correction.short_motion", samples=len(z), least=2 * settling, settling=settling
        )
    return (z - through(digital, z))[settling:]


def _dynamics_limit(
    calibration: Calibration, path: ScanPath, budget: float
) -> tuple[SpeedLimit, float]:
    """Return the limit set by the residual, and its part from undetected model error [m]."""
    z, period, allowed = path.z, path.sample_period, budget / 2
    known, undetected = residual_variances(calibration, period, z)
    residual = float(np.sqrt(np.max(known + undetected)))
    factor = highest_factor(
        lambda factor: largest_residual(calibration, period / factor, z), allowed, residual
    )
    limit = SpeedLimit(DYNAMICS, residual, allowed, "m", factor)
    return limit, float(np.sqrt(undetected[np.argmax(known + undetected)]))


def _outside_band(calibration: Calibration, path: ScanPath) -> tuple[float, float]:
    """Return the share of the mean square velocity above the valid band, and rms of Z there [m]."""
    frequency, velocity = velocity_spectrum(path.z, path.sample_period)
    power = np.abs(velocity) ** 2
    above = frequency > calibration.valid_up_to
    total, beyond = float(power.sum()), power[above]
    rms = np.sqrt(np.sum(beyond / (2 * np.pi * frequency[above]) ** 2) / 2)
    return (float(beyond.sum()) / total if total > 0 else 0.0), float(rms)


def _longer_dwell(
    calibration: Calibration, residual: float, undetected: float, budget: float
) -> float | None:
    """Return the dwell after a step [s] at which undetected model error would fit the budget.

    None if it does not dominate. The uncertainty of a slow term falls with the square root of the
    duration of the step test, and so does the largest relaxation that remains undetected.
    """
    plateau = calibration.certificate.undetected.plateau_s
    if plateau is None or not undetected**2 > 0.5 * residual**2:
        return None
    return rounded_up(plateau * (2 * residual / budget) ** 2, 2)


def _advice(
    calibration: Calibration, residuals: tuple[float, float], budget: float, binding: SpeedLimit
) -> Notice:
    factor = binding.speed_factor
    values: dict[str, object] = {"factor": rounded_down(factor), "limit": binding.name}
    if factor >= 1:
        return Notice(f"correction.{'fastest' if factor >= FASTEST else 'faster'}", **values)
    code = f"correction.{'slower' if factor else 'no_speed'}"
    if binding.name != DYNAMICS:
        return Notice(code, **values)
    dwell = _longer_dwell(calibration, *residuals, budget)
    better = Notice("correction.better" if dwell is None else "correction.dwell", dwell=dwell)
    return Notice(f"{code}_dynamics", better=better, **values)


def _message(
    calibration: Calibration,
    peak_to_valley: float,
    residuals: tuple[float, float],
    budget: float,
    advice: Notice,
) -> Notice:
    residual, undetected = residuals
    largest = calibration.certificate.undetected.largest
    part: Notice | str = ""
    if undetected and largest is not None:
        mostly = Notice(largest.code, parameter=largest.parameter)
        part = Notice("correction.undetected_part", part=2 * undetected, mostly=mostly)
    return Notice(
        "correction.within" if 2 * residual <= budget else "correction.exceeded",
        error=peak_to_valley,
        residual=2 * residual,
        undetected=part,
        budget=budget,
        advice=advice,
        valid_up_to=calibration.valid_up_to,
    )
