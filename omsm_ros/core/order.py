"""How many poles, zeros, and whether a delay: what the data insist on, and one more.

Three votes. The singular values of a block-Hankel matrix (Verhaegen and Dewilde 1992) say
how many states stand out of the noise, and bound the search. The Bayesian information
criterion finds the smallest structure the data insist on. Held-out edges may veto it.

The smallest such structure still leaves a bias of about one standard deviation, which no
covariance shows. The chosen one is therefore the best with one parameter more: variance,
which the band states, is preferred to bias, which nobody sees.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from omsm_ros.core.output_error import Fit
from omsm_ros.core.structure import Structure

MAX_POLES = 8
_LEAST_PARAMETERS = 3


def structures(poles: int) -> list[Structure]:
    """Those with ``poles``, smallest first: one or two zeros fewer, with a delay or without.

    What has mass does not follow infinitely fast, so there are always fewer zeros than poles.
    """
    if poles == 0:
        return [Structure(0, 0, True)]
    zeros = range(max(poles - 2, 0), poles)
    every = [Structure(poles, m, delay) for m in zeros for delay in (False, True)]
    return sorted(every, key=lambda structure: (structure.size, structure.delay))


@dataclass(frozen=True, eq=False)
class Candidate:
    """A fit with its scores: BIC (lower is better), held-out rms [m] or NaN where not tried."""

    fit: Fit
    bic: float
    held_out: float = float("nan")


def information(fit: Fit) -> float:
    """Bayesian information criterion, -2 log likelihood + size · log n."""
    n = fit.samples
    floor = np.finfo(np.float64).tiny
    return float(n * np.log(max(fit.sum_of_squares, floor) / n) + fit.structure.size * np.log(n))


def explore(
    fit_structure: Callable[[Structure, Sequence[Fit]], Fit], at_least: int, forced: int
) -> list[Candidate]:
    """Fit structure after structure; stop when two more poles in a row gain nothing.

    at_least: number of poles to go to in any case;  forced: only this many, if not 0
    """
    found: list[Candidate] = []
    fruitless = 0
    for poles in range(forced + 1) if forced else range(MAX_POLES + 1):
        before = min((c.bic for c in found), default=np.inf)
        for structure in _promising(poles, found, fit_structure):
            fitted = fit_structure(structure, [c.fit for c in found])
            found.append(Candidate(fitted, information(fitted)))
        fruitless = 0 if min(c.bic for c in found) < before else fruitless + 1
        if not forced and fruitless >= 2 and poles > at_least:
            break
    return [c for c in found if not forced or c.fit.structure.poles == forced]


def _promising(
    poles: int,
    found: list[Candidate],
    fit_structure: Callable[[Structure, Sequence[Fit]], Fit],
) -> list[Structure]:
    """The structures with ``poles`` that may yet win.

    The largest contains them all: what it cannot gain none of them can, so it is fitted
    first and added to ``found``, unless there are so few poles that all are of interest.
    """
    every = structures(poles)
    if poles < 3:
        return every
    largest = fit_structure(every[-1], [c.fit for c in found])
    best = min(c.bic for c in found)
    found.append(Candidate(largest, information(largest)))
    per_parameter = np.log(largest.samples)
    free = information(largest) - largest.structure.size * per_parameter
    return [s for s in every[:-1] if free + s.size * per_parameter < best]


def choose(candidates: Sequence[Candidate]) -> Candidate:
    """The best by BIC, enriched: the best of those that contain it with one parameter more.

    With fewer than three parameters, lag and roll-off could not both bend over the band.
    """
    smallest = min(candidates, key=lambda c: c.bic)
    wanted = max(smallest.fit.structure.size + 1, _LEAST_PARAMETERS)
    richer = [
        c
        for c in candidates
        if c.fit.structure.contains(smallest.fit.structure) and c.fit.structure.size >= wanted
    ]
    return min(
        richer, key=lambda c: (c.fit.structure.size, c.fit.sum_of_squares), default=smallest
    )
