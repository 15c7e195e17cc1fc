"""Estimate peak to valley of a part, free of the bias by noise and systematic errors.

Errors increase a peak to valley on average. Drawing errors of the same size once more shows by how
much. If a power p of the figure grows with the same power of the size of the errors, then with F of
the deviations and F' with errors drawn anew

    F^p of the part = F^p − (mean F'^p − F^p) / (2^(p/2) − 1)

with p = 2 for errors of smooth shape, and less for noise, for which points compete
(simulation and extrapolation; J. Cook, L. Stefanski, J. Am. Stat. Assoc. 89, 1314). Before, smooth
terms, means of neighbours and a Wiener filter remove most of the noise; the rest counts as an
error. Form taken for a move and upper bounds count as in :mod:`omsm_ros.core.form.part_figures`.

A scan sees the part on its tracks only. What the form may reach between them, and from the last
track to the rim, is extrapolated; half of it is added, and as much is the standard uncertainty.
So is half of what single points show alone, which may be dust, subtracted.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.form.deviation_map import DeviationMap, UncertainValue
from omsm_ros.core.form.part_figures import (
    either,
    length,
    of_square,
    real_effects,
    with_and_without,
    without_noise,
)
from omsm_ros.core.form.zernike_fit import RimStrip, ZernikeFit, continued, fit_zernikes, separable
from omsm_ros.core.registration.pose_parameters import root_of
from omsm_ros.core.streams.blocks import FloatArray, IntArray
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.core.surface.zernike_terms import ZernikeIndex, terms_up_to, zernike_values

# 99.5 % of the area lies between these (ISO 10110-5:2015 calls for a share to be stated).
ROBUST = (0.0025, 0.9975)
# Turning and polishing make rings and rolled edges, so that symmetric terms have higher orders.
_TERMS = terms_up_to(16) + tuple(ZernikeIndex(n, 0) for n in range(18, 32, 2))
# Orders of the smooth terms; the highest with forty points for each term is used.
_ORDERS, _PER_TERM = (30, 16, 12, 8, 4, 2), 40
# Condition number that leaves nine digits of the sum of the terms at points that were fitted.
_CONDITION = 1e7
# A hundred points for each term; two thousand show the extent of a smooth form.
_MOST_FITTED, _MOST_DRAWN = 20_000, 2_000
# 200 draws give a standard deviation to 5 %.
_DRAWS, _SEED = 200, 7
# Halvings of the cells that show local features, and points at either extreme.
_HALVINGS, _HALF = 4, 500
# The grid of cells may divide a feature. On one of three grids a third of a cell apart, any lies
# within a cell of a few times its size.
_SHIFTS = (0.0, 1 / 3, 2 / 3)
# Standard deviations of χ² that chance does not exceed.
_CHANCE = 3.0
# Least variance, so that a part without noise keeps all terms [m²].
_TINY = 1e-40
# Points that continue the form to a place of the rim; how far they may be off, in distances of the
# tracks; number of places.
_AROUND, _REACH, _PLACES = 24, 1.5, 360
# Neighbours on the next tracks, way to the middle between two, and the surroundings of a peak, in
# distances of the tracks; distance of the middle of the neighbours beyond which it is at the rim.
_NEXT, _HALF_WAY, _AWAY, _ONE_SIDED = (0.7, 1.3), 0.5, (2.0, 3.5), 0.3
# Peaks and single points at either end, and share of the height of a peak that is hidden.
# Share that the neighbours of a peak show unless it is a single point.
_PEAKS, _SINGLE, _UNSEEN, _COMPANY = 6, 24, 0.05, 1 / 3
# Most by which a summit that both neighbouring tracks miss exceeds what one track shows of it.
MOST_UNSEEN = float(_UNSEEN ** -(_HALF_WAY**2))
# Places about a peak up to the middle of four points of a raster, in distances of the tracks.
_ABOUT = np.outer(np.arange(1, 7) / 8, np.exp(1j * np.arange(24) * np.pi / 12)).reshape(-1, 1)
# Least singular value of a parabola through neighbours.
_LEAST_SPREAD = 1e-2


def extents_of_parts(
    maps: Sequence[DeviationMap], disc: Aperture, gaps: Gaps | None = None
) -> list[tuple[UncertainValue, UncertainValue]]:
    """Return the peak to valley of maps that differ by smooth form.

    Second is the extent of 99.5 % of the area, of the first map only.

    disc: of the smooth terms;  gaps: between the points of the maps, None without any
    """
    if not maps[0].noise_known:
        ways = zip(*map(with_and_without, maps), strict=True)
        one, other = (extents_of_parts(way, disc, gaps) for way in ways)
        return [(either(a[0], b[0]), either(a[1], b[1])) for a, b in zip(one, other, strict=True)]
    form = _PartForm.of(maps[0], disc)
    shifts = (map_.deviation - maps[0].deviation for map_ in maps)
    return [form.extents(m, s, gaps, m is maps[0]) for m, s in zip(maps, shifts, strict=True)]


class _PartForm(NamedTuple):
    """Estimated form of a part at all its points, and the noise that is left in it.

    value: (n,) [m];  smooth: its smooth terms
    cell, error: number of the cell (n,) whose mean a point has, and its noise [m]
    above: value less the smooth terms (n,) [m]
    local: points that differ from the smooth form (m,);  blurred: rms of the form lost [m]
    texture: height of waves that the scatter about the value shows, but no mean (n,) [m]
    unseen: how far other grids of cells show the form below and above the value (2, n) [m]
    """

    value: FloatArray
    smooth: ZernikeFit
    cell: IntArray
    error: FloatArray
    above: FloatArray
    local: IntArray
    blurred: float
    texture: FloatArray
    unseen: FloatArray

    @classmethod
    def of(cls, map_: DeviationMap, disc: Aperture) -> _PartForm:
        """Return the form of a map;  disc: of the smooth terms."""
        fit = _smooth(map_.every(_MOST_FITTED), disc)
        mean, cell = fit.height(map_.x, map_.y), np.arange(len(map_))
        (local, form, own, noise), *others = (_local_features(map_, mean, k) for k in _SHIFTS)
        left = map_.deviation - mean
        # Wiener's factor, and the rms of the form lost by it.
        more = max(float(np.mean(left**2)) - map_.noise**2, 0.0)
        share = more / (more + map_.noise**2) if more else 0.0
        value, error = mean + share * left, np.full(len(map_), share * map_.noise)
        value[local], error[local], cell[local] = form, noise, len(map_) + own
        blurred = (1 - share) * float(np.sqrt(more))
        waves, unseen = _texture(map_, map_.deviation - value), np.zeros((2, len(map_)))
        for at, other, _, scatter in others:
            chance = 2 * np.hypot(scatter, error[at])
            more = np.outer((-1, 1), other - value[at]) - chance
            unseen[:, at] = np.maximum(unseen[:, at], more)
        return cls(value, fit, cell, error, value - mean, local, blurred, waves, unseen)

    def extents(
        self, map_: DeviationMap, shift: FloatArray, gaps: Gaps | None, robust: bool
    ) -> tuple[UncertainValue, UncertainValue]:
        """Return the extents of the ``map_`` whose form differs by a smooth ``shift`` (n,) [m]."""
        form = self.value + shift
        even = map_.equal_areas(_MOST_DRAWN)
        order = self.local[np.argsort(form[self.local])]
        some = np.concatenate([even, order[:_HALF], order[-_HALF:]])
        drawn = _drawn(map_.part(some), self, form[some], some)
        beyond, alone = gaps.beyond(self, form) if gaps else np.zeros((2, 2))
        of_waves = [np.max(way * form + self.texture) - np.max(way * form) for way in (-1, 1)]
        found = []
        many = form[map_.equal_areas(_MOST_FITTED)]
        shares = ((0.0, 1.0), form, len(some)), (ROBUST, many, len(even))
        for ends, all_, count in shares[: 1 + robust]:
            of_some, *ways = (_extents(way[:count], ends) for way in (form[some], *drawn))
            again, more, likely, full, noise = (way**2 for way in ways)
            bare, open_ = without_noise(float(of_some), ways[-1])
            square = bare * abs(bare) - float(np.mean(again - noise) - np.mean(likely) + of_some**2)
            of_bounds, of_taken = (
                float(np.sqrt(np.mean(v**2))) for v in (more - again, full - np.mean(likely))
            )
            # Where many points compete for an extreme, the mean of the draws follows the noise of
            # the figure in part, so that it counts once to twice: the factor is √2.
            of_errors = length(*np.std([again, noise], axis=1))
            # An extent has two ends, each blurred independently.
            of_blur = 2 * of_some * np.sqrt(2) * self.blurred
            of_all = length(of_errors, of_bounds, of_taken, of_blur, 2 * float(of_some) * open_)
            figure = of_square(square, of_all)
            between = np.append(np.maximum(beyond, of_waves), -alone) / 2 * (all_ is form)
            value = (figure.value or 0.0) + _extents(all_, ends) - of_some + float(np.sum(between))
            found.append(UncertainValue(float(value), length(figure.uncertainty or 0.0, *between)))
        return found[0], found[1] if robust else UncertainValue(None, None)


def _extents(values: FloatArray, ends: tuple[float, float]) -> FloatArray:
    """Return the distances between the quantiles ``ends`` along the first axis."""
    if ends != (0.0, 1.0):
        values = np.quantile(values, ends, axis=0, method="hazen")
    return np.asarray(np.ptp(values, axis=0))


class Gaps(NamedTuple):
    """Places that the tracks miss.

    x, y: of the points (n,) [m];  spacing: of the tracks [m]
    near: points (q, k), the nearest first;  weights: of their sums that continue the form to a
        place of the rim, and that add to it if the curvature rises (2, q, k)
    strip: along the rim, for the mean square of the form; None for an annulus
    share: of the area that half a track along the rim has
    """

    x: FloatArray
    y: FloatArray
    spacing: float
    near: IntArray
    weights: FloatArray
    strip: RimStrip | None
    share: float

    @classmethod
    def of(
        cls, map_: DeviationMap, outline: Aperture, spacing: float, strip: RimStrip | None = None
    ) -> Gaps | None:
        """Return the gaps between the points and to the ``outline``; None for a profile.

        strip: along the rim, for sums of piston and other terms, weighted by area
        """
        from scipy.spatial import cKDTree  # takes long to load

        some = np.arange(0, len(map_), -(-len(map_) // _MOST_FITTED))
        x, y = map_.x[some], map_.y[some]
        if len(x) < _AROUND or min(np.ptp(x), np.ptp(y)) < _REACH * spacing:
            return None
        corners = outline.rim()
        (u, v), way = corners, np.cumsum(np.hypot(*np.diff(corners, prepend=corners[:, :1])))
        at = np.linspace(0, way[-1], _PLACES, endpoint=False)
        rim = np.stack([np.interp(at, way, u), np.interp(at, way, v)])
        away, near = cKDTree(np.column_stack([x, y])).query(rim.T, _AROUND)
        close = away[:, 0] < _REACH * spacing
        near, rim = near[close], rim[:, close, np.newaxis]
        parabola, plane = continued((x[near] - rim[0] + 1j * (y[near] - rim[1])) / spacing)
        weights = np.stack([parabola, (parabola - plane) / 2])
        if strip is not None:
            strip = RimStrip(strip.points, *(v[:1] / map_.area.sum() for v in strip[1:]))
        share = float(way[-1]) * spacing / abs(float(np.sum(u[:-1] * v[1:] - u[1:] * v[:-1])))
        return cls(map_.x, map_.y, spacing, some[near], weights, strip, share)

    def square(self, values: FloatArray) -> tuple[float, float]:
        """Return what form beyond the last track adds to the mean square of ``values`` (n,) [m].

        Second is the standard uncertainty of that [m²].
        """
        if self.strip is not None:
            more, errors = self.strip.missed(values[self.strip.points] ** 2)
            return float(more[0]), float(np.linalg.norm(errors))
        rim, last = np.sum(self.weights[0] * values[self.near], axis=1), values[self.near[:, 0]]
        return 0.0, self.share * abs(float(np.mean(rim**2 - last**2))) / 2 if len(rim) else 0.0

    def beyond(self, part: _PartForm, form: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return how far the form may reach beyond its extremes, and fall short of them (2,) [m].

        form: of the points of the ``part`` (n,) [m]
        """
        rim, further = np.sum(self.weights * form[self.near], axis=2)
        weights, found, alone = np.sum(self.weights, axis=0), [], []
        chance = 2 * np.sqrt(np.sum((weights * part.error[self.near]) ** 2, axis=1))
        for sign, unseen in zip((-1, 1), part.unseen, strict=True):
            values = sign * form
            # Form that flattens ends where it is.
            at_rim = sign * rim + np.maximum(sign * further, 0.0) - chance
            summit = self._summit(values + unseen, sign * part.above + unseen, part.error)
            found.append(float(np.max(at_rim, initial=summit) - values.max()))
            alone.append(self._alone(values, sign * part.above))
        return np.maximum(found, 0.0), np.array(alone)

    def _summit(self, values: FloatArray, above: FloatArray, noise: FloatArray) -> float:
        """Return how high ``values`` (n,) [m] may be between the tracks.

        above: smooth form (n,) [m], which tells what may be highest
        """
        may, highest = values + (MOST_UNSEEN - 1) * np.maximum(above, 0.0), float(values.max())
        for _ in range(_PEAKS):
            peak = int(np.argmax(may))
            near, at = self._about(peak)
            rise = _rise(at, values[near], values[peak], float(noise[peak]))
            highest = max(highest, float(values[peak]) + rise)
            may[near] = -np.inf
        return highest

    def _alone(self, values: FloatArray, above: FloatArray) -> float:
        """Return how far single points of ``values`` exceed all that neighbours show, (n,) [m]."""
        # Heights ``above`` the smooth form (n,) [m] decide: a slope makes no point single.
        left, most = values.copy(), 0.0
        for _ in range(_SINGLE):
            peak = int(np.argmax(left))
            near, at = self._about(peak)
            others = (away := np.abs(at)) > 0
            shown, dense = above[near[others & (away < _NEXT[1])]], np.any(away[others] < _HALF_WAY)
            base = float(np.median(shown if dense else above[near]))
            own = float(above[peak]) - base
            if not np.max(shown, initial=-np.inf) - base < _COMPANY * own:
                break
            left[peak], most = -np.inf, max(most, own)
        return min(float(values.max() - left.max()), most)

    def _about(self, peak: int) -> tuple[IntArray, NDArray[np.complex128]]:
        """Return the points (k,) about a ``peak``, and their places in distances of the tracks."""
        reach, middle = _AWAY[1] * self.spacing, self.x[peak]
        near = np.flatnonzero((self.x > middle - reach) & (self.x < middle + reach))
        at = ((self.x[near] - middle) + 1j * (self.y[near] - self.y[peak])) / self.spacing
        about = np.abs(at) < _AWAY[1]
        return near[about], at[about]


