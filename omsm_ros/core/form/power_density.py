"""Power spectral density of a map: areal, over radial frequency, and over direction.

``S(f_x, f_y) = dx dy |FFT(w z)|² / Σ w²``, two-sided, in m⁴, with the window ``w`` of the cells
that are there: its sum over all frequencies times df_x df_y is the mean square of the map under
that window (Parseval). Over radial frequency it is the content of each ring of width Δf by that
ring's area, so that ``Σ 2π f S(f) Δf`` is the mean square in the band of those rings, which ends
where not all directions are there any more; over direction, the mean square per radian of half a
turn, whose integral is the whole.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from omsm_ros.core.form.cells import Cells
from omsm_ros.core.samples.blocks import FloatArray

# Of half a turn, five degrees each: the other half is the same.
_SECTORS = 36
# A cell of frequency may lie in two rings: by its parts across and along.
_PARTS = 3
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
    band: of the radial one, from and to [1/m];  mean_square_in_band: under w [m²]
    """

    x: FloatArray
    y: FloatArray
    areal: FloatArray
    mean_square: float
    radial: Curve
    azimuthal: Curve
    band: tuple[float, float]
    mean_square_in_band: float

    def coarse(self, most: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return x (c,), y (r,), S (r, c) of whole blocks, at most ``most`` of them each way.

        In rising order of frequency; what is left over at the highest frequencies is left out.
        """
        across, along = (-(-len(values) // most) for values in (self.x, self.y))
        columns, rows = (
            np.argsort(v)[: len(v) // k * k] for v, k in ((self.x, across), (self.y, along))
        )
        areal = self.areal[np.ix_(rows, columns)]
        blocks = areal.reshape(len(rows) // along, along, len(columns) // across, across)
        x, y = self.x[columns].reshape(-1, across), self.y[rows].reshape(-1, along)
        return x.mean(axis=1), y.mean(axis=1), np.asarray(blocks.mean(axis=(1, 3)))


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
    radial, step = _over_frequency(x, y, areal, of_noise)
    band = (step / 2, float(radial.position[-1]) + step / 2)
    inside = float(np.sum(2 * np.pi * radial.position * radial.value) * step)
    azimuthal = _over_direction(x, y, areal, of_noise)
    return PowerDensity(x, y, areal, mean_square, radial, azimuthal, band, inside)


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


def _steps(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Return the spacings of the frequencies along x and y [1/m]."""
    across, along = (float(abs(v[1] - v[0])) if len(v) > 1 else 1.0 for v in (x, y))
    return across, along


def _over_frequency(
    x: FloatArray, y: FloatArray, areal: FloatArray, noise: FloatArray
) -> tuple[Curve, float]:
    """Return S over radial frequency, and the width of its rings [1/m]."""
    steps = _steps(x, y)
    cell, step = steps[0] * steps[1], max(steps)
    # Beyond the Nyquist frequency of an axis not all directions are there.
    last = max(int(min(np.abs(x).max(), np.abs(y).max()) / step - 0.5), 1)
    content, of_noise = np.zeros((2, last + 1))
    parts = (np.arange(_PARTS) + 0.5) / _PARTS - 0.5
    for across in parts * steps[0]:
        for along in parts * steps[1]:
            frequency = np.hypot((x + across)[np.newaxis], (y + along)[:, np.newaxis]).ravel()
            # The cell about zero is empty, for the mean is no content.
            ring = np.maximum(np.rint(frequency / step).astype(np.int64), 1)
            inside = ring <= last
            for total, values in ((content, areal), (of_noise, noise)):
                total += np.bincount(ring[inside], values.ravel()[inside], last + 1)
    position = np.asarray(step * np.arange(1, last + 1), np.float64)
    area = 2 * np.pi * position * step
    value, floor = (total[1:] * cell / _PARTS**2 / area for total in (content, of_noise))
    # Of a real map each frequency stands twice.
    independent = np.maximum(area / cell / 2, 1.0)
    return Curve(position, value, np.hypot(value / np.sqrt(independent), floor)), step


def _over_direction(x: FloatArray, y: FloatArray, areal: FloatArray, noise: FloatArray) -> Curve:
    steps = _steps(x, y)
    angle = np.arctan2(y[:, np.newaxis] + 0 * x, x[np.newaxis] + 0 * y[:, np.newaxis]).ravel()
    sector = np.floor((angle % np.pi) / np.pi * _SECTORS).astype(np.int64) % _SECTORS
    per_angle = abs(steps[0] * steps[1]) * _SECTORS / np.pi
    content, of_noise = (
        np.asarray(np.bincount(sector, v.ravel(), _SECTORS) * per_angle, np.float64)
        for v in (areal, noise)
    )
    scatter = np.sqrt(np.bincount(sector, areal.ravel() ** 2, _SECTORS)) * per_angle
    directions = np.asarray((np.arange(_SECTORS) + 0.5) * np.pi / _SECTORS, np.float64)
    return Curve(directions, content, np.asarray(np.hypot(scatter, of_noise)))
