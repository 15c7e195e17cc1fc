"""How large are the figures of the *part*, without what noise and systematic errors added to them?

A peak to valley or an rms is never made smaller by errors on the whole: that of noise alone is not
zero. What errors of the same size would add once more is known, by drawing them, and squares of
such figures add: for an rms that is exact, for an extent it is so where either errors or form are
all there is. So with F of the deviations and F' of the deviations with errors drawn anew

    F² of the part = 2 F² − mean F'²

(simulation and extrapolation; J. Cook, L. Stefanski, J. Am. Stat. Assoc. 89, 1314). Noise from
point to point is first averaged out by smooth terms and means of neighbours; of what they leave,
the share that is no noise stays. Noise that is left counts as an error.

What the fit of the pose may have taken away is no error that was added: form that looks like a move
is missing from the deviations. Their form and it are independent of each other (the estimate and
its error, in a fit that knows how large form is), so that its mean square is added, as far as it
is likely; that there may be more is uncertainty of the figure.

An upper bound is no error that is there: how large an open latency is, nobody knows. It is not
subtracted. By how much an error of its size would change the square, as mean square about none, is
uncertainty of the figure.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from omsm_ros.core.form.deviation_map import (
    DeviationMap,
    UncertainValue,
    gaussian_weights,
    weighted_quantiles,
)
from omsm_ros.core.form.zernike_fit import ZernikeFit, fit_zernikes
from omsm_ros.core.registration.placement import Aperture
from omsm_ros.core.streams.blocks import BoolArray, FloatArray, IntArray
from omsm_ros.core.surface.zernike_terms import ZernikeIndex, terms_up_to, zernike_values

# Means of scattered values around each of their points, over the width that takes most noise.
#
# The Gaussian of ISO 16610 on a fine grid, between whose nodes points lie linearly. Kernels that
# take less of short waves make more of what is at the rim, where parts are highest.

_MOST_ACROSS = 256
# Cutoffs in steps of the grid, each half a step of an octave wider than the one before.
_CUTOFFS = (2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0)
_SEED_LOCAL_MEANS = 11


class ChosenMeans(NamedTuple):
    """The width whose means come closest to what is there without noise.

    means: of its values (n,);  rest: share of the noise of a point in what they leave of it
    error: expected mean square of ``means`` from that without noise
    """

    means: LocalMeans
    rest: float
    error: float


@dataclass(frozen=True, eq=False)
class LocalMeans:
    """Means around n points. Linear: those of a sum are the sum of those.

    nodes, weights: of the four nodes of the grid around each point (4, n)
    along_y, along_x: weights of the Gaussian (r, r), (c, c);  total: of the points at each node
    """

    nodes: IntArray
    weights: FloatArray
    along_y: FloatArray
    along_x: FloatArray
    total: FloatArray

    @classmethod
    def of(cls, x: FloatArray, y: FloatArray, cutoff: float) -> LocalMeans:
        """Return those at x, y (n,) [m], of a ``cutoff`` in steps of about a point each."""
        spans = float(np.ptp(x)), float(np.ptp(y))
        longest = max(spans) or 1.0
        step = max(float(np.sqrt(spans[0] * spans[1] / len(x))), longest / _MOST_ACROSS)
        across, up = (x - x.min()) / step, (y - y.min()) / step
        rows, columns = int(up.max()) + 2, int(across.max()) + 2
        column, row = across.astype(np.int64), up.astype(np.int64)
        right, above = across - column, up - row
        corners = [(a, b) for a in (0, 1) for b in (0, 1)]
        nodes = np.stack([(row + b) * columns + column + a for a, b in corners])
        weights = np.stack(
            [(right if a else 1 - right) * (above if b else 1 - above) for a, b in corners]
        )
        made = cls(
            nodes,
            weights,
            gaussian_weights(rows, cutoff),
            gaussian_weights(columns, cutoff),
            np.ones((rows, columns)),
        )
        total = np.maximum(made._on_grid(np.ones(len(x))), np.finfo(np.float64).tiny)
        return cls(nodes, weights, made.along_y, made.along_x, total)

    def __call__(self, values: FloatArray) -> FloatArray:
        """Return the means of ``values`` (n,)."""
        means = (self._on_grid(values) / self.total).ravel()
        return np.asarray(np.sum(self.weights * means[self.nodes], axis=0), np.float64)

    def _on_grid(self, values: FloatArray) -> FloatArray:
        size = self.total.size
        sums = np.bincount(self.nodes.ravel(), (self.weights * values).ravel(), size)
        return np.asarray(self.along_y @ sums.reshape(self.total.shape) @ self.along_x, np.float64)


def closest_means(x: FloatArray, y: FloatArray, values: FloatArray, noise: float) -> ChosenMeans:
    """Return the means whose expected error is least for ``values`` at x, y, each (n,).

    The error is told by the values themselves (C. Stein's unbiased estimate), with the trace from
    one draw of signs.
    """
    signs = np.random.default_rng(_SEED_LOCAL_MEANS).choice([-1.0, 1.0], size=len(x))
    found = []
    for cutoff in _CUTOFFS:
        means = LocalMeans.of(x, y, cutoff)
        left = float(np.mean((values - means(values)) ** 2))
        kept = means(signs)
        error = left - noise**2 * (1 - 2 * float(np.mean(signs * kept)))
        found.append(ChosenMeans(means, float(np.mean((signs - kept) ** 2)), error))
    return min(found, key=lambda each: each.error)


# 99.5 % of the area lies between these (ISO 10110-5:2015 calls for a share to be stated).
ROBUST = (0.0025, 0.9975)
# Smooth terms of these orders, the most for which there are forty points each.
_ORDERS, _POINTS_PER_TERM = (12, 8, 4, 2), 40
# Two hundred for each of the 91 terms up to order 12. Drawn are extents, which two thousand points
# of a smooth form show.
_MOST_FITTED, _MOST_DRAWN = 20_000, 2_000
# 200 draws know a standard deviation to 5 %.
_DRAWS, _SEED = 200, 7
# Of the noise of the points: its mean effect is known to a sixth of its spread.
_NOISES = 40


def rms_of_part(map_: DeviationMap) -> UncertainValue:
    """Return the area-weighted rms about zero that the part has, by closed form.

    The mean square of deviations s + e is that of s, of e, and twice their mean product.
    """
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
    # With e = Σ a_i f_i that may be there, 2 d·e − e·e has the mean square 4 Σ (d·f_i)² + tr² P +
    # 2 tr P², P the products of the f_i.
    bounded = float(np.sum(own[map_.bounds]))
    of_bounds = 4 * float(np.sum(shared[map_.bounds] ** 2)) + bounded**2
    of_errors = of_form + of_bounds + 2 * float(np.sum(products**2))
    variance = of_errors + _variance_by_noise(map_, share)
    return _of_square(square, float(np.sqrt(variance)))


def extents_of_part(map_: DeviationMap, disc: Aperture) -> tuple[UncertainValue, UncertainValue]:
    """Return the peak to valley of the part, and the extent of 99.5 % of its area.

    disc: on which the smooth terms are
    """
    few = map_.every(_MOST_FITTED)
    noises = few.noise * np.random.default_rng(_SEED + 1).normal(size=(_NOISES, len(few)))
    fit = _smooth(few, disc, noises)
    base, left, blurred = _without_noise(few, fit, noises)
    chosen = slice(None, None, -(-len(few) // _MOST_DRAWN))
    ways = _drawn(few, fit, base, left, chosen)
    area = few.area[chosen]

    def robust(deviations: FloatArray, area: FloatArray) -> FloatArray:
        low_high = [weighted_quantiles(column, area, ROBUST) for column in deviations.T]
        return np.array([high - low for low, high in low_high])

    def whole(deviations: FloatArray, _: FloatArray) -> FloatArray:
        return np.asarray(np.ptp(deviations, axis=0), np.float64)

    found = []
    for extent in (whole, robust):
        of_all = float(extent(base[:, np.newaxis], few.area)[0])
        of_some = float(extent(base[chosen][:, np.newaxis], area)[0])
        again, more, likely, full, noisy = (extent(drawn, area) ** 2 for drawn in ways)
        square = of_some**2 - float(np.mean(again)) + float(np.mean(likely))
        of_taken = _rms(full - np.mean(likely))
        # Where many points compete for an extreme, the mean of draws follows the figure's own
        # noise but in part, so that twice its square has once to twice of it: √2.
        of_errors = _length(float(np.std(again)), float(np.std(noisy)))
        # Of the two points that an extent is between.
        of_blur = 2 * of_some * float(np.sqrt(2)) * blurred
        spread = _length(of_errors, _rms(more - again), of_taken, of_blur)
        figure = _of_square(square, spread)
        found.append(UncertainValue((figure.value or 0.0) + of_all - of_some, figure.uncertainty))
    return found[0], found[1]


def _smooth(map_: DeviationMap, disc: Aperture, noises: FloatArray) -> ZernikeFit:
    """Return smooth terms of the deviations, of as high an order as the points allow.

    noises: draws of it (d, n) [m], whose terms are its effects
    """
    orders = [n for n in _ORDERS if len(terms_up_to(n)) * _POINTS_PER_TERM <= len(map_)]
    terms = terms_up_to(orders[0] if orders else 0)
    points = (map_.x, map_.y, map_.deviation)
    return fit_zernikes(*points, terms, disc, weights=map_.area, effects=noises)


def _without_noise(
    map_: DeviationMap, fit: ZernikeFit, noises: FloatArray
) -> tuple[FloatArray, FloatArray, float]:
    """Return the deviations with as little noise as can be (n,), and what is left of it (d, n).

    And how much form is lost with it, rms.

    Smooth terms; of what they leave, means around each point, where these come closer to it than
    single points; of what those leave, the share that is no noise (Wiener). ``noises`` are draws
    (d, n) that go the same way; what the terms follow of them is in the covariance of the terms.
    """
    terms = zernike_values(*fit.disc.scaled(map_.x, map_.y), fit.terms)
    smooth = fit.coefficients @ terms
    rest, noise = map_.deviation - smooth, noises - fit.effects.T @ terms
    share, lost = _share_of_form(rest, map_.noise)
    found = closest_means(map_.x, map_.y, rest, map_.noise)
    if found.error >= share * map_.noise**2:
        return np.asarray(smooth + share * rest, np.float64), share * noise, lost
    near, noise_near = found.means(rest), np.array([found.means(each) for each in noise])
    share, lost = _share_of_form(rest - near, map_.noise * float(np.sqrt(found.rest)))
    base = smooth + near + share * (rest - near)
    return np.asarray(base, np.float64), noise_near + share * (noise - noise_near), lost


def _share_of_form(values: FloatArray, noise: float) -> tuple[float, float]:
    """Return which share of ``values`` (n,) comes closest to them without their ``noise``.

    And what it lacks of them then, rms.
    """
    variance = float(np.mean(values**2))
    share = max(1 - noise**2 / variance, 0.0) if variance > 0 else 0.0
    return share, (1 - share) * float(np.sqrt(max(variance - noise**2, 0.0)))


def _drawn(
    map_: DeviationMap, fit: ZernikeFit, base: FloatArray, left: FloatArray, chosen: slice
) -> tuple[FloatArray, ...]:
    """Return some of the deviations with errors drawn anew (m, draws).

    The second has besides what may be there of the upper bounds. The others have, instead of
    errors, what the fit is likely to have taken away, what it may have, and the noise left alone.

    base: without errors (n,);  left: draws of the noise that is left in it (d, n)
    """
    random = np.random.default_rng(_SEED)
    terms = zernike_values(*fit.disc.scaled(map_.x[chosen], map_.y[chosen]), fit.terms)
    effects, still = map_.effects[:, chosen], base[chosen][:, np.newaxis]
    taken = effects[: len(map_.taken)]

    def anew(ways: FloatArray) -> FloatArray:
        return np.asarray(ways.T @ random.normal(size=(len(ways), _DRAWS)), np.float64)

    noisy = still + np.tile(left[:, chosen].T, _DRAWS // _NOISES)
    drawn = noisy + anew(np.concatenate([effects[_real(map_)], _root(fit.covariance) @ terms]))
    bounded = drawn + anew(effects[map_.bounds])
    return drawn, bounded, still + anew(_root(map_.taken) @ taken), still + anew(taken), noisy


def _root(products: FloatArray) -> FloatArray:
    """Return rows (k, k) whose outer products add up to these mean ``products`` (k, k)."""
    values, vectors = np.linalg.eigh(products)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))).T, np.float64)


def _real(map_: DeviationMap) -> BoolArray:
    """Return which effects (e,) are of errors that are there, whatever their sign."""
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

    4 d²σ² of a point from its form and 2 σ⁴ from its noise, and as much again for not knowing σ.
    """
    noise = map_.noise**2
    return float(np.sum(share**2 * (4 * map_.deviation**2 * noise + 4 * noise**2)))


def _of_square(square: float, spread: float) -> UncertainValue:
    """Return the root of a ``square`` [m²] known to ``spread``, k = 1.

    Its uncertainty is half of the larger side of the interval that k = 2 of the square is. Errors
    that are not as they were drawn may take more from the square than there is: then that ends no
    nearer to zero than the square is known, for no figure is known to be zero.
    """
    value = float(np.sqrt(max(square, 0.0)))
    high = float(np.sqrt(max(square + 2 * spread, spread)))
    low = float(np.sqrt(max(square - 2 * spread, 0.0)))
    return UncertainValue(value, max(high - value, value - low) / 2)


# Maps without some of their terms: what bending, focus or turning would take away.
#
# Removal is linear, so that what an error does to the map goes the same way as the map.

# Piston, both tilts and power; what a Gaussian of a quarter of the side takes for form; what a
# turned part has all around, to order 12.
POWER = (ZernikeIndex(0, 0), ZernikeIndex(1, -1), ZernikeIndex(1, 1), ZernikeIndex(2, 0))
_FORM = terms_up_to(4)
SYMMETRIC = tuple(ZernikeIndex(n, 0) for n in range(4, 14, 2))


def without_columns(map_: DeviationMap, columns: FloatArray) -> DeviationMap:
    """Return the map without its area-weighted best sum of ``columns`` (k, n)."""
    weighted = columns * map_.area
    # Of points on a line some columns are the same; then the least solution serves.
    solve = np.linalg.pinv(weighted @ columns.T, rcond=1e-12, hermitian=True)
    values = np.concatenate([map_.deviation[np.newaxis], map_.effects])
    rest = values - (solve @ (weighted @ values.T)).T @ columns
    return replace(map_, deviation=rest[0], effects=rest[1:])


def best_fit(map_: DeviationMap) -> DeviationMap:
    """Return the map where the part sits as it fits best, in all that was fitted or held.

    What no move of the part explains: however it sat, so much deviates. Form that looks like a move
    is not in it, and neither is what the pose leaves open.
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

    A Gaussian filter would leave them along the rim, where its window is cut off.
    """
    return without_columns(map_, zernike_values(*disc.scaled(map_.x, map_.y), _FORM))


def asymmetric(map_: DeviationMap, disc: Aperture) -> DeviationMap:
    """Return the map without power and without what is the same all around, up to order 12."""
    return without_columns(map_, zernike_values(*disc.scaled(map_.x, map_.y), POWER + SYMMETRIC))


def _scaled(values: FloatArray) -> FloatArray:
    low, high = float(values.min()), float(values.max())
    return np.asarray((values - (low + high) / 2) / ((high - low) / 2 or 1.0), np.float64)
