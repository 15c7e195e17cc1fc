"""Difference between probe and model on a free path, as in the paper's Fig. 9."""

from dataclasses import dataclass

import numpy as np
import scipy  # whose parts are loaded when they are used

from omsm_ros.core.streams.blocks import FloatArray

# Tapered share of the motion; a longer taper would remove the ends of a sweep.
_TAPERED = 0.02
# Share of the strongest band's power.
_EXCITED = 0.1


@dataclass(frozen=True, eq=False)
class PathCheck:
    """The paper's Fig. 9 for one free path, arrays (n,) but the summary.

    frequency: instantaneous [Hz];  error_before, error_after: [m]
    lag_before, lag_after: of the probe behind the encoder, and behind the model [rad]
    rms_before, rms_after: [m]
    excited: bands of a hertz (from, to) in which the motion has power
    """

    frequency: FloatArray
    error_before: FloatArray
    error_after: FloatArray
    lag_before: FloatArray
    lag_after: FloatArray
    rms_before: float
    rms_after: float
    excited: tuple[tuple[float, float], ...]


def check_path(
    z: FloatArray,
    distance: FloatArray,
    predicted: FloatArray,
    static_gain: float,
    sample_period: float,
) -> PathCheck:
    """Return the instantaneous error and Hilbert phase lag before and after correction.

    z: encoder [m];  distance: probe on a fixed target [m];  predicted: G_m z [m], all (n,)
    The probe's own view of the motion is -distance / static_gain, apart from its offset.
    """
    output = -(distance / static_gain)
    before = _centred(z - output)
    after = _centred(predicted - output)
    turning = scipy.signal.hilbert(_centred(z))
    phase = np.unwrap(np.angle(turning))
    return PathCheck(
        frequency=np.gradient(phase) / (2 * np.pi * sample_period),
        error_before=before,
        error_after=after,
        lag_before=_lag(z, output),
        lag_after=_lag(predicted, output),
        rms_before=float(np.sqrt(np.mean(before**2))),
        rms_after=float(np.sqrt(np.mean(after**2))),
        excited=excited_bands(z, sample_period),
    )


def excited_bands(z: FloatArray, sample_period: float) -> tuple[tuple[float, float], ...]:
    """Return the bands of a hertz (from, to) in which a motion ``z`` (n,) [m] has power.

    Elsewhere the instantaneous frequency of a noisy motion strays, and there is no result.
    """
    power = abs(np.fft.rfft(_centred(z) * scipy.signal.windows.tukey(len(z), _TAPERED))) ** 2
    band = np.floor(np.arange(len(power)) / (len(z) * sample_period)).astype(np.int64)
    in_band = np.bincount(band, power)
    excited = np.flatnonzero(in_band > _EXCITED * in_band.max())
    return tuple((float(low), float(low + 1)) for low in excited)


def _centred(values: FloatArray) -> FloatArray:
    return np.asarray(values - np.mean(values))


def _lag(ahead: FloatArray, behind: FloatArray) -> FloatArray:
    ratio = scipy.signal.hilbert(_centred(ahead)) * np.conj(scipy.signal.hilbert(_centred(behind)))
    return np.asarray(np.angle(ratio))
