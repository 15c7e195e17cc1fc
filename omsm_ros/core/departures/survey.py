"""Which departures from a linear, steady G(s) does the residual of one fit show?"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from omsm_ros.core.departures.families import (
    BACKLASH,
    FASTEST_MODE_HZ,
    FRICTION,
    PERIODIC,
    VIBRATION,
    Departures,
)
from omsm_ros.core.departures.residual_space import ResidualSpace, Score
from omsm_ros.core.departures.term import Family, Term
from omsm_ros.core.fitting.output_error import Fit, Problem, evaluated
from omsm_ros.core.fitting.starting_points import ABOVE_CONTENT, ENOUGH_SAMPLES, coarser
from omsm_ros.core.fitting.steps import Edge, Steps
from omsm_ros.core.samples.blocks import FloatArray

# Probability of a false alarm of one family; ten of them together stay far below two per cent.
FALSE_ALARM = 1e-4
# Of the rate of the motion, as the residual may follow it.
_LAGS = 25
# A lagged rate weaker than this part of the strongest is rounding.
_ABOVE_ROUNDING = 1e-6
# Rows, and values of columns, that are in memory at a time.
_ROWS, _VALUES = 65_536, 8_000_000
# A step test rests for most of its time.
_MOSTLY = 0.5
# Where a motion turns and what a line is, fewer samples do not tell as well; their terms are few.
_BY_ALL = (VIBRATION, BACKLASH, FRICTION)


@dataclass(frozen=True, eq=False)
class Judged:
    """A term and what the residual says of it."""

    term: Term
    score: Score

    @property
    def log_p(self) -> float:
        """Natural logarithm of the probability of such a score anywhere in its family."""
        return self.score.log_p + float(np.log(self.term.trials))

    def evidence(self, samples: int) -> float:
        """Return ln of the odds for this term (Schwarz 1978), its coefficients priced."""
        return 0.5 * (self.score.chi_square - self.score.degrees * float(np.log(samples)))

    @property
    def significant(self) -> bool:
        """Return whether chance is less likely than FALSE_ALARM."""
        return bool(self.log_p < np.log(FALSE_ALARM))


@dataclass(frozen=True, eq=False)
class Survey:
    """The scores for ``fitted`` of all families, or of those named; each is computed once.

    slower: see :class:`Departures`
    """

    problem: Problem
    fitted: Fit
    steps: Steps
    only: Collection[str] = ()
    slower: float = 1.0

    @cached_property
    def space(self) -> ResidualSpace:
        """The residual, and what the fit imitates."""
        return ResidualSpace(self.problem, self.fitted)

    @cached_property
    def departures(self) -> Departures:
        """The columns of all families."""
        return Departures(self.problem, self.fitted, self.steps, self.slower)

    @cached_property
    def best(self) -> Mapping[str, Judged]:
        """Return the most significant term of each family, by the name of the family."""
        found: dict[str, Judged] = {}
        for family in self.departures.families(self.only):
            term = self._best_of(family)
            if family.name == PERIODIC:
                term = self._best_of(self.departures.periodic(term.parameter))
            judged, before = Judged(term, self.space.score(term.columns)), found.get(family.name)
            if before is None or self.evidence(judged) > self.evidence(before):
                found[family.name] = judged
        return found

    def _best_of(self, family: Family) -> Term:
        if len(family.parameters) == 1:
            return family.term(0)
        if self.thinned is None or family.name in _BY_ALL:
            return family.term(int(np.argmax(self.screened(family))))
        alike = self.thinned.departures.alike(family)
        return family.term(int(np.argmax(self.thinned.screened(alike))))

    def screened(self, family: Family) -> FloatArray:
        """Return χ² of each term of ``family``, as for white noise, see :class:`ResidualSpace`."""
        every = len(family.parameters)
        step = max(_VALUES // (len(self.problem.input) * family.width), 1)
        return np.concatenate(
            [
                self.space.screen(family.part(i, min(i + step, every)), family.width)
                for i in range(0, every, step)
            ]
        )

    @cached_property
    def thinned(self) -> Survey | None:
        """The same of fewer samples, of a long step test: what is slow shows there as well.

        None where there are few samples, where the motion hardly rests, so that much of it may be
        fast, or where rounding is shared by the readings of a plateau.
        """
        problem, steps = self.problem, self.steps
        fastest = max(problem.rate / (2 * np.pi), FASTEST_MODE_HZ)
        per_content = 0.5 / (problem.period * fastest * ABOVE_CONTENT)
        every = int(min(len(problem.input) / ENOUGH_SAMPLES, per_content))
        rests = bool(steps.edges) and float(np.mean(steps.moving)) < _MOSTLY
        if every < 2 or not rests or problem.shared > 0:
            return None
        fewer = coarser(problem, every)
        fitted = evaluated(fewer, self.fitted.structure, self.fitted.nonlinear)
        edges = tuple(
            Edge(edge.start // every, -(-edge.stop // every), edge.height) for edge in steps.edges
        )
        moved = replace(steps, edges=edges, moving=steps.moving[::every])
        return replace(self, problem=fewer, fitted=fitted, steps=moved)

    @cached_property
    def creep(self) -> tuple[Judged, ...]:
        """Return relaxations of every time constant that is looked for, each judged alone."""
        family = self.departures.creep()
        terms = (family.term(index) for index in range(len(family.parameters)))
        return tuple(Judged(t, self.space.score(t.columns[:, :1])) for t in terms)

    @cached_property
    def independence(self) -> float:
        """Return the probability that the residual follows the motion's rate by chance."""
        rate = np.concatenate([np.zeros(_LAGS - 1), np.gradient(self.problem.input)])
        # The last values of the rate, the newest last; at the very first samples there are none.
        past = np.lib.stride_tricks.sliding_window_view(rate, _LAGS)
        gram = np.zeros((_LAGS, _LAGS))
        for first in range(0, len(past), _ROWS):
            rows = np.ascontiguousarray(past[first : first + _ROWS])
            gram += rows.T @ rows
        powers, directions = np.linalg.eigh(gram)
        kept = powers > _ABOVE_ROUNDING**2 * powers[-1]
        if not np.any(kept):
            return 1.0
        mixed = directions[:, kept] / np.sqrt(powers[kept])
        columns = np.empty((mixed.shape[1], len(past)))
        for first in range(0, len(past), _ROWS):
            columns[:, first : first + _ROWS] = (past[first : first + _ROWS] @ mixed).T
        return float(np.exp(self.space.judged(columns).log_p))

    def significant(self, but: Collection[str] = ()) -> list[Judged]:
        """Return the significant families, the clearest first, without those named ``but``."""
        shown = [j for j in self.best.values() if j.term.family not in but and j.significant]
        return sorted(shown, key=self.evidence, reverse=True)

    def evidence(self, judged: Judged) -> float:
        """Return the logarithm of the odds for ``judged``."""
        return judged.evidence(self.fitted.samples)

    @property
    def slowest_creep(self) -> float:
        """Return the longest time constant [s] that was looked for."""
        return float(self.departures.time_constants()[-1])

    @property
    def plateau(self) -> float:
        """Time from one edge to the next [s]; of a motion without edges its whole length."""
        starts = [edge.start for edge in self.steps.edges]
        if len(starts) < 2:
            return self.departures.duration
        return float(np.median(np.diff(starts))) * self.problem.period
