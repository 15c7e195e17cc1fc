"""In which shapes may a measurement be wrong as a whole?

Noise averages out over an area; a drift, a reference surface or a filter that is a little wrong
does not. Such an error is a sum of shapes over the surface, each with an independent size of
standard deviation one (Karhunen and Loève): a shape then is what it does to every height [m].
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.special import erf

from omsm_ros.core.comparison.agreement import COVERAGE_FACTOR
from omsm_ros.core.correction.unknown_curves import components, random_walk
from omsm_ros.core.samples.blocks import FloatArray, IntArray

# Of an error correlated over half the radius of a disc 19 shapes hold what is kept, over a quarter
# 57, as with four times as many nodes.
_NODES = 400
# Of the variance, which changes a standard uncertainty by 0.25 %.
_LEFT_OUT = 0.005
# What is tried: from what no scan shows to what no scan survives, 12 % apart.
_DRIFTS_M = np.geomspace(1e-11, 1e-5, 121)


def unknown_form(x: FloatArray, y: FloatArray, size: FloatArray, length: float) -> FloatArray:
    """Return the shapes (k, m) of an error of standard deviation ``size`` (m,) [m] at x, y (m,).

    Its covariance falls with the distance d as ``exp(−d² / 2 length²)``. The shapes are found on
    400 of the places, as far from each other as can be, and carried to the others (Nyström), and
    scaled to the full variance. A length shorter than their distance is taken for it.
    """
    if len(x) == 0 or not np.any(size > 0):
        return np.empty((0, len(x)))
    some, apart = _nodes(x, y)
    length = max(length, apart)
    nodes = np.column_stack([x[some], y[some]])
    values, vectors = np.linalg.eigh(_kernel(nodes, nodes, length))
    values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
    share = np.cumsum(values) / values.sum()
    kept = int(np.searchsorted(share, 1 - _LEFT_OUT)) + 1
    carried = _kernel(np.column_stack([x, y]), nodes, length) @ (
        vectors[:, :kept] / np.sqrt(values[:kept])
    )
    found = np.linalg.norm(carried, axis=1, keepdims=True)
    return np.asarray((size[:, np.newaxis] * carried / np.maximum(found, 1e-9)).T, np.float64)


def _nodes(x: FloatArray, y: FloatArray) -> tuple[IntArray, float]:
    """Return the numbers of the nodes, and the least distance between two of them [m].

    Each is the place that is farthest from those before it (T. Gonzalez, Theor. Comput. Sci. 38,
    293): of a map of rows, every k-th place would leave wide gaps between columns of nodes.
    """
    nodes, apart = [0], 0.0
    nearest = np.hypot(x - x[0], y - y[0])
    while len(nodes) < min(_NODES, len(x)) and (farthest := float(nearest.max())) > 0:
        nodes.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, np.hypot(x - x[nodes[-1]], y - y[nodes[-1]]))
        apart = farthest
    return np.array(nodes), apart


def _kernel(one: FloatArray, other: FloatArray, length: float) -> FloatArray:
    square = np.sum((one[:, np.newaxis] - other[np.newaxis]) ** 2, axis=2)
    return np.asarray(np.exp(-square / (2 * length**2)), np.float64)


def drift(order: FloatArray, size: float) -> FloatArray:
    """Return the shapes (k, m) of a random walk in time that scatters by ``size`` [m] at its end.

    order: time of each place (m,), 0 at the beginning of the scan and 1 at its end
    """
    return np.asarray(size * components(random_walk, order), np.float64)


def likely_drift(
    difference: FloatArray, known: FloatArray, noise: FloatArray, drifts: FloatArray
) -> float:
    """Return the size of a drift of which nobody knows how large it was [m], from a difference.

    difference: (m,) [m];  known: shapes of the other errors (k, m) [m]
    noise: independent standard deviation of each place (m,) [m]
    drifts: shapes for a size of one metre (l, m)

    With ``difference ~ N(0, noise² + knownᵀ known + s² driftsᵀ drifts)`` some sizes s are likelier
    than others, a priori each alike in its logarithm; two of the size returned hold 95.45 % of
    what those make together. A drift of which the difference shows little may be larger than
    the likeliest: where one number alone told its size, the factor would be Student's.
    """
    some = np.linspace(0, len(difference) - 1, min(_NODES, len(difference))).astype(np.int64)
    shapes = known[:, some]
    covariance = shapes.T @ shapes + np.diag(noise[some] ** 2 + (1e-12) ** 2)
    root = cholesky(covariance, lower=True)
    data = solve_triangular(root, difference[some], lower=True)
    walked = solve_triangular(root, drifts[:, some].T, lower=True)
    values, vectors = np.linalg.eigh(walked.T @ walked)
    values = np.maximum(values, 0.0)
    square = (vectors.T @ (walked.T @ data)) ** 2
    sizes = _DRIFTS_M[:, np.newaxis]
    likelihood = np.sum(square * sizes**2 / (1 + sizes**2 * values), axis=1)
    likelihood -= np.sum(np.log1p(sizes**2 * values), axis=1)
    weight = np.exp(0.5 * (likelihood - likelihood.max()))
    held = erf(COVERAGE_FACTOR / np.sqrt(2) * sizes / _DRIFTS_M) @ (weight / weight.sum())
    return float(np.interp(erf(COVERAGE_FACTOR / np.sqrt(2)), held, _DRIFTS_M))