def _rise(at: NDArray[np.complex128], values: FloatArray, peak: float, noise: float) -> float:
    """Return how far the summit of a Gaussian through ``values`` (n,) [m] exceeds their ``peak``.

    The summit is half way to the next track at most. Where the neighbouring tracks miss it, it is
    there, and as wide as that allows. A cone is higher: form may rise from each place as steeply as
    the peak falls to a neighbouring track (E. McShane, Bull. Am. Math. Soc. 40, 837).

    at: places about the peak in distances of the tracks (n,);  noise: of the peak [m]
    """
    away = np.abs(at)
    around, ring = away > _AWAY[0], (away > _NEXT[0]) & (away < _NEXT[1])
    # At the rim there is none on the other side.
    if not (np.any(around) and np.any(ring)) or abs(np.mean(at[ring])) > _ONE_SIDED:
        return 0.0
    height = peak - float(np.median(values[around]))
    floor = max(2 * noise, _UNSEEN * height)
    if height <= floor:
        return 0.0
    steepest = max(float(np.max((peak - values[ring]) / away[ring])), 0.0)
    cone = float(np.max(np.min(values + steepest * np.abs(_ABOUT - at), axis=1))) - peak
    if np.median(values[ring]) <= peak - height + floor:
        return max(float(height * ((height / floor) ** _HALF_WAY**2 - 1)), cone)
    near = (away > 0) & (away < _NEXT[1])
    fall = np.log(height / np.clip(height - peak + values[near], floor, height))
    u, v = at[near].real, at[near].imag
    columns = np.stack([u, v, u * u, u * v, v * v], axis=1)
    *slope, a, b, c = np.linalg.lstsq(columns, fall, rcond=_LEAST_SPREAD)[0]
    curved, ways = np.linalg.eigh([[a, b / 2], [b / 2, c]])
    slope, curved = np.abs(ways.T @ slope), np.maximum(curved, np.finfo(np.float64).tiny)
    way = np.minimum(slope / (2 * curved), _HALF_WAY)
    gaussian = float(height * min(np.expm1(slope @ way - curved @ way**2), MOST_UNSEEN - 1))
    return max(gaussian, cone)


