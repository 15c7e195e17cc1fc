"""How many poles and zeros, and is there a delay? What the data ask for, and one parameter more.

The Bayesian information criterion finds the smallest structure that the data ask for. It is still
biased by about one standard deviation, which no covariance shows. The chosen structure is
therefore the best with one parameter more: it trades that bias for variance, which the band
states. What else was tried, and changed nothing, is in
``docs/design/identification-ablation.md``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from omsm_ros.core.dynamics.transfer_function import TransferFunction
from omsm_ros.core.fitting.descent import Effort
from omsm_ros.core.fitting.model_structure import Structure
from omsm_ros.core.fitting.output_error import Fit, Problem, fit
from omsm_ros.core.samples.blocks import BoolArray
from omsm_ros.errors import IdentificationError

# Without asking; real machines in the band of a step test have needed four.
_FREE_POLES = 8
# With asking: beyond, the coefficients of a polynomial lose their digits.
MAX_POLES = 20
# A lag and its roll-off: with fewer, the band is three times too narrow on a pure delay.
_LEAST_PARAMETERS = 3
# Of the critical damping: a resonance beyond half the sampling rate shows in no sample.
_DAMPED_BEYOND = 0.1
# Radians a sample, some thirty times half the sampling rate: from there on it is a constant.
_OUT_OF_SIGHT = 100.0
# Distance of a zero from a pole, relative: nearer than the data could ever tell apart.
_CANCELLING = 0.005


def structures(poles: int) -> list[Structure]:
    """Return those with ``poles``, smallest first: one or two zeros fewer, with a delay or without.

    A mass cannot follow infinitely fast, so there are always fewer zeros than poles.
    """
    if poles == 0:
        return [Structure(0, 0, True)]
    zeros = range(max(poles - 2, 0), poles)
    every = [Structure(poles, m, delay) for m in zeros for delay in (False, True)]
    return sorted(every, key=lambda structure: (structure.size, structure.delay))


@dataclass(frozen=True, eq=False)
class Candidate:
    """A fit with its BIC; lower is better."""

    fit: Fit
    bic: float


def information(fit: Fit, colour: float = 1.0) -> float:
    """Return the Bayesian information criterion, -2 log likelihood + colour · size · log n.

    colour: power of the noise at low frequency over its mean. A parameter of slow dynamics
        explains that much more of coloured noise by chance, so its price is that much higher.
    """
    n = fit.samples
    floor = float(np.finfo(np.float64).tiny)
    return float(n * np.log(max(fit.sum_of_squares, floor) / n) + colour * fit.size * np.log(n))


def explore(
    fit_structure: Callable[[Structure, Sequence[Fit]], Fit],
    order: int = 0,
    colour: float = 1.0,
    effort: Effort | None = None,
) -> list[Candidate]:
    """Fit structures of rising order until two more poles in a row gain nothing.

    order: number of poles to go to in any case;  colour: of the noise, see :func:`information`
    effort: of the fits; once it is spent no further order is begun

    Raises IdentificationError for an order that is no number of poles to try.
    """
    if not 0 <= order <= MAX_POLES:
        raise IdentificationError(f"order {order!r}, expected 0 (choose) to {MAX_POLES}")
    found: list[Candidate] = []
    fruitless = 0
    for poles in range(max(_FREE_POLES, order) + 1):
        before = min((c.bic for c in found), default=np.inf)
        for structure in _promising(poles, found, fit_structure, colour):
            fitted = fit_structure(structure, [c.fit for c in found])
            found.append(Candidate(fitted, information(fitted, colour)))
        fruitless = 0 if min(c.bic for c in found) < before else fruitless + 1
        enough = fruitless >= 2 or (effort is not None and effort.spent)
        if enough and poles >= order:
            break
    return found


def _promising(
    poles: int,
    found: list[Candidate],
    fit_structure: Callable[[Structure, Sequence[Fit]], Fit],
    colour: float,
) -> list[Structure]:
    """Return the structures with ``poles`` that may yet win.

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


def choose(candidates: Sequence[Candidate]) -> Candidate:
    """Return the best structure that contains the best by BIC and has one parameter more.

    It has three parameters at least: with fewer, lag and roll-off are not independent. A
    structure whose zero cancels a pole does not count as larger.
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
    return min(richer, key=lambda c: (c.fit.structure.size, c.fit.sum_of_squares), default=smallest)


def identifiable(dynamics: TransferFunction, period: float, duration: float) -> bool:
    """Return whether samples every ``period`` [s] for ``duration`` [s] identify every pole.

    One that decays no faster than the record lasts is a line of vibration or a drift; one that
    rings beyond half the sampling rate fits noise, and a filter made of it would ring.
    """
    poles = dynamics.poles()
    rate, decay = np.abs(poles), -poles.real
    lasting = decay * duration < 1
    turned = rate * period
    beyond = (np.pi < turned) & (turned < _OUT_OF_SIGHT)
    ringing = beyond & (decay < _DAMPED_BEYOND * rate)
    return not bool(np.any(lasting | ringing))


def cancels(dynamics: TransferFunction) -> bool:
    """Return whether a zero nearly cancels a pole: neither then has a meaningful covariance."""
    poles, zeros = dynamics.poles(), dynamics.zeros()
    apart = np.abs(poles[:, np.newaxis] - zeros[np.newaxis])
    return bool(np.any(apart < _CANCELLING * np.abs(poles[:, np.newaxis])))


def held_out_rms(problem: Problem, fitted: Fit, held: BoolArray) -> float:
    """Return the rms residual [m] over ``held`` (n,), fitted without them; NaN for none."""
    rest, unseen = problem.used & ~held, problem.used & held
    if not (np.any(rest) and np.any(unseen)):
        return float("nan")
    without = fit(replace(problem, used=rest), fitted.structure, [fitted.nonlinear])
    missed = problem.output[unseen] - problem.modelled(without)[unseen]
    return float(np.sqrt(np.mean(missed**2)))
