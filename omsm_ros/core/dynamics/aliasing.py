"""Where a vibration beyond the Nyquist frequency turns up in sampled data."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.errors import DataError


def folded_frequency(frequency: ArrayLike, sample_rate: float) -> FloatArray:
    """Return the apparent frequency [Hz] of ``frequency`` [Hz] sampled at ``sample_rate`` [Hz].

    ``|f - fs · NINT(f / fs)|`` with halves rounded up, as the paper has it; of the shape of
    ``frequency``.
    """
    if not sample_rate > 0:
        raise DataError(f"sample_rate {sample_rate!r} Hz is not positive")
    f = np.asarray(frequency, np.float64)
    return np.abs(f - sample_rate * np.floor(f / sample_rate + 0.5))
