"""Texture parameters (ISO 25178-2), slopes (ISO 10110-14), power spectral density and profiles.

The areal density is ``S(f_x, f_y) = dx dy |FFT(w z)|² / Σ w²``, two-sided, in m⁴, with the window
``w`` of the present cells: its sum over all frequencies times df_x df_y is the mean square of the
map under that window (Parseval). The radial density is the content of each ring of width Δf over
the area of the ring: ``Σ 2π f S(f) Δf`` is the mean square in the band of the rings. The azimuthal
density is the mean square per radian of half a turn.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from omsm_ros.core.form.deviation_map import DeviationMap, GridCells, UncertainValue
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.core.surface.deviation import Profile, line_profile, radial_profile
from omsm_ros.errors import DataError

# Fixed seeds, so that the same points give the same figures.
_NOISE_SEED, _DENSITY_NOISE_SEED = 21, 22
# Least cutoff of the S-filter in cells; a shorter one would pass aliased wavelengths.
_LEAST_CELLS = 3.0
# Limits of the bands, as shares of the longest side.
_BANDS = {"form": (np.inf, 1 / 4), "waviness": (1 / 4, 1 / 20), "finer": (1 / 20, 0.0)}
# Default cutoff of the L-filter, the limit of form.
_DEFAULT_L = 1 / 4
# Sectors of five degrees; the other half of the turn is the same.
_SECTORS = 36
# Parts along each axis by which a cell of frequency is shared between two rings.
_PARTS = 3
# Half-width and spacing of line profiles over the radius.
_HALF_WIDTH, _SPACING = 1 / 100, 1 / 100
# The angular profile averages the outer third of the radius over two degrees.
_OUTER, _DEGREES = 2 / 3, 2.0
# Widths of rings over the radius; the narrowest that the turns of the scan fill to 80 % is used.
_RINGS, _COVERED = (1 / 50, 1 / 25, 1 / 10), 0.8


@dataclass(frozen=True, slots=True)
class Bands:
    """Cutoff wavelengths [m] of the S- and the L-filter, and limits of the bands of rms."""

    s_filter: float
    l_filter: float
    rms_bands: dict[str, tuple[float | None, float]]


def bands_of(
    cells: GridCells, s_filter: float | None = None, l_filter: float | None = None
) -> Bands:
    """Return the cutoffs asked for; by default three cells and a quarter of the longest side.

    Raises DataError for an L-filter that is not longer than the S-filter.
    """
    across = max(cells.present.shape) * cells.pitch
    shortest = max(s_filter or 0.0, _LEAST_CELLS * cells.pitch)
    longest = l_filter or _DEFAULT_L * across
    if l_filter is not None and longest <= shortest:
        raise DataError("form.empty_filter_band", l_filter=longest, s_filter=shortest)
    ends = {
        name: (None if long == np.inf else long * across, max(short * across, shortest))
        for name, (long, short) in _BANDS.items()
    }
    found = {name: (long, short) for name, (long, short) in ends.items() if (long or 1e9) > short}
    return Bands(shortest, longest, found)


@dataclass(frozen=True, eq=False)
class _FilteredBand:
    """One band of the cells: the map, the map with as much noise again, and the error effects."""

    values: FloatArray
    noisier: FloatArray
    effects: FloatArray

    def figure(self, of: Callable[[FloatArray], float]) -> UncertainValue:
        """Return a figure of the values with its uncertainty from noise and all effects."""
        value = of(self.values)
        noise = (of(self.noisier) - value) / (np.sqrt(2) - 1)
        shares = [(of(self.values + e) - of(self.values - e)) / 2 for e in self.effects]
        return UncertainValue(value, float(np.sqrt(noise**2 + np.sum(np.square(shares)))))


def texture(cells: GridCells, formless: GridCells, bands: Bands) -> dict[str, UncertainValue]:
    """Return Sa, Sq, Sz [m], Ssk, Sku [1] of the S-L surface, rms by band [m], slopes [1].

    formless: the same cells after the F-operation
    """
    surface = _band(formless, bands.l_filter, bands.s_filter)
    found = {name: surface.figure(of) for name, of in _PARAMETERS.items()}
    for name, (long, short) in bands.rms_bands.items():
        found[f"rms_{name}"] = _band(formless if long else cells, long, short).figure(_rms)
    return found | _slope_figures(cells, bands)


def slopes_without_second_order(rest: GridCells, bands: Bands) -> dict[str, UncertainValue]:
    """Return the rms slope [1] of cells without their second order."""
    return {"slope_rms_without_second_order": _slope_figures(rest, bands)["slope_rms"]}


def _slope_figures(cells: GridCells, bands: Bands) -> dict[str, UncertainValue]:
    smooth = _band(cells, None, bands.s_filter, whole=True)
    if not len(_slopes(smooth.values, cells)):
        return dict.fromkeys(("slope_rms", "slope_largest"), UncertainValue(None, None))
    return {
        "slope_rms": smooth.figure(lambda image: _rms_about_zero(_slopes(image, cells))),
        "slope_largest": smooth.figure(lambda image: float(np.max(_slopes(image, cells)))),
    }


def _band(cells: GridCells, long: float | None, short: float, whole: bool = False) -> _FilteredBand:
    """Return the wavelengths from ``short`` to ``long``, of present cells or as ``whole`` images.

    The L-filter acts on the result of the S-filter (ISO 25178-2).
    """
    more = np.random.default_rng(_NOISE_SEED).normal(size=cells.mean.shape) * cells.noise
    images = np.concatenate([[cells.mean, more], cells.effects])
    fine = cells.smoothed(images, short)
    if long is not None:
        fine = fine - cells.smoothed(fine, long)
    rows = fine if whole else fine[:, cells.present]
    return _FilteredBand(rows[0], rows[0] + rows[1], rows[2:])


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean((values - values.mean()) ** 2)))


def _moment(values: FloatArray, order: int) -> float:
    size = _rms(values)
    return float(np.mean(((values - values.mean()) / size) ** order)) if size > 0 else 0.0


_PARAMETERS: dict[str, Callable[[FloatArray], float]] = {
    "Sa": lambda values: float(np.mean(np.abs(values - values.mean()))),
    "Sq": _rms,
    "Sz": lambda values: float(np.ptp(values)),
    "Ssk": lambda values: _moment(values, 3),
    "Sku": lambda values: _moment(values, 4),
}


def _rms_about_zero(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _slopes(image: FloatArray, cells: GridCells) -> FloatArray:
    """Return slopes (k,) over two cells with all neighbours present; of one row, along it."""
    ways = [axis for axis, size in enumerate(image.shape) if size > 1]
    inside = cells.present.copy()
    square = np.zeros(image.shape)
    for axis in ways:
        before, after = (np.roll(image, way, axis) for way in (1, -1))
        square += (after - before) ** 2
        # Values rolled in from the opposite side are no neighbours.
        there = np.pad(cells.present, [(1, 1) if n == axis else (0, 0) for n in (0, 1)])
        size = image.shape[axis]
        inside &= there.take(range(size), axis) & there.take(range(2, size + 2), axis)
    return np.asarray(np.sqrt(square[inside]) / (2 * cells.pitch)) if ways else np.empty(0)


@dataclass(frozen=True, eq=False)
class UncertainCurve:
    """Values of a function at positions, and their standard uncertainty, each (k,)."""

    position: FloatArray
    value: FloatArray
    uncertainty: FloatArray

    def entry(self) -> dict[str, list[float]]:
        """Return the JSON values for result files."""
        names = ("position", "value", "uncertainty")
        return {name: getattr(self, name).tolist() for name in names}


@dataclass(frozen=True, eq=False)
class PowerDensity:
    """Power spectral density of a map: areal, over radial frequency, and over direction.

    areal: S (r, c) [m⁴] over frequencies x (c,) and y (r,) [1/m];  mean_square: under w [m²]
    radial: S over radial frequency [1/m], [m⁴];  azimuthal: over direction from x [rad], [m²/rad]
    band: of the radial density, from and to [1/m];  mean_square_in_band: under w [m²]
    """

    x: FloatArray
    y: FloatArray
    areal: FloatArray
    mean_square: float
    radial: UncertainCurve
    azimuthal: UncertainCurve
    band: tuple[float, float]
    mean_square_in_band: float

    def coarse(self, most: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return x (c,), y (r,), S (r, c) averaged over blocks, at most ``most`` in each direction.

        In rising order of frequency; an incomplete block at the highest frequencies is left out.
        """
        across, along = (-(-len(values) // most) for values in (self.x, self.y))
        columns, rows = (
            np.argsort(v)[: len(v) // k * k] for v, k in ((self.x, across), (self.y, along))
        )
        areal = self.areal[np.ix_(rows, columns)]
        blocks = areal.reshape(len(rows) // along, along, len(columns) // across, across)
        x, y = self.x[columns].reshape(-1, across), self.y[rows].reshape(-1, along)
        return x.mean(axis=1), y.mean(axis=1), np.asarray(blocks.mean(axis=(1, 3)))


def power_density(cells: GridCells) -> PowerDensity:
    """Return the densities of a map, with their uncertainty from the scatter of the periodogram.

    A mean over k independent frequencies has a relative uncertainty of 1/√k. The density of the
    noise of the points is not subtracted, but added to the uncertainty.
    """
    window = _window(cells)
    areal, mean_square = _areal(cells, cells.mean, window)
    noise = np.random.default_rng(_DENSITY_NOISE_SEED).normal(size=cells.mean.shape) * cells.noise
    of_noise, _ = _areal(cells, noise, window)
    y, x = (np.asarray(np.fft.fftfreq(size, cells.pitch), np.float64) for size in cells.mean.shape)
    radial, step = _over_frequency(x, y, areal, of_noise)
    band = (step / 2, float(radial.position[-1]) + step / 2)
    inside = float(np.sum(2 * np.pi * radial.position * radial.value) * step)
    azimuthal = _over_direction(x, y, areal, of_noise)
    return PowerDensity(x, y, areal, mean_square, radial, azimuthal, band, inside)


def _window(cells: GridCells) -> FloatArray:
    """Return a taper (r, c) that falls to zero at the rim of an ellipse about the cells."""
    across = [np.linspace(-1, 1, size + 2)[1:-1] for size in cells.present.shape]
    radius = np.minimum(np.hypot(across[0][:, np.newaxis], across[1][np.newaxis]), 1.0)
    return np.asarray(np.cos(np.pi * radius / 2) ** 2 * cells.present)


def _areal(cells: GridCells, image: FloatArray, window: FloatArray) -> tuple[FloatArray, float]:
    square = float(np.sum(window**2))
    # The mean under the window would leak into the lowest frequencies.
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
) -> tuple[UncertainCurve, float]:
    """Return S over radial frequency, and the width of its rings [1/m]."""
    steps = _steps(x, y)
    cell, step = steps[0] * steps[1], max(steps)
    # Beyond the Nyquist frequency of an axis some directions are missing.
    last = max(int(min(np.abs(x).max(), np.abs(y).max()) / step - 0.5), 1)
    content, of_noise = np.zeros((2, last + 1))
    parts = (np.arange(_PARTS) + 0.5) / _PARTS - 0.5
    for across in parts * steps[0]:
        for along in parts * steps[1]:
            frequency = np.hypot((x + across)[np.newaxis], (y + along)[:, np.newaxis]).ravel()
            # The cell about zero is empty, because the mean was removed.
            ring = np.maximum(np.rint(frequency / step).astype(np.int64), 1)
            inside = ring <= last
            for total, values in ((content, areal), (of_noise, noise)):
                total += np.bincount(ring[inside], values.ravel()[inside], last + 1)
    position = np.asarray(step * np.arange(1, last + 1), np.float64)
    area = 2 * np.pi * position * step
    value, floor = (total[1:] * cell / _PARTS**2 / area for total in (content, of_noise))
    # The spectrum of a real map holds each frequency twice.
    independent = np.maximum(area / cell / 2, 1.0)
    return UncertainCurve(position, value, np.hypot(value / np.sqrt(independent), floor)), step


def _over_direction(
    x: FloatArray, y: FloatArray, areal: FloatArray, noise: FloatArray
) -> UncertainCurve:
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
    return UncertainCurve(directions, content, np.asarray(np.hypot(scatter, of_noise)))


Averaging = Callable[[FloatArray], Profile]


def profiles(map_: DeviationMap, disc: Aperture) -> dict[str, UncertainCurve]:
    """Return the mean deviations [m] over x, y, the diagonal, radius [m], and angle [rad].

    Uncertainties are from noise and all error sources. A profile without points is left out.
    """
    x, y = map_.x - disc.x, map_.y - disc.y
    band = {"half_width": _HALF_WIDTH * disc.radius, "spacing": _SPACING * disc.radius}
    made: dict[str, Averaging] = {
        name: lambda d, angle=angle: line_profile(x, y, d, angle=angle, **band)  # type: ignore[misc]
        for name, angle in (("x", 0.0), ("y", np.pi / 2), ("diagonal", np.pi / 4))
    }
    width = _ring(x, y, disc.radius)
    made["radius"] = lambda d: radial_profile(x, y, d, spacing=width)
    made["angle"] = lambda d: _around(x, y, d, disc.radius)
    found = {name: _curve(map_, average) for name, average in made.items()}
    return {name: curve for name, curve in found.items() if len(curve.position)}


def _ring(x: FloatArray, y: FloatArray, radius: float) -> float:
    """Return the least width of rings [m] of which most contain points."""
    reach = np.hypot(x, y)
    extent = float(reach.max() - reach.min())
    for width in np.array(_RINGS) * radius:
        found = radial_profile(x, y, reach, spacing=float(width))
        if len(found.position) * width >= _COVERED * extent:
            return float(width)
    return float(_RINGS[-1] * radius)


def _around(x: FloatArray, y: FloatArray, deviation: FloatArray, radius: float) -> Profile:
    outer = np.hypot(x, y) >= _OUTER * radius
    angle = np.arctan2(y[outer], x[outer])
    count = round(360 / _DEGREES)
    place = np.floor((angle + np.pi) / (2 * np.pi) * count).astype(np.int64) % count
    points = np.bincount(place, minlength=count)
    filled = points > 0

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(place, values, count)[filled] / points[filled])

    return Profile(position=mean(angle), value=mean(deviation[outer]), points=points[filled])


def _curve(map_: DeviationMap, average: Averaging) -> UncertainCurve:
    profile = average(map_.deviation)
    variance = map_.noise**2 / np.maximum(profile.points, 1)
    for effect in map_.effects:
        variance = variance + average(effect).value ** 2
    return UncertainCurve(profile.position, profile.value, np.sqrt(variance))