def _local_features(
    map_: DeviationMap, smooth: FloatArray, shift: float
) -> tuple[IntArray, FloatArray, IntArray, FloatArray]:
    """Return where (m,) grooves, pips, scratches and edges change the ``smooth`` form (n,) [m].

    Also the form there [m], the number of the cell whose mean it is, and the noise of that mean
    [m], each (m,).  shift: of the grid of cells in the largest of them

    Cells of five sizes whose mean exceeds what noise makes anywhere on the map show them, as do
    single points (D. Donoho, I. Johnstone, Biometrika 81, 425). Each of the largest cells with one
    has the means of the sizes with the least expected error (Stein); all cells have, if the means
    of one size are closer than none all over the map, as for ripple.
    """
    rest, (column, row), ripple = map_.deviation - smooth, _finest_cells(map_, shift), False
    shape = [((int(v.max()) >> _HALVINGS + 1) + 1) << _HALVINGS + 1 for v in (column, row)]
    place, size = column * shape[1] + row, shape[0] * shape[1]
    counts, sums = (np.bincount(place, w, size).reshape(shape) for w in (None, rest))
    differs = np.abs(rest) > _beyond_chance(len(map_)) * map_.noise
    for k in range(_HALVINGS + 1):
        count, ratio = int(np.count_nonzero(counts)), sums / np.sqrt(np.maximum(counts, 1))
        if np.any(high := np.abs(ratio) > _beyond_chance(count) * map_.noise):
            differs |= high[column >> k, row >> k]
        # Σ (mean / error)² of noise alone is χ² with as many degrees of freedom as cells.
        square = float(np.sum(ratio**2)) / max(map_.noise**2, _TINY)
        ripple |= square - 2 * count > _CHANCE * np.sqrt(2 * count)
        halves = (v[::2] + v[1::2] for v in (counts, sums))
        counts, sums = (v[:, ::2] + v[:, 1::2] for v in halves)  # four cells make one
    largest = _numbers(column, row, _HALVINGS)
    # Without noise there is nothing to average.
    chosen = ((np.bincount(largest, differs) > 0) | ripple) & (map_.noise > 0)
    some = np.flatnonzero(chosen[largest])
    if not len(some):
        return some, np.empty(0), some, np.empty(0)
    levels = (_numbers(column[some], row[some], k) for k in range(_HALVINGS, -1, -1))
    cells = [*map(_renumbered, levels), np.arange(len(some))]
    best = _least_risk(cells, rest[some], map_.noise)
    firsts = np.cumsum([0, *(int(cell.max()) + 1 for cell in cells[:-1])])
    own = np.stack(cells)[best, np.arange(len(some))] + firsts[best]
    mean, error = _cell_means(own, rest[some], map_.noise)
    return some, smooth[some] + mean[own], own, error[own]


