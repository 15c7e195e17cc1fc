"""In which independent ways may a curve vary of which only size and smoothness are known?

Drift over time, straightness over a slide's travel, pitch over Z: nobody knows the curve, but its
standard deviation and how far it is correlated. By Karhunen and Loève such a curve is a sum of
independent components, the eigenvectors of its covariance; few of them carry nearly all of it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray

Kernel = Callable[[FloatArray, FloatArray], FloatArray]

# Between the nodes the components are interpolated; the last of those kept has a few nodes a wave.
_NODES = 128
# What the components left out would add to a standard deviation: half of this, 0.5 %.
_LEFT_OUT = 0.01


def random_walk(start: FloatArray, end: FloatArray) -> FloatArray:
    """Return the covariance of a walk of unit variance after one unit, zero at zero."""
    return np.minimum(start, end)


def fading(length: float) -> Kernel:
    """Return the covariance of a curve of unit variance that forgets itself over ``length``."""
    return lambda start, end: np.exp(-np.abs(start - end) / length)


def smooth(length: float) -> Kernel:
    """Return the covariance of a smooth curve of unit variance, correlated over ``length``."""
    return lambda start, end: np.exp(-0.5 * ((start - end) / length) ** 2)


def components(kernel: Kernel, where: FloatArray) -> FloatArray:
    """Return independent components of unit variance (k, n) of a curve at ``where`` (n,).

    Their squares add up to the variance of the curve, less a hundredth at most.
    """
    first, last = float(np.min(where)), float(np.max(where))
    if last == first:
        size = float(np.sqrt(kernel(where[:1], where[:1])[0]))
        return np.full((1, len(where)), size)
    nodes = np.linspace(first, last, _NODES)
    values, vectors = np.linalg.eigh(kernel(nodes[:, np.newaxis], nodes[np.newaxis]))
    values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
    share = np.cumsum(values) / max(float(values.sum()), np.finfo(np.float64).tiny)
    kept = min(int(np.searchsorted(share, 1 - _LEFT_OUT)) + 1, _NODES)
    return np.stack(
        [
            np.interp(where, nodes, np.sqrt(value) * vector)
            for value, vector in zip(values[:kept], vectors.T[:kept], strict=True)
        ]
    )
