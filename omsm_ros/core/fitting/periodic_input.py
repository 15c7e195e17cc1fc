"""A recorded motion as one period, and its spectrum without the noise of the encoder."""

from __future__ import annotations

import numpy as np
from scipy import fft, ndimage

from omsm_ros.core.dynamics.transfer_function import ComplexArray
from omsm_ros.core.machine.trajectories import s_curve
from omsm_ros.core.samples.blocks import FloatArray

# Long enough that a bridge across the whole travel adds nothing near the fastest motion.
_BRIDGE_S = 0.3
# Where samples are slow a bridge must still be smooth to them.
_MIN_BRIDGE_SAMPLES = 64
# In it a light mode rings down.
_REST_S = 1.0
# A record of milliseconds tells of no mode that rings for a second: so many times as long it rests.
_RESTS_OF_RECORD = 4.0
# Power is then known to 10 %.
_SMOOTHING_BINS = 101


def close_period(motion: FloatArray, period: float) -> FloatArray:
    """Return ``motion`` (n,) and a smooth way back to its start, of a length quick to transform.

    On the way back it rests, until nothing rings when the record starts anew.
    """
    duration = len(motion) * period
    bridge = max(round(min(_BRIDGE_S, duration) / period), _MIN_BRIDGE_SAMPLES)
    rest = round(min(_REST_S, _RESTS_OF_RECORD * duration) / period)
    total = fft.next_fast_len(len(motion) + bridge + rest, real=True)
    phase = np.arange(1, total - len(motion) + 1) / bridge
    way_back = motion[-1] + (motion[0] - motion[-1]) * s_curve(np.asarray(phase))
    return np.concatenate([motion, way_back])


def denoised(spectrum: ComplexArray, noise_power: float) -> ComplexArray:
    """Return what is motion in its ``spectrum`` (k,), up to the last frequency that has any.

    Wiener's filter. Where an encoder shows only its noise, the probe saw nothing of it;
    a fit that took it for motion would be paid for a response that vanishes there.
    """
    if noise_power <= 0:
        return spectrum
    width = min(_SMOOTHING_BINS, len(spectrum))
    power = np.abs(spectrum) ** 2
    smooth = ndimage.uniform_filter1d(power, width, mode="nearest")
    weight = np.clip(1 - noise_power / np.maximum(smooth, np.finfo(np.float64).tiny), 0.0, 1.0)
    # A mean of m exponential variables scatters by 1/√m; twice that is not motion.
    weight[weight < 3 / np.sqrt(width)] = 0.0
    last = int(np.flatnonzero(weight)[-1]) if np.any(weight) else 0
    return np.asarray((weight * spectrum)[: last + 1], np.complex128)


def motion_spectrum(motion: FloatArray, period: float, noise: float) -> ComplexArray:
    """Transform of ``motion`` (n,), closed to a period, up to its last content, (k,).

    noise: standard deviation of a sample of the motion [m], taken out
    """
    closed = np.asarray(fft.rfft(close_period(motion, period)), np.complex128)
    return denoised(closed, len(motion) * noise**2)