def _finest_cells(map_: DeviationMap, shift: float = 0.0) -> tuple[IntArray, IntArray]:
    """Return column and row of the smallest cells, each (n,);  shift: in the largest cells."""
    # These are eight mean distances of the points wide.
    spans = np.array([np.ptp(map_.x), np.ptp(map_.y)])
    side = 8 * float(np.sqrt(np.prod(np.maximum(spans, 1e-3 * spans.max())) / len(map_)))
    x, y = (((v - v.min()) / side + shift) * 2**_HALVINGS for v in (map_.x, map_.y))
    return x.astype(np.int64), y.astype(np.int64)


def _numbers(column: IntArray, row: IntArray, halvings: int) -> IntArray:
    """Return the numbers (n,) of the cells that hold 2^``halvings`` rows and columns."""
    return (column >> halvings) * ((int(row.max()) >> halvings) + 1) + (row >> halvings)


def _renumbered(cell: IntArray) -> IntArray:
    """Return the numbers of the cells (n,) without those that have no point."""
    return np.asarray((np.cumsum(np.bincount(cell) > 0) - 1)[cell])


def _texture(map_: DeviationMap, rest: FloatArray) -> FloatArray:
    """Return the height of waves (n,) [m] that make the ``rest`` (n,) [m] exceed the noise.

    Fine waves, as of a fingerprint, scatter the points of a cell without a change of its mean. That
    may also be noise, which is larger there.
    """
    cell = _numbers(*_finest_cells(map_), _HALVINGS)
    counts = np.bincount(cell)
    square, _ = _cell_means(cell, rest**2, 0.0)
    # R. A. Fisher's √(2 χ²) is nearly normal.
    usual = np.sqrt(np.maximum(2 * counts - 1, 0)) + _beyond_chance(int(np.sum(counts > 0)))
    shown = 2 * counts * square > (map_.noise * usual) ** 2
    return np.asarray(np.sqrt(2 * np.where(shown, square - map_.noise**2, 0.0))[cell])


