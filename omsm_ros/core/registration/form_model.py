"""A fit beside which the part may have form errors that nobody knows.

A part is never what it should be. Its form error of low order looks, in part, like a part that sits
elsewhere: on an off-axis paraboloid 10 µm of shift make what 100 nm of astigmatism make. Least
squares would call all of it shift, and state a hundredth of its error. Here the data are

    d = J δ + Z c + noise,   c_k ~ N(0, σ_g²)

J the freedoms of the fit, within what a part may be off by that was put on by hand, and Z
polynomials of orders 2 to 8, whose sizes σ_g, one for each order, are found from the data
themselves by restricted maximum likelihood (D. MacKay, Neural Comput. 4, 415; the fixed point of
its eq. 4.9). Form falls with order: no order
may have less than a higher one, and a size found from few terms may be that of a lucky part: it is
taken as large as six of seven parts would have it. So a shift is read off those orders in which
this part is good, and its uncertainty holds what the others may have. Dust is what lies far from
any sum of the columns.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from omsm_ros.core.registration.placement import Aperture
from omsm_ros.core.streams import statistics
from omsm_ros.core.streams.blocks import FloatArray, IntArray
from omsm_ros.core.surface.zernike_terms import ZernikeIndex, rms_of, terms_up_to, zernike_values
from omsm_ros.errors import DataError

HIGHEST_ORDER = 8
NOT_SETTLED = (
    "the pose does not settle: on these points it and the part's form look alike; check the "
    "surface's parameters, the sign of its radii and the units of the cloud, or hold what need not "
    "be fitted, as --fit piston,tip,tilt"
)
_TERMS: tuple[ZernikeIndex, ...] = terms_up_to(HIGHEST_ORDER)
_SCALE = np.array([1 / rms_of(term) for term in _TERMS])
# Of its size: a term of which less is new on these points is left out.
_LEAST_NEW = 1e-4
# A turned part has rings of their own size: symmetric terms from the fourth order on are apart.
_RINGS = HIGHEST_ORDER + 1
_ORDERS = np.array([term.n for term in _TERMS])
_GROUPS = np.array([_RINGS if t.m == 0 and t.n > 2 else t.n for t in _TERMS])
# Of the products of all terms over the area: one where it is a disc. One whose rim is missing over
# a hundredth of the radius has two.
_NEARLY_A_DISC = 10.0
# Of the variances. A part settles in 8 to 40 turns.
_TURNS, _SETTLED = 300, 1e-3
# Sizes of optical figure errors fall with the second to fourth power of their order.
_STEEPEST = 4
# Beneath a picometre a form error is of no interest, and a variance of zero has no inverse; nor
# beneath a tenth of the variance that noise leaves of a term, for nothing could show it.
_LEAST_M = 1e-12
_LEAST_SHARE = 0.1
# No measurement knows a term better, however many points it has; and beyond it what separates form
# from pose, a billionth of their products, drowns in rounding.
_BEST_KNOWN_M = 1e-11
# Ten times what is left after a plain fit: most of the form may have gone into the pose.
_MOST_SHARE = 100.0
# Of the normal distribution at 15 %. With it 95 % bands held the truth in 93 to 100 % of simulated
# parts with spectra from n⁻² to n⁻⁶, or with single terms; with 20 %, in 90 to 100 %.
_QUANTILE = 1.0364
# Of one in a million points of Gaussian noise; texture has shorter tails.
OUTLIER_SIGMAS = 5.0
# What more than one point of twenty does is the part, with a fifth to spare.
_MOST_DUST, _BEYOND_COMMON = 0.05, 1.2
# Beneath it nothing is dust: a nominal surface against itself leaves rounding.
LEAST_LIMIT_M = 1e-12
# The first fit has dust in it, the second hardly any.
_DUST_PASSES = 3
# Of a full step, so that thirty of them still arrive.
_LEAST_RELAXED = 0.1

# Consecutive points whose errors may hang together.
GROUP = 128


@dataclass(frozen=True, eq=False)
class FormBasis:
    """Polynomials of orders 2 to 8: on a disc Zernike's, on a strip, a ring or a square those that
    are orthonormal over it, and to piston and tilts, made of Zernike's in their order.

    disc: they are made on;  mix: of all Zernike terms up to order 8 (k, 45);  group: order (k,)
    """

    disc: Aperture
    mix: FloatArray
    group: IntArray

    @classmethod
    def over(cls, x: FloatArray, y: FloatArray, area: FloatArray, disc: Aperture) -> FormBasis:
        """Return those of the area that points at x, y [m] stand for, each (n,).

        Raises DataError for points at so few places that no form could show.
        """
        values = _zernikes(disc, x, y)
        gram = (values * (area / area.sum())) @ values.T
        if np.linalg.cond(gram) < _NEARLY_A_DISC:
            return cls(disc, np.eye(len(_TERMS))[_ORDERS >= 2], _GROUPS[_ORDERS >= 2])
        rows: list[FloatArray] = []
        groups: list[int] = []
        for place in range(len(_TERMS)):
            row = np.eye(len(_TERMS))[place]
            for _ in range(2):  # once more takes away what rounding has left
                for other in rows:
                    row = row - (other @ gram @ row) * other
            new = float(row @ gram @ row)
            if new > _LEAST_NEW**2 * gram[place, place]:
                rows.append(row / np.sqrt(new))
                groups.append(int(_GROUPS[place]))
        form = np.array(groups) >= 2
        if not np.any(form):
            raise DataError(
                "the points lie at so few places that no form shows; measure across the part"
            )
        return cls(disc, np.array(rows)[form], np.array(groups)[form])

    def __len__(self) -> int:
        return len(self.group)

    def columns(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the polynomials (k, n) at x, y (n,) [m], each of rms one over the area."""
        return np.asarray(self.mix @ _zernikes(self.disc, x, y), np.float64)


