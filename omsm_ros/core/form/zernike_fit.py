"""Fit Zernike polynomials to scattered points, with their covariance.

Normal equations, gathered in portions that fit the processor's cache, are solved by Cholesky: an
equilibrated Gram matrix of condition 10⁶ leaves ten digits. Where the points cover too little of
the disc to separate the terms, the highest orders are left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import comb
from typing import NamedTuple

import numpy as np
import scipy  # whose parts are loaded when they are used
from numpy.typing import NDArray

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
# Width of the strip along the rim in which parabolas replace sums, and the largest distance of its
# points from the outline, in tracks; places along the rim, and nodes across the strip.
_STRIP, _REACH, _PLACES, _NODES = 4.0, 1.5, 480, 6
# Points of a parabola; weight of its curvatures, and the least singular value that counts.
_AROUND, _LEAST_CURVED, _LEAST_SPREAD = 24, 0.3, 1e-2


def passes(x: FloatArray, y: FloatArray) -> IntArray | None:
    """Return the first point of each pass of the path x, y (n,), (g,), beginning with zero.

    A pass is a turn of a spiral or two lines of a raster: from one upward crossing of the middle to
    the next, along the axis that has more of them. None for fewer than eight passes, or points that
    follow no path.
    """
    crossed = max(_crossings(x), _crossings(y), key=len)
    if len(crossed) < 2:
        return None
    # Passes about a gap may not cross it. They begin with the first point, so that only the last is
    # incomplete.
    first, last = crossed[1] - crossed[0], crossed[-1] - crossed[-2]
    more = np.arange(crossed[0] % first, crossed[0], first), np.arange(crossed[-1], len(x), last)
    begins = np.concatenate([more[0], crossed[:-1], more[1]]) - crossed[0] % first
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
    x: FloatArray, y: FloatArray, deviation: FloatArray, terms: Sequence[ZernikeIndex],
    disc: Aperture, *, weights: FloatArray | None = None, effects: FloatArray | None = None,
    condition: float = _WORST_CONDITION, strip: RimStrip | None = None,
    sums: tuple[FloatArray, FloatArray] | None = None,
) -> ZernikeFit:  # fmt: skip
    """Fit ``terms`` to ``deviation`` [m] at x, y [m] of the part, each (n,), by least squares.

    weights: area of each point (n,), None for equal weights
    effects: of errors on the deviations (e, n) [m], fitted in the same way
    condition: largest condition number of the terms; with a larger one the highest are left out
    strip: along the rim, for sums of the terms; form that no term describes is then continued from
        the last tracks to the outline
    sums: what :func:`normal_equations` returns for these terms and weights, if it is known

    The covariance includes errors that are correlated over a pass of the path. Raises DataError
    for fewer than two points a term, or points that determine no term.
    """
    if len(x) < (least := max(2 * len(terms), 8)):
        raise DataError("form.few_points_for_terms", points=len(x), terms=len(terms), least=least)
    if sums is None:
        values = deviation[np.newaxis] if effects is None else np.vstack([deviation, effects])
        sums = normal_equations(x, y, values, terms, disc, weights)
    gram, right = sums
    kept = separable(gram, terms, condition)
    gram, right = gram[np.ix_(kept, kept)], right[kept]
    used = tuple(terms[k] for k in kept)
    scale = 1 / np.sqrt(np.diag(gram))
    root = np.linalg.cholesky(gram * np.outer(scale, scale))
    inverse = np.linalg.inv(root) * scale
    inverse = inverse.T @ inverse
    half = np.linalg.solve(root, scale[:, np.newaxis] * right)
    found = scale[:, np.newaxis] * np.linalg.solve(root.T, half)
    scores = _scores(x, y, deviation, found[:, 0], used, disc, weights, inverse)
    fit = ZernikeFit(
        disc=disc,
        terms=used,
        coefficients=found[:, 0],
        covariance=_with_variance_floor(*(inverse @ each @ inverse for each in scores)),
        left_out=tuple(t for t in terms if t not in used),
        effects=found[:, 1:],
    )
    if strip is None:
        return fit
    rest = deviation[strip.points] - fit.height(x[strip.points], y[strip.points])
    more, errors = (inverse @ each[kept] for each in strip.missed(rest))
    covariance = fit.covariance + errors @ errors.T
    return replace(fit, coefficients=fit.coefficients + more, covariance=covariance)


class RimStrip(NamedTuple):
    """Difference of integrals along the rim, where the form is steep, from sums over points.

    Points there stand for the way to the outline, along which mid-spatial form changes. In a strip
    that fades inwards, integrals of parabolas through neighbouring points replace the sums. Half
    the difference to planes is a standard uncertainty, because the next order of a series is one
    that the points do not show; another is the noise of the parabolas.

    points: of the strip (s,)
    more: weights of the points in the integrals less those in the sums (k, s)
    open_: half the weights in the integrals of parabolas less those of planes (k, s)
    """

    points: IntArray
    more: FloatArray
    open_: FloatArray

    @classmethod
    def of(
        cls, places: FloatArray, weights: FloatArray, outline: Aperture, spacing: float,
        terms: Sequence[ZernikeIndex], disc: Aperture,
    ) -> RimStrip | None:  # fmt: skip
        """Return the strip for sums of ``terms`` on a ``disc``; None for a polygon or few points.

        places: x, y of the points (2, n) [m];  weights: of them (n,);  spacing: of the tracks [m]
        """
        if outline.outline == "polygon":
            return None
        outline = outline.disc if outline.outline == "annulus" else outline
        ends, rim = _around(outline)
        depth = _STRIP * spacing / float(np.hypot(*rim).min())
        size = outline.share_of_rim(*places)
        points = np.flatnonzero(size > 1 - 2 * depth)
        if depth >= 0.5 or len(points) < _AROUND:
            return None
        near_rim = places[:, points]
        # The nearest single points may lie on one track: means are half a track long.
        step = float(np.median(np.hypot(*np.diff(near_rim))))
        along = max(int(spacing / 2 / step), 1) if step else 1
        groups = near_rim[:, : len(points) // along * along].reshape(2, -1, along)
        together = np.max(np.ptp(groups, axis=2), axis=0) < spacing  # else a jump to another line
        u, v = np.mean(groups[:, together], axis=2)
        if len(u) < _AROUND:
            return None
        tree = scipy.spatial.cKDTree(np.column_stack([u, v]))
        middle = np.array([[outline.x], [outline.y]])
        # Steps along a track may be longer than the distance of the tracks.
        known = tree.query((rim + middle).T)[0] < _REACH * max(spacing, along * step)
        nodes, shares = np.polynomial.legendre.leggauss(_NODES)
        inwards = depth * (nodes + 1) / 2
        triangles = np.abs(ends[0, :-1] * ends[1, 1:] - ends[1, :-1] * ends[0, 1:]) / 2
        shares = (1 - inwards) * depth * shares * _fading(inwards / depth)
        at = (rim[:, :, np.newaxis] * (1 - inwards)).reshape(2, -1) + middle
        near = tree.query(at.T, _AROUND)[1]
        away = (u[near] - at[0, :, np.newaxis]) + 1j * (v[near] - at[1, :, np.newaxis])
        outwards = np.repeat(rim[0] - 1j * rim[1], _NODES)[:, np.newaxis]
        shares_of = continued(away * outwards / np.abs(outwards) / spacing)
        own = weights[points] * known[scipy.spatial.cKDTree((rim + middle).T).query(near_rim.T)[1]]
        # The points stand for the covered part of the outline only.
        covered = max(float(np.sum(triangles[known])), 1e-300) * (1 - (1 - 2 * depth) ** 2)
        area = np.outer(triangles * known * np.sum(own) / covered, shares).ravel()
        begins = np.arange(len(area) + 1) * _AROUND
        sums, columns = (zernike_values(*disc.scaled(*v), terms) for v in (near_rim, at))
        sums *= own * _fading((1 - size[points]) / depth)
        parabola, plane = np.zeros((2, *sums.shape))
        for made, share in zip((parabola, plane), shares_of, strict=True):
            rows = share.ravel(), near.ravel(), begins
            each = scipy.sparse.csr_array(rows, (len(area), len(u)))
            of_means = np.repeat(columns * area @ each / along, along, axis=1)
            made[:, np.flatnonzero(np.repeat(together, along))] = of_means
        return cls(points, parabola - sums, (parabola - plane) / 2)

    def missed(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what sums over ``values`` (s,) of the points miss (k,), and errors (k, 1 + s)."""
        noise = np.diff(values, 2).std() / np.sqrt(6)
        return self.more @ values, np.column_stack([self.open_ @ values, noise * self.more])


