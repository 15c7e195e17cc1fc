"""Test each family of error sources against the scans and its declared size.

For a family that takes part with prior covariance Σ and posterior covariance P, the posterior mean
b is spread as Σ − P if the declaration is true: ``χ² = bᵀ (Σ − P)⁻¹ b``. For one that does not take
part it is the score test: with s what its columns find in the residual, I their information once
all others are fitted, ``χ² = sᵀ I⁻¹ s`` (Rao 1948).
"""

from dataclasses import dataclass

import numpy as np
import scipy  # whose parts are loaded when they are used

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
        if not self.dof:
            return 0.0
        half, order = self.chi_square / 2, self.dof / 2
        tail = scipy.special.gammaincc(order, half)
        # Beyond what a float holds, its asymptote.
        far = (order - 1) * np.log(max(half, 1.0)) - half - scipy.special.gammaln(order)
        log_tail = np.log(tail) if tail > 1e-290 else far
        return float(max(-scipy.special.ndtri_exp(log_tail - np.log(2.0)), 0.0))


def evidence_of(solution: Solution, family: Family) -> Evidence:
    """Return what the scans say of ``family``."""
    if family.name not in solution.tested:
        solution.tested[family.name] = _tested(solution, family)
    found: Evidence = solution.tested[family.name]
    return found


def _tested(solution: Solution, family: Family) -> Evidence:
    here = solution.network.place[family.name]
    declared = family.name in solution.sizes
    if declared:
        unit = np.broadcast_to(np.maximum(solution.sizes[family.name], 1e-15), family.size)
        share, axes = np.linalg.eigh(solution.covariance_of(here) / np.outer(unit, unit))
        share = np.clip(share, 1e-300, 1.0)
        # By the data alone: the prior is taken out again.
        taken = 1 - share
        known, least = np.maximum(taken, 0.0) / share, _LEAST_TAKEN
        alone = axes.T @ (solution.values[here] / unit) / np.maximum(taken, _LEAST_TAKEN)
        plausible = wide = np.sqrt(axes.T**2 @ np.maximum(family.wide / unit, 1.0) ** 2)
    else:
        mixed = solution.matrix[here]
        own = mixed[:, here]
        score = solution.right[here] - mixed @ solution.values
        explained = solution.explained(here)
        unit = 1 / np.sqrt(np.maximum(np.diag(own), 1e-300))
        known, axes = np.linalg.eigh((own - explained.T @ explained) * np.outer(unit, unit))
        known, least = np.maximum(known, 0.0), _LEAST_LEFT
        alone = axes.T @ (score * unit) / np.maximum(known, _LEAST_LEFT)
        wide = np.full(family.size, max(family.wide / float(np.max(unit)), _NO_COLUMN))
        plausible = np.full(family.size, family.wide * np.median(1 / unit))
    # A direction is tested if the scans know it better than its plausible size, however small the
    # declared one is; one that is not keeps the plausible size.
    shown = known > np.maximum(least, wide**-2)
    square, variance = alone[shown] ** 2, 1 / known[shown]
    before, after = variance + float(declared), variance + plausible[shown] ** 2
    chi_square = float(np.sum(square / before))
    gain = chi_square - float(np.sum(square / after - np.log(before / after)))
    values = unit * (axes @ np.where(shown, alone, 0.0))
    free = unit[:, np.newaxis] * axes / np.sqrt(known + wide**-2)
    effect, _ = solution.network.effect(family.name, values, free @ free.T)
    return Evidence(family, values, chi_square, int(np.sum(shown)), effect, gain, free, declared)
