"""Estimate peak to valley and rms of a part, free of the bias by noise and systematic errors.

Errors increase a peak to valley or an rms on average. Drawing errors of the same size once more
shows by how much, because squares of such figures add: exactly for an rms, and for an extent where
either errors or form dominate. With F of the deviations and F' with errors drawn anew

    F² of the part = 2 F² − mean F'²

(simulation and extrapolation; J. Cook, L. Stefanski, J. Am. Stat. Assoc. 89, 1314). Before, smooth
terms, means of neighbours and a Wiener filter remove most of the noise; the rest counts as an
error.

Form that the fit of the pose may have taken for a move is missing from the deviations. It is
independent of the form that is left, so its probable mean square is added; its uncertainty belongs
to the figure. Upper bounds of errors, as of an unknown latency, are not subtracted; the change of
the square by an error of that size belongs to the uncertainty.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from omsm_ros.core.form.deviation_map import DeviationMap, UncertainValue, weighted_quantiles
from omsm_ros.core.form.zernike_fit import ZernikeFit, fit_zernikes
from omsm_ros.core.streams.blocks import BoolArray, FloatArray, IntArray
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.core.surface.zernike_terms import ZernikeIndex, terms_up_to, zernike_values

# 99.5 % of the area lies between these (ISO 10110-5:2015 calls for a share to be stated).
ROBUST = (0.0025, 0.9975)
# Orders of the smooth terms; the highest with forty points for each term is used.
_ORDERS, _POINTS_PER_TERM = (12, 8, 4, 2), 40
# Two hundred points for each of the 91 terms up to order 12; two thousand show the extent of a
# smooth form.
_MOST_FITTED, _MOST_DRAWN = 20_000, 2_000
# 200 draws give a standard deviation to 5 %.
_DRAWS, _SEED = 200, 7
# Cells that show local features, in mean distances of the points, and points at either extreme.
_CELLS, _HALF = (8.0, 4.0, 2.0, 1.0), 1_000
# Standard deviations of χ² that chance does not exceed.
_CHANCE = 3.0
# Least variance, so that a part without noise keeps all terms [m²].
_TINY = 1e-40
# Points at either extreme that show the form lost there.
_EXTREME = 100
# Draws of the noise, which give its mean effect to a sixth of its standard deviation.
_NOISES = 40
# Piston, both tilts and power; the terms that ISO 25178-2 removes as form; the rotationally
# symmetric terms up to order 12.
POWER = (ZernikeIndex(0, 0), ZernikeIndex(1, -1), ZernikeIndex(1, 1), ZernikeIndex(2, 0))
_FORM = terms_up_to(4)
SYMMETRIC = tuple(ZernikeIndex(n, 0) for n in range(4, 14, 2))


def rms_of_part(map_: DeviationMap) -> UncertainValue:
    """Return the area-weighted rms of the part about zero, in closed form."""
    if not map_.noise_known:
        return _either(*(rms_of_part(one) for one in _with_and_without(map_)))
    share = map_.area / map_.area.sum()
    weighted = map_.effects * share
    products = weighted @ map_.effects.T
    shared = weighted @ map_.deviation
    noise = map_.noise**2
    real, taken = _real(map_), slice(len(map_.taken))
    among_real, own = products[np.ix_(real, real)], np.diag(products)
    missing = float(np.sum(map_.taken * products[taken, taken]))
    square = float(share @ map_.deviation**2 - np.trace(among_real) - noise) + missing
    of_form = 4 * max(float(np.sum(shared[real] ** 2)) - float(np.sum(among_real**2)), 0.0)
    of_form += 4 * float(np.sum(shared[taken] ** 2)) + (float(np.sum(own[taken])) - missing) ** 2
    # For e = Σ a_i f_i, the mean square of 2 d·e − e·e is 4 Σ (d·f_i)² + tr² P + 2 tr P², with P
    # the products of the f_i.
    bounded = float(np.sum(own[map_.bounds]))
    of_bounds = 4 * float(np.sum(shared[map_.bounds] ** 2)) + bounded**2
    of_errors = of_form + of_bounds + 2 * float(np.sum(products**2))
    variance = of_errors + _variance_by_noise(map_, share)
    return of_square(square, float(np.sqrt(variance)))


def extents_of_part(map_: DeviationMap, disc: Aperture) -> tuple[UncertainValue, UncertainValue]:
    """Return the peak to valley of the part, and the extent of 99.5 % of its area.

    disc: of the smooth terms
    """
    if not map_.noise_known:
        one, other = (extents_of_part(m, disc) for m in _with_and_without(map_))
        return _either(one[0], other[0]), _either(one[1], other[1])
    few = map_.every(_MOST_FITTED)
    noises = few.noise * np.random.default_rng(_SEED + 1).normal(size=(_NOISES, len(few)))
    fit = _smooth(few, disc, noises)
    base, left, blurred = _without_noise(few, fit, noises)
    even = slice(None, None, -(-len(few) // _MOST_DRAWN))
    drawn, form, noisy = few.part(even), base[even], left[:, even]
    ends = np.array([base.min(), base.max()])
    count, area = len(drawn), drawn.area
    if (local := local_features(map_, fit)) is not None:
        ends = np.array([min(ends[0], local.form.min()), max(ends[1], local.form.max())])
        order = np.argsort(local.form)
        some = order if len(order) <= _MOST_DRAWN else np.r_[order[:_HALF], order[-_HALF:]]
        drawn = drawn.joined(map_.part(local.points[some]))
        form = np.concatenate([form, local.form[some]])
        noisy = np.concatenate([noisy, local.noise[:, some]], axis=1)
        blurred = max(blurred, local.blurred)
    ways = _drawn(drawn, fit, form, noisy)

    def robust(deviations: FloatArray) -> FloatArray:
        low_high = [weighted_quantiles(column[:count], area, ROBUST) for column in deviations.T]
        return np.array([high - low for low, high in low_high])

    def whole(deviations: FloatArray) -> FloatArray:
        return np.asarray(np.ptp(deviations, axis=0), np.float64)

    low, high = weighted_quantiles(base, few.area, ROBUST)
    found = []
    for extent, of_all in ((whole, float(np.ptp(ends))), (robust, high - low)):
        of_some = float(extent(form[:, np.newaxis])[0])
        again, more, likely, full, noise = (extent(way) ** 2 for way in ways)
        square = of_some**2 - float(np.mean(again)) + float(np.mean(likely))
        of_taken = _rms(full - np.mean(likely))
        # Where many points compete for an extreme, the mean of the draws follows the noise of the
        # figure in part, so that it counts once to twice: the factor is √2.
        of_errors = _length(float(np.std(again)), float(np.std(noise)))
        # An extent has two ends, each blurred independently.
        of_blur = 2 * of_some * float(np.sqrt(2)) * blurred
        spread = _length(of_errors, _rms(more - again), of_taken, of_blur)
        figure = of_square(square, spread)
        found.append(UncertainValue((figure.value or 0.0) + of_all - of_some, figure.uncertainty))
    return found[0], found[1]


def _with_and_without(map_: DeviationMap) -> tuple[DeviationMap, DeviationMap]:
    """Return the map as if all that may be noise were texture, and as if it were noise."""
    return replace(map_, noise=0.0, noise_known=True), replace(map_, noise_known=True)


def _either(measured: UncertainValue, quiet: UncertainValue) -> UncertainValue:
    """Return the figure as measured; what may be noise counts in its uncertainty."""
    spread = max(measured.uncertainty or 0.0, quiet.uncertainty or 0.0)
    return UncertainValue(
        measured.value, _length(spread, (measured.value or 0.0) - (quiet.value or 0.0))
    )


class LocalFeatures(NamedTuple):
    """Points (m,) of a map whose form differs from its smooth form and its local means.

    points: indices in the map;  form: estimate [m];  noise: draws of what is left of it (d, m) [m]
    blurred: rms of the form that the estimate does not resolve [m]
    """

    points: IntArray
    form: FloatArray
    noise: FloatArray
    blurred: float


def local_features(map_: DeviationMap, fit: ZernikeFit) -> LocalFeatures | None:
    """Return what grooves, pips, scratches and edges add to the smooth form; None for nothing.

    Cells of four sizes whose mean exceeds what noise makes anywhere on the map show them, as do
    single points (D. Donoho, I. Johnstone, Biometrika 81, 425). Each of the largest cells with one
    has the means of the size with the least expected error (Stein); all cells have, if the means of
    one size are closer than none all over the map, as for ripple.
    """
    if map_.noise == 0:
        return None
    smooth = fit.height(map_.x, map_.y)
    rest = map_.deviation - smooth
    spans = np.array([np.ptp(map_.x), np.ptp(map_.y)])
    side = float(np.sqrt(np.prod(np.maximum(spans, 1e-3 * spans.max())) / len(map_)))
    levels, differs = [], np.abs(rest) > _beyond_chance(len(map_)) * map_.noise
    ripple = False
    for pitch in side * np.array(_CELLS):
        column, row = (((v - v.min()) / pitch).astype(np.int64) for v in (map_.x, map_.y))
        levels.append(column * (int(row.max()) + 1) + row)
        mean, error = _cell_means(levels[-1], rest, map_.noise)
        count = int(np.sum(error > 0))
        differs |= (np.abs(mean) > _beyond_chance(count) * error)[levels[-1]]
        # Σ (mean / error)² of noise alone is χ² with as many degrees of freedom as cells.
        chi_square = float(np.sum((mean[error > 0] / error[error > 0]) ** 2))
        ripple |= chi_square - 2 * count > _CHANCE * np.sqrt(2 * count)
    chosen = (np.bincount(levels[0], differs) > 0) | ripple
    some = np.flatnonzero(chosen[levels[0]])
    if not len(some):
        return None
    cells = [np.unique(level[some], return_inverse=True)[1] for level in levels]
    cells.append(np.arange(len(some)))
    best = _least_risk(cells, rest[some], map_.noise)

    def means(values: FloatArray) -> FloatArray:
        made = np.stack([_cell_means(cell, values, 0.0)[0][cell] for cell in cells])
        return np.asarray(made[best, np.arange(len(some))], np.float64)

    form = means(rest[some])
    random = np.random.default_rng(_SEED + 2)
    noise = [means(map_.noise * random.normal(size=len(some))) for _ in range(_NOISES)]
    order = np.argsort(smooth[some] + form)
    ends = np.concatenate([order[:_EXTREME], order[-_EXTREME:]])
    missed = (rest[some] - form)[ends][best[ends] < len(levels)]
    variance = float(np.mean(missed**2)) - map_.noise**2 if len(missed) else 0.0
    blurred = float(np.sqrt(max(variance, 0.0)))
    return LocalFeatures(some, smooth[some] + form, np.array(noise), blurred)


def _least_risk(cells: Sequence[IntArray], values: FloatArray, noise: float) -> IntArray:
    """Return the level (n,) whose cell means have the least expected error, by largest cell.

    cells: number of the cell of each point at each level, each (n,), from the largest to one point
    """
    risks = []
    for cell in cells:
        mean, _ = _cell_means(cell, values, 0.0)
        size = np.bincount(cell)[cell]
        # Each cell follows the noise of one point.
        risk = (values - mean[cell]) ** 2 + 2 * noise**2 / size
        risks.append(np.bincount(cells[0], risk))
    # A choice of its own follows the noise of a cell, so the gain must exceed that of chance.
    usual, own = int(np.argmin(np.sum(risks, axis=1))), np.argmin(risks, axis=0)
    gain = risks[usual] - np.min(risks, axis=0)
    chance = _CHANCE * noise**2 * np.sqrt(2 * np.bincount(cells[0]))
    return np.asarray(np.where(gain > chance, own, usual)[cells[0]], np.int64)


def _cell_means(cell: IntArray, values: FloatArray, noise: float) -> tuple[FloatArray, FloatArray]:
    """Return the mean of ``values`` (n,) in each cell (k,), and its standard error; zero: empty."""
    counts = np.bincount(cell)
    held = np.maximum(counts, 1)
    error = np.where(counts > 0, noise / np.sqrt(held), 0.0)
    return np.asarray(np.bincount(cell, values) / held), error


def _beyond_chance(count: int) -> float:
    """Return the multiple of σ that none of ``count`` normal values is likely to exceed."""
    return float(np.sqrt(2 * np.log(max(count, 2)))) + 1.0


def _smooth(map_: DeviationMap, disc: Aperture, noises: FloatArray) -> ZernikeFit:
    """Return smooth terms of the deviations, of as high an order as the points show.

    noises: draws of the noise (d, n) [m], fitted as the effects
    """
    orders = [n for n in _ORDERS if len(terms_up_to(n)) * _POINTS_PER_TERM <= len(map_)] or [0]
    for order, lower in zip(orders, [*orders[1:], -1], strict=True):
        points = (map_.x, map_.y, map_.deviation)
        fit = fit_zernikes(*points, terms_up_to(order), disc, weights=map_.area, effects=noises)
        # Orders that only follow the noise would blur the rim, where the noise of all adds up.
        high = np.array([term.n > lower for term in fit.terms])
        variance = np.mean(fit.effects[high] ** 2, axis=1)
        count = len(variance)
        chi_square = float(np.sum(fit.coefficients[high] ** 2 / np.maximum(variance, _TINY)))
        if chi_square > count + _CHANCE * np.sqrt(2 * count):
            break
    return fit


def _without_noise(
    map_: DeviationMap, fit: ZernikeFit, noises: FloatArray
) -> tuple[FloatArray, FloatArray, float]:
    """Return the denoised deviations (n,), the remaining noise (d, n), and the lost form, rms [m].

    A Wiener filter takes the residual of the smooth terms. ``noises`` are draws (d, n) filtered
    alike; the part that the terms follow is in their covariance.
    """
    terms = zernike_values(*fit.disc.scaled(map_.x, map_.y), fit.terms)
    smooth = fit.coefficients @ terms
    rest, noise = map_.deviation - smooth, noises - fit.effects.T @ terms
    share, lost = _share_of_form(rest, map_.noise)
    return np.asarray(smooth + share * rest, np.float64), share * noise, lost


def _share_of_form(values: FloatArray, noise: float) -> tuple[float, float]:
    """Return the Wiener factor for ``values`` (n,) with ``noise``, and the form lost by it, rms."""
    variance = float(np.mean(values**2))
    share = max(1 - noise**2 / variance, 0.0) if variance > 0 else 0.0
    return share, (1 - share) * float(np.sqrt(max(variance - noise**2, 0.0)))


def _drawn(
    map_: DeviationMap, fit: ZernikeFit, base: FloatArray, left: FloatArray
) -> tuple[FloatArray, ...]:
    """Return the deviations with five kinds of errors drawn anew, each (m, draws).

    All errors that are present; these and the upper bounds; the form that the fit has probably
    taken; the form that it may have taken at most; the remaining noise alone.

    base: without errors (n,);  left: draws of the noise that is left in it (d, n)
    """
    random = np.random.default_rng(_SEED)
    terms = zernike_values(*fit.disc.scaled(map_.x, map_.y), fit.terms)
    effects, still = map_.effects, base[:, np.newaxis]
    taken = effects[: len(map_.taken)]

    def anew(ways: FloatArray) -> FloatArray:
        return np.asarray(ways.T @ random.normal(size=(len(ways), _DRAWS)), np.float64)

    noisy = still + np.tile(left.T, _DRAWS // _NOISES)
    drawn = noisy + anew(np.concatenate([effects[_real(map_)], _root(fit.covariance) @ terms]))
    bounded = drawn + anew(effects[map_.bounds])
    return drawn, bounded, still + anew(_root(map_.taken) @ taken), still + anew(taken), noisy


def _root(products: FloatArray) -> FloatArray:
    """Return rows (k, k) whose outer products add up to these mean ``products`` (k, k)."""
    values, vectors = np.linalg.eigh(products)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))).T, np.float64)


def _real(map_: DeviationMap) -> BoolArray:
    """Return which effects (e,) are of errors that are certainly present."""
    real = np.ones(len(map_.effects), np.bool_)
    real[map_.bounds] = False
    real[: len(map_.taken)] = False
    return real


def _length(*shares: float) -> float:
    return float(np.sqrt(sum(share**2 for share in shares)))


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _variance_by_noise(map_: DeviationMap, share: FloatArray) -> float:
    """Return the variance of the mean square [m⁴] from the noise of the points.

    For each point 4 d²σ² from its form, 2 σ⁴ from its noise, and 2 σ⁴ from the uncertainty of σ.
    """
    noise = map_.noise**2
    return float(np.sum(share**2 * (4 * map_.deviation**2 * noise + 4 * noise**2)))


def of_square(square: float, spread: float) -> UncertainValue:
    """Return the root of a ``square`` [m²] with its standard uncertainty ``spread`` [m²].

    The uncertainty is half the larger side of the interval of the root for k = 2 of the square. A
    square may be negative by chance; the interval then ends at the root of ``spread``.
    """
    value = float(np.sqrt(max(square, 0.0)))
    high = float(np.sqrt(max(square + 2 * spread, spread)))
    low = float(np.sqrt(max(square - 2 * spread, 0.0)))
    return UncertainValue(value, max(high - value, value - low) / 2)


def without_columns(map_: DeviationMap, columns: FloatArray) -> DeviationMap:
    """Return the map without its area-weighted fit of ``columns`` (k, n), effects included."""
    weighted = columns * map_.area
    # For points on a line some columns coincide; the minimum-norm solution is used.
    solve = np.linalg.pinv(weighted @ columns.T, rcond=1e-12, hermitian=True)
    values = np.concatenate([map_.deviation[np.newaxis], map_.effects])
    rest = values - (solve @ (weighted @ values.T)).T @ columns
    return replace(map_, deviation=rest[0], effects=rest[1:])


def best_fit(map_: DeviationMap) -> DeviationMap:
    """Return the map after best-fit alignment in all fitted and held pose parameters.

    It contains neither the uncertainty of the pose nor form that looks like a move.
    """
    moves = map_.effects[map_.moves]
    size = np.sqrt(np.mean(moves**2, axis=1))
    return without_columns(map_, moves[size > 0] / size[size > 0, np.newaxis])


def without_second_order(map_: DeviationMap) -> DeviationMap:
    """Return the map without its best ``Σ c_ij x^i y^j``, i + j ≤ 2."""
    u, v = (_scaled(values) for values in (map_.x, map_.y))
    return without_columns(map_, np.stack([np.ones_like(u), u, v, u * u, u * v, v * v]))


def without_tilt(map_: DeviationMap, disc: Aperture) -> DeviationMap:
    """Return the map without piston and tilts."""
    return without_columns(map_, zernike_values(*disc.scaled(map_.x, map_.y), POWER[:3]))


def without_power(map_: DeviationMap, disc: Aperture) -> DeviationMap:
    """Return the map without piston, tilts and power: the irregularity of ISO 10110-5."""
    return without_columns(map_, zernike_values(*disc.scaled(map_.x, map_.y), POWER))


def without_form(map_: DeviationMap, disc: Aperture) -> DeviationMap:
    """Return the map without Zernike terms up to order 4: the F-operation of ISO 25178-2.

    A Gaussian filter would leave form at the rim, where its window is cut off.
    """
    return without_columns(map_, zernike_values(*disc.scaled(map_.x, map_.y), _FORM))


def asymmetric(map_: DeviationMap, disc: Aperture) -> DeviationMap:
    """Return the map without power and without rotationally symmetric terms up to order 12."""
    return without_columns(map_, zernike_values(*disc.scaled(map_.x, map_.y), POWER + SYMMETRIC))


def _scaled(values: FloatArray) -> FloatArray:
    low, high = float(values.min()), float(values.max())
    return np.asarray((values - (low + high) / 2) / ((high - low) / 2 or 1.0), np.float64)
