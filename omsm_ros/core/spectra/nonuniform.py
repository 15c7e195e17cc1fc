"""The Fourier sum of samples that are not evenly spaced.

``F(k Δν) = Σ_j y_j exp(-2πi k Δν u_j)`` by spreading each sample over a fine grid with a
Kaiser-Bessel kernel, one FFT, and division by the kernel's transform (Greengard and Lee,
SIAM Review 46, 2004; kernel of Fessler and Sutton, IEEE Trans. Signal Process. 51, 2003).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import special

from omsm_ros.core.samples.blocks import FloatArray

# Eight neighbours and twice the grid: an error of 1e-7 of the largest line.
_WIDTH = 8
_OVERSAMPLING = 2
_BETA = np.pi * np.sqrt((_WIDTH / _OVERSAMPLING * (_OVERSAMPLING - 0.5)) ** 2 - 0.8)


def fourier_sum(
    place: FloatArray, values: FloatArray, spacing: float, count: int
) -> NDArray[np.complex128]:
    """Return F at 0, ``spacing``, … (count,), of ``values`` (n,) at ``place`` (n,).

    spacing: Δν [1/unit of place], at most one over the range of ``place``
    """
    grid = _even(_OVERSAMPLING * 2 * count)
    position = (place - place[0]) * spacing * grid
    first = np.floor(position).astype(np.int64) - _WIDTH // 2 + 1
    total = np.zeros(grid)
    for offset in range(_WIDTH):
        cell = first + offset
        weight = _kernel(position - cell)
        total += np.bincount(cell % grid, values * weight, minlength=grid)
    spectrum = np.fft.rfft(total)[:count]
    # The sum started at place[0], not at zero; magnitudes do not care, phases are turned back.
    k = np.arange(count)
    turned = np.exp(-2j * np.pi * spacing * place[0] * k)
    return np.asarray(spectrum * turned / _kernel_transform(k / grid), np.complex128)


def _kernel(distance: FloatArray) -> FloatArray:
    inside = np.maximum(1 - (2 * distance / _WIDTH) ** 2, 0.0)
    return np.asarray(special.i0(_BETA * np.sqrt(inside)))


def _kernel_transform(frequency: FloatArray) -> FloatArray:
    """Return the transform of the kernel over grid cells, at ``frequency`` [1/cell]."""
    inside = np.sqrt(_BETA**2 - (np.pi * _WIDTH * frequency) ** 2)
    return np.asarray(_WIDTH * np.sinh(inside) / inside)


def _even(count: int) -> int:
    """Return the next power of two, for a fast transform."""
    return 1 << (count - 1).bit_length()
