"""Test each family of error sources against the scans and its declared size.

For a family that takes part with prior covariance Σ and posterior covariance P, the posterior mean
b is spread as Σ − P if the declaration is true: ``χ² = bᵀ (Σ − P)⁻¹ b``. For one that does not take
part it is the score test: with s what its columns find in the residual, I their information once
all others are fitted, ``χ² = sᵀ I⁻¹ s`` (Rao 1948).
"""

from dataclasses import dataclass

import numpy as np

from omsm_ros.core.adjustment.network import Solution
from omsm_ros.core.adjustment.sources import Family
from omsm_ros.core.streams.blocks import FloatArray

# A share of the prior variance that is removed by less is rounding.
_LEAST_TAKEN = 1e-8
# Share of a column's information that the other columns must leave; less is rounding.
_LEAST_LEFT = 1e-10
# Effect of a column of zeros, over its noise: a speed that is the same in all scans.
_NO_COLUMN = 1e-100


@dataclass(frozen=True, eq=False)
class Evidence:
    """One family against its declaration.

    values: by the scans alone, of each column (size,) [unit]; 0 where nothing is shown
    chi_square, dof: against the declared size, of the directions that the scans show
    effect: rms of the family's share of the heights [m], by ``values``
    gain: twice the logarithm by which the likelihood grows if the prior has the size ``wide``
        instead of the declared one; a family that could explain anything gains less (Occam)
    free: root of the covariance (size, size) that the scans leave if the declaration is worth
        nothing, and the family may be as large as ``wide``
    declared: True if it takes part by a declared size or a default
    deviate: of a normal distribution, as rare as χ² is
    """

    family: Family
    values: FloatArray
    chi_square: float
    dof: int
    effect: float
    gain: float
    free: FloatArray
    declared: bool

    @property
    def shown(self) -> bool:
        """True if the scans determine any direction of it."""
        return self.dof > 0

    @property
    def uncertainty(self) -> FloatArray:
        """Standard uncertainty of each column (size,) by ``free`` [unit]."""
        return np.asarray(np.sqrt(np.sum(self.free**2, axis=1)))

    @property
    def deviate(self) -> float:
        """As many standard deviations as χ² is rare; large ones by their square root."""
        from scipy import special  # takes long to load

        if not self.dof:
            return 0.0
        half, order = self.chi_square / 2, self.dof / 2
        tail = special.gammaincc(order, half)
        # Beyond what a float holds, its asymptote.
        far = (order - 1) * np.log(max(half, 1.0)) - half - special.gammaln(order)
        log_tail = np.log(tail) if tail > 1e-290 else far
        return float(max(-special.ndtri_exp(log_tail - np.log(2.0)), 0.0))


def evidence_of(solution: Solution, family: Family) -> Evidence:
    """Return what the scans say of ``family``."""
    if family.name in solution.sizes:
        return _of_declared(solution, family)
    return _of_absent(solution, family)


def _of_declared(solution: Solution, family: Family) -> Evidence:
    here = solution.network.place[family.name]
    size = np.broadcast_to(np.maximum(solution.sizes[family.name], 1e-15), family.size)
    share, axes = np.linalg.eigh(solution.covariance_of(here) / np.outer(size, size))
    share = np.clip(share, 1e-300, 1.0)
    moved = axes.T @ (solution.values[here] / size)
    taken = 1 - share
    # By the data alone: variance once the prior is taken out again. A direction is tested if
    # the scans know it better than its plausible size, however small the declared one is.
    own = share / np.maximum(taken, _LEAST_TAKEN)
    wide = np.sqrt(axes.T**2 @ np.maximum(family.wide / size, 1.0) ** 2)
    shown = (taken > _LEAST_TAKEN) & (own < wide**2)
    chi_square = float(np.sum(moved[shown] ** 2 / taken[shown]))
    alone = np.where(shown, moved / np.where(shown, taken, 1.0), moved)
    values = size * (axes @ alone)
    free = size[:, np.newaxis] * axes / np.sqrt(np.maximum(taken, 0.0) / share + wide**-2)
    gain = sum(
        _gain((m / t) ** 2, o + 1.0, o + w**2)
        for m, t, o, w in zip(moved[shown], taken[shown], own[shown], wide[shown], strict=True)
    )
    tested = chi_square, int(np.sum(shown)), gain
    return _evidence(solution, family, values, tested, free)


def _gain(square: float, before: float, after: float) -> float:
    """Return the growth of 2 log L of a value of ``square`` from one variance to another."""
    return float(square / before - square / after + np.log(before / after))


def _of_absent(solution: Solution, family: Family) -> Evidence:
    net = solution.network
    here = net.place[family.name]
    mixed = solution.matrix[here]
    own = mixed[:, here]
    score = solution.right[here] - mixed @ solution.values
    explained = solution.factor.forward(mixed[:, solution.active].T)
    left = own - explained.T @ explained
    scale = np.sqrt(np.maximum(np.diag(own), 1e-300))
    information, axes = np.linalg.eigh(left / scale / scale[:, np.newaxis])
    # A direction known less well than its plausible size is not determined.
    plausible = 1 / max(float(np.min(family.wide * scale)), _NO_COLUMN) ** 2
    shown = information > max(_LEAST_LEFT, plausible)
    moved = axes.T @ (score / scale)
    known = np.where(shown, information, 1.0)
    values = (axes @ np.where(shown, moved / known, 0.0)) / scale
    # A direction that is not shown keeps the plausible size of the family.
    variance = 1 / (np.maximum(information, 0.0) + plausible)
    free = axes * np.sqrt(variance) / scale[:, np.newaxis]
    chi_square = float(np.sum(np.where(shown, moved**2 / known, 0.0)))
    ratio = (family.wide * np.median(scale)) ** 2
    gain = sum(
        _gain(m**2 / i**2, 1 / i, 1 / i + ratio)
        for m, i in zip(moved[shown], information[shown], strict=True)
    )
    tested = chi_square, int(np.sum(shown)), gain
    return _evidence(solution, family, values, tested, free)


def _evidence(
    solution: Solution, family: Family, values: FloatArray, tested: tuple[float, int, float],
    free: FloatArray,
) -> Evidence:  # fmt: skip
    """Return the evidence with the size of what the family does to the heights.

    tested: χ², its degrees of freedom, and the gain;  free: root of the covariance (size, size)
    """
    effect, _ = solution.network.effect(family.name, values, free @ free.T)
    chi_square, dof, gain = tested
    declared = family.name in solution.sizes
    return Evidence(family, values, chi_square, dof, effect, gain, free, declared)