def _zernikes(disc: Aperture, x: FloatArray, y: FloatArray) -> FloatArray:
    return np.asarray(zernike_values(*disc.scaled(x, y), _TERMS) * _SCALE[:, np.newaxis])


@dataclass(eq=False)
class FormNormalEquations:
    """Of columns with each other, with the deviation and with ``sources`` systematic effects.

    points: how many came;  square, total: sums of their squared residuals and deviations [m²]
    gram: (columns, columns + 1 + sources)
    scores: of each column, the sum over groups of 128 successive points of the squared sum of its
        products with the residual, which shows errors that hang together
    """

    columns: int
    sources: int
    points: int = 0
    square: float = 0.0
    total: float = 0.0
    gram: FloatArray = field(init=False)
    scores: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        self.gram = np.zeros((self.columns, self.columns + 1 + self.sources))
        self.scores = np.zeros(self.columns)

    def add(self, columns: FloatArray, deviation: FloatArray, systematic: FloatArray,
            residual: FloatArray) -> None:  # fmt: skip
        """Take in the next points: columns (q, n), the others (n,), (s, n), (n,)."""
        right = np.concatenate([columns, deviation[np.newaxis], systematic])
        self.gram += columns @ right.T
        self.points += len(deviation)
        self.square += float(residual @ residual)
        self.total += float(deviation @ deviation)
        edges = np.arange(0, len(residual), GROUP)
        if len(edges):
            self.scores += np.sum(np.add.reduceat(columns * residual, edges, axis=1) ** 2, axis=1)


class Estimate(NamedTuple):
    """step: δ (p,) in the unit of the columns;  form: c (k,) [m rms];  covariance: of both
    sizes: σ_g of each term (k,) [m];  likely: covariance of the step where no size is bad luck
    """

    step: FloatArray
    form: FloatArray
    covariance: FloatArray
    sizes: FloatArray
    noise: float
    likely: FloatArray

    @property
    def length(self) -> float:
        """Return how long the step is, in its own standard uncertainty."""
        free = len(self.step)
        spread = np.sqrt(np.diag(self.covariance)[:free])
        shared = self.covariance[:free, :free] / np.outer(spread, spread)
        inverse = np.linalg.pinv(shared, rcond=1e-14, hermitian=True)
        step = self.step / spread
        return float(np.sqrt(max(step @ inverse @ step, 0.0)))


def estimate(
    gram: FloatArray,
    moments: FloatArray,
    variance: float,
    largest: float,
    group: IntArray,
    expected: tuple[FloatArray, FloatArray],
) -> Estimate:
    """Return the estimate from the normal equations of columns [J, Z].

    gram: (p + k, p + k);  moments: columns times data (p + k,) [m]
    variance: of the noise of one point, as it averages out [m²]
    largest: mean square of the data [m²], which bounds what form there may be
    group: of each column of Z (k,): its order, or that of rings
    expected: where the freedoms stand, and standard deviation of where parts do, about zero (p,)
    """
    dofs = len(gram) - len(group)
    scale = np.sqrt(np.maximum(np.diag(gram), np.finfo(np.float64).tiny))
    scale[dofs:] = 1.0
    points = float(np.median(np.diag(gram)[dofs:]))
    noise = max(variance, _LEAST_M**2, points * _BEST_KNOWN_M**2)
    normal, right = gram / np.outer(scale, scale) / noise, moments / scale / noise
    value, spread = expected[0] * scale[:dofs], expected[1] * scale[:dofs]
    normal[np.arange(dofs), np.arange(dofs)] += 1 / spread**2
    right[:dofs] -= value / spread**2
    least = np.maximum(_LEAST_SHARE / np.diag(normal)[dofs:], _LEAST_M**2)
    sizes = np.maximum(largest, least)
    for _ in range(_TURNS):
        covariance = _inverse(normal, sizes, dofs)
        found = covariance @ right
        unknown = np.diag(covariance)[dofs:] / sizes
        new = _sizes(found[dofs:], unknown, least, group)
        new = np.clip(new, least, np.maximum(_MOST_SHARE * largest, least))
        change = float(np.max(np.abs(np.log(new / sizes))))
        sizes = new
        if change < _SETTLED:
            break
    likely = covariance[:dofs, :dofs]
    sizes = sizes * _variance_upper_factor(np.diag(covariance)[dofs:] / sizes, group)
    covariance = _inverse(normal, sizes, dofs)
    found = covariance @ right / scale
    return Estimate(
        step=found[:dofs],
        form=found[dofs:],
        covariance=covariance / np.outer(scale, scale),
        sizes=np.sqrt(sizes),
        noise=noise,
        likely=likely / np.outer(scale, scale)[:dofs, :dofs],
    )


