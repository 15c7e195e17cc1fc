"""How much do points scatter? Robustly, so that dust and edges do not count."""

from __future__ import annotations

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray

# Of the normal distribution, whose median absolute value is 0.6745 σ.
SIGMA_OF_MAD = 1.4826


def spread(values: FloatArray) -> float:
    """Return the standard deviation of Gaussian values (n,) about zero, whatever a few do."""
    return SIGMA_OF_MAD * float(np.median(np.abs(values)))


def noise_of(deviation: FloatArray) -> float:
    """Return the standard deviation of what changes from point to point [m], robustly.

    From second differences of points in the order in which they were measured, for which form and
    slow drift are straight lines: ``median |d_(i−1) − 2 d_i + d_(i+1)| = 0.6745 √6 σ``.
    """
    if len(deviation) < 3:
        return 0.0
    return spread(np.diff(deviation, 2)) / float(np.sqrt(6))
