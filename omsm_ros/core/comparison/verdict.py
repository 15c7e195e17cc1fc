"""Agree, differ, or cannot tell; and why."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from omsm_ros.core.comparison.agreement import Agreement, root_mean_square
from omsm_ros.core.comparison.matching import Matched
from omsm_ros.readable import chance, figure, percent, plain, quantity

AGREE, DIFFER, CANNOT_TELL = "agree", "differ", "cannot tell"

# Of pairs that agree one in a hundred may look as unlikely.
_LEAST_PROBABILITY = 0.01
# A term beyond one, which of pairs that agree one in twenty has, and all terms as unlikely as that.
_UNLIKELY = 0.05
# What is beyond one but not by this is as well chance as a difference.
_PLAINLY_BEYOND = 1.25
# Of the smaller area: of less, the figures are those of another part.
_LEAST_SHARED = 0.5


@dataclass(frozen=True, slots=True)
class Verdict:
    """verdict: AGREE, DIFFER or CANNOT_TELL;  reasons: for it, the weightiest first
    reservations: what it rests on beside the stated uncertainties
    """

    verdict: str
    reasons: tuple[str, ...]
    reservations: tuple[str, ...]


def verdict_of(
    matched: Matched,
    agreement: Agreement | None,
    unknown: tuple[str, ...],
    shared: float,
    reservations: tuple[str, ...],
) -> Verdict:
    """Return the verdict.

    agreement: None if the uncertainty of a measurement is not known;  unknown: why
    shared: of the smaller area, the share that both cover
    """
    if shared < _LEAST_SHARED:
        unknown += (f"they share {percent(shared)} of the smaller area, expected 50 % or more",)
    if agreement is None or shared < _LEAST_SHARED:
        return Verdict(CANNOT_TELL, unknown, reservations)
    differs = _differences(agreement)
    if differs:
        return Verdict(DIFFER, differs, reservations)
    doubts = _doubts(matched, agreement)
    if doubts:
        return Verdict(CANNOT_TELL, doubts, reservations)
    largest = agreement.largest
    return Verdict(
        AGREE,
        (
            f"all {len(agreement.terms)} Zernike terms: the largest |E_n| is "
            f"{plain(abs(largest.e_n))}, of {_named(largest.n, largest.m)}",
            f"a difference like theirs or larger: {chance(agreement.probability)}",
            f"|E_n| < 1 on {percent(agreement.within, 3)} of the area",
            "what may differ unseen, term by term: up to " + _least_sure(agreement),
        ),
        reservations,
    )


def _least_sure(found: Agreement) -> str:
    """Return the terms of the largest uncertainty, with it."""
    terms = sorted(found.terms, key=lambda term: -term.expanded)[:3]
    return ", ".join(f"{quantity(t.expanded, 'm')} of {_named(t.n, t.m)}" for t in terms)


def _differences(found: Agreement) -> tuple[str, ...]:
    largest, probability = found.largest, found.probability
    plainly = abs(largest.e_n) > _PLAINLY_BEYOND
    both = abs(largest.e_n) > 1 and probability < _UNLIKELY
    reasons = []
    if plainly or both:
        reasons.append(
            f"{_named(largest.n, largest.m)} differs by {quantity(largest.difference, 'm')} "
            f"where {quantity(largest.expanded, 'm')} are explained: E_n = {plain(largest.e_n)}"
        )
    if probability < _LEAST_PROBABILITY or both:
        reasons.append(
            f"all terms together: {chance(probability)} if only the stated errors were there"
        )
    if found.farthest > _PLAINLY_BEYOND * found.allowed:
        x, y = (quantity(place, "m") for place in found.at)
        reasons.append(
            f"at x = {x}, y = {y} they differ by {plain(found.farthest)} standard "
            f"uncertainties, where {plain(found.allowed)} are the most to expect of all places"
        )
    reasons += [
        f"{figure(name)}: E_n = {plain(number.e_n)}"
        for name, number in found.figures.items()
        if number.e_n is not None and abs(number.e_n) > _PLAINLY_BEYOND and reasons
    ]
    return tuple(reasons)


def _doubts(matched: Matched, found: Agreement) -> tuple[str, ...]:
    beyond = {_named(t.n, t.m): t.e_n for t in found.terms if abs(t.e_n) > 1}
    beyond |= {
        figure(name): number.e_n
        for name, number in found.figures.items()
        if number.e_n is not None and abs(number.e_n) > 1
    }
    doubts = [
        f"{name} has E_n = {plain(value)}, too little beyond 1 to tell"
        for name, value in beyond.items()
    ]
    deviation = matched.without_fit(np.stack([matched.a, matched.b]))
    compared = float(np.max(root_mean_square(deviation)))
    # Of half the terms: a pose that is hardly known leaves two or three open, and tells the others.
    usual = float(np.median([term.expanded for term in found.terms]))
    if usual > compared:
        doubts.append(
            f"half of the terms have an uncertainty of {quantity(usual, 'm')} or more, more "
            f"than all that is compared, {quantity(compared, 'm')} rms; measure with less"
        )
    return tuple(doubts)


_NAMES = {
    (2, 0): "power",
    (2, 2): "astigmatism",
    (2, -2): "oblique astigmatism",
    (3, 1): "coma in x",
    (3, -1): "coma in y",
    (3, 3): "trefoil",
    (3, -3): "oblique trefoil",
    (4, 0): "spherical aberration",
}


def _named(n: int, m: int) -> str:
    term = f"Z({n}, {m})"
    return f"{_NAMES[n, m]} {term}" if (n, m) in _NAMES else term
