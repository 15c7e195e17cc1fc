"""Least squares with a surface common to all scans, eliminated.

``y = B a + X p + e``: B are the terms of the surface, X a few columns whose parameters p are
asked for. With ``C = (BᵀB)⁻¹ BᵀX`` the columns free of the surface are ``X - B C``; the
surface may take any shape without touching p. Rows are made anew from the scans in portions,
so memory holds the normal equations and one portion.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import linalg

from omsm_ros.core.samples.blocks import FloatArray, IntArray
from omsm_ros.core.verification.polar_surface import PolarBasis, PolarRows

# Keeps a term that no point sees at zero; of the others it takes 1e-12 of their size.
_RIDGE = 1e-12
# The terms of a portion, 4 MB, stay in the cache.
_PORTION = 5_000


@dataclass(frozen=True, eq=False)
class Portion:
    """Points of one interval of radius: which (n,), and the surface's terms there."""

    interval: int
    points: IntArray
    rows: PolarRows


Columns = Callable[[Portion], tuple[FloatArray, FloatArray]]
"""From a portion of n points to X (n, p) and y (n,)."""


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Of the parameters alone.

    matrix, right, square: (p, p), (p,) and yᵀy, the surface eliminated
    shares: C (terms, p);  surface: coefficients when p = 0, (terms,)
    """

    matrix: FloatArray
    right: FloatArray
    square: float
    shares: FloatArray
    surface: FloatArray

    def misfit(self, parameters: FloatArray) -> float:
        """Return the sum of squares that ``parameters`` (p,) and the best surface leave."""
        return float(self.square + parameters @ (self.matrix @ parameters - 2 * self.right))

    def surface_of(self, parameters: FloatArray) -> FloatArray:
        """Return the coefficients of the surface (terms,) that goes with ``parameters`` (p,)."""
        return np.asarray(self.surface - self.shares @ parameters)


def portions(
    basis: PolarBasis, order: IntArray, interval: IntArray, radius: FloatArray, angle: FloatArray
) -> Iterator[Portion]:
    """Yield all points in portions of one interval each.

    order: points sorted by their interval, in time within it;  interval: of each point
    radius, angle: where each point lies [m], [rad]
    """
    edges = np.searchsorted(interval[order], np.arange(basis.intervals + 1))
    for number, (first, last) in enumerate(pairwise(edges)):
        for begin in range(first, last, _PORTION):
            points = order[begin : min(begin + _PORTION, last)]
            yield Portion(number, points, basis.rows(number, radius[points], angle[points]))


def normal_equations(
    basis: PolarBasis, parts: Iterator[Portion], columns: Columns
) -> NormalEquations:
    """Gather ``parts`` and eliminate the surface."""
    size = basis.size
    of_surface, mixed, own = np.zeros((size, size)), np.zeros((size, 0)), np.zeros((0, 0))
    for part in parts:
        terms, (x, y) = part.rows.matrix(), columns(part)
        x = np.concatenate([x, y[:, np.newaxis]], axis=1)
        if not own.size:
            mixed, own = np.zeros((size, x.shape[1])), np.zeros((x.shape[1], x.shape[1]))
        here = basis.terms(part.interval)
        of_surface[here, here] += terms.T @ terms
        mixed[here] += terms.T @ x
        own += x.T @ x
    diagonal = np.diag_indices(size)
    of_surface[diagonal] += _RIDGE * np.max(of_surface[diagonal])
    shares = linalg.cho_solve(linalg.cho_factor(of_surface), mixed)
    reduced = own - mixed.T @ shares
    return NormalEquations(
        matrix=reduced[:-1, :-1],
        right=reduced[:-1, -1],
        square=float(reduced[-1, -1]),
        shares=shares[:, :-1],
        surface=shares[:, -1],
    )
