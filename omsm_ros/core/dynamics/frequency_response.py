"""How does one signal answer another? Estimated without a model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import signal

from omsm_ros.core.dynamics.transfer_function import ComplexArray
from omsm_ros.core.samples.blocks import FloatArray


@dataclass(frozen=True, eq=False)
class FrequencyResponse:
    """A response estimated without a model, arrays (k,).

    frequency: [Hz];  coherence: 0-1;  uncertainty: standard, relative
    """

    frequency: FloatArray
    response: ComplexArray
    coherence: FloatArray
    uncertainty: FloatArray


def frequency_response(
    motion: FloatArray, output: FloatArray, sample_period: float, segment: int
) -> FrequencyResponse:
    """Return H1 = S_yu / S_uu by Welch's method, on increments, in segments of ``segment`` samples.

    Increments make steps and offsets stationary and cancel in the ratio. The uncertainty is
    that of Bendat and Piersol, √((1 - γ²) / (2 γ² n)), with n independent segments.
    """
    du, dy = np.diff(motion), np.diff(output)
    rate = 1 / sample_period
    options = {"fs": rate, "nperseg": min(segment, len(du)), "detrend": False}
    frequency, cross = signal.csd(du, dy, **options)
    _, inward = signal.welch(du, **options)
    _, coherence = signal.coherence(du, dy, **options)
    count = max(2 * len(du) / options["nperseg"] - 1, 1.0)
    inside = np.clip(coherence, 1e-12, 1.0)
    uncertainty = np.sqrt((1 - inside) / (2 * inside * count))
    tiny = np.finfo(np.float64).tiny
    return FrequencyResponse(
        frequency, np.asarray(cross / np.maximum(inward, tiny)), coherence, uncertainty
    )