def _around(outline: Aperture) -> tuple[FloatArray, FloatArray]:
    """Return ends (2, q + 1) and middles (2, q) of parts of the outer rim [m], from its middle."""
    corners, middle = outline.rim(), np.array([[outline.x], [outline.y]])
    way = np.cumsum(np.hypot(*np.diff(corners, prepend=corners[:, :1])))
    at = np.linspace(0, way[-1], _PLACES + 1)
    ends = np.stack([np.interp(at, way, v) for v in corners])
    ends = (ends - middle) / outline.share_of_rim(*ends)
    rim = (ends[:, 1:] + ends[:, :-1]) / 2
    return ends, rim / outline.share_of_rim(*(rim + middle))


def continued(places: NDArray[np.complex128]) -> FloatArray:
    """Return shares of values in the parabola and the plane through them at each node (2, q, k).

    places: of the values from the node (q, k). Curvature that they do not show is zero.
    """
    u, v = places.real, places.imag
    curved = [_LEAST_CURVED * each for each in (u * u, u * v, v * v)]
    columns = np.stack([np.ones_like(u), u, v, *curved], axis=-1)
    gram = np.swapaxes(columns, 1, 2) @ columns
    found = []
    for kept in (6, 3):
        own = gram[:, :kept, :kept]
        ridge = _LEAST_SPREAD**2 * np.trace(own, axis1=1, axis2=2)[:, np.newaxis, np.newaxis]
        first = np.eye(kept)[:, :1]
        solved = np.linalg.solve(own + ridge * np.diag(np.arange(kept) > 0), first)
        found.append((columns[..., :kept] @ solved)[..., 0])
    return np.stack(found)


