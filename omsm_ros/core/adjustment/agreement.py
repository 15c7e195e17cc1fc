"""Do the scans agree? Each alone, with what was found of the machine, against the others.

``E_n = |a − b| / (2 √(u_a² + u_b²))`` for PV, rms and the first Zernike terms (ISO 17043). The
terms are compared within the adjustment: columns of their own for one scan, whose estimate is the
difference with its full uncertainty. PV and rms are those of each scan alone, corrected by what
was found of the machine together.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy  # whose parts are loaded when they are used

from omsm_ros.core.adjustment.evidence import evidence_of
from omsm_ros.core.adjustment.families import DIFFERS
from omsm_ros.core.adjustment.figures import Figure, FormOf, places_of
from omsm_ros.core.adjustment.network import Solution, solve
from omsm_ros.core.kinematics.kinematics import Surface
from omsm_ros.core.streams.blocks import FloatArray

# Share of adjustments with agreeing scans in which any E_n exceeds its limit.
_BY_CHANCE = 0.005


@dataclass(frozen=True, eq=False)
class ScanAgreement:
    """One scan against all others: E_n of each figure.

    scan: its number;  pv, rms: E_n;  terms: E_n of each Zernike term, degree 2 to 4
    limit: of E_n; one, but that of many figures one is beyond by chance
    alone: PV and rms of this scan alone, with its own uncertainty
    """

    scan: int
    pv: float
    rms: float
    terms: FloatArray
    limit: float
    alone: tuple[Figure, Figure]

    @property
    def largest(self) -> float:
        """Largest E_n of all."""
        return float(max(self.pv, self.rms, float(np.max(self.terms))))


def agreement_of(
    solution: Solution, nominal: Surface | None, removed: Sequence[str]
) -> tuple[ScanAgreement, ...]:
    """Return each scan against the others; none for a single one."""
    blocks = solution.network.blocks
    if blocks.scans < 2:
        return ()
    y = solution.y - solution.network.of_families(solution.values, list(solution.sizes))
    part = solution.network.part
    seen = [np.bincount(part.cell[blocks.scan == k], minlength=part.cells) > 0
            for k in range(blocks.scans)]  # fmt: skip
    common = np.all(seen, axis=0)
    if not common.any():
        common = np.any(seen, axis=0)
    # A form has another PV where it is read elsewhere: all scans at the same places.
    places = places_of(solution, common)
    alone = []
    for k in range(blocks.scans):
        scales = replace(solution.scales, noise=solution.scales.noise[[k]])
        one = solve(solution.network.alone(k), y[blocks.scan == k], scales, {})
        alone.append(FormOf.of(one, nominal, removed, places).pv_and_rms())
    return tuple(_compared(solution, k, alone) for k in range(blocks.scans))


def _compared(
    solution: Solution, scan: int, alone: Sequence[tuple[Figure, Figure]]
) -> ScanAgreement:
    one = alone[scan]
    others = [a for k, a in enumerate(alone) if k != scan]
    name = f"{DIFFERS}@{scan}"
    family = next(f for f in solution.network.families if f.name == name)
    evidence = evidence_of(solution, family)
    terms = np.abs(evidence.values) / (2 * np.hypot(evidence.uncertainty, solution.scales.texture))
    number = len(alone) * (len(terms) + 2)
    return ScanAgreement(
        scan=scan,
        pv=_e_n(one[0], _mean([a[0] for a in others])),
        rms=_e_n(one[1], _mean([a[1] for a in others])),
        terms=terms,
        limit=max(1.0, -float(scipy.special.ndtri(_BY_CHANCE / (2 * number))) / 2),
        alone=one,
    )


def _mean(figures: Sequence[Figure]) -> Figure:
    """Return the weighted mean of independent figures."""
    weights = np.array([1 / max(f.uncertainty, 1e-15) ** 2 for f in figures])
    values = np.array([f.value for f in figures])
    return Figure(float(weights @ values / weights.sum()), float(weights.sum() ** -0.5))


def _e_n(one: Figure, other: Figure) -> float:
    spread = 2 * np.hypot(one.uncertainty, other.uncertainty)
    return float(abs(one.value - other.value) / max(spread, 1e-15))
