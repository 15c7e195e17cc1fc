"""Test each family of error sources against the scans and its declared size.

For a family that takes part with prior covariance Σ and posterior covariance P, the posterior mean
b is spread as Σ − P if the declaration is true: ``χ² = bᵀ (Σ − P)⁻¹ b``. For one that does not take
part it is the score test: with s what its columns find in the residual, I their information once
all others are fitted, ``χ² = sᵀ I⁻¹ s`` (Rao 1948).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from omsm_ros.core.adjustment.families import Family
from omsm_ros.core.adjustment.network import Solution
from omsm_ros.core.streams.blocks import FloatArray

# The scans show a direction if they remove at least this share of its prior variance.
_LEAST_SHOWN = 0.1
# Share of a column's information that the other columns must leave; less is rounding.
_LEAST_LEFT = 1e-10
# Effect of a column of zeros, over its noise: a speed that is the same in all scans.
_NO_COLUMN = 1e-100


@dataclass(frozen=True, eq=False)
class Evidence:
    """One family against its declaration.

    values, uncertainty: by the scans alone, of each column (size,) [unit]; where nothing is
        shown, 0 and the plausible size
    chi_square, dof: against the declared size, of the directions that the scans show
    effect: rms of the family's share of the heights [m], by ``values``
    gain: twice the logarithm by which the likelihood grows if the prior has the size ``wide``
        instead of the declared one; a family that could explain anything gains less (Occam)
    spread: root of the covariance of ``values``, (size, size); of a family that takes part, after
        the adjustment
    open: True if a direction of it is not shown by the scans
    deviate: of a normal distribution, as rare as χ² is
    """

    family: Family
    values: FloatArray
    uncertainty: FloatArray
    chi_square: float
    dof: int
    effect: float
    gain: float
    spread: FloatArray
    open: bool

    @property
    def shown(self) -> bool:
        """True if the scans determine any direction of it."""
        return self.dof > 0

    @property
    def deviate(self) -> float:
        """As many standard deviations as χ² is rare; large ones by their square root."""
        if not self.dof:
            return 0.0
        log_tail = _log_tail(self.chi_square, self.dof)
        return float(max(-special.ndtri_exp(log_tail - np.log(2.0)), 0.0))


def _log_tail(chi_square: float, dof: int) -> float:
    tail = special.gammaincc(dof / 2, chi_square / 2)
    if tail > 1e-290:
        return float(np.log(tail))
    half = chi_square / 2
    return float((dof / 2 - 1) * np.log(half) - half - special.gammaln(dof / 2))


def evidence_of(solution: Solution, family: Family) -> Evidence:
    """Return what the scans say of ``family``."""
    if family.name in solution.sizes:
        return _of_declared(solution, family)
    return _of_absent(solution, family)


def _of_declared(solution: Solution, family: Family) -> Evidence:
    here = solution.network.place[family.name]
    size = max(solution.sizes[family.name], 1e-15)
    share, axes = np.linalg.eigh(solution.covariance_of(here) / size**2)
    moved = axes.T @ solution.values[here] / size
    taken = 1 - np.clip(share, 0.0, 1.0)
    shown = taken > _LEAST_SHOWN
    chi_square = float(np.sum(moved[shown] ** 2 / taken[shown]))
    # By the data alone: mean and variance once the prior is taken out again.
    alone = np.where(shown, moved / np.where(shown, taken, 1.0), moved)
    variance = np.where(shown, share / np.where(shown, taken, 1.0), share)
    values = size * (axes @ alone)
    uncertainty = size * np.sqrt(np.sum(axes**2 * variance, axis=1))
    spread = size * axes * np.sqrt(share)
    gain = 0.0
    for m, t, p in zip(moved[shown], taken[shown], share[shown], strict=True):
        own = p / t
        gain += _gain((m / t) ** 2, own + 1.0, own + (family.wide / size) ** 2)
    tested = chi_square, int(np.sum(shown)), gain
    return _evidence(solution, family, values, uncertainty, tested, spread)


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
    uncertainty = np.sqrt(axes**2 @ variance) / scale
    spread = axes * np.sqrt(variance) / scale[:, np.newaxis]
    chi_square = float(np.sum(np.where(shown, moved**2 / known, 0.0)))
    ratio = (family.wide * np.median(scale)) ** 2
    gain = sum(
        _gain(m**2 / i**2, 1 / i, 1 / i + ratio)
        for m, i in zip(moved[shown], information[shown], strict=True)
    )
    tested = chi_square, int(np.sum(shown)), gain
    return _evidence(solution, family, values, uncertainty, tested, spread)


def _evidence(
    solution: Solution,
    family: Family,
    values: FloatArray,
    uncertainty: FloatArray,
    tested: tuple[float, int, float],
    spread: FloatArray,
) -> Evidence:
    """Return the evidence with the size of what the family does to the heights.

    tested: χ², its degrees of freedom, and the gain;  spread: root of the covariance (size, size)
    """
    net = solution.network
    change = net.column(family.name) @ values
    effect = float(np.sqrt(np.average(change**2, weights=net.blocks.count)))
    chi_square, dof, gain = tested
    return Evidence(
        family, values, uncertainty, chi_square, dof, effect, gain, spread,
        dof < family.size,
    )  # fmt: skip
