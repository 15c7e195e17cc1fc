"""Fit Zernike polynomials to scattered points, with their covariance.

Normal equations, gathered in portions that fit the processor's cache, are solved by Cholesky: an
equilibrated Gram matrix of condition 10⁶ leaves ten digits. Where the points cover too little of
the disc to separate the terms, the highest orders are left out.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import comb

import numpy as np

from omsm_ros.core.streams.blocks import FloatArray, IntArray
from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.core.surface.zernike_terms import ZernikeIndex, zernike_values
from omsm_ros.errors import DataError

# Half-width of the band about the middle in which positions do not count as crossed, over the span.
_NEAR_MIDDLE = 0.05
# Least points of a pass and passes of a path; points in random order cross every fourth point.
_LEAST_POINTS, _LEAST_PASSES = 16, 8
# Points at a time: 37 terms of them fit a cache of 2.5 MB; all at once take three times as long.
CHUNK = 8192
# Largest condition number of the Gram matrix, which leaves ten digits.
_WORST_CONDITION = 1e6
# Successive points whose errors may be correlated, on paths without passes.
_GROUP, _LEAST_GROUPS = 128, 4
# Order of differences over passes: of a wave of sixteen passes 1/400 remains, of noise all.
DIFFERENCES = 4
# Sums over groups with a smaller share of the variance of single points are rounding.
_ROUNDING = 1e-12
# Terms of the series 1 / (1 − h) in the share h, about a tenth, of a group in the fit.
_FOLLOWED = 2


def passes(x: FloatArray, y: FloatArray) -> IntArray | None:
    """Return the first point of each pass of the path x, y (n,), (g,), beginning with zero.

    A pass is a turn of a spiral or two lines of a raster: from one upward crossing of the middle to
    the next, along the axis that has more of them. None for fewer than eight passes, or points that
    follow no path.
    """
    crossed = max(_crossings(x), _crossings(y), key=len)
    if len(crossed) < 2:
        return None
    # The passes begin with the first point, so that only the last is incomplete.
    begins = np.append(crossed, 2 * crossed[-1] - crossed[-2]) - crossed[0]
    begins = begins[begins < len(x)]
    enough = len(begins) >= _LEAST_PASSES and len(x) >= _LEAST_POINTS * len(begins)
    return begins if enough else None


def _crossings(position: FloatArray) -> IntArray:
    """Return the points (g,) at which ``position`` (n,) crosses its middle upwards."""
    low, high = float(position.min()), float(position.max())
    middle, near = (low + high) / 2, _NEAR_MIDDLE * (high - low)
    outside = np.flatnonzero(np.abs(position - middle) > near)
    above = position[outside] > middle
    return np.asarray(outside[1:][above[1:] & ~above[:-1]], np.int64)


@dataclass(frozen=True, eq=False)
class ZernikeFit:
    """Coefficients (k,) [m] of ``terms``, each one at the rim of ``disc``.

    covariance: from scatter about the fit and form that the path does not resolve (k, k) [m²]
    left_out: terms that the points do not separate
    effects: coefficients of the error effects (k, e) [m]
    """

    disc: Aperture
    terms: tuple[ZernikeIndex, ...]
    coefficients: FloatArray
    covariance: FloatArray
    left_out: tuple[ZernikeIndex, ...]
    effects: FloatArray

    @property
    def uncertainty(self) -> FloatArray:
        """Standard uncertainty of each coefficient (k,) [m], from scatter and all effects."""
        variance = np.diag(self.covariance) + np.sum(self.effects**2, axis=1)
        return np.asarray(np.sqrt(variance), np.float64)

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the sum of the terms [m] at x, y (n,) [m]."""
        made = np.empty(len(x))
        for begin in range(0, len(x), CHUNK):
            chunk = slice(begin, begin + CHUNK)
            u, v = self.disc.scaled(x[chunk], y[chunk])
            made[chunk] = self.coefficients @ zernike_values(u, v, self.terms)
        return made


def fit_zernikes(
    x: FloatArray,
    y: FloatArray,
    deviation: FloatArray,
    terms: Sequence[ZernikeIndex],
    disc: Aperture,
    *,
    weights: FloatArray | None = None,
    effects: FloatArray | None = None,
    condition: float = _WORST_CONDITION,
) -> ZernikeFit:
    """Fit ``terms`` to ``deviation`` [m] at x, y [m] of the part, each (n,), by least squares.

    weights: area of each point (n,), None for equal weights
    effects: of errors on the deviations (e, n) [m], fitted in the same way
    condition: largest condition number of the terms; with a larger one the highest are left out

    The covariance includes errors that are correlated over a pass of the path. Raises DataError
    for fewer than two points a term, or points that determine no term.
    """
    if len(x) < max(2 * len(terms), 8):
        raise DataError(
            "form.few_points_for_terms",
            points=len(x),
            terms=len(terms),
            least=max(2 * len(terms), 8),
        )
    more = np.empty((0, len(x))) if effects is None else effects
    values = np.concatenate([deviation[np.newaxis], more])
    gram, right = _normal_equations(x, y, values, terms, disc, weights)
    kept = separable(gram, terms, condition)
    gram, right = gram[np.ix_(kept, kept)], right[kept]
    used = tuple(terms[k] for k in kept)
    scale = 1 / np.sqrt(np.diag(gram))
    root = np.linalg.cholesky(gram * np.outer(scale, scale))
    inverse = np.linalg.inv(root) * scale
    inverse = inverse.T @ inverse
    found = scale[:, np.newaxis] * np.linalg.solve(
        root.T, np.linalg.solve(root, scale[:, np.newaxis] * right)
    )
    scores = _scores(x, y, deviation, found[:, 0], used, disc, weights, inverse)
    return ZernikeFit(
        disc=disc,
        terms=used,
        coefficients=found[:, 0],
        covariance=_with_variance_floor(*(inverse @ each @ inverse for each in scores)),
        left_out=tuple(t for t in terms if t not in used),
        effects=found[:, 1:],
    )