def _fading(inwards: FloatArray) -> FloatArray:
    """Return weights that fall smoothly from 1 at the rim, 0, to 0 at 1."""
    s = np.clip(inwards, 0.0, 1.0)
    return np.asarray(1 - s**3 * (10 - 15 * s + 6 * s**2))


def normal_equations(
    x: FloatArray, y: FloatArray, values: FloatArray, terms: Sequence[ZernikeIndex],
    disc: Aperture, weights: FloatArray | None,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Return the weighted products of the ``terms`` (k, k), and with the ``values`` (k, v)."""
    gram, right = np.zeros((len(terms), len(terms))), np.zeros((len(terms), len(values)))
    for begin in range(0, len(x), CHUNK):
        chunk = slice(begin, begin + CHUNK)
        columns = zernike_values(*disc.scaled(x[chunk], y[chunk]), terms)
        root = np.ones(len(x[chunk])) if weights is None else np.sqrt(weights[chunk])
        columns *= root
        gram += columns @ columns.T  # numpy takes half the time for an array with itself
        right += columns @ (values[:, chunk] * root).T
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
    x: FloatArray, y: FloatArray, deviation: FloatArray, coefficients: FloatArray,
    terms: Sequence[ZernikeIndex], disc: Aperture, weights: FloatArray | None, inverse: FloatArray,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Return the covariance (k, k) of columns times residual, by groups and by single points.

    Groups are passes of the path. Where the path resolves form that the terms do not describe, the
    sums over passes vary smoothly, and their fourth differences show the errors alone (systematic
    samples: K. Wolter, Introduction to Variance Estimation, 2007, ch. 8). The first and the last
    passes, which determine the form at the rim, are in few of them; single points show the rest.
    Without passes, groups are successive points with correlated errors.

    inverse: of the Gram matrix (k, k). The fit follows the errors of each group in part; the
    residuals are therefore those from the fit to all other groups (delete-a-group jackknife;
    R. Bell, D. McCaffrey, Surv. Methodol. 28, 169).
    """
    begins, differences = passes(x, y), DIFFERENCES
    if begins is None:
        size = _GROUP if len(x) >= _GROUP * _LEAST_GROUPS * len(terms) else 1
        begins, differences = np.arange(0, len(x), size), 0
    ends = np.append(begins[1:], len(x))
    sums, (single, missed) = np.empty((len(terms), len(begins))), np.zeros((2, *inverse.shape))
    binomial = np.array([comb(differences, k) for k in range(differences + 1)])
    squares = binomial**2 / comb(2 * differences, differences)
    # Share of the square of each sum that the differences contain.
    shown = np.convolve(np.ones(len(begins) - differences), squares)
    first = 0
    while first < len(begins):
        # A portion holds as many whole groups as fit the cache.
        last = max(int(np.searchsorted(ends, begins[first] + CHUNK, "right")), first + 1)
        chunk, groups = slice(begins[first], ends[last - 1]), slice(first, last)
        columns = zernike_values(*disc.scaled(x[chunk], y[chunk]), terms)
        residual = deviation[chunk] - coefficients @ columns
        weighted = columns if weights is None else columns * weights[chunk]
        rough = residual
        if differences and len(residual) > 2:  # the noise along the path
            rough = np.pad(np.diff(residual, 2) / np.sqrt(6), 1, "edge")
        alone = weighted * rough
        single += alone @ alone.T
        sizes = ends[groups] - begins[groups]
        if np.any(shown[groups] < 1):
            missed += alone * np.repeat(1 - shown[groups], sizes) @ alone.T
        sums[:, groups] = _group_sums(residual, columns, weighted, inverse, sizes)
        first = last
    scatter = np.diff(sums, differences, axis=1) / np.sqrt(comb(2 * differences, differences))
    scatter = _over_groups(scatter, single - missed, differences) + missed
    dof = max(1 - len(terms) / len(x), 1e-3)
    return scatter / dof, single / dof


def _over_groups(sums: FloatArray, alone: FloatArray, differences: int) -> FloatArray:
    """Return the sum of products (k, k) of the ``differences`` of sums over groups (k, g).

    alone: the same of single points. Errors beyond these are in the first and last groups, too.
    """
    count, scatter = sums.shape[1], sums @ sums.T
    if not differences:  # The sum over all groups is zero, so that one group is not independent.
        return np.asarray(scatter * count / max(count - 1, 1))
    own = np.diag(scatter)
    beyond = np.maximum(own - np.diag(alone), 0.0) / np.where(own > 0, own, np.inf)
    more = np.sqrt(1 + differences / count * beyond)
    return np.asarray(scatter * np.outer(more, more))


def _group_sums(
    residual: FloatArray, columns: FloatArray, weighted: FloatArray, inverse: FloatArray,
    sizes: IntArray,
) -> FloatArray:  # fmt: skip
    """Return sums of products over groups (k, g), for the fit to all other groups.

    residual: (n,);  columns, weighted: those of the fit, and times their weights (k, n)
    sizes: points of each group (g,)
    """
    if np.max(sizes) == 1:
        share = np.einsum("kn,kn->n", inverse @ weighted, columns)
        return np.asarray(weighted * residual * sum(share**k for k in range(_FOLLOWED + 1)))
    sums, ends = np.zeros((len(columns), len(sizes))), np.cumsum(sizes)
    for own, begin, end in zip(sums.T, ends - sizes, ends, strict=True):
        part, along = slice(begin, end), residual[begin:end]
        for _ in range(_FOLLOWED + 1):
            own += (followed := weighted[:, part] @ along)
            along = (inverse @ followed) @ columns[:, part]
    return sums


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
