"""Estimate the rms of a part, free of the bias by noise and systematic errors; remove smooth form.

Form that the fit of the pose may have taken for a move is missing from the deviations. It is
independent of the form that is left, so its probable mean square is added; its uncertainty belongs
to the figure. Upper bounds of errors, as of an unknown latency, are not subtracted; the change of
the square by an error of that size belongs to the uncertainty.

A scan sees the part on its tracks only. Between them a peak may be higher than its points, and
from the last track to the rim the form goes on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import comb
from typing import NamedTuple

import numpy as np
import scipy  # whose parts are loaded when they are used
from numpy.typing import NDArray

from omsm_ros.core.form.deviation_map import DeviationMap, GridCells, UncertainValue
from omsm_ros.core.form.zernike_fit import (
    CHUNK,
    DIFFERENCES,
    RimStrip,
    ZernikeFit,
    continued,
    normal_equations,
    passes,
)
from omsm_ros.core.streams.blocks import BoolArray, FloatArray, IntArray
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.core.surface.area_weights import errors_at_gaps
from omsm_ros.core.surface.zernike_terms import ZernikeIndex, terms_up_to, zernike_values

# The best Σ c_ij x^i y^j, i + j ≤ 2; what is no irregularity (ISO 10110-5), and its rest without
# symmetry; form to be removed by ISO 25178-2: a Gaussian filter would leave it at the rim, where
# its window is cut off.
SECOND_ORDER = terms_up_to(2)
POWER = (ZernikeIndex(0, 0), ZernikeIndex(1, -1), ZernikeIndex(1, 1), ZernikeIndex(2, 0))
TILT = POWER[:3]
SYMMETRIC = POWER + tuple(ZernikeIndex(n, 0) for n in range(4, 14, 2))
FORM = terms_up_to(4)


def rms_of_part(map_: DeviationMap, beyond: tuple[float, float] = (0.0, 0.0)) -> UncertainValue:
    """Return the area-weighted rms of the part about zero, in closed form.

    beyond: mean square that form between the last track and the rim adds, and its standard
        uncertainty [m²]
    """
    if not map_.noise_known:
        return either(*(rms_of_part(one, beyond) for one in with_and_without(map_)))
    share = map_.area / map_.area.sum()
    weighted = map_.effects * share
    products = weighted @ map_.effects.T
    shared = weighted @ map_.deviation
    noise = map_.noise**2
    real, taken = real_effects(map_), slice(len(map_.taken))
    among_real, own = products[np.ix_(real, real)], np.diag(products)
    missing = float(np.sum(map_.taken * products[taken, taken]))
    square = float(share @ map_.deviation**2 - np.trace(among_real) - noise) + missing + beyond[0]
    of_form = 4 * max(float(np.sum(shared[real] ** 2)) - float(np.sum(among_real**2)), 0.0)
    of_form += 4 * float(np.sum(shared[taken] ** 2)) + (float(np.sum(own[taken])) - missing) ** 2
    # For e = Σ a_i f_i, the mean square of 2 d·e − e·e is 4 Σ (d·f_i)² + tr² P + 2 tr P², with P
    # the products of the f_i.
    bounded = float(np.sum(own[map_.bounds]))
    of_bounds = 4 * float(np.sum(shared[map_.bounds] ** 2)) + bounded**2
    of_errors = of_form + of_bounds + 2 * float(np.sum(products**2))
    variance = of_errors + beyond[1] ** 2
    # For each point 4 d²σ² from its form, 2 σ⁴ from its noise, and 2 σ⁴ from the scatter of σ; for
    # all what form may add to σ.
    by_noise = float(np.sum(share**2 * (4 * map_.deviation**2 * noise + 4 * noise**2)))
    by_noise += 4 * noise * map_.noise_error**2
    variance += max(by_noise, _variance_by_tracks(map_, share))
    return of_square(square, float(np.sqrt(variance)))


def with_and_without(map_: DeviationMap) -> tuple[DeviationMap, DeviationMap]:
    """Return the map as if all that may be noise were texture, and as if it were noise."""
    return replace(map_, noise=0.0, noise_known=True), replace(map_, noise_known=True)


def either(measured: UncertainValue, quiet: UncertainValue) -> UncertainValue:
    """Return the figure as measured; what may be noise counts in its uncertainty."""
    spread = max(measured.uncertainty or 0.0, quiet.uncertainty or 0.0)
    return UncertainValue(
        measured.value, length(spread, (measured.value or 0.0) - (quiet.value or 0.0))
    )


def real_effects(map_: DeviationMap) -> BoolArray:
    """Return which effects (e,) are of errors that are certainly present."""
    real = np.ones(len(map_.effects), np.bool_)
    real[map_.bounds] = False
    real[: len(map_.taken)] = False
    return real


def length(*shares: float) -> float:
    """Return the root of the sum of the squares of independent ``shares``."""
    return float(np.sqrt(sum(share**2 for share in shares)))


def _variance_by_tracks(map_: DeviationMap, share: FloatArray) -> float:
    """Return the variance of the mean square [m⁴] from form between the tracks.

    The mean squares of successive passes of the path vary smoothly where the tracks resolve the
    form; their fourth differences show what they do not (systematic samples: K. Wolter,
    Introduction to Variance Estimation, 2007, ch. 8). Area that one pass has too much the next one
    lacks, so that it counts with the difference of both.
    """
    begins = passes(map_.x, map_.y)
    if begins is None:
        return 0.0
    means = np.add.reduceat(map_.deviation**2, begins) / np.diff(begins, append=len(map_))
    weight = np.add.reduceat(share, begins)
    of_areas = np.gradient(means) ** 2 * _rough_squares(weight) / 2
    return float(np.sum(weight**2 * _rough_squares(means) + of_areas))


def _rough_squares(values: FloatArray) -> FloatArray:
    """Return the squares of what is not smooth in ``values`` (n,), from their differences."""
    rough = np.diff(values, DIFFERENCES) ** 2 / comb(2 * DIFFERENCES, DIFFERENCES)
    before = DIFFERENCES // 2
    return np.asarray(np.pad(rough, (before, len(values) - len(rough) - before), "edge"))


def of_square(square: float, spread: float) -> UncertainValue:
    """Return the root of a ``square`` [m²] with its standard uncertainty ``spread`` [m²].

    The uncertainty is half the larger side of the interval of the root for k = 2 of the square. A
    square may be negative by chance; the interval then ends at the root of ``spread``.
    """
    value = float(np.sqrt(max(square, 0.0)))
    high = float(np.sqrt(max(square + 2 * spread, spread)))
    low = float(np.sqrt(max(square - 2 * spread, 0.0)))
    return UncertainValue(value, max(high - value, value - low) / 2)


def fitted(gram: FloatArray, right: FloatArray) -> FloatArray:
    """Solve normal equations; for points on a line, where columns coincide, by minimum norm."""
    return np.asarray(np.linalg.pinv(gram, rcond=1e-12, hermitian=True) @ right)


def best_fit(map_: DeviationMap) -> DeviationMap:
    """Return the map after best-fit alignment in all fitted and held pose parameters.

    It contains neither the uncertainty of the pose nor form that looks like a move.
    """
    moves = map_.effects[map_.moves]
    size = np.sqrt(np.mean(moves**2, axis=1))
    columns = moves[size > 0] / size[size > 0, np.newaxis]
    weighted = columns * map_.area
    right = np.column_stack([weighted @ map_.deviation, weighted @ map_.effects.T])
    shares = fitted(weighted @ columns.T, right)
    deviation = map_.deviation - shares[:, 0] @ columns
    return replace(map_, deviation=deviation, effects=map_.effects - shares[:, 1:].T @ columns)


class SmoothTerms(NamedTuple):
    """Zernike ``terms`` of a map on a ``disc``, and sums from which each choice of them is fitted.

    gram: area-weighted products of the terms (k, k);  right: with deviation and effects (k, 1 + e)
    """

    map: DeviationMap
    disc: Aperture
    terms: tuple[ZernikeIndex, ...]
    gram: FloatArray
    right: FloatArray

    @classmethod
    def of(cls, map_: DeviationMap, disc: Aperture, terms: Sequence[ZernikeIndex]) -> SmoothTerms:
        """Return the ``terms`` of a map."""
        values = np.vstack([map_.deviation, map_.effects])
        sums = normal_equations(map_.x, map_.y, values, terms, disc, map_.area)
        return cls(map_, disc, tuple(terms), *sums)

    def sums(self, terms: Sequence[ZernikeIndex]) -> tuple[FloatArray, FloatArray]:
        """Return the sums of some of the ``terms``: (t, t) and (t, 1 + e)."""
        chosen = [self.terms.index(term) for term in terms]
        return self.gram[np.ix_(chosen, chosen)], self.right[chosen]

    def without(self, terms: Sequence[ZernikeIndex]) -> DeviationMap:
        """Return the map without the fit of some of the ``terms``."""
        shares, map_ = fitted(*self.sums(terms)), self.map
        deviation, effects = np.empty_like(map_.deviation), np.empty_like(map_.effects)
        for begin in range(0, len(map_), CHUNK):
            part = slice(begin, begin + CHUNK)
            columns = zernike_values(*self.disc.scaled(map_.x[part], map_.y[part]), terms)
            deviation[part] = map_.deviation[part] - shares[:, 0] @ columns
            effects[:, part] = map_.effects[:, part] - shares[:, 1:].T @ columns
        return replace(map_, deviation=deviation, effects=effects)


def short_waves(map_: DeviationMap, cells: GridCells, longest: float) -> DeviationMap:
    """Return the points less the waves of their ``cells`` longer than ``longest`` [m]."""
    images = cells.low_pass(longest)(np.concatenate([cells.mean[np.newaxis], cells.effects]))
    at = [(map_.y - cells.y[0]) / cells.steps[1], (map_.x - cells.x[0]) / cells.steps[0]]
    between = scipy.ndimage.map_coordinates
    low = np.array([between(image, at, order=1, mode="nearest") for image in images])
    return replace(map_, deviation=map_.deviation - low[0], effects=map_.effects - low[1:])


# Noise adds to an extent with the first power of its size where many points compete for it, with
# the second where one has it. The middle is used, the others are limits of a uniform error.
_POWERS = (1.0, 1.5, 2.0)


def without_noise(once: float, again: FloatArray) -> tuple[float, float]:
    """Return an extent [m] without noise, from extents ``again`` (draws,) with twice the variance.

    It may be negative by chance. Second is the standard uncertainty of the extrapolation [m].
    """
    left = [once**p - (np.mean(again**p) - once**p) / (2 ** (p / 2) - 1) for p in _POWERS]
    found = [float(np.sign(v) * abs(v) ** (1 / p)) for v, p in zip(left, _POWERS, strict=True)]
    return found[1], float(np.ptp(found)) / np.sqrt(12)


# Points that continue the form to a place of the rim; how far they may be off, in distances of the
# tracks; least number of places; width of the strip that has these points, in both.
_AROUND, _REACH, _PLACES, _STRIP = 24, 1.5, 360, 12.0
# Longest steps along a path over the distance of its tracks, as of points in no order, and that
# distance over the shortest.
_MOST_ALONG, _DENSEST = 4.0, 1000.0
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


class Gaps(NamedTuple):
    """Places that the tracks miss.

    x, y: of the points (n,) [m]
    spacing: of the tracks about each point, or of points along them that are wider apart (n,) [m]
    rim: places on the outline (2, q) [m];  near: points about them (q, k), the nearest first
    weights: of their sums that continue the form to these places, and of those by which sums of
        fewer points differ (2, q, k)
    strip: along the rim, for the mean square of the form; None for an annulus
    share: of the area that half a track along the rim has
    areas: share of the area that each point has (n,)
    at_gaps: errors of means over the area, None without wide gaps
    of_rim: error of the area at each place of a guessed rim, as a share of all (4, q)
    outwards: weights of the change of the form half a track beyond a guessed rim (q, k)
    """

    x: FloatArray
    y: FloatArray
    spacing: FloatArray
    rim: FloatArray
    near: IntArray
    weights: FloatArray
    strip: RimStrip | None
    share: float
    areas: FloatArray
    at_gaps: Callable[[FloatArray], FloatArray] | None
    of_rim: FloatArray
    outwards: FloatArray

    @classmethod
    def of(
        cls, map_: DeviationMap, outline: Aperture, spacing: float, strip: RimStrip | None = None,
        *, guessed: bool = False, uncovered: float = 0.0,
    ) -> Gaps | None:  # fmt: skip
        """Return the gaps between the points and to the ``outline``; None for a profile.

        strip: along the rim, for sums of piston and other terms, weighted by area
        guessed: the outline is around the points;  uncovered: share of it in wide gaps
        """
        extent = min(np.ptp(map_.x), np.ptp(map_.y))
        if len(map_) < _AROUND or extent < _REACH * spacing:
            return None
        steps, most = np.hypot(np.diff(map_.x), np.diff(map_.y)), _MOST_ALONG * spacing
        along = np.minimum(np.append(steps[:1], steps), np.append(steps, steps[-1:]))
        # Points in no order have steps across the part.
        local = np.clip(along if (usual := np.median(steps)) < most else 0 * along, spacing, most)
        size, depth = outline.share_of_rim(map_.x, map_.y), _STRIP * spacing / extent
        hole = outline.sizes[0] / outline.radius if outline.outline == "annulus" else -depth
        # More points along a track than across would hide what is across it.
        some = np.flatnonzero((size > 1 - depth) | (size < hole + depth))
        some = some[:: max(int(spacing / 2 / max(usual, spacing / _DENSEST)), 1)]
        some = some if len(some) >= _AROUND else np.arange(len(map_))
        corners = outline.rim()
        (u, v), way = corners, np.cumsum(np.hypot(*np.diff(corners, prepend=corners[:, :1])))
        # Equal parts of each side, because smooth form is often highest in a corner.
        parts = np.ceil(np.diff(way) / way[-1] * max(_PLACES, way[-1] / spacing) - 1e-6)
        at = np.interp(np.arange(parts.sum()), np.append(0, np.cumsum(parts)), way)
        rim = np.stack([np.interp(at, way, u), np.interp(at, way, v)])
        tree = scipy.spatial.cKDTree(np.stack([map_.x, map_.y], axis=1)[some])
        away, near = tree.query(rim.T, _AROUND)
        near, place = some[near], rim[0] + 1j * rim[1]
        du, dv = (np.roll(rim, -1, axis=1) - np.roll(rim, 1, axis=1)) / 2
        apart = map_.x[near].T + 1j * map_.y[near].T - place
        # Within a sector that was not measured all points lie on one side.
        sides = (apart * (du - 1j * dv)).real
        close = (away[:, 0] < _REACH * local[near[:, 0]]) & (np.ptp(np.sign(sides), axis=0) > 1)
        near, rim, apart = near[close], rim[:, close], apart[:, close]
        parabola, _ = continued(apart.T / spacing)
        weights = np.stack([parabola, parabola])
        weights[1, :, : _AROUND // 2] -= continued(apart.T[:, : _AROUND // 2] / spacing)[0]
        if strip is not None:
            strip = RimStrip(strip.points, *(v[:1] / map_.area.sum() for v in strip[1:]))
        at_gaps = errors_at_gaps(map_.x, map_.y, outline, spacing) if uncovered else None
        half = spacing / abs(float(np.sum(u[:-1] * v[1:] - u[1:] * v[:-1])))
        # A guessed rim is off by up to half a track. It may lie elsewhere, or be larger.
        of_rim = np.stack([du, dv, np.abs(du), np.abs(dv)])[:, close] * half / np.sqrt(3) * guessed
        ahead = guessed / 2 * ((dv - 1j * du) / np.hypot(du, dv))[close, np.newaxis]
        outwards = continued(apart.T / spacing - ahead)[0] - parabola
        return cls(
            map_.x, map_.y, local, rim, near, weights, strip, share=float(way[-1]) * half,
            areas=map_.area / map_.area.sum(), at_gaps=at_gaps, of_rim=of_rim, outwards=outwards,
        )  # fmt: skip

    def square(self, values: FloatArray) -> tuple[float, float]:
        """Return what form beyond the last track adds to the mean square of ``values`` (n,) [m].

        Second is the standard uncertainty of that [m²].
        """
        rim, mean = np.sum(self.weights[0] * values[self.near], axis=1), self.areas @ values**2
        open_ = [*(self.of_rim @ (rim**2 - mean))]
        if self.at_gaps is not None:
            open_ += [*self.at_gaps(values**2 - mean)]
        if self.strip is not None:
            more, errors = self.strip.missed(values[self.strip.points] ** 2)
            return float(more[0]), length(*open_, float(np.linalg.norm(errors)))
        rise = float(np.mean(rim**2 - values[self.near[:, 0]] ** 2)) if len(rim) else 0.0
        return 0.0, length(*open_, self.share * rise / 2)

    def at_rim(self, form: FloatArray, rest: FloatArray, smooth: ZernikeFit, local: IntArray,
               noise: FloatArray) -> FloatArray:  # fmt: skip
        """Return the form at the rim and its standard uncertainty (2, q) [m], without noise.

        A parabola continues the form; how far one through half of its points differs is the
        uncertainty. Where smooth terms are the form, the mean of both counts, and half their gap.

        form, rest: of the points, and less its ``smooth`` terms (n,) [m];  noise: of both (n,) [m]
        local: points of other form, about which smooth terms are not valid
        """
        found, plain = np.sum(self.weights * form[self.near], axis=2), np.ones(len(form), np.bool_)
        of_noise = np.sum((self.weights[1] * noise[self.near]) ** 2, axis=1)
        found[1], plain[local] = np.sqrt(np.maximum(found[1] ** 2 - of_noise, 0.0)), False
        other = np.sum(self.weights[0] * rest[self.near], axis=1) + smooth.height(*self.rim)
        half = (other - found[0]) / 2
        return np.where(np.all(plain[self.near], axis=1), [found[0] + half, half], found)

    def beyond(
        self, form: FloatArray, above: FloatArray, rim: FloatArray, unseen: FloatArray,
        noise: FloatArray,
    ) -> tuple[FloatArray, FloatArray]:  # fmt: skip
        """Return how far the form may reach beyond its extremes, and fall short of them (2,) [m].

        form, above: of the points, and less its smooth terms (n,) [m];  rim: the form there (q,)
        unseen: how far the form may reach below and above its points (2, n) [m]
        noise: of the form (n,) [m]
        """
        found, alone = [], []
        for sign, more in zip((-1, 1), unseen, strict=True):
            values, rest = sign * form, sign * above
            summit = self._summit(values + more, rest + more, noise)
            found.append(max(summit - float(np.max(sign * rim, initial=values.max())), 0.0))
            alone.append(self._alone(values, rest))
        return np.array(found), np.array(alone)

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
        spacing, middle = self.spacing[peak], self.x[peak]
        reach = _AWAY[1] * spacing
        near = np.flatnonzero((self.x > middle - reach) & (self.x < middle + reach))
        at = ((self.x[near] - middle) + 1j * (self.y[near] - self.y[peak])) / spacing
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