def _least_risk(cells: Sequence[IntArray], values: FloatArray, noise: float) -> IntArray:
    """Return the level (n,) whose cell means have the least expected error.

    Cells of the level that is best for all are divided where that is certainly better, and so on
    (dyadic CART: D. Donoho, Ann. Stat. 25, 1870), or united likewise.

    cells: number of the cell of each point at each level, each (n,), from the largest to one point
    """
    risks = []
    for cell in cells:
        mean, _ = _cell_means(cell, values, 0.0)
        # Each cell follows the noise of one point.
        risks.append((values - mean[cell]) ** 2 + 2 * noise**2 / np.bincount(cell)[cell])
    usual = int(np.argmin(np.sum(risks, axis=1)))
    best, risk = np.full(len(values), len(cells) - 1), risks[-1]
    for level in reversed(range(len(cells) - 1)):
        cell = cells[level]
        more = np.bincount(cell, risks[level] - risk)
        # A choice of its own follows the noise of a cell, so the gain must exceed that of chance.
        chance = _beyond_chance(len(more)) * noise**2 * np.sqrt(2 * np.bincount(cell))
        whole = (more < (chance if level >= usual else -chance))[cell]
        best, risk = np.where(whole, level, best), np.where(whole, risks[level], risk)
    return best


def _cell_means(cell: IntArray, values: FloatArray, noise: float) -> tuple[FloatArray, FloatArray]:
    """Return the mean of ``values`` (n,) in each cell (k,), and its standard error; zero: empty."""
    counts = np.bincount(cell)
    held = np.maximum(np.arange(int(counts.max()) + 1), 1)
    errors = np.append(0.0, noise / np.sqrt(held[1:]))
    return np.asarray(np.bincount(cell, values) / held[counts]), errors[counts]