def _inverse(normal: FloatArray, sizes: FloatArray, dofs: int) -> FloatArray:
    full = normal.copy()
    index: IntArray = np.arange(dofs, len(full))
    full[index, index] += 1 / sizes
    root = 1 / np.sqrt(np.diag(full))
    try:
        inverse = np.linalg.inv(full * np.outer(root, root)) * np.outer(root, root)
    except np.linalg.LinAlgError as err:
        raise DataError(NOT_SETTLED) from err
    # Where pose and form are all but one, rounding leaves variances below zero.
    if not np.all(np.diag(inverse) > 0):
        raise DataError(NOT_SETTLED)
    return np.asarray((inverse + inverse.T) / 2, np.float64)


def _variance_upper_factor(unknown: FloatArray, group: IntArray) -> FloatArray:
    """Return by how much each variance (k,) may be larger than it was found, in one of seven parts.

    unknown: share of each term that the data leave open (k,). The factor is ν/χ²(ν, 15 %), by
    Wilson and Hilferty's approximation, for the ν terms that a group's size was found from.
    """
    factor = np.ones_like(unknown)
    for each in np.unique(group):
        chosen = group == each
        known = max(float(np.sum(1 - unknown[chosen])), 1.0)
        factor[chosen] = (1 - 2 / (9 * known) - _QUANTILE * np.sqrt(2 / (9 * known))) ** -3
    return factor


def _sizes(form: FloatArray, unknown: FloatArray, least: FloatArray, group: IntArray) -> FloatArray:
    """Return the variance of each term (k,) by its group, none below that of a higher one.

    unknown: share of each term that the data leave open (k,)
    """
    new, above = np.empty_like(form), 0.0
    for each in (_RINGS, *range(HIGHEST_ORDER, 1, -1)):
        chosen = group == each
        if not np.any(chosen):
            continue
        known = max(float(np.sum(1 - unknown[chosen])), 1e-3)
        value = max(float(np.sum(form[chosen] ** 2)) / known, float(least[chosen].max()))
        if each != _RINGS:
            value = above = max(value, above)
        new[chosen] = value
    return _monotone_variances(new, group)


def _monotone_variances(sizes: FloatArray, group: IntArray) -> FloatArray:
    """Return the variances (k,), none falling steeper with order than parts do.

    A shift of an asphere is coma and nothing else: what coma there may be cannot be read off
    trefoil alone.
    """
    held, below = sizes.copy(), 0.0
    for each in range(2, HIGHEST_ORDER + 1):
        chosen = group == each
        below *= ((each - 1) / each) ** (2 * _STEEPEST)
        if np.any(chosen):
            below = max(below, float(held[chosen].max()))
            held[chosen] = below
    return held


def outlier_limit(residual: FloatArray) -> float:
    """Return the distance [m] from the smooth form beyond which a point is dust.

    Dust is rare: what more than one point of twenty does, steps or a coarse reading, is the part.
    """
    common = float(np.quantile(np.abs(residual), 1 - _MOST_DUST))
    return max(OUTLIER_SIGMAS * statistics.spread(residual), _BEYOND_COMMON * common, LEAST_LIMIT_M)


def best_matching_sum(columns: FloatArray, deviation: FloatArray) -> tuple[FloatArray, float]:
    """Return the sum (q,) of ``columns`` (q, n) that is most like, and how far from it is dust [m].

    Without bounds on any column: what the pose leaves after a step that was not small, or a form
    that is not known yet, is neither noise nor dust.
    """
    scale = np.sqrt(np.mean(columns**2, axis=1))
    scale[scale == 0] = 1.0
    columns = columns / scale[:, np.newaxis]
    limit, residual, fitted = np.inf, deviation, np.zeros(len(columns))
    for _ in range(_DUST_PASSES):
        chosen = np.abs(residual) <= limit
        near = columns[:, chosen]
        solve = np.linalg.pinv(near @ near.T, rcond=1e-12, hermitian=True)
        fitted = np.asarray(solve @ (near @ deviation[chosen]), np.float64)
        residual = deviation - fitted @ columns
        limit = outlier_limit(residual)
        if np.array_equal(np.abs(residual) <= limit, chosen):
            break
    return fitted / scale, limit


def relaxation_factor(share: float, last: FloatArray, step: FloatArray) -> float:
    """Return the share of a ``step`` (p,) to take, after ``share`` of the one before it.

    Where form and pose look alike, a whole step overshoots: what form there may be follows the
    pose (Aitken's relaxation; B. Irons, R. Tuck, Int. J. Numer. Meth. Eng. 1, 275).
    """
    change = last - step
    square = float(change @ change)
    if not np.any(last) or square == 0:
        return 1.0
    return float(np.clip(share * float(last @ change) / square, _LEAST_RELAXED, 1.0))
