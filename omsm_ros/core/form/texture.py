"""Texture parameters (ISO 25178-2), slopes (ISO 10110-14), power spectral density and profiles.

The areal density is ``S(f_x, f_y) = dx dy |FFT(w z)|² / Σ w²``, two-sided, in m⁴, with the window
``w`` of the present cells: its sum over all frequencies times df_x df_y is the mean square of the
map under that window (Parseval). The radial density is the content of each ring of width Δf over
the area of the ring: ``Σ 2π f S(f) Δf`` is the mean square in the band of the rings. The azimuthal
density is the mean square per radian of half a turn.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from omsm_ros.core.form.deviation_map import DeviationMap, GridCells, UncertainValue, square_slope
from omsm_ros.core.form.part_figures import of_square
from omsm_ros.core.streams.blocks import BoolArray, FloatArray
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.core.surface.deviation import Profile, line_profile, radial_profile
from omsm_ros.errors import DataError

# A fixed seed, so that the same points give the same figures.
_NOISE_SEED = 21
# Least cutoff of the S-filter in cells; a shorter one would pass aliased wavelengths.
_LEAST_CELLS = 4.0
# Weights of the cutoffs 1, √2, √3 for the figure at zero: by the first, the first two, all.
_EXTRAPOLATED = np.array([[1.0, 0.0, 0.0], [2.0, -1.0, 0.0], [3.0, -3.0, 1.0]])
# Images filtered at a time; draws of the noise; and share of the subtracted noise that is
# uncertain, where noise and form do not add as squares.
_AT_A_TIME, _DRAWS, _UNSURE = 8, 4, 0.25
# The width of the cells does not change a cutoff of this number of them.
_MANY_CELLS = 12.0
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
# Shares of the way to the rim between which the form continues to the edge.
_FLAT = (0.6, 0.9)
# The profile at the edge: share of the radius where it begins; factor by which rings are narrower.
_EDGE, _FINER_AT_EDGE = 0.9, 4
# Widths of rings over the radius; the narrowest that the turns of the scan fill to 80 % is used.
_RINGS, _COVERED = (1 / 50, 1 / 25, 1 / 10), 0.8


@dataclass(frozen=True, slots=True)
class Bands:
    """Cutoff wavelengths [m] of the S- and the L-filter, and limits of the bands of rms.

    s_filter: None: no wavelength is removed;  resolved: the shortest that the cells resolve
    """

    s_filter: float | None
    resolved: float
    l_filter: float
    rms_bands: dict[str, tuple[float | None, float | None]]


def bands_of(
    cells: GridCells, s_filter: float | None = None, l_filter: float | None = None
) -> Bands:
    """Return the cutoffs asked for; by default no S-filter, and a quarter of the longest side.

    Raises DataError for an L-filter that is not longer than the S-filter.
    """
    across = max(len(v) * step for v, step in zip((cells.x, cells.y), cells.steps, strict=True))
    resolved = _LEAST_CELLS * cells.pitch
    shortest = max(s_filter or 0.0, resolved)
    longest = l_filter or _DEFAULT_L * across
    if l_filter is not None and longest <= shortest:
        raise DataError("form.empty_filter_band", l_filter=longest, s_filter=shortest)
    found: dict[str, tuple[float | None, float | None]] = {}
    for name, (long, short) in _BANDS.items():
        if long * across > shortest:
            end = short * across if short * across > shortest else s_filter and shortest
            found[name] = (None if long == np.inf else long * across, end)
    return Bands(s_filter and shortest, resolved, longest, found)


@dataclass(frozen=True, eq=False)
class _FilteredBand:
    """One band of the cells after each cutoff of the S-filter, to extrapolate to none.

    levels: the values, and draws of their noise, for each cutoff (1 + draws, …)
    effects: of the error sources, after the first cutoff (e, …)
    noise_known: that the values contain this noise
    """

    levels: Sequence[FloatArray]
    effects: FloatArray
    noise_known: bool

    def figures(self, of: Callable[[FloatArray], FloatArray], sizes: int) -> list[UncertainValue]:
        """Return figures of the values, without noise and without loss by the S-filter.

        Noise adds to the square of a size, so that its own addition is subtracted. The loss of the
        square is a smooth function of the square of the cutoff, so that the cutoffs 1, √2, √3 give
        it at zero. That number of them is used for which noise and the next step are smallest.
        Both belong to the uncertainty, with all effects and the change by every other cell alone.

        of: the figures of one image, of which the first ``sizes`` are sizes
        """

        def measure(k: int) -> FloatArray:
            found = np.array([of(v[0] + v[k] if k else v[0]) for v in self.levels])
            found[:, :sizes] **= 2
            return np.asarray(weights @ found)

        weights = _EXTRAPOLATED[: len(self.levels), : len(self.levels)]
        here, *again = map(measure, range(len(self.levels[0])))
        added = np.mean(again, axis=0) - here
        values = here - added if self.noise_known else here
        steps = np.diff(values, axis=0)
        steps = np.concatenate([steps, steps[-1:] if len(steps) else np.zeros_like(values)])
        of_noise = np.hypot(np.std(again, axis=0), added * (_UNSURE if self.noise_known else 1.0))
        spread = np.hypot(of_noise, steps)
        first = self.levels[0][0]
        shares = [(of(first + e) - of(first - e)) / 2 for e in self.effects]
        every_other = of(first) - of(first[..., ::2])
        systematic, found = np.linalg.norm([every_other, *shares], axis=0), []
        for k, best in enumerate(np.argmin(spread, axis=0)):
            value, deviation = float(values[best, k]), float(spread[best, k])
            one = of_square(value, deviation) if k < sizes else UncertainValue(value, deviation)
            whole = float(np.hypot(one.uncertainty or 0.0, systematic[k]))
            found.append(UncertainValue(one.value, whole))
        return found


def texture(
    cells: GridCells, formless: GridCells, bands: Bands, points: DeviationMap | None = None,
    rest: GridCells | None = None, slope: float | None = None,
) -> dict[str, UncertainValue]:  # fmt: skip
    """Return Sa, Sq, Sz [m], Ssk, Sku, Sdq [1] of the S-L surface, rms by band [m], slopes [1].

    formless: the same cells after the F-operation
    points: the S-L surface, None for that of the cells
    rest: the same cells without their second order, whose slope is found too
    slope: mean square between all points of a grid [1], of which the cells hold blocks
    """
    shown = [cells] if rest is None else [cells, rest]
    images = [np.concatenate([c.mean[np.newaxis], c.effects]) for c in shown]
    cutoffs = _cutoffs(cells, bands.s_filter)
    *steep, levels = _planes(cells, [*images, formless.mean[np.newaxis]], cutoffs, len(images))
    between = (bands.s_filter, bands.l_filter)
    surface = _band(formless, *between, levels) if points is None else _of_points(points)
    found = dict(zip(("Sa", "Sq", "Sz", "Ssk", "Sku"), surface.figures(_moments, 3), strict=True))
    blocks, lost = formless, 0.0
    if slope is not None:
        # Blocks hold what the filters remove, and lose short waves.
        held = square_slope(np.where(cells.present, cells.mean, np.nan), cells.steps)
        blocks, lost = replace(formless, width=0.0), max(slope - held, 0.0)
    pairs = _band(blocks, *between, levels, between=True)
    found["Sdq"] = UncertainValue(None, None)
    if pairs.levels[0].size:
        found["Sdq"] = pairs.figures(lambda v: np.sqrt(np.mean(v * v, keepdims=True) + lost), 1)[0]
    for name, (long, short) in bands.rms_bands.items():
        same = long and short in (None, bands.s_filter)
        band = _band(formless if long else cells, short, long, levels if same else None)
        found[f"rms_{name}"] = band.figures(lambda v: _moments(v)[1:2], 1)[0]
    found["slope_rms"], found["slope_largest"] = _slopes(cells, steep[0])
    if rest is not None:
        found["slope_rms_without_second_order"] = _slopes(rest, steep[1])[0]
    return found


def _of_points(map_: DeviationMap) -> _FilteredBand:
    """Return the points, each as often as its area demands, as a band that no S-filter changed."""
    ends = np.cumsum(map_.area)
    even = np.searchsorted(ends, (np.arange(len(map_)) + 0.5) / len(map_) * ends[-1])
    level = np.random.default_rng(_NOISE_SEED).normal(0, map_.noise, (1 + _DRAWS, len(map_)))
    level[0] = map_.deviation
    return _FilteredBand([level[:, even]], map_.effects[:, even], map_.noise_known)


def _planes(
    cells: GridCells, images: list[FloatArray], cutoffs: list[tuple[float, float]], steep: int = 0
) -> list[list[FloatArray]]:
    """Return the slopes of the first ``steep`` images (1 + e, r, c), the levels of the others.

    Those along x and y (2, 1 + draws + e, r, c), or levels (1, …), for each cutoff: with those of
    the noise; of the effects after the first cutoff only.
    """
    noise, found = _noise(cells), [list[FloatArray]() for _ in images]
    for cutoff in cutoffs:
        fit = cells.planes(cutoff)
        of_noise = fit(noise)
        for k, (planes, image) in enumerate(zip(found, images, strict=True)):
            kinds, image = [1, 2] if k < steep else [0], image[:1] if planes else image
            few = np.split(image, range(_AT_A_TIME, len(image), _AT_A_TIME))
            own = np.concatenate([fit(part, kinds) for part in few], axis=1)
            planes.append(np.concatenate([own[:, :1], of_noise[kinds], own[:, 1:]], axis=1))
    return found


def _slopes(cells: GridCells, planes: list[FloatArray]) -> list[UncertainValue]:
    """Return the rms and the largest slope [1] of the cells."""
    chosen = cells.present & _neighboured(cells.present)
    if not np.any(chosen):
        return 2 * [UncertainValue(None, None)]
    steep = [np.moveaxis(p[:, :, chosen], 0, 1) for p in planes]
    levels, effects = [s[: 1 + _DRAWS] for s in steep], steep[0][1 + _DRAWS :]

    def sizes(values: FloatArray) -> FloatArray:
        square = values[0] ** 2 + values[1] ** 2
        return np.sqrt([np.mean(square), np.max(square)])

    return _FilteredBand(levels, effects, cells.noise_known).figures(sizes, 2)


def _noise(cells: GridCells) -> FloatArray:
    """Return draws of the noise of the cells (draws, r, c)."""
    random = np.random.default_rng(_NOISE_SEED)
    return np.asarray(random.normal(size=(_DRAWS, *cells.mean.shape)) * cells.noise)


def _cutoffs(cells: GridCells, short: float | None) -> list[tuple[float, float]]:
    """Return cutoffs along x and y [m]: that asked for, or multiples of the cells."""
    if short:
        return [(short, short)]
    cutoffs = (_LEAST_CELLS * k**0.5 for k in (1, 2, 3))
    return [(many * cells.steps[0], many * cells.steps[1]) for many in cutoffs]


def _band(
    cells: GridCells, short: float | None, long: float | None,
    planes: list[FloatArray] | None = None, *, between: bool = False,
) -> _FilteredBand:  # fmt: skip
    """Return the present cells between an S- and an L-filter (ISO 25178-2).

    planes: of their mean, if they are known
    between: return the slopes between neighbouring cells instead
    """
    images, effects = np.concatenate([cells.mean[np.newaxis], _noise(cells)]), cells.effects
    if short is None and cells.width == 0:
        levels = [images]
    elif short is not None and short > _MANY_CELLS * cells.pitch:
        levels, effects = [cells.smoothed(images, short)], cells.smoothed(effects, short)
    else:
        # The effects of systematic errors have no short waves.
        own = planes or _planes(cells, [images[:1]], _cutoffs(cells, short))[0]
        levels = [p[0] for p in own]

    low = cells.low_pass(long) if long else lambda images: 0 * images

    def kept(images: FloatArray) -> FloatArray:
        rest = images - low(images)
        return cells.between(rest) if between else np.asarray(rest[:, cells.present])

    return _FilteredBand([*map(kept, levels)], kept(effects), cells.noise_known)


def _neighboured(present: BoolArray) -> BoolArray:
    """Return which cells (r, c) have a neighbour along each axis that has several cells."""
    found = np.full(present.shape, max(present.shape) > 1)
    for axis in [axis for axis, size in enumerate(present.shape) if size > 1]:
        pad = np.pad(present, [(1, 1) if n == axis else (0, 0) for n in (0, 1)])
        found &= np.delete(pad, [-2, -1], axis) | np.delete(pad, [0, 1], axis)
    return found


def _moments(values: FloatArray) -> FloatArray:
    """Return Sa, Sq, Sz, Ssk, Sku of the values (n,)."""
    about = values - values.mean()
    square = about * about  # a general power takes ten times as long
    size = float(np.sqrt(np.mean(square)))
    third, fourth = float(np.mean(square * about)), float(np.mean(square * square))
    shape = (third / size**3, fourth / size**4) if size else (0.0, 0.0)
    return np.array([np.mean(np.abs(about)), size, np.ptp(values), *shape])


@dataclass(frozen=True, eq=False)
class UncertainCurve:
    """Values of a function at positions, and their standard uncertainty, each (k,)."""

    position: FloatArray
    value: FloatArray
    uncertainty: FloatArray

    def entry(self) -> dict[str, list[float]]:
        """Return the JSON values for result files."""
        return {name: values.tolist() for name, values in vars(self).items()}


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

    A mean over k independent frequencies has a relative uncertainty of 1/√k. The radial and the
    azimuthal density are without that of the noise of the points, if it is known.
    """
    window = _window(cells)
    y, x = (
        np.asarray(np.fft.fftfreq(size, step), np.float64)
        for size, step in zip(cells.mean.shape, reversed(cells.steps), strict=True)
    )
    # Share of each frequency that the mean over a cell passes.
    along, across = (
        np.sinc(v * step * cells.width)
        for v, step in zip((y, x), reversed(cells.steps), strict=True)
    )
    passed = np.outer(along, across) ** 2
    image = cells.mean
    if cells.width > 0:
        # The mean position of the points is not the middle of the cell.
        steep = cells.planes(_cutoffs(cells, None)[0])(image[np.newaxis], (1, 2))
        steps = np.reshape(cells.steps, (2, 1, 1))
        image = image - np.sum(steep[:, 0] * cells.offset[::-1] * steps, axis=0)
    # The mean under the window would leak into the lowest frequencies.
    content = np.abs(np.fft.fft2(window * (image - np.average(image, weights=window)))) ** 2
    areal = content * np.prod(cells.steps) / np.sum(window**2) / passed
    white = np.sum((window * cells.noise) ** 2) / np.sum(window**2) * np.prod(cells.steps)
    of_noise = white / passed
    mean_square = float(areal.sum()) * float(np.prod(_steps(x, y)))
    radial, step = _over_frequency(x, y, areal, of_noise, cells.noise_known)
    band = (step / 2, float(radial.position[-1]) + step / 2)
    inside = float(np.sum(2 * np.pi * radial.position * radial.value) * step)
    azimuthal = _over_direction(x, y, areal, of_noise, cells.noise_known)
    return PowerDensity(x, y, areal, mean_square, radial, azimuthal, band, inside)