def _beyond_chance(count: int) -> float:
    """Return the multiple of σ that none of ``count`` normal values is likely to exceed."""
    return float(np.sqrt(2 * np.log(max(count, 2)))) + 1.0


def _smooth(map_: DeviationMap, disc: Aperture) -> ZernikeFit:
    """Return smooth terms of the deviations, of as high an order as the points show."""
    orders = [n for n in _ORDERS if _PER_TERM * sum(t.n <= n for t in _TERMS) <= len(map_)] or [0]
    every = [term for term in _TERMS if term.n <= orders[0]]
    columns = zernike_values(*disc.scaled(map_.x, map_.y), every) * (root := np.sqrt(map_.area))
    gram, right = columns @ columns.T, columns @ (map_.deviation * root)
    squares = (weighted := columns * root) @ weighted.T
    unresolved = (2 + _CHANCE * np.sqrt(2 / len(map_))) * map_.noise**2  # noise and as much form
    finer = float(map_.area @ (map_.deviation**2 - unresolved))
    next_: list[ZernikeIndex] = []
    for order, lower in zip(orders, [*orders[1:], -1], strict=True):
        terms = [term for term in every if term.n <= order]
        kept = separable(gram[: len(terms), : len(terms)], terms, _CONDITION)
        # Orders that only follow the noise would blur the rim, where the noise of all adds up.
        inverse = np.linalg.inv(gram[np.ix_(kept, kept)])
        new, fitted = [terms[k].n > lower for k in kept], inverse @ right[kept]
        solve, found, free = inverse[new], fitted[new], sum(new)
        covariance = map_.noise**2 * solve @ squares[np.ix_(kept, kept)] @ solve.T
        # Wald's test, because where the points leave parts of the disc out the terms are alike.
        chi_square = float(found @ np.linalg.solve(covariance + _TINY * np.eye(free), found))
        # Finer form that they leave makes them swing at the rim, so they must follow most of it.
        most = found @ np.linalg.solve(solve[:, new], found) > finer - right[kept] @ fitted
        if most and chi_square > free + _CHANCE * np.sqrt(2 * free):
            break
        next_ = terms if most else []
    # An undetected form of the next orders is largest at the rim; their covariance bounds it.
    terms = next_ or terms
    points, known = (map_.x, map_.y, map_.deviation), slice(len(terms))
    sums = gram[known, known], right[known, np.newaxis]
    return fit_zernikes(*points, terms, disc, weights=map_.area, condition=_CONDITION, sums=sums)


