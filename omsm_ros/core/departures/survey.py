"""Which departures from a linear, steady G(s) does the residual of one fit show?"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from omsm_ros.core.departures.families import PERIODIC, Departures, Family, Term
from omsm_ros.core.departures.residual_space import ResidualSpace, Score
from omsm_ros.core.fitting.output_error import Fit, Problem
from omsm_ros.core.fitting.steps import Steps

# Probability of a false alarm of one family; ten of them together stay far below two per cent.
FALSE_ALARM = 1e-4
# Of the rate of the motion, as the residual may follow it.
_LAGS = 25
# A lagged rate weaker than this part of the strongest is rounding.
_ABOVE_ROUNDING = 1e-6


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
        screened = self.space.screen(family.columns, family.width)
        return family.term(int(np.argmax(screened)))

    @cached_property
    def creep(self) -> tuple[Judged, ...]:
        """Return relaxations of every time constant that is looked for, each judged alone."""
        family = self.departures.creep()
        terms = [family.term(index) for index in range(len(family.parameters))]
        return tuple(Judged(t, self.space.score(t.columns[:, :1])) for t in terms)

    @cached_property
    def independence(self) -> float:
        """Return the probability that the residual follows the motion's rate by chance."""
        rate = np.gradient(self.problem.input)
        past = np.column_stack([np.roll(rate, lag) for lag in range(_LAGS)])
        past[:_LAGS] = 0.0
        left, values, _ = np.linalg.svd(past, full_matrices=False)
        kept = values > _ABOVE_ROUNDING * values[0]
        return float(np.exp(self.space.score(left[:, kept]).log_p)) if np.any(kept) else 1.0

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
