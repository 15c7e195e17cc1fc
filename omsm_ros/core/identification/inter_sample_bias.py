"""Bound the bias of the lag from motion that an edge hides between samples.

Motion beyond half the sampling rate folds into the samples. Edges locked to the sample clock fold
alike every time: the fit then finds a lag that is not there, with white residuals. The data
cannot show it, but the encoder's content near half the sampling rate bounds it.
"""

from __future__ import annotations

import numpy as np

from omsm_ros.core.fitting.steps import Steps
from omsm_ros.core.samples.blocks import FloatArray

# How much stronger than the motion itself the probe may answer beyond half the rate.
_GREATEST_GAIN_BEYOND = 5.0
# Band of the encoder's spectrum, in parts of the sampling rate, from which to extrapolate.
_TOP_BAND = (0.35, 0.5)
# Of rest beside an edge: it begins and ends at nothing, so that its spectrum has no leakage.
_MARGIN_SAMPLES = 20


def inter_sample_delay_bound(motion: FloatArray, steps: Steps, sample_period: float) -> float:
    """Return a bound on the bias of the low-frequency delay [s] by motion hidden between samples.

    With U the spectrum of an edge of height A, what folds onto low frequencies is U at the
    sampling rate on both sides, so the lag shifts by up to ``2 |U(f_s)| (1 + |G|) / A``.
    U(f_s) is extrapolated from the content below f_s / 2 at the rate at which an edge with
    finite acceleration falls, 1/f³. A motion without edges is taken as one long edge.
    """
    increments = np.diff(motion)
    pieces = [
        increments[max(edge.start - _MARGIN_SAMPLES, 0) : edge.stop + _MARGIN_SAMPLES]
        for edge in steps.edges
    ] or [increments * np.hanning(len(increments))]
    energy = sum(_top_energy(piece, steps.noise) for piece in pieces)
    height = sum(float(np.sum(np.abs(piece))) ** 2 for piece in pieces)
    if energy <= 0:
        return 0.0
    # |ΔU| = |1 - exp(-jωT)| |U| is nearly 2 |U| / T at the top.
    at_top = 0.5 * sample_period * np.sqrt(energy / height)
    at_rate = at_top * (0.5 * sum(_TOP_BAND)) ** 3
    return float(2 * at_rate * (1 + _GREATEST_GAIN_BEYOND))


def _top_energy(increments: FloatArray, noise: float) -> float:
    """Return mean |FFT of the increments|² in the top band [m²], less what encoder noise gives."""
    power = np.abs(np.fft.rfft(increments)) ** 2
    frequency = np.fft.rfftfreq(len(increments))
    band = (frequency >= _TOP_BAND[0]) & (frequency <= _TOP_BAND[1])
    doubled = np.abs(1 - np.exp(-2j * np.pi * frequency[band])) ** 2
    return float(np.mean(power[band] - len(increments) * noise**2 * doubled))
