"""Is this motion safe to measure with, and how fast may it be run?

From a planned or recorded motion: the dynamic error that it would cause, what the correction
leaves of it, and how much faster the same path may be run. The error is that of the path in
time, and its bound is that of the worst place, not the mean of the scan. What lies beyond the
frequency to which the calibration is trusted counts as not corrected at all. The speed is the
least of all limits, and the one that binds is named.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.correction.motion_filter import SETTLED
from omsm_ros.core.correction.uncertainty import (
    ErrorSources,
    covariance_parts,
    filter_history,
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
    fast_length,
    velocity_spectrum,
)
from omsm_ros.core.lti.recursion import START_SAMPLES, Recursion, through
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import ConfigurationError, DataError
from omsm_ros.readable import plain, quantity
from omsm_ros.units import NANOMETRE_M

# What does the correction leave of a motion, at each moment of it?
#
# Within the band to which the calibration is trusted its covariance; beyond it the whole
# (1 - G) z, and everywhere what follows the motion but not linearly.

# The band that counts as trusted ends between these shares of the frequency of trust.
_PASSED_SHARE = 0.8
# A millimetre of travel through the stop band is then ten nanometres, of which 1 - G passes.
_ATTENUATION_DB = 100.0
# An error beyond the band is taken as its rms over so many seconds.
_RUNNING_S = 0.1


class Residual:
    """What the correction leaves of motions sampled every ``sample_period`` [s].

    Within the trusted band it is that of the calibration's covariance, and above it the whole
    (1 - G) z, as its rms over a tenth of a second. Near the record's ends, at most a quarter of
    it at either, the motion above the band is taken to be as large as next to them.

    To design its filters takes as long as to run them over a stretch, so all stretches share them.
    """

    def __init__(self, calibration: Calibration, sample_period: float) -> None:
        self._trusted = calibration.valid_up_to
        self._linear = ErrorSources.of(calibration).motion_error ** 2
        self._digital = discretise(calibration.dynamics, sample_period)
        self._parts = [
            (sensitivity_filters(part, sample_period), filter_history(part))
            for part in covariance_parts(calibration)
        ]

    def variances(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the variances of the residual of ``z`` (n,) [m²], each at most (n,).

        The first is of all but what could hide in the step test, the second of that.
        """
        noise, undetected = (self._variance(*part, z) for part in self._parts)
        known = noise + self._linear
        known += _missed_above(self._trusted, self._digital, z)
        settling = max(self._digital.settling_samples(SETTLED), START_SAMPLES)
        settling = min(settling, len(z) // 4)
        return known[settling:], undetected[settling:]

    def largest(self, z: FloatArray) -> float:
        """Return the largest standard uncertainty that is left of ``z`` [m]."""
        known, undetected = self.variances(z)
        return float(np.sqrt(np.max(known + undetected)))

    @staticmethod
    def _variance(
        filters: Sequence[DigitalFilter], past: Callable[[FloatArray], FloatArray], z: FloatArray
    ) -> FloatArray:
        """Return the variance of G z [m²] from one part of the covariance, (n,)."""
        variance = np.zeros(len(z))
        if not filters:
            return variance
        before = past(z[:START_SAMPLES])
        for digital in filters:
            recursion = Recursion(digital)
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
    # Beyond the kernel's reach the record's ends would count as motion.
    fast = (centred - _convolved(centred, kernel))[half:-half]
    missed = running_mean(
        (fast - through(digital, fast)) ** 2, round(_RUNNING_S / digital.sample_period)
    )
    return np.pad(missed, half, mode="edge")


def _band_kernel(up_to: float, sample_period: float, samples: int) -> FloatArray:
    """Return a low-pass of linear phase that falls from 0.8 ``up_to`` to ``up_to`` [Hz].

    By Kaiser's window, 100 dB or what fits into half of ``samples``; one tap where all passes.
    """
    if up_to >= 0.5 / sample_period:
        return np.ones(1)
    transition = (1 - _PASSED_SHARE) * up_to * sample_period
    # Kaiser (1974): taps and shape for an attenuation over a transition.
    half = int(np.ceil((_ATTENUATION_DB - 8) / (2.285 * 2 * np.pi * transition) / 2))
    half = min(half, samples // 4)
    index = np.arange(-half, half + 1)
    cutoff = (1 + _PASSED_SHARE) / 2 * up_to * sample_period
    kernel = 2 * cutoff * np.sinc(2 * cutoff * index)
    kernel = kernel * np.kaiser(len(index), 0.1102 * (_ATTENUATION_DB - 8.7))
    return np.asarray(kernel / kernel.sum())


def _convolved(values: FloatArray, kernel: FloatArray) -> FloatArray:
    """Return the convolution (n,), by FFT; true where the kernel lies inside the record."""
    # In stretches of eight kernels, each with the values that reach into it (overlap and save).
    reach = len(kernel) - 1
    length = min(fast_length(8 * len(kernel)), fast_length(len(values) + reach))
    step = length - reach
    stretches = -(-(len(values) + reach) // step)
    padded = np.zeros(stretches * step + reach)
    padded[reach : reach + len(values)] = values
    rows = np.lib.stride_tricks.sliding_window_view(padded, length)[::step]
    spectra = np.fft.rfft(rows) * np.fft.rfft(kernel, length)
    whole = np.fft.irfft(spectra, length)[:, reach:].ravel()
    return np.asarray(whole[reach // 2 : reach // 2 + len(values)])


def running_mean(values: FloatArray, width: int) -> FloatArray:
    """Return the mean of the nearest ``width`` values, (n,)."""
    width = int(np.clip(width, 1, len(values)))
    total = np.concatenate([[0.0], np.cumsum(values)])
    means = np.maximum(total[width:] - total[:-width], 0.0) / width
    before = width // 2
    return np.pad(means, (before, len(values) - len(means) - before), mode="edge")


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
    dynamics, undetected = _dynamics_limit(calibration, path, budget)
    others, missing = speed_limits(
        path, limits or MachineLimits(), calibration.valid_up_to, budget, calibration.dynamics
    )
    every = (dynamics, *others)
    binding = min(every, key=lambda limit: limit.speed_factor)
    message = _message(calibration, spread, (dynamics.value, undetected), budget, binding)
    return Prediction(
        peak_to_valley=spread,
        rms=float(np.std(error)),
        residual=dynamics.value,
        residual_hidden=undetected,
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
    known, undetected = Residual(calibration, period).variances(z)
    here = np.sqrt(known + undetected)
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
    return limit, float(np.sqrt(undetected[np.argmax(known + undetected)]))


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


def _undetected_share_text(calibration: Calibration, undetected: float) -> str:
    """Return the name the part of the residual that the step test could not have shown."""
    mostly = calibration.certificate.get("hidden_mostly")
    if undetected == 0 or not isinstance(mostly, str):
        return ""
    return (
        f"; {quantity(2 * undetected, 'm')} of it are what the step test could not have shown, "
        f"mostly {mostly}"
    )


def _better_calibration(
    calibration: Calibration, residuals: tuple[float, float], budget: float
) -> str:
    """Say which step test would leave less: what slow motion leaves open falls with its length.

    The noise of a slow term falls with the square root of the test's duration, and so does
    the largest relaxation that it would miss.
    """
    residual, undetected = residuals
    plateau = calibration.certificate.get("plateau_s")
    if type(plateau) is not float or not undetected**2 > 0.5 * residual**2:
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
    residual, undetected = residuals
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
        f"{_undetected_share_text(calibration, undetected)}), {verdict} the budget "
        f"of {quantity(budget, 'm')}; {advice} (trusted up to "
        f"{quantity(calibration.valid_up_to, 'Hz')})"
    )
