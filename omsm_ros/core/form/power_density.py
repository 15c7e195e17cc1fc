"""Power spectral density of a map: areal, over radial frequency, and over direction.

``S(f_x, f_y) = dx dy |FFT(w z)|² / Σ w²``, two-sided, in m⁴, with the window ``w`` of the cells
that are there: its sum over all frequencies times df_x df_y is the mean square of the map under
that window (Parseval). Over radial frequency it is the mean over direction, so that
``∫ 2π f S(f) df`` is the same; over direction, the mean square per radian of half a turn.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from omsm_ros.core.form.cells import Cells
from omsm_ros.core.samples.blocks import FloatArray

# Of half a turn, five degrees each: the other half is the same.
_SECTORS = 36
# Any, but one: the same points have the same figures.
_NOISE_SEED = 22


@dataclass(frozen=True, eq=False)
class Curve:
    """A function on the points where it was taken, and its standard uncertainty, each (k,)."""

    position: FloatArray
    value: FloatArray
    uncertainty: FloatArray

    def entry(self) -> dict[str, list[float]]:
        """Return what a result file says of it."""
        names = ("position", "value", "uncertainty")
        return {name: getattr(self, name).tolist() for name in names}


@dataclass(frozen=True, eq=False)
class PowerDensity:
    """areal: S (r, c) [m⁴] over frequencies x (c,) and y (r,) [1/m];  mean_square: under w [m²]

    radial: S over radial frequency [1/m], [m⁴];  azimuthal: over direction from x [rad], [m²/rad]
    """

    x: FloatArray
    y: FloatArray
    areal: FloatArray
    mean_square: float
    radial: Curve
    azimuthal: Curve


def power_density(cells: Cells) -> PowerDensity:
    """Return the densities of a map; their uncertainty is from the scatter of the periodogram.

    A mean over k independent cells of frequency is uncertain by its k-th root, and noise of the
    points counts as content: its own density is added to the uncertainty.
    """
    window = _window(cells)
    areal, mean_square = _areal(cells, cells.mean, window)
    noise = np.random.default_rng(_NOISE_SEED).normal(size=cells.mean.shape) * cells.noise
    of_noise, _ = _areal(cells, noise, window)
    y, x = (np.asarray(np.fft.fftfreq(size, cells.pitch), np.float64) for size in cells.mean.shape)
    radial, azimuthal = _averaged(x, y, areal, of_noise)
    return PowerDensity(x, y, areal, mean_square, radial, azimuthal)


def _window(cells: Cells) -> FloatArray:
    """Return a taper (r, c) that falls to zero at the rim of an ellipse about the cells."""
    across = [np.linspace(-1, 1, size + 2)[1:-1] for size in cells.present.shape]
    radius = np.minimum(np.hypot(across[0][:, np.newaxis], across[1][np.newaxis]), 1.0)
    return np.asarray(np.cos(np.pi * radius / 2) ** 2 * cells.present)


def _areal(cells: Cells, image: FloatArray, window: FloatArray) -> tuple[FloatArray, float]:
    square = float(np.sum(window**2))
    # The mean under the window is no content, and would leak into the lowest frequencies.
    level = float(np.sum(window * image) / np.sum(window))
    tapered = window * (image - level)
    spectrum = np.abs(np.fft.fft2(tapered)) ** 2
    density = spectrum * cells.pitch**2 / square
    return np.asarray(density), float(np.sum(tapered**2) / square)


def _averaged(
    x: FloatArray, y: FloatArray, areal: FloatArray, noise: FloatArray
) -> tuple[Curve, Curve]:
    steps = (x[1] - x[0] if len(x) > 1 else 1.0), (y[1] - y[0] if len(y) > 1 else 1.0)
    frequency = np.hypot(x[np.newaxis], y[:, np.newaxis]).ravel()
    step = float(max(steps))
    ring = np.rint(frequency / step).astype(np.int64)
    # Beyond the Nyquist frequency of an axis not all directions are there.
    whole = (ring > 0) & (frequency <= min(np.abs(x).max(), np.abs(y).max()))
    angle = np.arctan2(y[:, np.newaxis] + 0 * x, x[np.newaxis] + 0 * y[:, np.newaxis]).ravel()
    sector = np.floor((angle % np.pi) / np.pi * _SECTORS).astype(np.int64) % _SECTORS
    radial = _mean_by(ring[whole], frequency[whole], areal.ravel()[whole], noise.ravel()[whole])
    per_angle = float(abs(steps[0] * steps[1])) * _SECTORS / np.pi
    content, of_noise = (
        np.asarray(np.bincount(sector, v.ravel(), _SECTORS) * per_angle, np.float64)
        for v in (areal, noise)
    )
    scatter = np.sqrt(np.bincount(sector, areal.ravel() ** 2, _SECTORS)) * per_angle
    directions = np.asarray((np.arange(_SECTORS) + 0.5) * np.pi / _SECTORS, np.float64)
    return radial, Curve(directions, content, np.asarray(np.hypot(scatter, of_noise)))


def _mean_by(
    group: FloatArray, position: FloatArray, value: FloatArray, noise: FloatArray
) -> Curve:
    counts = np.bincount(group)
    filled = counts > 0

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(group, values)[filled] / counts[filled])

    # Of a real map each frequency stands twice.
    independent = np.maximum(counts[filled] / 2, 1.0)
    spread = mean(value) / np.sqrt(independent)
    return Curve(mean(position), mean(value), np.hypot(spread, mean(noise)))
