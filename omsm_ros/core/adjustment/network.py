"""Weighted least squares with priors: normal equations, and their solution.

``y = F β + Z ζ + K δ + cell + noise``: F columns of the families, Z terms of the part, K hat
functions of the drift of each scan. Cells are eliminated one by one: with Σw the weight that a
cell has and s² its variance, ``N = XᵀWX − Σ c cᵀ / (Σw + 1/s²)``, c = Σ w x over the cell.
The normal equations without y are the geometry alone: planning uses them too.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy import linalg, sparse

from omsm_ros.core.adjustment.blocks import Blocks
from omsm_ros.core.adjustment.part_terms import RINGS, PartModel
from omsm_ros.core.adjustment.sources import Family
from omsm_ros.core.streams.blocks import BoolArray, FloatArray, IntArray

Sizes = Mapping[str, float | FloatArray]
"""Prior standard deviations of the families that take part, of all columns or of each; a matrix is
their covariance."""

# A walk between two knots of half a turn stays below the noise of a block.
_KNOTS_A_TURN, _MOST_KNOTS = 2, 300
# Blocks at a time: 28 MB of rows.
_PORTION = 4096
# The level of a scan: no prior; drift begins at zero with the first, so that the part has its own.
_LEVEL_M, _FIRST_LEVEL_M = 1e-5, 1e-9


@dataclass(frozen=True, eq=False)
class Scales:
    """Variances that are estimated from the data.

    walk: of the drift after one second [m²/s];  bands: of the terms of each degree above the free
        ones [m²];  cells: of a cell [m²];  noise: of a block's mean over its white noise, each scan
    """

    walk: float
    bands: Mapping[int, float]
    cells: float
    noise: FloatArray

    @property
    def texture(self) -> float:
        """Standard deviation of the part by cells and rings, which no smooth term describes [m]."""
        return float(np.sqrt(self.cells + sum(s for d, s in self.bands.items() if d <= RINGS)))


class _Sums(NamedTuple):
    """Sums over the blocks of one scan: XᵀWX, and Σ w x over each cell.

    matrix: (p, p);  common: of families and terms (cells, k);  along: of its knots (cells, l), of
        which the few turns through a cell have some
    """

    matrix: FloatArray
    common: FloatArray
    along: sparse.csr_array


@dataclass(frozen=True, eq=False)
class Network:
    """The design of all scans, and its normal equations.

    place: columns of each family among the parameters;  knots: of each scan
    steps: time between knots of each scan [s]
    """

    blocks: Blocks
    families: tuple[Family, ...]
    part: PartModel
    place: Mapping[str, slice] = field(init=False)
    knots: tuple[slice, ...] = field(init=False)
    steps: tuple[float, ...] = field(init=False)
    terms: slice = field(init=False)
    _values: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    _hats: sparse.csr_array = field(init=False)
    _member: sparse.csr_array = field(init=False)
    _sums: list[_Sums] = field(init=False, default_factory=list)

    def __post_init__(self) -> None:
        blocks, place, begin = self.blocks, {}, 0
        for family in self.families:
            place[family.name] = slice(begin, begin + family.size)
            begin += family.size
        values = self._values if self._values.size else _terms_at(self.part, blocks)
        end = begin + values.shape[1]
        hats, knots, steps = _hats_of(blocks, end)
        number = len(blocks)
        member = sparse.csr_array(
            (np.ones(number), (self.part.cell, np.arange(number))), shape=(self.part.cells, number)
        )
        made = {"place": place, "terms": slice(begin, end), "knots": knots, "steps": steps,
                "_values": values, "_hats": hats, "_member": member}  # fmt: skip
        for name, value in made.items():
            object.__setattr__(self, name, value)

    @property
    def size(self) -> int:
        """Number of parameters."""
        return int(self.terms.stop + self._hats.shape[1])

    def weights(self, scales: Scales) -> FloatArray:
        """Return the inverse variance of each block [1/m²], (b,)."""
        blocks = self.blocks
        return np.asarray(1 / (blocks.variance * scales.noise[blocks.scan]))

    def cell_share(self, weights: FloatArray, scales: Scales) -> FloatArray:
        """Return the variance of each cell after its blocks, 1 / (Σw + 1/s²) [m²]."""
        total = self._member @ weights
        return np.asarray(1 / (total + 1 / max(scales.cells, LEAST_VARIANCE)))

    def alone(self, scan: int) -> Network:
        """Return the part by the blocks of ``scan``, without families; sums are not made anew."""
        mine = self.blocks.scan == scan
        part = replace(self.part, cell=self.part.cell[mine])
        made = Network(self.blocks.only(mine), (), part, _values=self._values[mine])
        matrix, sums, along = self._by_scan()[scan]
        begin = self.terms.start
        made._sums.append(_Sums(matrix[begin:, begin:], sums[:, begin:], along))
        return made

    def with_families(self, extra: Sequence[Family], columns: FloatArray) -> Network:
        """Return the network with further families, whose block means are ``columns`` (b, k)."""
        every = np.concatenate([self.blocks.columns, columns], axis=1)
        blocks, families = replace(self.blocks, columns=every), (*self.families, *extra)
        return Network(blocks, families, self.part, _values=self._values)

    def with_column(self, name: str, values: FloatArray) -> Network:
        """Return the network with other block means ``values`` (b,) of family ``name``."""
        columns = self.blocks.columns.copy()
        columns[:, self.place[name]] = values
        blocks = replace(self.blocks, columns=columns)
        return Network(blocks, self.families, self.part, _values=self._values)

    def _own(self, scan: int) -> list[tuple[slice, slice]]:
        """Return the parameters that blocks of ``scan`` depend on, which are all but others' knots,
        and their places among these: the common ones and the knots."""
        knots, split = self.knots[scan], self.terms.stop
        return [(slice(split), slice(split)), (knots, slice(split, None))]

    def _by_scan(self) -> list[_Sums]:
        """Return the sums of each scan by white noise alone.

        Made once: with the noise of each scan they are summed anew, whatever it is.
        """
        if not self._sums:
            self._sums.extend(self._sums_of(k) for k in range(self.blocks.scans))
        return self._sums

    def _sums_of(self, scan: int) -> _Sums:
        mine = np.flatnonzero(self.blocks.scan == scan)
        knots, split = self.knots[scan], self.terms.stop
        size, cells = split + knots.stop - knots.start, self.part.cells
        matrix, sums = np.zeros((size, size)), np.zeros((cells, split))
        root = 1 / np.sqrt(self.blocks.variance[mine])
        number = np.arange(len(mine))
        member = sparse.csc_array((root, (self.part.cell[mine], number)), (cells, len(mine)))
        hats = self._hats[mine, knots.start - split : knots.stop - split]
        hats = sparse.diags_array(root) @ hats
        matrix[split:, split:] = (hats.T @ hats).toarray()
        for first in range(0, len(mine), _PORTION):
            here = slice(first, first + _PORTION)
            part = mine[here]
            rows = np.concatenate([self.blocks.columns[part], self._values[part]], axis=1)
            rows *= root[here, np.newaxis]
            matrix[:split, :split] += rows.T @ rows
            matrix[split:, :split] += hats[here].T @ rows
            sums += member[:, here] @ rows
        matrix[:split, split:] = matrix[split:, :split].T
        return _Sums(matrix, sums, member @ hats)

    def cell_sums(self, scales: Scales) -> tuple[FloatArray, sparse.csr_array]:
        """Return Σ w x over each cell, of families and terms (cells, k), of knots (cells, l)."""
        scans = list(zip(self._by_scan(), scales.noise, strict=True))
        common = np.add.reduce([one.common / noise for one, noise in scans])
        return common, sparse.hstack([one.along / noise for one, noise in scans], format="csr")

    def normal_matrix(self, scales: Scales) -> FloatArray:
        """Return XᵀV⁻¹X with the cells eliminated, (size, size): of the geometry alone."""
        root = np.sqrt(self.cell_share(self.weights(scales), scales))
        common, along = self.cell_sums(scales)
        common *= root[:, np.newaxis]
        along = sparse.diags_array(root) @ along
        split, made = self.terms.stop, np.empty((self.size, self.size))
        made[:split, :split] = common.T @ common
        made[split:, :split] = along.T @ common
        made[:split, split:] = made[split:, :split].T
        made[split:, split:] = (along.T @ along).toarray()
        np.negative(made, out=made)
        for k, one in enumerate(self._by_scan()):
            for (row, top), (column, left) in itertools.product(self._own(k), repeat=2):
                made[row, column] += one.matrix[top, left] / scales.noise[k]
        return made

    def pulled(self, scales: Scales, y: FloatArray) -> FloatArray:
        """Return V⁻¹y with the cells eliminated, (b,) [1/m]."""
        return np.asarray(self.weights(scales) * (y - self.cells_of(scales, y)[self.part.cell]))

    def sums_by_column(self, pulled: FloatArray) -> FloatArray:
        """Return Xᵀ times ``pulled`` (b,) or (b, k)."""
        return np.concatenate(
            [self.blocks.columns.T @ pulled, self._values.T @ pulled, self._hats.T @ pulled]
        )

    def cells_of(self, scales: Scales, residual: FloatArray) -> FloatArray:
        """Return the cells that go with ``residual`` (b,) [m], (cells,)."""
        weights = self.weights(scales)
        sums = self._member @ (weights * residual)
        return np.asarray(self.cell_share(weights, scales) * sums)

    def fitted(self, parameters: FloatArray) -> FloatArray:
        """Return X β without the cells, (b,) [m]."""
        families = self.blocks.columns @ parameters[: self.terms.start]
        return np.asarray(
            families + self._values @ parameters[self.terms] + self.of_drift(parameters)
        )

    def of_drift(self, parameters: FloatArray) -> FloatArray:
        """Return the drift at the blocks, (b,) [m]."""
        return np.asarray(self._hats @ parameters[self.terms.stop :])

    def of_families(self, parameters: FloatArray, names: Sequence[str]) -> FloatArray:
        """Return what families ``names`` add to the heights of the blocks, (b,) [m]."""
        made = np.zeros(len(self.blocks))
        for name in names:
            here = self.place[name]
            made += self.blocks.columns[:, here] @ parameters[here]
        return made

    def effect(self, name: str, values: FloatArray, covariance: FloatArray) -> tuple[float, float]:
        """Return what ``values`` (size,) of family ``name`` do to the heights, rms over the points,
        and its standard uncertainty by ``covariance`` (size, size) [m]."""
        here, blocks = self.place[name], self.blocks
        # The inverse variance of a block is its number of points over the variance of one.
        power = np.add.reduce([noise**2 * one.matrix[here, here] for noise, one
                               in zip(blocks.noise, self._by_scan(), strict=True)])  # fmt: skip
        power /= blocks.count.sum()
        square = np.array([values @ power @ values, np.sum(power * covariance)])
        effect, uncertainty = np.sqrt(np.maximum(square, 0.0))
        return float(effect), float(uncertainty)

    def active(self, sizes: Sizes) -> BoolArray:
        """Return which parameters take part where the families in ``sizes`` do, (size,)."""
        made = np.ones(self.size, np.bool_)
        for name, here in self.place.items():
            made[here] = name in sizes
        return made

    def add_prior(self, matrix: FloatArray, active: IntArray, scales: Scales, sizes: Sizes) -> None:
        """Add the precision before the scans to ``matrix`` (a, a) of the parameters ``active``.

        sizes: standard deviations of the families that take part
        """
        diagonal = np.zeros(self.size)
        for name, size in sizes.items():
            if np.ndim(size) == 2:
                first = int(np.searchsorted(active, self.place[name].start))
                own = slice(first, first + len(np.asarray(size)))
                matrix[own, own] += Factor.of(np.array(size)).inverse()
            else:
                diagonal[self.place[name]] = 1 / np.maximum(size, _LEAST_SIZE) ** 2
        free, degrees = self.part.free, self.part.degrees
        variance = np.array(
            [f**2 if f else scales.bands[int(d)] for f, d in zip(free, degrees, strict=True)]
        )
        diagonal[self.terms] = 1 / np.maximum(variance, LEAST_VARIANCE)
        matrix[np.diag_indices(len(active))] += diagonal[active]
        left_out = self.size - len(active)
        for knots, step in zip(self.knots, self.steps, strict=True):
            # Knots stand behind all others, and always take part.
            here = slice(knots.start - left_out, knots.stop - left_out)
            moves = np.diff(np.eye(knots.stop - knots.start), axis=0)
            matrix[here, here] += moves.T @ moves / (max(scales.walk, LEAST_VARIANCE) * step)
            level = _FIRST_LEVEL_M if knots is self.knots[0] else _LEVEL_M
            matrix[here.start, here.start] += level**-2


def _terms_at(part: PartModel, blocks: Blocks) -> FloatArray:
    """Return terms of the part at all blocks, (b, k), a portion at a time."""
    made = np.empty((len(blocks), len(part.degrees)))
    for first in range(0, len(blocks), _PORTION):
        here = slice(first, first + _PORTION)
        made[here] = part.values(blocks.x[here], blocks.y[here], blocks.span[here])
    return made


# Square of a picometre: keeps what is exactly known regular.
LEAST_VARIANCE, _LEAST_SIZE = 1e-24, 1e-15


def _hats_of(
    blocks: Blocks, begin: int
) -> tuple[sparse.csr_array, tuple[slice, ...], tuple[float, ...]]:
    """Return hat functions over the time of each scan, (b, knots)."""
    rows: list[IntArray] = []
    places: list[IntArray] = []
    values: list[FloatArray] = []
    knots, steps, first = [], [], 0
    for k in range(blocks.scans):
        mine = np.flatnonzero(blocks.scan == k)
        intervals = int(np.clip(_KNOTS_A_TURN * (blocks.turn[mine[-1]] + 1), 4, _MOST_KNOTS))
        since = blocks.since[mine]
        step = float(since[-1]) / intervals
        place = np.clip(since / step, 0, intervals * (1 - 1e-12))
        left = place.astype(np.int64)
        rows += [mine, mine]
        places += [first + left, first + left + 1]
        values += [1 - (place - left), place - left]
        knots.append(slice(begin + first, begin + first + intervals + 1))
        steps.append(step)
        first += intervals + 1
    joined = (np.concatenate(values), (np.concatenate(rows), np.concatenate(places)))
    return sparse.csr_array(joined, shape=(len(blocks), first)), tuple(knots), tuple(steps)


@dataclass(frozen=True, eq=False)
class Factor:
    """Cholesky root L of a positive matrix whose rows have different units: A = D⁻¹ L Lᵀ D⁻¹.

    No ridge: a free form of 100 nm with an uncertainty of 0.03 nm would be pulled by 1e-13.
    """

    root: FloatArray
    scale: FloatArray

    @classmethod
    def of(cls, matrix: FloatArray) -> Factor:
        """Return the factor of ``matrix`` (p, p), which is overwritten."""
        scale = 1 / np.sqrt(np.diag(matrix))
        matrix *= scale
        matrix *= scale[:, np.newaxis]
        return cls(linalg.cholesky(matrix, lower=True, overwrite_a=True), scale)

    def solve(self, right: FloatArray) -> FloatArray:
        """Return A⁻¹ ``right`` (p,)."""
        return np.asarray(self.scale * linalg.cho_solve((self.root, True), self.scale * right))

    def forward(self, right: FloatArray) -> FloatArray:
        """Return Z (p, k) with ZᵀZ = ``right``ᵀ A⁻¹ ``right`` (p, k)."""
        scaled = self.scale[:, np.newaxis] * right
        return np.asarray(linalg.solve_triangular(self.root, scaled, lower=True))

    def inverse(self) -> FloatArray:
        """Return A⁻¹ (p, p)."""
        made, _ = linalg.lapack.dpotri(self.root, lower=1)
        for k in range(len(made)):  # the lower half mirrored in place, it may be large
            made[k, k + 1 :] = made[k + 1 :, k]
        made *= self.scale
        made *= self.scale[:, np.newaxis]
        return np.asarray(made)


@dataclass(frozen=True, eq=False)
class Solution:
    """Parameters that take part, and all that is known of the others.

    values: of all parameters, 0 where they take no part
    matrix, right: normal equations of all, without priors
    sizes: prior standard deviations of the families that took part, of one or of each column
    active: parameters that take part (a,);  factor: of their normal matrix, priors included
    covariance: of those, (a, a);  tested: what was found of families, by their names
    """

    network: Network
    y: FloatArray
    scales: Scales
    sizes: Sizes
    values: FloatArray
    covariance: FloatArray
    matrix: FloatArray
    right: FloatArray
    active: IntArray
    factor: Factor
    tested: dict[str, Any] = field(default_factory=dict)

    @cached_property
    def residual(self) -> FloatArray:
        """Return y less families, part terms and drift, cells still in it, (b,) [m]."""
        return np.asarray(self.y - self.network.fitted(self.values))

    @cached_property
    def _explained(self) -> tuple[IntArray, FloatArray]:
        others = np.setdiff1d(np.arange(self.network.size), self.active)
        return others, self.factor.forward(self.matrix[np.ix_(self.active, others)])

    def explained(self, here: slice) -> FloatArray:
        """Return Z (a, k), by whose products those that take part explain ``here`` that do not."""
        others, spread = self._explained
        first = int(np.searchsorted(others, here.start))
        return spread[:, first : first + here.stop - here.start]

    def smooth_form(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the form by its terms at x, y [m], cells left out, (n,) [m]."""
        return np.asarray(self.network.part.values(x, y) @ self.values[self.network.terms])

    def covariance_of(self, here: slice) -> FloatArray:
        """Return the covariance of consecutive parameters that take part."""
        first = int(np.searchsorted(self.active, here.start))
        part = slice(first, first + here.stop - here.start)
        return self.covariance[part, part]

    def uncertainty(self, name: str) -> FloatArray:
        """Return standard uncertainties of a family's parameters."""
        here = self.network.place[name]
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance_of(here)), 0.0)))


def solve(
    network: Network, y: FloatArray, scales: Scales, sizes: Sizes, like: Solution | None = None
) -> Solution:
    """Return the solution for given scales and prior sizes of the families that take part.

    like: of the same cells and noise, whose normal equations are not made anew
    """
    matrix = like.matrix if like else network.normal_matrix(scales)
    right = like.right if like else network.sums_by_column(network.pulled(scales, y))
    active = np.flatnonzero(network.active(sizes))
    inside = matrix[np.ix_(active, active)]
    network.add_prior(inside, active, scales, sizes)
    factor = Factor.of(inside)
    values = np.zeros(network.size)
    values[active] = factor.solve(right[active])
    return Solution(
        network, y, scales, sizes, values, factor.inverse(), matrix, right, active, factor
    )