def _normal_equations(
    x: FloatArray,
    y: FloatArray,
    values: FloatArray,
    terms: Sequence[ZernikeIndex],
    disc: Aperture,
    weights: FloatArray | None,
) -> tuple[FloatArray, FloatArray]:
    gram, right = np.zeros((len(terms), len(terms))), np.zeros((len(terms), len(values)))
    for begin in range(0, len(x), CHUNK):
        chunk = slice(begin, begin + CHUNK)
        columns = zernike_values(*disc.scaled(x[chunk], y[chunk]), terms)
        weighted = columns if weights is None else columns * weights[chunk]
        gram += weighted @ columns.T
        right += weighted @ values[:, chunk].T
    return gram, right


def separable(gram: FloatArray, terms: Sequence[ZernikeIndex], condition: float) -> list[int]:
    """Return the indices of the terms up to the highest order that is well conditioned."""
    for order in range(max(t.n for t in terms), -1, -1):
        kept = [k for k, t in enumerate(terms) if t.n <= order]
        own = np.diag(gram)[kept]
        if np.all(own > 0):
            scale = 1 / np.sqrt(own)
            values = np.linalg.eigvalsh(gram[np.ix_(kept, kept)] * np.outer(scale, scale))
            if values[0] > 0 and values[-1] / values[0] < condition:
                return kept
    raise DataError("form.no_term")


def _scores(
    x: FloatArray,
    y: FloatArray,
    deviation: FloatArray,
    coefficients: FloatArray,
    terms: Sequence[ZernikeIndex],
    disc: Aperture,
    weights: FloatArray | None,
    inverse: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return the covariance (k, k) of columns times residual, by groups and by single points.

    Groups are passes of the path. Where the path resolves form that the terms do not describe, the
    sums over passes vary smoothly, and their fourth differences show the errors alone (systematic
    samples: K. Wolter, Introduction to Variance Estimation, 2007, ch. 8). Without passes, groups
    are successive points with correlated errors.

    inverse: of the Gram matrix (k, k). The fit follows the errors of each group in part; the
    residuals are therefore those from the fit to all other groups (delete-a-group jackknife;
    R. Bell, D. McCaffrey, Surv. Methodol. 28, 169).
    """
    begins, differences = passes(x, y), DIFFERENCES
    if begins is None:
        size = _GROUP if len(x) >= _GROUP * _LEAST_GROUPS * len(terms) else 1
        begins, differences = np.arange(0, len(x), size), 0
    ends = np.append(begins[1:], len(x))
    sums, single = np.empty((len(terms), len(begins))), np.zeros((len(terms), len(terms)))
    first = 0
    while first < len(begins):
        # A portion holds as many whole groups as fit the cache.
        last = max(int(np.searchsorted(ends, begins[first] + CHUNK, "right")), first + 1)
        chunk, groups = slice(begins[first], ends[last - 1]), slice(first, last)
        columns = zernike_values(*disc.scaled(x[chunk], y[chunk]), terms)
        residual = deviation[chunk] - coefficients @ columns
        weighted = columns if weights is None else columns * weights[chunk]
        products = weighted * residual
        rough = residual
        if differences and len(residual) > 2:  # the noise along the path
            rough = np.pad(np.diff(residual, 2) / np.sqrt(6), 1, "edge")
        alone = weighted * rough
        single += alone @ alone.T
        sizes = ends[groups] - begins[groups]
        sums[:, groups] = _group_sums(products, columns, weighted, inverse, sizes)
        first = last
    scatter = np.diff(sums, differences, axis=1) / np.sqrt(comb(2 * differences, differences))
    count = max(scatter.shape[1], 2)
    # The sum over all groups is zero, so that without differences one group is not independent.
    free = count if differences else count - 1
    dof = max(1 - len(terms) / len(x), 1e-3)
    return scatter @ scatter.T * len(begins) / free / dof, single / dof


def _group_sums(
    products: FloatArray,
    columns: FloatArray,
    weighted: FloatArray,
    inverse: FloatArray,
    sizes: IntArray,
) -> FloatArray:
    """Return sums of ``products`` (k, n) over groups (k, g), for the fit to all other groups.

    sizes: points of each group (g,)
    """
    begins = np.cumsum(sizes) - sizes
    followed = np.add.reduceat(products, begins, axis=1)
    sums = followed
    for _ in range(_FOLLOWED):
        along = np.sum(np.repeat(inverse @ followed, sizes, axis=1) * columns, axis=0)
        followed = np.add.reduceat(weighted * along, begins, axis=1)
        sums = sums + followed
    return np.asarray(sums, np.float64)


def _with_variance_floor(covariance: FloatArray, floor: FloatArray) -> FloatArray:
    """Return the covariance (k, k) with its variances raised to those of ``floor``.

    Few groups lie at the rim, where the estimate from groups may be too small by chance.
    """
    own, least = np.diag(covariance), np.diag(floor)
    scatters = own > _ROUNDING * least
    ratio = np.where(scatters, np.maximum(least / np.where(scatters, own, 1.0), 1.0), 0.0)
    more = np.sqrt(ratio)
    raised = covariance * np.outer(more, more) + np.diag(np.where(scatters, 0.0, least))
    return np.asarray(raised, np.float64)
