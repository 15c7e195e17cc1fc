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
from dataclasses import dataclass, replace

import numpy as np

from omsm_ros.core.dynamics.transfer_function import TransferFunction
from omsm_ros.core.fitting.model_structure import Structure
from omsm_ros.core.fitting.output_error import Fit, Problem, fit
from omsm_ros.core.samples.blocks import BoolArray
from omsm_ros.errors import IdentificationError

MAX_POLES = 8
_LEAST_PARAMETERS = 3
# Held-out rms, relative: far above its scatter over a few thousand samples.
_CLEARLY_WORSE = 1.05
# Distance of a zero from a pole, relative: nearer than the data could ever tell apart.
_CANCELLING = 0.005


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


def information(fit: Fit, colour: float = 1.0) -> float:
    """Bayesian information criterion, -2 log likelihood + colour · size · log n.

    colour: power of the noise at low frequency over its mean. Of coloured noise a slow
        parameter explains that much more by chance, and has to explain it to be believed.
    """
    n = fit.samples
    floor = float(np.finfo(np.float64).tiny)
    return float(n * np.log(max(fit.sum_of_squares, floor) / n) + colour * fit.size * np.log(n))


def explore(
    fit_structure: Callable[[Structure, Sequence[Fit]], Fit],
    at_least: int,
    forced: int,
    colour: float = 1.0,
) -> list[Candidate]:
    """Fit structure after structure; stop when two more poles in a row gain nothing.

    at_least: number of poles to go to in any case;  forced: only this many, if not 0
    colour: of the noise, see :func:`information`

    Raises IdentificationError for a forced order that is no number of poles to try.
    """
    if not 0 <= forced <= MAX_POLES:
        raise IdentificationError(f"order {forced!r}, expected 0 (choose) to {MAX_POLES}")
    found: list[Candidate] = []
    fruitless = 0
    for poles in range(forced + 1) if forced else range(MAX_POLES + 1):
        before = min((c.bic for c in found), default=np.inf)
        for structure in _promising(poles, found, fit_structure, colour):
            fitted = fit_structure(structure, [c.fit for c in found])
            found.append(Candidate(fitted, information(fitted, colour)))
        fruitless = 0 if min(c.bic for c in found) < before else fruitless + 1
        if not forced and fruitless >= 2 and poles > at_least:
            break
    return [c for c in found if not forced or c.fit.structure.poles == forced]


def _promising(
    poles: int,
    found: list[Candidate],
    fit_structure: Callable[[Structure, Sequence[Fit]], Fit],
    colour: float,
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
    found.append(Candidate(largest, information(largest, colour)))
    spare = (best - information(largest, colour)) / (colour * np.log(largest.samples))
    return [s for s in every[:-1] if s.size < largest.structure.size + spare]


def choose(
    candidates: Sequence[Candidate], held_out: Callable[[Fit], float]
) -> tuple[Candidate, list[Candidate]]:
    """The best by BIC, enriched: the best of those that contain it with one parameter more.

    With fewer than three parameters, lag and roll-off could not both bend over the band.
    One whose zero cancels a pole is no richer. The enriched one is vetoed where it is
    clearly worse on edges it has not seen.

    held_out: rms [m] of a structure, fitted without the held-out edges, on them
    """
    smallest = min(candidates, key=lambda c: c.bic)
    wanted = max(smallest.fit.structure.size + 1, _LEAST_PARAMETERS)
    richer = [
        c
        for c in candidates
        if c.fit.structure.contains(smallest.fit.structure)
        and c.fit.structure.size >= wanted
        and not cancels(c.fit.dynamics)
    ]
    enriched = min(
        richer, key=lambda c: (c.fit.structure.size, c.fit.sum_of_squares), default=smallest
    )
    scored = {c: replace(c, held_out=held_out(c.fit)) for c in {smallest, enriched}}
    chosen = scored[enriched]
    if chosen.held_out > _CLEARLY_WORSE * scored[smallest].held_out:
        chosen = scored[smallest]
    return chosen, [scored.get(c, c) for c in candidates]


def cancels(dynamics: TransferFunction) -> bool:
    """True if a zero all but cancels a pole, which then means nothing and has no covariance."""
    poles, zeros = dynamics.poles(), dynamics.zeros()
    apart = np.abs(poles[:, np.newaxis] - zeros[np.newaxis])
    return bool(np.any(apart < _CANCELLING * np.abs(poles[:, np.newaxis])))


def held_out_rms(problem: Problem, fitted: Fit, held: BoolArray) -> float:
    """rms [m] over the samples ``held`` (n,) of the structure fitted without them; NaN if none."""
    rest, unseen = problem.used & ~held, problem.used & held
    if not (np.any(rest) and np.any(unseen)):
        return float("nan")
    without = fit(replace(problem, used=rest), fitted.structure, [fitted.nonlinear])
    missed = problem.output[unseen] - problem.modelled(without)[unseen]
    return float(np.sqrt(np.mean(missed**2)))
