"""Model errors are added to a fit one after the other while the residual shows a significant one.

A slow relaxation or a soft mode becomes poles of G. Errors that are added to the reading
independently of G (backlash, friction, drift, lines of vibration …) become nuisance terms, columns
of the background. Two slow families that explain the residual about equally well are fitted
together, because one alone would also explain a part of the other.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from omsm_ros.core.estimation.model_order import Candidate, fit, identifiable, information
from omsm_ros.core.estimation.model_structure import Fit
from omsm_ros.core.estimation.noise import VERY_STRONG, correct_errors_in_variables
from omsm_ros.core.estimation.optimisation import EvaluationBudget
from omsm_ros.core.estimation.preparation import Prepared
from omsm_ros.core.identification.model_choice import OVER, ChosenModel
from omsm_ros.core.lti.transfer_function import Structure
from omsm_ros.core.model_errors.families import (
    BACKLASH,
    CREEP,
    DRIFT,
    FRICTION,
    LINEARITY,
    MODE,
    PERIODIC,
    STIFFENING,
    VIBRATION,
    ModelErrorTerm,
)
from omsm_ros.core.model_errors.residual_diagnostics import ResidualDiagnostics, ScoreTest
from omsm_ros.core.model_errors.undetected import at_fitted_pole, fit_with_added_poles, poles_of

# Rounds, each for one model error; a machine with more errors cannot be used to measure.
_MOST_ROUNDS = 6
_POLES = {CREEP, MODE}
_NUISANCE_FAMILIES = {BACKLASH, DRIFT, FRICTION, LINEARITY, PERIODIC, VIBRATION}
# Families whose columns depend on the fitted response, and improve it.
_TURNING = {BACKLASH, FRICTION}
_SLOW = {BACKLASH, CREEP, DRIFT, FRICTION, LINEARITY}
# Most poles of a simple model, a structure and its roll-off; nonlinearity looks like many more.
_PLAIN_POLES = 2
# Factors on the poles of a mode at which a fit starts: tested modes are six per cent apart.
_MODE_FREQUENCY_RATIOS = (1.0, 0.97, 1.03)


@dataclass(frozen=True, eq=False)
class ModelledTerm:
    """A nuisance term and its ``columns`` in the background."""

    term: ModelErrorTerm
    columns: slice


@dataclass(frozen=True, eq=False)
class SearchResult:
    """The result of the search.

    nuisance_terms: model errors in the background;  added_poles: those that became poles
    stiffening: a stiffness that grows, which has no model;  diagnostics: of the last fit
    p_value: least chance of all else by which the residual follows the motion
    without: diagnostics of the fit before each of ``added_poles`` was added
    incomplete: the search was cut short, because its budget was exhausted
    """

    prepared: Prepared
    model: ChosenModel
    diagnostics: ResidualDiagnostics
    nuisance_terms: Sequence[ModelledTerm] = ()
    added_poles: Sequence[ModelErrorTerm] = ()
    stiffening: ScoreTest | None = None
    p_value: float = 1.0
    without: Sequence[ResidualDiagnostics] = ()
    incomplete: bool = False


Choose = Callable[..., tuple[Prepared, ChosenModel]]


def search_model_errors(
    prepared: Prepared,
    choose: Choose,
    budget: EvaluationBudget | None = None,
    *,
    may_grow: bool = True,
) -> SearchResult:
    """Add model errors to the problem or to the model until the residual shows no more.

    choose: fits a prepared problem anew, as ``model_from_start``
    budget: of all evaluations, None for the default
    may_grow: poles may be added to the model
    """
    started = _initial_model(prepared, choose, budget or EvaluationBudget())
    search = _Search(choose, *started, refused=set() if may_grow else {*_POLES})
    diagnostics = search.diagnostics()
    for _ in range(_MOST_ROUNDS):
        shown = list(filter(search.new, diagnostics.significant(search.refused | search.settled)))
        # A stiffness that grows has no model, and a term that is added after it would imitate it.
        if not shown or shown[0].term.family == STIFFENING:
            break
        # Without budget a nuisance term is still fitted to the structure that was chosen.
        if search.budget.stops() and shown[0].term.family in _POLES:
            break
        if search.add(diagnostics, shown):
            diagnostics = search.diagnostics()
    left = diagnostics.significant(search.settled)
    # A family with a model was tried, or the search did not come to it: it names no cause.
    stiffening = left[0] if left and left[0].term.family == STIFFENING else None
    return SearchResult(
        search.prepared,
        search.model,
        diagnostics,
        search.nuisance_terms,
        search.grown,
        stiffening,
        min([diagnostics.independence] + [float(np.exp(j.log_p)) for j in left if j != stiffening]),
        search.without,
        incomplete=search.budget.incomplete,
    )


@dataclass(eq=False)
class _Search:
    """The state of a search.

    refused: families whose poles were no improvement
    settled: families whose columns were recomputed for the response
    grown, without: terms that became poles since the last nuisance term, and the diagnostics before
    """

    choose: Choose
    prepared: Prepared
    nuisance_terms: list[ModelledTerm]
    model: ChosenModel
    budget: EvaluationBudget
    refused: set[str] = field(default_factory=set)
    settled: set[str] = field(default_factory=set)
    grown: list[ModelErrorTerm] = field(default_factory=list)
    without: list[ResidualDiagnostics] = field(default_factory=list)

    def diagnostics(self) -> ResidualDiagnostics:
        """Return the diagnostics of the model."""
        return ResidualDiagnostics(
            self.prepared.problem, self.model.chosen.fit, self.prepared.steps
        )

    def add(self, diagnostics: ResidualDiagnostics, shown: Sequence[ScoreTest]) -> bool:
        """Add the first of the model errors ``shown``; return False if it is refused."""
        columns = _select_nuisance_terms(diagnostics, shown)
        present = {modelled.term.family for modelled in self.nuisance_terms}
        again = {judged.term.family for judged in columns} & _TURNING & present
        if again:
            background = self.prepared.problem.background.copy()
            for place, modelled in enumerate(self.nuisance_terms):
                if modelled.term.family in again:
                    term = diagnostics.model_errors.again(modelled.term)
                    background[:, modelled.columns] = term.columns
                    self.nuisance_terms[place] = ModelledTerm(term, modelled.columns)
            problem = replace(self.prepared.problem, background=background)
            self.prepared = replace(self.prepared, problem=problem)
            self.settled |= again
        elif columns:
            self.prepared, added = _with_columns(self.prepared, columns, self.nuisance_terms)
            self.nuisance_terms = [*self.nuisance_terms, *added]
            self.grown, self.without = [], []
        else:
            if (larger := _grown(self.prepared, self.model, shown[0].term, self.budget)) is None:
                self.refused.add(shown[0].term.family)
                return False
            self.prepared, self.model = larger
            self.grown.append(at_fitted_pole(shown[0].term, self.model.chosen.fit))
            self.without.append(diagnostics)
            return True
        self.prepared, self.model = self.choose(self.prepared, self.budget, kept=self.model)
        return True

    def new(self, judged: ScoreTest) -> bool:
        """Return whether no nuisance term has its period, to a cycle: two could cancel."""
        known = [m.term.parameter for m in self.nuisance_terms if m.term.family == PERIODIC]
        apart = 1 / np.array(known) - 1 / (judged.term.parameter or np.inf)
        cycles = np.abs(apart) * np.ptp(self.prepared.problem.input)
        return judged.term.family != PERIODIC or bool(np.all(cycles >= 1))


def _initial_model(
    prepared: Prepared, choose: Choose, budget: EvaluationBudget
) -> tuple[Prepared, list[ModelledTerm], ChosenModel, EvaluationBudget]:
    prepared, nuisance_terms = _with_columns(prepared, _drift(prepared, budget))
    prepared, model = choose(prepared, budget)
    prepared, model, budget = _with_errors_in_variables(prepared, model, choose, budget)
    if columns := _modelled_as_poles(prepared, model, budget):
        prepared, added = _with_columns(prepared, columns, nuisance_terms)
        nuisance_terms += added
        prepared, model = choose(prepared, budget, kept=model)
    return prepared, nuisance_terms, model, budget


def _with_errors_in_variables(
    prepared: Prepared, model: ChosenModel, choose: Choose, budget: EvaluationBudget
) -> tuple[Prepared, ChosenModel, EvaluationBudget]:
    """Return all three with the encoder's own noise taken out, if that describes more.

    The problem without it is searched anew, with a budget of its own.
    """
    best = prepared, model, budget
    # Twice, because noise in the input may have led to a wild response.
    for _ in range(2):
        before = best[1].chosen.fit
        known = prepared.problem.evaluated(before.structure, before.nonlinear)
        problem = correct_errors_in_variables(prepared.problem, known, prepared.steps.edges)
        if problem is None:
            break
        quieter, own = replace(prepared, problem=problem), EvaluationBudget(watch=budget.watch)
        quieter, found = choose(quieter, own, before=best[1])
        if information(found.chosen.fit) >= information(before):
            break
        best = quieter, found, own
    return best


def _drift(prepared: Prepared, budget: EvaluationBudget) -> list[ScoreTest]:
    """Return drift that is significant with a delay alone, before a slow pole can fit it.

    A nonlinear scale of the probe competes with it: steps that climb and return make both alike.
    """
    problem = prepared.problem
    lag = fit(problem, Structure(0, 0, True), [np.array([0.1])], budget=budget, part=problem.sums)
    diagnostics = ResidualDiagnostics(problem, lag, prepared.steps, (CREEP, DRIFT, LINEARITY))
    # If the decimated record shows none, all samples need not be tested.
    for each in filter(None, (diagnostics.thinned, diagnostics)):
        shown = _select_nuisance_terms(each, each.significant())
        shown = [judged for judged in shown if judged.term.family == DRIFT]
        if not shown:
            break
    return shown


def _modelled_as_poles(
    prepared: Prepared, model: ChosenModel, budget: EvaluationBudget
) -> list[ScoreTest]:
    """Return nuisance terms that ``model`` fits by poles: with them a simple model is better."""
    plain = [c for c in model.candidates if c.fit.structure.poles <= _PLAIN_POLES]
    if model.chosen.fit.structure.poles <= _PLAIN_POLES or not plain:
        return []
    best = min(plain, key=lambda candidate: candidate.bic).fit
    # Compared with the best of all: the chosen one has a parameter more than that.
    rival = min((c.fit for c in model.candidates), key=information)
    diagnostics = ResidualDiagnostics(prepared.problem, best, prepared.steps, _NUISANCE_FAMILIES)
    # The decimated record is tested first, as for drift.
    if (fewer := diagnostics.thinned) is not None:
        there = fewer.problem.evaluated(rival.structure, rival.nonlinear)
        if not _improving_terms(prepared, fewer, there, budget):
            return []
    return _improving_terms(prepared, diagnostics, rival, budget)


def _improving_terms(
    prepared: Prepared, diagnostics: ResidualDiagnostics, rival: Fit, budget: EvaluationBudget
) -> list[ScoreTest]:
    columns = _select_nuisance_terms(diagnostics, diagnostics.significant())
    if not columns:
        return []
    plain, before = diagnostics.fitted, replace(prepared, problem=diagnostics.problem)
    problem = _with_columns(before, columns)[0].problem
    nuisance_terms = fit(problem, plain.structure, [plain.nonlinear], budget=budget)
    further = problem.background.shape[1] - diagnostics.problem.background.shape[1]
    cost = information(nuisance_terms) + further * np.log(nuisance_terms.samples)
    return columns if cost < information(rival) else []


def _select_nuisance_terms(
    diagnostics: ResidualDiagnostics, shown: Sequence[ScoreTest]
) -> list[ScoreTest]:
    """Return the terms to fit as nuisance now: the first, and its equals among slow families."""
    if not shown:
        return []
    first = shown[0]
    equals = [
        other
        for other in shown[1:]
        if {first.term.family, other.term.family} <= _SLOW
        and diagnostics.evidence(other) > diagnostics.evidence(first) - VERY_STRONG
    ]
    chosen = [judged for judged in (first, *equals) if judged.term.family in _NUISANCE_FAMILIES]
    turning = [judged for judged in chosen if judged.term.family in _TURNING]
    # Backlash and friction are nearly collinear: fitted together, they would cancel at any size.
    return [judged for judged in chosen if judged not in turning[1:]]


def _with_columns(
    prepared: Prepared, shown: Sequence[ScoreTest], before: Sequence[ModelledTerm] = ()
) -> tuple[Prepared, list[ModelledTerm]]:
    if not shown:
        return prepared, []
    background, added = prepared.problem.background, []
    drifts = [b.columns.stop - b.columns.start for b in before if b.term.family == DRIFT]
    for judged in shown:
        start = background.shape[1]
        # A drift of higher degree keeps the columns of the lower ones.
        known = sum(drifts) if judged.term.family == DRIFT else 0
        background = np.column_stack([background, judged.term.columns[:, known:]])
        added.append(ModelledTerm(judged.term, slice(start, background.shape[1])))
    problem = replace(prepared.problem, background=background)
    return replace(prepared, problem=problem), added


def _grown(
    prepared: Prepared, model: ChosenModel, term: ModelErrorTerm, budget: EvaluationBudget
) -> tuple[Prepared, ChosenModel] | None:
    problem, new = prepared.problem, poles_of(term)
    duration = len(problem.input) * problem.period
    if term.family == CREEP or np.min(-new.real) * duration < OVER:
        # The response to the end of the record reaches the start of the period.
        problem = replace(problem, fits_initial_condition=True)
    starts = (1.0,) if term.family == CREEP else _MODE_FREQUENCY_RATIOS
    chosen = model.chosen.fit
    larger = fit_with_added_poles(problem, chosen, new, starts, budget)
    if larger is None or not identifiable(larger.dynamics, problem.period, duration):
        return None
    best = Candidate(larger, information(larger))
    if problem is not prepared.problem:
        # Both models include the initial-condition response in the criterion.
        chosen = fit(problem, chosen.structure, [chosen.nonlinear], budget=budget)
    if best.bic >= information(chosen):
        return None
    grown = replace(model, chosen=best, candidates=[*model.candidates, best])
    return replace(prepared, problem=problem), grown
