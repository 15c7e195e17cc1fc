"""Zernike polynomials of scattered points, with their covariance.

Normal equations in portions that stay in the processor's cache, solved by Cholesky once they are
found well conditioned: an equilibrated Gram matrix of condition κ costs κ times the rounding of a
float, so that 10⁶ leaves ten digits. Where the points cover too little of the disc to
separate the terms, those of highest order are left out, and are not evaluated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import comb

import numpy as np

from omsm_ros.core.registration.placement import Aperture
from omsm_ros.core.streams.blocks import FloatArray, IntArray
from omsm_ros.core.surface.zernike_terms import ZernikeIndex, zernike_values
from omsm_ros.errors import DataError

# Where does a path come past its own neighbourhood again: turns of a spiral, lines of a raster?

# Of the span, on either side of its middle: what jitters there has not passed it.
_NEAR_MIDDLE = 0.05
# Points in no order pass the middle every fourth point.
_LEAST_POINTS, _LEAST_PASSES = 16, 8


def passes(x: FloatArray, y: FloatArray) -> IntArray | None:
    """Return where each pass of the path x, y (n,) begins, (g,), the first at zero.

    A pass is from one upward crossing of the middle to the next, along the axis that has more of
    them. None for fewer than eight, or points that follow no path.
    """
    crossed = max(_crossings(x), _crossings(y), key=len)
    if len(crossed) < 2:
        return None
    # From the first point on, so that no pass but the last is a part of one.
    begins = np.append(crossed, 2 * crossed[-1] - crossed[-2]) - crossed[0]
    begins = begins[begins < len(x)]
    enough = len(begins) >= _LEAST_PASSES and len(x) >= _LEAST_POINTS * len(begins)
    return begins if enough else None


def _crossings(position: FloatArray) -> IntArray:
    """Return the points (g,) at which ``position`` (n,) has come from below to above its middle."""
    low, high = float(position.min()), float(position.max())
    middle, near = (low + high) / 2, _NEAR_MIDDLE * (high - low)
    off_middle = np.flatnonzero(np.abs(position - middle) > near)
    above = position[off_middle] > middle
    return np.asarray(off_middle[1:][above[1:] & ~above[:-1]], np.int64)


# Points at a time: 37 terms of them stay in a cache of 2.5 MB; all at once take thrice as long.
CHUNK = 8192
# Ten digits are left, more than any of them is worth.
_WORST_CONDITION = 1e6
# Consecutive points whose errors may hang together, where they follow no path with passes.
_GROUP, _LEAST_GROUPS = 128, 4
# Of sums over passes: a wave of sixteen passes leaves a four-hundredth, noise all of itself.
_DIFFERENCES = 4
# Of the variance of single points: sums over groups that cancel to less scatter by rounding alone.
_ROUNDING = 1e-12
# Terms of the series 1 / (1 − h) in the share h that a group has of the fit, some tenth.
_FOLLOWED = 2


@dataclass(frozen=True, eq=False)
class ZernikeFit:
    """Coefficients (k,) [m] of ``terms``, each one at the rim of ``disc``.

    covariance: from the scatter of the points about the fit, and form that they do not resolve
        (k, k) [m²]
    left_out: terms that the points do not separate
    effects: coefficients of the further deviations (k, e) [m]
    """

    disc: Aperture
    terms: tuple[ZernikeIndex, ...]
    coefficients: FloatArray
    covariance: FloatArray
    left_out: tuple[ZernikeIndex, ...]
    effects: FloatArray

    @property
    def uncertainty(self) -> FloatArray:
        """Standard uncertainty of each coefficient (k,) [m], by scatter and all effects."""
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
) -> ZernikeFit:
    """Fit ``terms`` to ``deviation`` [m] at x, y [m] of the part, each (n,), by least squares.

    weights: the area of each point (n,); None: every point alike
    effects: further deviations (e, n) [m] whose coefficients (k, e) are wanted of the same fit

    The covariance holds errors that hang together over a pass of the path, and form between passes
    that they do not resolve. Raises DataError for fewer points than terms, or points that determine
    no term.
    """
    if len(x) < max(2 * len(terms), 8):
        raise DataError(
            f"{len(x)} points for {len(terms)} Zernike terms, expected {max(2 * len(terms), 8)} or "
            "more; measure more points or ask for fewer terms"
        )
    more = np.empty((0, len(x))) if effects is None else effects
    values = np.concatenate([deviation[np.newaxis], more])
    gram, right = _normal_equations(x, y, values, terms, disc, weights)
    kept = _separable(gram, terms)
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


def _separable(gram: FloatArray, terms: Sequence[ZernikeIndex]) -> list[int]:
    """Return the places of the terms up to the highest order that is well conditioned."""
    for order in range(max(t.n for t in terms), -1, -1):
        kept = [k for k, t in enumerate(terms) if t.n <= order]
        own = np.diag(gram)[kept]
        if np.all(own > 0):
            scale = 1 / np.sqrt(own)
            values = np.linalg.eigvalsh(gram[np.ix_(kept, kept)] * np.outer(scale, scale))
            if values[0] > 0 and values[-1] / values[0] < _WORST_CONDITION:
                return kept
    raise DataError("the points determine no Zernike term; check the aperture and the weights")


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

    Groups are passes of the path. Form that the terms do not describe is no error where the path
    is close enough for it: then sums over passes follow a smooth course, and only what departs
    from it counts, by fourth differences (of systematic samples: K. Wolter, Introduction to
    Variance Estimation, 2007, ch. 8). Form between passes that none resolves departs, a whole
    pass long. Without passes, groups are of successive points, whose errors may hang together.

    inverse: of the Gram matrix (k, k). The fit follows each group's errors by the group's share of
    that matrix, so that its residuals are too small; they are taken as the fit to all other groups
    leaves them (delete-a-group jackknife; R. Bell, D. McCaffrey, Surv. Methodol. 28, 169).
    """
    begins, differences = _groups(x, y, len(terms))
    ends = np.append(begins[1:], len(x))
    sums, single = np.empty((len(terms), len(begins))), np.zeros((len(terms), len(terms)))
    first = 0
    while first < len(begins):
        # Whole groups, as many as stay in the cache.
        last = max(int(np.searchsorted(ends, begins[first] + CHUNK, "right")), first + 1)
        chunk, groups = slice(begins[first], ends[last - 1]), slice(first, last)
        columns = zernike_values(*disc.scaled(x[chunk], y[chunk]), terms)
        residual = deviation[chunk] - coefficients @ columns
        weighted = columns if weights is None else columns * weights[chunk]
        products = weighted * residual
        alone = weighted * _uncorrelated_residual(residual) if differences else products
        single += alone @ alone.T
        sizes = ends[groups] - begins[groups]
        sums[:, groups] = _group_sums(products, columns, weighted, inverse, sizes)
        first = last
    scatter = np.diff(sums, differences, axis=1) / np.sqrt(comb(2 * differences, differences))
    count = max(scatter.shape[1], 2)
    # The sum over all groups is zero: where they are taken as they are, one of them is not free.
    free = count if differences else count - 1
    dof = max(1 - len(terms) / len(x), 1e-3)
    return scatter @ scatter.T * len(begins) / free / dof, single / dof


