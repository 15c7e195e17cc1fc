"""Sums of products over all points: all that a linear fit needs of them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from omsm_ros.core.samples.blocks import FloatArray

# Consecutive points whose errors may hang together.
GROUP = 128


@dataclass(eq=False)
class NormalEquations:
    """Of columns with each other, with the deviation and with ``sources`` systematic effects.

    points: how many came;  square, total: sums of their squared residuals and deviations [m²]
    gram: (columns, columns + 1 + sources)
    scores: of each column, the sum over groups of 128 successive points of the squared sum of its
        products with the residual: what tells errors that hang together
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
