"""Parallel sections of a ratio of polynomials, for tests."""

import numpy as np
from numpy.polynomial import polynomial

from omsm_ros.core.estimation.parallel_sections import BAND_LIMITED, ParallelSections, variable


def from_polynomials(hold, period, numerator, denominator, delay):
    """Return the sections of one ratio, ascending in s, or in z⁻¹ of a held input.

    The poles must differ from each other.
    """
    roots = np.roots(denominator[::-1] if hold == BAND_LIMITED else denominator)
    if hold != BAND_LIMITED:
        roots = 2 / period * (roots - 1) / (roots + 1)
    down = [(-2 * p.real / abs(p) ** 2, abs(p) ** -2) for p in roots if p.imag > 0]
    down = np.array(down + [(-1 / p.real, 0.0) for p in roots if p.imag == 0])
    lines = np.linspace(0.003, 0.47, 40 * (len(roots) + 1)) / period
    if hold == BAND_LIMITED:
        s = 2j * np.pi * lines
        value = polynomial.polyval(s, numerator) / polynomial.polyval(s, denominator)
    else:
        q = np.exp(-2j * np.pi * lines * period)
        value = polynomial.polyval(q, numerator) / polynomial.polyval(q, denominator)
    w = variable(hold, lines * period) / period
    basis = 1 / (1 + down[:, :1] * w + down[:, 1:] * w * w)
    columns = [np.ones(len(w))]
    for each, (_, d2) in zip(basis, down, strict=True):
        columns += [each, each * w * (d2 > 0)]
    matrix, scale = np.array(columns).T, np.abs(np.array(columns)).max(axis=1)
    scale[scale == 0] = 1.0
    both = np.concatenate([matrix.real, matrix.imag]) / scale
    found = np.linalg.lstsq(both, np.concatenate([value.real, value.imag]), rcond=None)[0] / scale
    return ParallelSections(
        hold=hold, period=period, denominators=down, numerators=found[1:].reshape(1, -1, 2),
        direct=found[:1], delays=np.array([delay]),
    )  # fmt: skip