def _drawn(
    map_: DeviationMap, part: _PartForm, form: FloatArray, points: IntArray
) -> tuple[FloatArray, ...]:
    """Return the ``form`` (m,) with five kinds of errors drawn anew, each (m, draws).

    All errors that are present; these and the upper bounds; the form that the fit has probably
    taken; the form that it may have taken at most; the remaining noise alone.

    points: of the ``part`` that the map has (m,)
    """
    random = np.random.default_rng(_SEED)
    terms = zernike_values(*part.smooth.disc.scaled(map_.x, map_.y), part.smooth.terms)
    effects, still = map_.effects, form[:, np.newaxis]
    taken = effects[: len(map_.taken)]

    def anew(ways: FloatArray) -> FloatArray:
        return np.asarray(ways.T @ random.normal(size=(len(ways), _DRAWS)), np.float64)

    # Points with the mean of one cell share its noise.
    cell = _renumbered(part.cell[points])
    noise = random.normal(size=(int(cell.max()) + 1, _DRAWS))[cell]
    noisy = still + noise * part.error[points, np.newaxis]
    errors = [effects[real_effects(map_)], root_of(part.smooth.covariance) @ terms]
    drawn = noisy + anew(np.concatenate(errors))
    bounded = drawn + anew(effects[map_.bounds])
    likely, full = anew(root_of(map_.taken) @ taken), anew(taken)
    return drawn, bounded, still + likely, still + full, noisy
