"""Forbes' polynomials for aspheres of revolution.

G. W. Forbes, "Shape specification for axially symmetric optical surfaces", Opt. Express 15, 5218
(2007), and "Robust, efficient computational methods for axially symmetric optical aspheres", Opt.
Express 18, 19700 (2010). All are functions of ``x = (r/radius)²``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray

Series = tuple[FloatArray, FloatArray]


def bfs_series(coefficients: Sequence[float], x: FloatArray) -> Series:
    """Return Σ a_m Q_m^bfs(x) and its derivative, the polynomials of mild aspheres.

    ``P_(m+1) = (2 − 4x) P_m − P_(m−1)`` and ``f_m Q_m = P_m − g_(m−1) Q_(m−1) − h_(m−2) Q_(m−2)``
    (2010, eq. 2.9 and appendix): orthonormal in the slope of the departure along the normal.
    """
    zero = np.zeros_like(x)
    plain = [(2 + zero, zero), (6 - 8 * x, zero - 8)]
    q: list[Series] = []
    total, slope = zero, zero
    for m, (f, g, h) in enumerate(_recurrence(len(coefficients))):
        if m >= 2:
            plain.append(
                (
                    (2 - 4 * x) * plain[-1][0] - plain[-2][0],
                    (2 - 4 * x) * plain[-1][1] - 4 * plain[-1][0] - plain[-2][1],
                )
            )
        value, rate = plain[m]
        if m >= 1:
            value, rate = value - g * q[-1][0], rate - g * q[-1][1]
        if m >= 2:
            value, rate = value - h * q[-2][0], rate - h * q[-2][1]
        q.append((value / f, rate / f))
        total = total + coefficients[m] * q[-1][0]
        slope = slope + coefficients[m] * q[-1][1]
    return total, slope


def _recurrence(count: int) -> list[tuple[float, float, float]]:
    """Return f_m, g_(m−1), h_(m−2) for m = 0 to ``count − 1``; zero where there is none."""
    found: list[tuple[float, float, float]] = []
    f: list[float] = []
    g: list[float] = []
    for m in range(count):
        if m == 0:
            f, found = [2.0], [(2.0, 0.0, 0.0)]
            continue
        h = -m * (m - 1) / (2 * f[m - 2]) if m >= 2 else 0.0
        g.append(-0.5 if m == 1 else -(1 + g[m - 2] * h) / f[m - 1])
        f.append(float(np.sqrt(m * (m + 1) + 3 - g[m - 1] ** 2 - h**2)))
        found.append((f[m], g[m - 1], h))
    return found


def con_series(coefficients: Sequence[float], x: FloatArray) -> Series:
    """Return Σ a_m Q_m^con(x) and its derivative, the polynomials of strong aspheres.

    ``Q_m^con(x) = P_m^(0,4)(2x − 1)``, Jacobi polynomials (2007, eq. 2.4), by their recurrence.
    """
    t, zero = 2 * x - 1, np.zeros_like(x)
    before: Series = (zero, zero)
    now: Series = (zero + 1, zero)
    total, slope = zero, zero
    for m, coefficient in enumerate(coefficients):
        total, slope = total + coefficient * now[0], slope + coefficient * now[1]
        if m == 0:
            a, b, c = 3.0, -2.0, 0.0
        else:
            scale = 2 * (m + 1) * (m + 5) * (2 * m + 4)
            a = (2 * m + 5) * (2 * m + 6) * (2 * m + 4) / scale
            b = -(2 * m + 5) * 16 / scale
            c = 2 * m * (m + 4) * (2 * m + 6) / scale
        factor = a * t + b
        value = factor * now[0] - c * before[0]
        rate = factor * now[1] + 2 * a * now[0] - c * before[1]
        before, now = now, (value, rate)
    return total, slope
