"""Fit, test every family, release what the scans refute, and fit again.

The family that explains most is released first; those that explain as much as it does, and nothing
together with it, are one group whose members these scans do not separate.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from omsm_ros.core.adjustment.evidence import Evidence, evidence_of
from omsm_ros.core.adjustment.families import base_name
from omsm_ros.core.adjustment.network import (
    Network,
    Scales,
    Solution,
    estimate_scales,
    solve,
)
from omsm_ros.core.adjustment.part_terms import FREE_DEGREE, HIGHEST_DEGREE, RINGS, SYMMETRIC
from omsm_ros.core.streams.blocks import FloatArray

# Of some sixty families one in five hundred clean adjustments has one beyond: 4.2 σ each.
_UNDECLARED_LIMIT = 4.5
# A declared size is a standard uncertainty; of a dozen, one in four hundred is beyond by chance.
_DECLARED_LIMIT = 3.7
# Twice the logarithm of odds of 150 : 1, "very strong" (Kass and Raftery 1995).
_LEAST_GAIN = 10.0
# Smaller than this no source matters to any accuracy asked of the method.
_LEAST_EFFECT_M = 0.5e-9
# Two explanations within this of each other in χ², or in their share of it, are not separated.
_ALIKE, _ALIKE_SHARE = 12.0, 0.05
_MOST_RELEASED = 8
# Starting values; each step moves a variance by 30 at most, and four are enough for 2 %.
_WALK_START, _BAND_START_M, _CELLS_START_M = 1e-18, 3e-9, 3e-9
_FIRST_STEPS, _FURTHER_STEPS = 5, 3
# Of a variance: 2 % of a standard deviation.
_SETTLED = 0.04
# Families that are free on principle: their size is no statement about the machine.
_FREE = ("tilt", "decentre", "clocking")


@dataclass(frozen=True, eq=False)
class Refutation:
    """A family that the scans show beyond what was declared.

    evidence: when it was released;  alike: other families that explain the same
    """

    evidence: Evidence
    alike: tuple[str, ...]

    @property
    def name(self) -> str:
        """Name of the family that was released."""
        return self.evidence.family.name


def start_scales(network: Network, walk: float | None) -> Scales:
    """Return scales to begin with.

    walk: declared standard deviation of the drift after one second [m]
    """
    bands = dict.fromkeys(range(FREE_DEGREE + 1, HIGHEST_DEGREE + 1), _BAND_START_M**2)
    bands[RINGS] = bands[SYMMETRIC] = _BAND_START_M**2
    first = _WALK_START if not walk else walk**2
    return Scales(first, bands, _CELLS_START_M**2, np.ones(network.blocks.scans))


def settled(solution: Solution, steps: int) -> Solution:
    """Return the solution after ``steps`` estimates of its scales, fewer once they are constant."""
    for _ in range(steps):
        scales = estimate_scales(solution)
        still = _alike(scales, solution.scales)
        solution = solve(solution.network, solution.y, scales, solution.sizes)
        if still:
            break
    return solution


def _alike(one: Scales, other: Scales) -> bool:
    """Return whether drift, noise and cells differ by too little to matter."""
    pairs = np.array([[one.walk, other.walk], *zip(one.noise, other.noise, strict=True)])
    close = np.all(np.abs(np.diff(pairs)) < _SETTLED * pairs[:, :1])
    least = float(np.min(pairs[:, 0])) * 1e-4
    return bool(close and abs(one.cells - other.cells) < max(0.3 * one.cells, least))


def fit_and_refute(
    network: Network, y: FloatArray, scales: Scales, sizes: Mapping[str, float]
) -> tuple[Solution, tuple[Refutation, ...]]:
    """Return the solution with all refuted families released, and which they are."""
    solution = settled(solve(network, y, scales, sizes), _FIRST_STEPS)
    found: list[Refutation] = []
    while len(found) < _MOST_RELEASED:
        beyond = refuted_by(solution, [r.name for r in found])
        if not beyond:
            break
        best = _culprit(beyond)
        family = best.family
        released = {**solution.sizes, family.name: family.wide}
        solution = settled(solve(network, y, solution.scales, released), _FURTHER_STEPS)
        still = {e.family.name for e in refuted_by(solution, [*(r.name for r in found)])}
        alike = [e.family.name for e in beyond if e is not best and _as_good(e, best)]
        found.append(Refutation(best, tuple(n for n in alike if n not in still)))
    return solution, tuple(_merged(found))


def refuted_by(solution: Solution, released: list[str]) -> list[Evidence]:
    """Return the evidence of the families beyond their declaration, strongest first."""
    found = []
    for family in solution.network.families:
        if family.name in released or base_name(family.name) in _FREE:
            continue
        declared = family.name in solution.sizes
        evidence = evidence_of(solution, family)
        limit = _DECLARED_LIMIT if declared else _UNDECLARED_LIMIT
        rare = evidence.deviate > limit and evidence.gain > _LEAST_GAIN
        if rare and evidence.effect > _LEAST_EFFECT_M:
            found.append(evidence)
    return sorted(found, key=lambda e: -e.gain)


def _as_good(one: Evidence, best: Evidence) -> bool:
    return one.gain >= best.gain - max(_ALIKE, _ALIKE_SHARE * best.gain)


def _culprit(beyond: list[Evidence]) -> Evidence:
    """Return the strongest; a named family before one that only detects."""
    as_good = [e for e in beyond if _as_good(e, beyond[0])]
    named = [e for e in as_good if e.family.named]
    return (named or as_good)[0]


def _merged(found: list[Refutation]) -> list[Refutation]:
    """Leave out of a group what was released by itself later."""
    names = {r.name for r in found}
    return [replace(r, alike=tuple(n for n in r.alike if n not in names)) for r in found]