def _window(cells: GridCells) -> FloatArray:
    """Return a taper (r, c) that falls to zero at the rim of an ellipse about the cells."""
    across = [np.linspace(-1, 1, size + 2)[1:-1] for size in cells.present.shape]
    radius = np.minimum(np.hypot(across[0][:, np.newaxis], across[1][np.newaxis]), 1.0)
    return np.asarray(np.cos(np.pi * radius / 2) ** 2 * cells.present)


def _steps(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Return the spacings of the frequencies along x and y [1/m]."""
    across, along = (float(abs(v[1] - v[0])) if len(v) > 1 else 1.0 for v in (x, y))
    return across, along


def _over_frequency(
    x: FloatArray, y: FloatArray, areal: FloatArray, noise: FloatArray, known: bool
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
    return _without_noise(position, value, value / np.sqrt(independent), floor, known), step


def _without_noise(
    position: FloatArray, value: FloatArray, scatter: FloatArray, noise: FloatArray, known: bool
) -> UncertainCurve:
    """Return the density less that of the noise, if it is known to be noise."""
    left = np.maximum(value - noise, 0.0) if known else value
    spread = np.hypot(scatter, noise * (_UNSURE if known else 1.0))
    return UncertainCurve(position, left, np.asarray(spread, np.float64))


def _over_direction(
    x: FloatArray, y: FloatArray, areal: FloatArray, noise: FloatArray, known: bool
) -> UncertainCurve:
    steps = _steps(x, y)
    angle = np.arctan2(y[:, np.newaxis] + 0 * x, x[np.newaxis] + 0 * y[:, np.newaxis]).ravel()
    sector = np.floor((angle % np.pi) / np.pi * _SECTORS).astype(np.int64) % _SECTORS
    per_angle = steps[0] * steps[1] * _SECTORS / np.pi
    content, of_noise, square = (
        np.asarray(np.bincount(sector, v.ravel(), _SECTORS) * per_angle, np.float64)
        for v in (areal, noise, areal**2)
    )
    scatter = np.sqrt(square * per_angle)
    directions = np.asarray((np.arange(_SECTORS) + 0.5) * np.pi / _SECTORS, np.float64)
    return _without_noise(directions, content, scatter, of_noise, known)


def profiles(map_: DeviationMap, disc: Aperture) -> dict[str, UncertainCurve]:
    """Return the mean deviations [m] over x, y, the diagonal, radius [m], and angle [rad].

    "edge" is that over the outer tenth of the radius in narrower rings, for a roll-off.
    Uncertainties are from noise and all error sources. A profile without points is left out.
    """
    x, y = map_.x - disc.x, map_.y - disc.y
    band = {"half_width": _HALF_WIDTH * disc.radius, "spacing": _SPACING * disc.radius}
    made: dict[str, Callable[[FloatArray], Profile]] = {
        name: lambda d, angle=angle: line_profile(x, y, d, angle=angle, **band)  # type: ignore[misc]
        for name, angle in (("x", 0.0), ("y", np.pi / 2), ("diagonal", np.pi / 4))
    }
    width = _ring(x, y, disc.radius)
    made["radius"] = lambda d: radial_profile(x, y, d, spacing=width)
    outer, step = np.hypot(x, y) >= _OUTER * disc.radius, _DEGREES * np.pi / 180
    angle = np.arctan2(y[outer], x[outer])
    made["angle"] = lambda d: line_profile(
        angle, 0 * angle, d[:, outer], half_width=1.0, spacing=step
    )
    if np.any(rim := np.hypot(x, y) >= _EDGE * disc.radius):
        narrow = _ring(x[rim], y[rim], disc.radius / _FINER_AT_EDGE, disc.radius)
        made["edge"] = lambda d: radial_profile(x[rim], y[rim], d[:, rim], spacing=narrow)
    rows = np.vstack([map_.deviation, map_.effects])
    found = {name: _curve(average(rows), map_.noise) for name, average in made.items()}
    return {name: curve for name, curve in found.items() if len(curve.position)}


def edge_roll_off(map_: DeviationMap, outline: Aperture) -> UncertainValue:
    """Return how far the rim of the ``outline`` lies above the form within it [m].

    That is the outermost complete ring, less the parabola over the distance from the middle through
    the rings from 0.6 to 0.9 of it: below zero for a rolled edge. Rings have the outline's shape.
    """
    size = outline.share_of_rim(map_.x, map_.y)
    angle = np.arctan2(map_.y - outline.y, map_.x - outline.x)
    x, y = size * np.cos(angle), size * np.sin(angle)
    width = _ring(x, y, 1.0 / _FINER_AT_EDGE, 1.0)
    rings = radial_profile(x, y, np.vstack([map_.deviation, map_.effects]), spacing=width)
    inner = (rings.position > _FLAT[0]) & (rings.position < _FLAT[1])
    if np.sum(inner) < 4 or rings.position[-1] < _EDGE:
        return UncertainValue(None, None)
    columns = np.vander(rings.position, 3)
    weights = -columns[-1] @ np.linalg.pinv(columns[inner])
    weights = np.append(weights, 1.0)
    chosen = np.append(np.flatnonzero(inner), len(inner) - 1)
    fall, *found = rings.value[:, chosen] @ weights
    noise = map_.noise * np.linalg.norm(weights / np.sqrt(rings.points[chosen]))
    return UncertainValue(float(fall), float(np.hypot(noise, np.linalg.norm(found))))


def _ring(x: FloatArray, y: FloatArray, *radii: float) -> float:
    """Return the least width of rings [m] of which most contain points."""
    reach = np.hypot(x, y)
    extent = float(reach.max() - reach.min())
    widths = np.outer(radii, _RINGS).ravel()
    for width in widths:
        found = radial_profile(x, y, reach, spacing=float(width))
        if len(found.position) * width >= _COVERED * extent:
            return float(width)
    return float(widths[-1])


def _curve(profile: Profile, noise: float) -> UncertainCurve:
    of_effects = np.sum(profile.value[1:] ** 2, axis=0)
    variance = noise**2 / np.maximum(profile.points, 1) + of_effects
    return UncertainCurve(profile.position, profile.value[0], np.sqrt(variance))
