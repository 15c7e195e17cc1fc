"""Means of scattered values around each of their points, over the width that takes most noise.

The Gaussian of ISO 16610 on a fine grid, between whose nodes points lie linearly. Kernels that
take less of short waves make more of what is at the rim, where parts are highest.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from omsm_ros.core.form.cells import gaussian_weights
from omsm_ros.core.samples.blocks import FloatArray, IntArray

_MOST_ACROSS = 256
# Cutoffs in steps of the grid, each half a step of an octave wider than the one before.
_CUTOFFS = (2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0)
_SEED = 11


class Chosen(NamedTuple):
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


def closest_means(x: FloatArray, y: FloatArray, values: FloatArray, noise: float) -> Chosen:
    """Return the means whose expected error is least for ``values`` at x, y, each (n,).

    The error is told by the values themselves (C. Stein's unbiased estimate), with the trace from
    one draw of signs.
    """
    signs = np.random.default_rng(_SEED).choice([-1.0, 1.0], size=len(x))
    found = []
    for cutoff in _CUTOFFS:
        means = LocalMeans.of(x, y, cutoff)
        left = float(np.mean((values - means(values)) ** 2))
        kept = means(signs)
        error = left - noise**2 * (1 - 2 * float(np.mean(signs * kept)))
        found.append(Chosen(means, float(np.mean((signs - kept) ** 2)), error))
    return min(found, key=lambda each: each.error)
