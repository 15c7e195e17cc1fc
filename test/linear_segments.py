"""The exact response of a linear system to a motion that is straight between its samples."""

import numpy as np
from scipy import signal


def through(numerator, denominator, values, period):
    """Return the response from rest (n,) to ``values`` (n,), polynomials highest power first."""
    b, a, _ = signal.cont2discrete((numerator, denominator), period, "foh")
    return signal.lfilter(np.ravel(b), a, values - values[0])