def _uncorrelated_residual(residual: FloatArray) -> FloatArray:
    """Return what neighbours of a path do not share of the ``residual`` (n,), as large as noise."""
    if len(residual) < 3:
        return residual
    rough = np.diff(residual, 2) / np.sqrt(6)
    return np.asarray(np.concatenate([rough[:1], rough, rough[-1:]]), np.float64)


def _groups(x: FloatArray, y: FloatArray, terms: int) -> tuple[IntArray, int]:
    """Return where groups of points begin (g,), and how often sums over them are to be differenced.

    terms: how many are fitted
    """
    begins = passes(x, y)
    if begins is not None:
        return begins, _DIFFERENCES
    size = _GROUP if len(x) >= _GROUP * _LEAST_GROUPS * terms else 1
    return np.arange(0, len(x), size), 0


def _group_sums(
    products: FloatArray,
    columns: FloatArray,
    weighted: FloatArray,
    inverse: FloatArray,
    sizes: IntArray,
) -> FloatArray:
    """Return sums of ``products`` (k, n) over groups (k, g), as the fit to all others leaves them.

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
    """Return the covariance (k, k), no variance below that of the ``floor``.

    Few groups lie at the rim: by chance they may state far too little.
    """
    own, least = np.diag(covariance), np.diag(floor)
    scatters = own > _ROUNDING * least
    ratio = np.where(scatters, np.maximum(least / np.where(scatters, own, 1.0), 1.0), 0.0)
    more = np.sqrt(ratio)
    raised = covariance * np.outer(more, more) + np.diag(np.where(scatters, 0.0, least))
    return np.asarray(raised, np.float64)
