"""Forbes' polynomials, for aspheres of revolution and for freeforms.

G. W. Forbes, "Shape specification for axially symmetric optical surfaces", Opt. Express 15, 5218
(2007), "Robust, efficient computational methods for axially symmetric optical aspheres", Opt.
Express 18, 19700 (2010), and "Characterizing the shape of freeform optics", Opt. Express 20, 2483
(2012). All are functions of ``x = (r/radius)²``.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

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

    ``Q_m^con(x) = P_m^(0,4)(2x − 1)``, Jacobi polynomials (2007, eq. 2.4).
    """
    return _jacobi_series(coefficients, 0.0, 4.0, x)


def freeform_series(coefficients: Sequence[float], m: int, x: FloatArray) -> Series:
    """Return Σ a_n Q_n^m(x) and its derivative by x, the polynomials of freeforms, m ≥ 1.

    They are what their definition says (2012, sec. 3): of degree n, the sign of its power (−1)ⁿ,
    and ``u^m cos mθ Q_n^m(u²)`` orthonormal in the gradient, whose products are averaged over θ
    and, with weight 1/√(1 − u²), over u.
    """
    # Well conditioned for that weight, so that no digit is lost on the way to high degrees.
    orders = -0.5, m - 1.5
    changed = _orthonormal(len(coefficients), m, orders) @ np.asarray(coefficients, np.float64)
    return _jacobi_series([float(a) for a in changed], *orders, x)


@lru_cache(maxsize=64)
def _orthonormal(count: int, m: int, orders: tuple[float, float]) -> FloatArray:
    """Return the upper triangle (count, count) whose columns are Q_n^m in Jacobi polynomials.

    ``|∇(u^m Q cos mθ)|²`` has the mean ``(A² + m² B²)/2`` over θ, with A = ∂/∂u (u^m Q) and
    B = u^(m−1) Q. The mean over u = sin φ is a sum over even steps of φ, exact for polynomials.
    """
    steps = m + 2 * count + 2
    u = np.sin((np.arange(steps) + 0.5) * np.pi / (2 * steps))
    columns = []
    for unit in np.eye(count):
        value, rate = _jacobi_series([float(a) for a in unit], *orders, u**2)
        along = u ** (m - 1) * (m * value + 2 * u**2 * rate)
        columns.append(np.concatenate([along, m * u ** (m - 1) * value]))
    root = np.linalg.qr(np.array(columns).T / np.sqrt(2 * steps), mode="r")
    signs = np.sign(np.diag(root)) * (-1.0) ** np.arange(count)
    return np.asarray(np.linalg.inv(root) * signs, np.float64)


def _jacobi_series(
    coefficients: Sequence[float], alpha: float, beta: float, x: FloatArray
) -> Series:
    """Return Σ a_k P_k^(α,β)(2x − 1) and its derivative by x, by their recurrence of three."""
    t, zero, both = 2 * x - 1, np.zeros_like(x), alpha + beta
    before: Series = (zero, zero)
    now: Series = (zero + 1, zero)
    total, slope = zero, zero
    for k, coefficient in enumerate(coefficients):
        total, slope = total + coefficient * now[0], slope + coefficient * now[1]
        if k == 0:
            a, b, c = (both + 2) / 2, (alpha - beta) / 2, 0.0
        else:
            scale = 2 * (k + 1) * (k + 1 + both) * (2 * k + both)
            a = (2 * k + both + 1) * (2 * k + both + 2) * (2 * k + both) / scale
            b = (2 * k + both + 1) * (alpha**2 - beta**2) / scale
            c = 2 * (k + alpha) * (k + beta) * (2 * k + both + 2) / scale
        factor = a * t + b
        value = factor * now[0] - c * before[0]
        rate = factor * now[1] + 2 * a * now[0] - c * before[1]
        before, now = now, (value, rate)
    return total, slope
