"""What an edge may hide between samples, as a bound on the lag.

Motion beyond half the sampling rate folds into the samples, and edges locked to the
sample clock fold alike every time: the fit then sees a lag that is not there, with white
residuals. The data cannot show it, but the encoder's content near half the rate bounds it.
"""

from __future__ import annotations

import numpy as np

from omsm_ros.core.records import FloatArray
from omsm_ros.core.step_test import Steps

# How much stronger than the motion itself the probe may answer beyond half the rate.
_GREATEST_GAIN_BEYOND = 5.0
# Band of the encoder's spectrum, in parts of the sampling rate, from which to extrapolate.
_TOP_BAND = (0.35, 0.5)
_MARGIN_SAMPLES = 20


def inter_sample_delay_bound(motion: FloatArray, steps: Steps, sample_period: float) -> float:
    """Bound on the bias of the low-frequency delay [s] from motion hidden between samples.

    With U the spectrum of an edge of height A, what folds onto low frequencies is U at the
    sampling rate on both sides, so the lag shifts by up to ``2 |U(f_s)| (1 + |G|) / A``.
    U(f_s) is extrapolated from the content below f_s / 2 at the rate at which an edge with
    finite acceleration falls, 1/f³. A motion without edges is measured by its total change.
    """
    content, height = _top_content(motion, steps)
    if height == 0:
        return 0.0
    rate = 1 / sample_period
    top = 0.5 * sum(_TOP_BAND) * rate
    # |ΔU| = |1 - exp(-jωT)| |U|, nearly 2 |U| at the top.
    at_top = content / 2 * sample_period
    at_rate = at_top * (top / rate) ** 3
    return float(2 * at_rate * (1 + _GREATEST_GAIN_BEYOND) / height)


def _top_content(motion: FloatArray, steps: Steps) -> tuple[float, float]:
    """rms of |FFT of the increments| in the top band above noise [m], and height [m], per edge."""
    increments = np.diff(motion)
    pieces = [
        increments[max(edge.start - _MARGIN_SAMPLES, 0) : edge.stop + _MARGIN_SAMPLES]
        for edge in steps.edges
    ] or [increments]
    energy, height = 0.0, 0.0
    for piece in pieces:
        power = np.abs(np.fft.rfft(piece * np.hanning(len(piece) + 2)[1:-1])) ** 2 if not steps.edges else np.abs(np.fft.rfft(piece)) ** 2
        frequency = np.fft.rfftfreq(len(piece))
        band = (frequency >= _TOP_BAND[0]) & (frequency <= _TOP_BAND[1])
        if np.any(band):
            mean_square = np.mean(np.abs(1 - np.exp(-2j * np.pi * frequency[band])) ** 2)
            energy += float(np.mean(power[band])) - len(piece) * steps.noise**2 * mean_square
        height += float(np.sum(np.abs(piece))) ** 2 if not steps.edges else 0.0
    height += sum(edge.height**2 for edge in steps.edges)
    return float(np.sqrt(max(energy, 0.0))), float(np.sqrt(height))
