"""What a response does to slow motion: ``ln G = -L s + k s² + …``, lag L and curvature k."""

from __future__ import annotations

import numpy as np

from omsm_ros.core.dynamics.transfer_function import TransferFunction
from omsm_ros.core.samples.blocks import FloatArray


def slow_motion_jacobian(dynamics: TransferFunction) -> FloatArray:
    """Return d(L, k)/d(numerator, denominator[1:], delay), shape (2, p) [s, s²].

    With ``∂ln G/∂n_i = s^i/N`` and ``∂ln G/∂d_i = -s^i/D``, cut after s².
    """
    up = _inverse_series(dynamics.numerator)
    down = _inverse_series(dynamics.denominator)
    columns: list[FloatArray] = [_shifted(up, i) for i in range(len(dynamics.numerator))]
    columns += [-_shifted(down, i) for i in range(1, len(dynamics.denominator))]
    columns.append(np.array([0.0, -1.0, 0.0]))
    rows = np.array([[-c[1] for c in columns], [c[2] for c in columns]], np.float64)
    return rows


def _inverse_series(polynomial: FloatArray) -> FloatArray:
    """Return 1/polynomial to s², (3,)."""
    n0, n1, n2 = np.append(polynomial, np.zeros(2))[:3]
    return np.array([1.0 / n0, -n1 / n0**2, n1**2 / n0**3 - n2 / n0**2], np.float64)


def _shifted(series: FloatArray, powers: int) -> FloatArray:
    """Return the times s to the ``powers``, to s²."""
    return np.asarray(np.append(np.zeros(powers), series)[:3], np.float64)
