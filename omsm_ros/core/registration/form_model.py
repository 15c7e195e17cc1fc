"""Estimate the pose of a part together with its unknown form error.

Form error of low order looks, in part, like a shifted part: on an off-axis paraboloid a shift of
10 µm has the effect of 100 nm of astigmatism. Least squares would attribute all of it to the shift
and understate the uncertainty by a factor of a hundred. The model is

    d = J δ + Z c + noise,   c_k ~ N(0, σ_g²)

J holds the columns of the pose, whose prior is the offset of a manually mounted part; Z holds
polynomials of orders 2 to 8. Restricted maximum likelihood gives the standard deviation σ_g of
each order (D. MacKay, Neural Comput. 4, 415; fixed point of its eq. 4.9). No order may have a
smaller σ_g than a higher order. A σ_g from few terms may be small by chance, so its upper
one-sided 85 % bound is used. Points far from any sum of the columns are outliers (dust).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from omsm_ros.core.streams import statistics
from omsm_ros.core.streams.blocks import BoolArray, FloatArray, IntArray
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.core.surface.zernike_terms import ZernikeIndex, rms_of, terms_up_to, zernike_values
from omsm_ros.errors import DataError

HIGHEST_ORDER = 8
NOT_SETTLED = "registration.form_like_pose"
"""Code of the error of a fit that does not converge."""
_TERMS: tuple[ZernikeIndex, ...] = terms_up_to(HIGHEST_ORDER)
_SCALE = np.array([1 / rms_of(term) for term in _TERMS])
# A term with a smaller independent share on these points is left out.
_LEAST_NEW = 1e-4
# Turning makes rings, so rotationally symmetric terms from the fourth order on have their own σ.
_RINGS = HIGHEST_ORDER + 1
_GROUPS = np.array([_RINGS if t.m == 0 and t.n > 2 else t.n for t in _TERMS])
# Terms of an order are equally high in rms, as on isotropic form, or at the rim, where rotational
# ones have √2 times the rms: the middle of both variances.
_USUAL = np.array([1.0 if term.m else 1.5**0.5 for term in _TERMS])
# Relative change of the variances at convergence; parts need 8 to 40 iterations.
_TURNS, _SETTLED = 300, 1e-3
# Amplitudes of optical figure errors fall with the second to fourth power of their order (±1).
_STEEPEST, _FALL, _FALL_ERROR = 4, 3.0, 1.0
# Lower bounds of σ_g: a picometre, so that the variance has an inverse, and a tenth of the
# variance that noise leaves of a term, below which data cannot show it.
_LEAST_M = 1e-12
_LEAST_SHARE = 0.1
# Lower bound of the uncertainty of a term, however many points there are; a smaller one would let
# rounding decide between form and pose.
_BEST_KNOWN_M = 1e-11
# Upper bound of σ_g² over the mean square left after a plain fit, which may have taken most of the
# form for pose.
_MOST_SHARE = 100.0
# Quantile of the normal distribution at 15 %. With it 95 % bands held the truth in 93 to 100 % of
# simulated parts with spectra from n⁻² to n⁻⁶ or with single terms; with 20 %, in 90 to 100 %.
_QUANTILE = 1.0364
# One in a million points of Gaussian noise lies beyond it; texture has shorter tails.
OUTLIER_SIGMAS = 5.0
# A deviation that more than 5 % of the points reach is part of the form; the factor is a margin.
_MOST_DUST, _BEYOND_COMMON = 0.05, 1.2
# Least eigenvalue of columns that are no copies. Those that are nearly alike differ at few points,
# and large multiples of them that cancel would follow dust there: bound of the rms of a multiple
# over that of the deviation.
_ROUNDING, _MOST_CANCELLED = 1e-12, 100.0
# Rounding of a nominal surface against itself is no outlier.
LEAST_LIMIT_M = 1e-12
# The second fit is already nearly free of dust.
_DUST_PASSES = 3

# Consecutive points whose errors may be correlated.
GROUP = 128


@dataclass(frozen=True, eq=False)
class FormBasis:
    """Polynomials of orders 2 to 8, orthogonal over the area and to piston and tilts.

    On a disc these are Zernike's; elsewhere they are made of Zernike's in their order.

    disc: of the Zernike terms, one at the rim;  mix: of all up to order 8 (k, 45)
    group: order of each, or the group of rings (k,)
    level: weights of all that make piston and tilts, orthonormal over the area (l, 45)
    """

    disc: Aperture
    mix: FloatArray
    group: IntArray
    level: FloatArray

    @classmethod
    def over(cls, x: FloatArray, y: FloatArray, area: FloatArray, disc: Aperture) -> FormBasis:
        """Return the basis on the ``area`` (n,) that points at x, y (n,) [m] stand for.

        Raises DataError for points at too few places to show any form.
        """
        values = zernike_values(*disc.scaled(x, y), _TERMS) * _SCALE[:, np.newaxis]
        gram = (values * (area / area.sum())) @ values.T
        rows: list[FloatArray] = []
        kept: list[int] = []
        for place, row in enumerate(np.eye(len(_TERMS))):
            for _ in range(2):  # the second pass removes rounding errors of the first
                for other in rows:
                    row = row - (other @ gram @ row) * other
            new = float(row @ gram @ row)
            if new > _LEAST_NEW**2 * gram[place, place]:
                rows.append(row / np.sqrt(new))
                kept.append(place)
        form = _GROUPS[kept] >= 2
        if not np.any(form):
            raise DataError("registration.no_form")
        whole = np.array(rows) * _SCALE
        mix = whole[form] * _USUAL[kept, np.newaxis][form]
        return cls(disc, mix, _GROUPS[kept][form], whole[~form])

    def __len__(self) -> int:
        return len(self.group)

    def columns(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the polynomials (k, n) at x, y (n,) [m], with their usual rms over the area."""
        return np.asarray(self.mix @ self.terms(x, y), np.float64)

    def terms(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the Zernike terms (45, n) at x, y (n,) [m] of which ``mix`` makes the columns."""
        return zernike_values(*self.disc.scaled(x, y), _TERMS)


class FormNormalEquations:
    """Products of columns with each other, the deviation and ``sources`` systematic effects.

    points: number added;  square, total: sums of squared residuals and deviations [m²]
    gram: (columns, columns + 1 + sources)
    scores: for each column, the sum over groups of 128 successive points of the squared sum of its
        products with the residual, which shows correlated errors
    """

    def __init__(self, columns: int, sources: int) -> None:
        self.columns, self.points = columns, 0
        self.square = self.total = 0.0
        self.gram, self.scores = np.zeros((columns, columns + 1 + sources)), np.zeros(columns)

    def add(self, columns: FloatArray, deviation: FloatArray, systematic: FloatArray,
            residual: FloatArray, near: BoolArray | None = None, gram: FloatArray | None = None,
            mix: FloatArray | None = None) -> None:  # fmt: skip
        """Add points: columns (q, n), deviation (n,), systematic (s, n), residual (n,).

        near: which of them to add (n,), None for all;  gram: of their columns (q, q) if it is known
        mix: weights (q, k) of ``columns`` (k, n) whose sums are the columns, if they are not
        """
        if near is not None and not np.all(near):
            columns, systematic = columns[:, near], systematic[:, near]
            deviation, residual = deviation[near], residual[near]
        gram = columns @ columns.T if gram is None else gram
        right = columns @ np.vstack([deviation, systematic]).T
        whole = len(residual) // GROUP * GROUP
        groups = columns[:, :whole].reshape(len(columns), -1, GROUP).swapaxes(0, 1)
        by_group = (groups @ residual[:whole].reshape(-1, GROUP, 1))[..., 0].T
        by_group = np.column_stack([by_group, columns[:, whole:] @ residual[whole:]])
        if mix is not None:  # the products of few sums, instead of those of all points
            gram, right, by_group = mix @ gram @ mix.T, mix @ right, mix @ by_group
        self.gram += np.concatenate([gram, right], axis=1)
        self.scores += np.sum(by_group**2, axis=1)
        self.points += len(deviation)
        self.square += float(residual @ residual)
        self.total += float(deviation @ deviation)


class Estimate(NamedTuple):
    """Estimate of pose and form.

    step: δ (p,) in the unit of the columns;  form: c (k,) [m rms];  covariance: of both
    sizes: σ_g of each term (k,) [m], at its upper bound;  noise: variance of one point [m²]
    likely: covariance of the step with the most likely σ_g
    """

    step: FloatArray
    form: FloatArray
    covariance: FloatArray
    sizes: FloatArray
    noise: float
    likely: FloatArray

    @property
    def length(self) -> float:
        """Return the Mahalanobis length of the step."""
        free = len(self.step)
        spread = np.sqrt(np.diag(self.covariance)[:free])
        shared = self.covariance[:free, :free] / np.outer(spread, spread)
        inverse = np.linalg.pinv(shared, rcond=1e-14, hermitian=True)
        step = self.step / spread
        return float(np.sqrt(max(step @ inverse @ step, 0.0)))


def estimate(
    gram: FloatArray, moments: FloatArray, variance: float, largest: float, group: IntArray,
    expected: tuple[FloatArray, FloatArray],
) -> Estimate:  # fmt: skip
    """Return the estimate from the normal equations of columns [J, Z].

    gram: (p + k, p + k);  moments: columns times data (p + k,) [m]
    variance: of the noise of one point, as it averages out [m²]
    largest: mean square of the data [m²], which bounds the form
    group: of each column of Z (k,): its order, or that of rings
    expected: value of the pose, and standard deviation of its prior about zero, both (p,)
    """
    dofs = len(gram) - len(group)
    scale = np.sqrt(np.maximum(np.diag(gram), np.finfo(np.float64).tiny))
    scale[dofs:] = 1.0
    points = float(np.median(np.diag(gram)[dofs:]))
    noise = max(variance, _LEAST_M**2, points * _BEST_KNOWN_M**2)
    scales = np.outer(scale, scale)
    normal, right = gram / scales / noise, moments / scale / noise
    value, spread = expected[0] * scale[:dofs], expected[1] * scale[:dofs]
    normal[np.arange(dofs), np.arange(dofs)] += 1 / spread**2
    right[:dofs] -= value / spread**2
    least = np.maximum(_LEAST_SHARE / np.diag(normal)[dofs:], _LEAST_M**2)
    sizes = np.maximum(largest, least)
    for _ in range(_TURNS):
        covariance, found = _solved(normal, right, sizes, dofs)
        unknown = np.diag(covariance)[dofs:] / sizes
        new = _sizes(found[dofs:], unknown, least, group)
        new = np.clip(new, least, np.maximum(_MOST_SHARE * largest, least))
        change, sizes = float(np.max(np.abs(np.log(new / sizes)))), new
        if change < _SETTLED:
            break
    likely = covariance[:dofs, :dofs] / scales[:dofs, :dofs]
    sizes = _upper_variances(sizes, np.diag(covariance)[dofs:] / sizes, group)
    covariance, found = _solved(normal, right, sizes, dofs)
    step, form = np.split(found / scale, [dofs])
    return Estimate(step, form, covariance / scales, np.sqrt(sizes), noise, likely)


def _solved(
    normal: FloatArray, right: FloatArray, sizes: FloatArray, dofs: int
) -> tuple[FloatArray, FloatArray]:
    """Return the covariance of the solution of the normal equations, and the solution."""
    full = normal + np.diag(np.append(np.zeros(dofs), 1 / sizes))
    root = 1 / np.sqrt(np.diag(full))
    try:
        inverse = np.linalg.inv(full * np.outer(root, root)) * np.outer(root, root)
    except np.linalg.LinAlgError as err:
        raise DataError(NOT_SETTLED) from err
    # Where pose and form are nearly the same, rounding leaves variances below zero.
    if not np.all(np.diag(inverse) > 0):
        raise DataError(NOT_SETTLED)
    inverse = (inverse + inverse.T) / 2
    found = inverse @ right
    # Pose parameters may be so alike that the inverse has few digits; the residual restores them.
    for _ in range(6):
        found += inverse @ (right - full @ found)
    return inverse, found


def _upper_variances(sizes: FloatArray, unknown: FloatArray, group: IntArray) -> FloatArray:
    """Return the upper 85 % bounds of the variances ``sizes`` (k,) of the terms.

    unknown: share of each term that the data leave open (k,). For the ν terms that determine the
    variance of a group the bound is ν/χ²(ν, 15 %) of it, by Wilson and Hilferty's approximation. A
    power law through the other orders counts as 2/v terms, with v the variance of its logarithm,
    or as fewer if the order departs from it by more than chance.
    """
    upper = sizes.copy()
    # Noise hides terms of all orders, so those seen count in units of the best seen.
    seen = (1 - unknown) / max(float(np.max((1 - unknown)[group != _RINGS], initial=0.0)), 1e-3)
    for each in np.unique(group):
        chosen = group == each
        known, log = float(np.sum(1 - unknown[chosen])), np.log(sizes[chosen])
        others = ~chosen & (group != _RINGS)
        if each != _RINGS and np.any(others):
            terms = max(float(np.sum(seen[chosen])), 1e-3)
            law, variance = _power_law(sizes[others], seen[others], group[others] / each)
            by_law = 2 / max(variance, float(np.max(log - law)) ** 2 - 2 / terms)
            log = (terms * log + by_law * law) / (terms + by_law)
            known += by_law
        spread = 2 / (9 * max(known, 1.0))
        upper[chosen] = np.exp(log) * (1 - spread - _QUANTILE * np.sqrt(spread)) ** -3
    # A conic constant hides the lowest rings, which are as high as other form of their order.
    return np.where(group == _RINGS, np.maximum(upper, np.max(upper[group == 4], initial=0)), upper)


def _power_law(sizes: FloatArray, seen: FloatArray, order: FloatArray) -> tuple[float, float]:
    """Return the logarithm at order 1 of a power law through ``sizes`` (k,), and its variance.

    A term has the Fisher information seen²/2 about the logarithm of its variance.
    """
    columns = np.stack([np.ones_like(order), -2 * np.log(order)])
    weighted, prior = columns * seen**2 / 2, np.array([0.0, _FALL_ERROR**-2])
    first = np.linalg.inv(weighted @ columns.T + np.diag([1e-9, prior[1]]))[0]
    return float(first @ (weighted @ np.log(sizes) + _FALL * prior)), float(first[0])


def _sizes(form: FloatArray, unknown: FloatArray, least: FloatArray, group: IntArray) -> FloatArray:
    """Return the variance of each term (k,) by group, none below that of a higher order.

    They fall with ``n**-_STEEPEST`` at most, because a shift of an asphere looks like coma: trefoil
    alone must not bound the coma.  unknown: share of each term that the data leave open (k,)
    """
    new, above, before = np.empty_like(form), 0.0, 0
    for each in np.unique(group)[::-1]:
        chosen = group == each
        known, total = float(np.sum(1 - unknown[chosen])), float(np.sum(form[chosen] ** 2))
        value = total / max(known, 1e-3)
        if above and each != _RINGS and known < 1:
            # Data that show less than a term do not show more than the next order lets expect.
            usual = above * (before / each) ** (2 * _FALL)
            value = min(value, total + (1 - known) * usual)
        value = max(value, float(least[chosen].max()))
        if each != _RINGS:
            value = above = max(value, above)
            before = each
        new[chosen] = value
    ratio = group / group[:, np.newaxis]
    lower = np.where(ratio <= 1, ratio, 0.0) ** (2 * _STEEPEST)
    return np.where(group == _RINGS, new, np.max(lower * new, axis=1))


def outlier_limit(residual: FloatArray) -> float:
    """Return the distance [m] from the smooth form beyond which a point is an outlier.

    Outliers are rare: steps or a coarse resolution affect more than 5 % of the points.
    """
    common = float(np.quantile(np.abs(residual), 1 - _MOST_DUST))
    return max(OUTLIER_SIGMAS * statistics.spread(residual), _BEYOND_COMMON * common, LEAST_LIMIT_M)


def best_matching_sum(
    columns: FloatArray, deviation: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray, FloatArray]:
    """Return the fit of ``columns`` (q, n) to the ``deviation`` (n,) [m] without its outliers.

    Coefficients (q,), residual (n,) [m], which points are within its outlier limit (n,), and
    products of the columns over these (q, q).

    The fit is free of any prior, because the residual of a large step or of an unknown form is
    neither noise nor an outlier.
    """
    scale = np.sqrt(np.mean(columns**2, axis=1))
    scale[scale == 0] = 1.0
    gram = whole = columns @ columns.T
    near = np.ones(len(deviation), np.bool_)
    for _ in range(_DUST_PASSES):
        right = columns @ np.where(near, deviation, 0.0) / scale
        values, ways = np.linalg.eigh(gram / np.outer(scale, scale))
        sums = ways.T @ right / np.maximum(values, _ROUNDING * values[-1])
        most = _MOST_CANCELLED * np.sqrt(np.mean(deviation[near] ** 2))
        known = (values > _ROUNDING * values[-1]) & (np.abs(sums) <= most)
        fitted = np.asarray(ways @ np.where(known, sums, 0.0) / scale)
        residual = deviation - fitted @ columns
        before, near = near, np.abs(residual) <= outlier_limit(residual)
        if np.array_equal(before, near):
            break
        # Few are beyond the limit: to take them off is less work than to copy all others.
        far = columns[:, ~near]
        gram = whole - far @ far.T
    return fitted, residual, near, gram
