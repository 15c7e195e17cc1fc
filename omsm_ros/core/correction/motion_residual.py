"""What does the correction leave of a motion, at each moment of it?

Within the band to which the calibration is trusted its covariance; beyond it the whole
(1 - G) z, and everywhere what follows the motion but not linearly.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from omsm_ros.core.correction.motion_filter import SETTLED
from omsm_ros.core.correction.uncertainty import (
    ErrorSources,
    past_of,
    sensitivity_filters,
    uncertain_parts,
)
from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.dynamics.discretisation import DigitalFilter, discretise
from omsm_ros.core.dynamics.discretisation_error import fast_length
from omsm_ros.core.dynamics.recursion import START_SAMPLES, Recursion, through
from omsm_ros.core.samples.blocks import FloatArray

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
            (sensitivity_filters(part, sample_period), past_of(part))
            for part in uncertain_parts(calibration)
        ]

    def variances(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the variances of the residual of ``z`` (n,) [m²], each at most (n,).

        The first is of all but what could hide in the step test, the second of that.
        """
        noise, hidden = (self._variance(*part, z) for part in self._parts)
        known = noise + self._linear
        known += _missed_beyond(self._trusted, self._digital, z)
        settling = max(self._digital.settling_samples(SETTLED), START_SAMPLES)
        settling = min(settling, len(z) // 4)
        return known[settling:], hidden[settling:]

    def largest(self, z: FloatArray) -> float:
        """Return the largest standard uncertainty that is left of ``z`` [m]."""
        known, hidden = self.variances(z)
        return float(np.sqrt(np.max(known + hidden)))

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


def _missed_beyond(up_to: float, digital: DigitalFilter, z: FloatArray) -> FloatArray:
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
