"""Estimate peak to valley of a part, free of the bias by noise and systematic errors.

Errors increase a peak to valley on average. Drawing errors of the same size once more shows by how
much. If a power p of the figure grows with the same power of the size of the errors, then with F of
the deviations and F' with errors drawn anew

    F^p of the part = F^p − (mean F'^p − F^p) / (2^(p/2) − 1)

with p = 2 for errors of smooth shape, and less for noise, for which points compete
(simulation and extrapolation; J. Cook, L. Stefanski, J. Am. Stat. Assoc. 89, 1314). Before, smooth
terms, means of neighbours and a Wiener filter remove most of the noise; the rest counts as an
error. Form taken for a move and upper bounds count as in :mod:`omsm_ros.core.form.part_figures`.

What the form may reach between the tracks is extrapolated; half of it is added, and as much is the
standard uncertainty. So is half of what single points show alone, which may be dust, subtracted.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from omsm_ros.core.form.deviation_map import DeviationMap, UncertainValue
from omsm_ros.core.form.part_figures import (
    Gaps,
    either,
    length,
    of_square,
    real_effects,
    with_and_without,
    without_noise,
)
from omsm_ros.core.form.zernike_fit import ZernikeFit, fit_zernikes, separable
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
# Halvings of the cells that show local features; points at either extreme, and places of the rim.
_HALVINGS, _HALF, _OF_RIM = 4, 500, 48
# The grid of cells may divide a feature. On one of three grids a third of a cell apart, any lies
# within a cell of a few times its size.
_SHIFTS = (0.0, 1 / 3, 2 / 3)
# Standard deviations of χ² that chance does not exceed.
_CHANCE = 3.0
# Least variance, so that a part without noise keeps all terms [m²].
_TINY = 1e-40


def extents_of_parts(
    maps: Sequence[DeviationMap], disc: Aperture, gaps: Gaps | None = None,
    past: tuple[float, float] = (0.0, 0.0),
) -> list[tuple[UncertainValue, UncertainValue]]:  # fmt: skip
    """Return the peak to valley of maps that differ by smooth form.

    Second is the extent of 99.5 % of the area, of the first map only.

    disc: of the smooth terms;  gaps: between the points of the maps, None without any
    past: how far points that no map holds reach below and above all others [m]
    """
    if not maps[0].noise_known:
        ways = zip(*map(with_and_without, maps), strict=True)
        one, other = (extents_of_parts(way, disc, gaps, past) for way in ways)
        return [(either(a[0], b[0]), either(a[1], b[1])) for a, b in zip(one, other, strict=True)]
    form = _PartForm.of(maps[0], disc)
    shifts = (map_.deviation - maps[0].deviation for map_ in maps)
    return [form.extents(m, s, gaps, m is maps[0], past) for m, s in zip(maps, shifts, strict=True)]


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
        self, map_: DeviationMap, shift: FloatArray, gaps: Gaps | None, robust: bool,
        past: tuple[float, float],
    ) -> tuple[UncertainValue, UncertainValue]:  # fmt: skip
        """Return the extents of the ``map_`` whose form differs by a smooth ``shift`` (n,) [m]."""
        form = self.value + shift
        even = map_.equal_areas(_MOST_DRAWN)
        order = self.local[np.argsort(form[self.local])]
        some = np.concatenate([even, order[:_HALF], order[-_HALF:]])
        (rim, outer), (beyond, alone) = (np.empty((2, 0)), np.empty(0)), np.zeros((2, 2))
        if gaps is not None:
            rest = self.above + shift
            rim = gaps.at_rim(form, rest, self.smooth, self.local, self.error)
            outer = rim[0] + np.sum(gaps.outwards * form[gaps.near], axis=1)
            beyond, alone = gaps.beyond(form, self.above, rim[0], self.unseen, self.error)
        rows = self._drawn_to_rim(map_, form, some, gaps, rim)
        tops = [[np.max(w * v, initial=-np.inf) for v in (form, rim[0], outer)] for w in (-1, 1)]
        of_rim = np.ravel(np.diff(np.maximum.accumulate(tops, axis=1)) * (0.5, 1.0))
        of_waves = [np.max(way * form + self.texture) - np.max(way * form) for way in (-1, 1)]
        found = []
        many, form = form[map_.equal_areas(_MOST_FITTED)], np.append(form, rim[0])
        shares = ((0.0, 1.0), form, len(rows[0])), (ROBUST, many, len(even))
        for ends, all_, count in shares[: 1 + robust]:
            of_some, *ways = (_extents(way[:count], ends) for way in rows)
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
            between = np.maximum(np.maximum(beyond, of_waves), past)
            between = np.append(between, -alone) / 2 * (all_ is form)
            value = (figure.value or 0.0) + _extents(all_, ends) - of_some + float(np.sum(between))
            of_gaps = length(*between, *of_rim * (all_ is form))
            found.append(UncertainValue(float(value), length(figure.uncertainty or 0.0, of_gaps)))
        return found[0], found[1] if robust else UncertainValue(None, None)

    def _drawn_to_rim(self, map_: DeviationMap, form: FloatArray, some: IntArray, gaps: Gaps | None,
                      rim: FloatArray) -> list[FloatArray]:  # fmt: skip
        """Return the ``form`` of ``some`` points and the ends of the ``rim`` (m,), and as drawn."""
        if gaps is None:
            return [form[some], *_drawn(map_.part(some), self, form[some], some)]
        order = np.argsort(rim[0])
        ends = np.unique(np.append(order[:_OF_RIM], order[-_OF_RIM:]))
        points, count, (at_rim, open_) = np.append(some, gaps.near[ends]), len(some), rim[:, ends]
        drawn = _drawn(map_.part(points), self, form[points], points)
        open_ = np.outer(open_, np.random.default_rng(_SEED + 1).normal(size=_DRAWS))
        rows = [np.append(form[some], at_rim)]
        for way, share in zip(drawn, (open_, open_, 0.0, 0.0, 0.0), strict=True):
            # Errors continue to the rim as the form does.
            errors = (way.T - form[points])[:, count:].reshape(_DRAWS, len(ends), -1)
            moved = np.einsum("qk,dqk->qd", gaps.weights[0, ends], errors)
            rows.append(np.concatenate([way[:count], (at_rim + moved.T).T + share]))
        return rows


def _extents(values: FloatArray, ends: tuple[float, float]) -> FloatArray:
    """Return the distances between the quantiles ``ends`` along the first axis."""
    if ends != (0.0, 1.0):
        values = np.quantile(values, ends, axis=0, method="hazen")
    return np.asarray(np.ptp(values, axis=0))


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
