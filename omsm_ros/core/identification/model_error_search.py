"""Model departures one after the other, as long as the residual shows a significant one.

A slow relaxation or a soft mode becomes a pole; what adds to the reading whatever G is
(backlash, friction, drift, a line of vibration …) becomes columns beside it. Two slow families
that explain the residual about equally well are fitted together: alone, one would take the
other's part.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from omsm_ros.core.calibration.finding import Finding
from omsm_ros.core.estimation.model_order import Candidate, information
from omsm_ros.core.estimation.model_order import choose as choose_candidate
from omsm_ros.core.estimation.model_structure import Structure
from omsm_ros.core.estimation.noise import correct_errors_in_variables
from omsm_ros.core.estimation.optimisation import EvaluationBudget
from omsm_ros.core.estimation.output_error import Fit, Problem, evaluated, fit
from omsm_ros.core.estimation.preparation import Prepared
from omsm_ros.core.identification.model_choice import ChosenModel, keep_better, rechosen
from omsm_ros.core.model_errors.families import (
    BACKLASH,
    CREEP,
    DRIFT,
    FRICTION,
    LINEARITY,
    MODE,
    PERIODIC,
    VIBRATION,
    ModelErrorTerm,
)
from omsm_ros.core.model_errors.residual_diagnostics import ResidualDiagnostics, ScoreTest
from omsm_ros.core.model_errors.undetected import at_fitted_pole, fit_with_added_poles, poles_of
from omsm_ros.errors import Notice

# Each models one departure; a machine with more is not one to measure with.
_MOST_ROUNDS = 6
_NUISANCE_FAMILIES = {BACKLASH, DRIFT, FRICTION, LINEARITY, PERIODIC, VIBRATION}
# Their columns follow the fitted response, which they improve.
_TURNING = {BACKLASH, FRICTION}
_SLOW = {BACKLASH, CREEP, DRIFT, FRICTION, LINEARITY}
# Odds below which the data do not choose, as a logarithm (Kass and Raftery 1995: very strong).
_UNDECIDED = 5.0
# A decay slower than the record is a drift.
_LEAST_DECAYS = 1.0
# A ring that has decayed by fewer e-folds at the end of the record is still felt at its beginning,
# where the period begins anew: a thousandth of it is left after seven.
_SETTLED_DECAYS = 7.0
# A structure and its roll-off; what is not linear looks like many more.
_PLAIN_POLES = 2
# Two time constants a decade apart look much the same: the fit starts at several. Of modes those
# looked for lie six per cent apart.
_FASTER = (1.0, 2.0, 5.0)
_MODE_FREQUENCY_RATIOS = (1.0, 0.97, 1.03)
# As a logarithm; a mode that rings seven times is as wide.
_SAME_LINE = 0.1


@dataclass(frozen=True, eq=False)
class ModelledTerm:
    """A departure with columns of its own in the background, at ``columns``."""

    term: ModelErrorTerm
    columns: slice


@dataclass(frozen=True, eq=False)
class SearchResult:
    """What was fitted in the end.

    nuisance_terms: departures in the background;  added_poles: those that became poles
    unmodelled: significant, but no model describes them;  diagnostics: of the last fit
    without: survey of the fit before each of ``added_poles`` was added
    incomplete: the search was cut short, because its budget was exhausted
    """

    prepared: Prepared
    model: ChosenModel
    diagnostics: ResidualDiagnostics
    nuisance_terms: Sequence[ModelledTerm] = ()
    added_poles: Sequence[ModelErrorTerm] = ()
    unmodelled: Sequence[ScoreTest] = ()
    without: Sequence[ResidualDiagnostics] = ()
    incomplete: bool = False


def completeness(searched: SearchResult) -> Finding:
    """Return a reservation where the search was cut short."""
    incomplete = str(Notice("estimation.search_incomplete"))
    return Finding(reservations=(incomplete,) if searched.incomplete else ())


Choose = Callable[[Prepared, EvaluationBudget], tuple[Prepared, ChosenModel]]


def search_model_errors(
    prepared: Prepared,
    choose: Choose,
    budget: EvaluationBudget | None = None,
    *,
    may_grow: bool = True,
) -> SearchResult:
    """Add model errors to the problem or to the model until the residual shows no more.

    choose: fits a prepared problem anew;  budget: of all evaluations, None for the default
    may_grow: poles may be added to the model
    """
    prepared, nuisance_terms, model, budget = _initial_model(
        prepared, choose, budget or EvaluationBudget()
    )
    grown: list[ModelErrorTerm] = []
    without: list[ResidualDiagnostics] = []
    settled: set[str] = set()
    modes: list[float] = []
    refused: set[str] = set() if may_grow else {CREEP, MODE}
    diagnostics = ResidualDiagnostics(prepared.problem, model.chosen.fit, prepared.steps)
    for _ in range(_MOST_ROUNDS):
        shown = _without_modelled_lines(diagnostics.significant(refused | settled), modes)
        if not shown or budget.stops():
            break
        columns = _select_nuisance_terms(diagnostics, shown)
        again = (
            {c.term.family for c in columns} & _TURNING & {b.term.family for b in nuisance_terms}
        )
        if again:
            prepared, nuisance_terms = _recomputed_columns(
                prepared, diagnostics, nuisance_terms, again
            )
            settled |= again
            prepared, model = _rechoose(prepared, model, choose, budget)
        elif columns:
            prepared, added = _with_columns(prepared, columns, nuisance_terms)
            nuisance_terms += added
            prepared, model = _rechoose(prepared, model, choose, budget)
            grown, without = [], []
        else:
            larger = _grown(prepared, model, shown[0].term, budget)
            modes += [shown[0].term.parameter] if shown[0].term.family == MODE else []
            if larger is None:
                refused.add(shown[0].term.family)
                continue
            prepared, model = larger
            grown.append(at_fitted_pole(shown[0].term, model.chosen.fit))
            without.append(diagnostics)
        diagnostics = ResidualDiagnostics(prepared.problem, model.chosen.fit, prepared.steps)
    return SearchResult(
        prepared,
        model,
        diagnostics,
        nuisance_terms,
        grown,
        diagnostics.significant(settled),
        without,
        incomplete=budget.incomplete,
    )


def _initial_model(
    prepared: Prepared, choose: Choose, budget: EvaluationBudget
) -> tuple[Prepared, list[ModelledTerm], ChosenModel, EvaluationBudget]:
    """Return the problem, its first nuisance terms and its model, and the budget to go on with."""
    prepared, nuisance_terms = _with_columns(prepared, _drift(prepared, budget))
    prepared, model = choose(prepared, budget)
    prepared, model, budget = _with_errors_in_variables(prepared, model, choose, budget)
    columns = _modelled_as_poles(prepared, model, budget)
    if columns:
        prepared, added = _with_columns(prepared, columns, nuisance_terms)
        nuisance_terms += added
        prepared, model = _rechoose(prepared, model, choose, budget)
    return prepared, nuisance_terms, model, budget


def _rechoose(
    prepared: Prepared, model: ChosenModel, choose: Choose, budget: EvaluationBudget
) -> tuple[Prepared, ChosenModel]:
    """Return a problem that has changed since ``model`` was chosen, and the model chosen anew."""
    prepared, found = choose(prepared, budget)
    return prepared, keep_better(prepared.problem, found, model.chosen.fit, budget)


def _with_errors_in_variables(
    prepared: Prepared, model: ChosenModel, choose: Choose, budget: EvaluationBudget
) -> tuple[Prepared, ChosenModel, EvaluationBudget]:
    """Return all three with the encoder's own noise taken out, if that describes more.

    The problem without it is searched anew, with a budget of its own.
    """
    problem = correct_errors_in_variables(prepared.problem, model.chosen.fit, prepared.steps.edges)
    if problem is None:
        return prepared, model, budget
    quieter, own = replace(prepared, problem=problem), budget.renewed()
    found = rechosen(problem, model, own)
    if found is None:
        quieter, found = choose(quieter, own)
    better = information(found.chosen.fit) < information(model.chosen.fit)
    return (quieter, found, own) if better else (prepared, model, budget)


def _drift(prepared: Prepared, budget: EvaluationBudget) -> list[ScoreTest]:
    """Return drift, if it shows before any model does: a model would take it for a slow pole."""
    problem = prepared.problem
    lag = fit(problem, Structure(0, 0, True), [np.array([0.1])], budget=budget)
    diagnostics = ResidualDiagnostics(problem, lag, prepared.steps, (CREEP, DRIFT))
    # What does not show in fewer samples of a long record need not be looked for in all.
    if diagnostics.thinned is not None and not _detected_drift(diagnostics.thinned):
        return []
    return _detected_drift(diagnostics)


def _detected_drift(diagnostics: ResidualDiagnostics) -> list[ScoreTest]:
    shown = _select_nuisance_terms(diagnostics, diagnostics.significant())
    return [judged for judged in shown if judged.term.family == DRIFT]


def _modelled_as_poles(
    prepared: Prepared, model: ChosenModel, budget: EvaluationBudget
) -> list[ScoreTest]:
    """Return departures that poles of ``model`` imitate: beside them a plain model describes more.

    What is not linear is not bent into poles where fewer of them and its own columns do better.
    """
    chosen, best = model.chosen, _best_plain(model)
    if chosen.fit.structure.poles <= _PLAIN_POLES or best is None:
        return []
    diagnostics = ResidualDiagnostics(prepared.problem, best, prepared.steps, _NUISANCE_FAMILIES)
    fewer = diagnostics.thinned
    # As above: of a long record not all are looked at where fewer do not ask for it.
    if fewer is not None:
        there = evaluated(fewer.problem, chosen.fit.structure, chosen.fit.nonlinear)
        if not _improving_terms(prepared, fewer, there, budget):
            return []
    return _improving_terms(prepared, diagnostics, chosen.fit, budget)


def _improving_terms(
    prepared: Prepared, diagnostics: ResidualDiagnostics, chosen: Fit, budget: EvaluationBudget
) -> list[ScoreTest]:
    """Return what shows, if the fit of ``diagnostics`` describes more beside it than ``chosen`` does."""
    columns = _select_nuisance_terms(diagnostics, diagnostics.significant())
    if not columns:
        return []
    plain, before = diagnostics.fitted, replace(prepared, problem=diagnostics.problem)
    problem = _with_columns(before, columns)[0].problem
    nuisance_terms = fit(problem, plain.structure, [plain.nonlinear], budget=budget)
    further = problem.background.shape[1] - diagnostics.problem.background.shape[1]
    better = information(nuisance_terms) + further * np.log(nuisance_terms.samples) < information(
        chosen
    )
    return columns if better else []


def _without_modelled_lines(shown: Sequence[ScoreTest], modes: Sequence[float]) -> list[ScoreTest]:
    """Return ``shown`` without lines of vibration at ``modes`` [Hz] that described more.

    A light mode that the steps keep ringing looks like a line, and one that a fit has not met, or
    met badly, leaves one. Beside the response it would be gone from it.
    """
    return [
        judged
        for judged in shown
        if judged.term.family != VIBRATION
        or all(abs(np.log(judged.term.parameter / mode)) > _SAME_LINE for mode in modes)
    ]


def _select_nuisance_terms(
    diagnostics: ResidualDiagnostics, shown: Sequence[ScoreTest]
) -> list[ScoreTest]:
    """Return those to fit in the background now: the clearest, and its equals among the slow."""
    if not shown:
        return []
    first = shown[0]
    equals = [
        other
        for other in shown[1:]
        if {first.term.family, other.term.family} <= _SLOW
        and diagnostics.evidence(other) > diagnostics.evidence(first) - _UNDECIDED
    ]
    chosen = [judged for judged in (first, *equals) if judged.term.family in _NUISANCE_FAMILIES]
    turning = [judged for judged in chosen if judged.term.family in _TURNING]
    # Backlash and friction look so much alike that both at once cancel at any size.
    return [judged for judged in chosen if judged not in turning[1:]]


def _with_columns(
    prepared: Prepared, shown: Sequence[ScoreTest], before: Sequence[ModelledTerm] = ()
) -> tuple[Prepared, list[ModelledTerm]]:
    background = prepared.problem.background
    added = []
    drifts = [b.columns.stop - b.columns.start for b in before if b.term.family == DRIFT]
    for judged in shown:
        start = background.shape[1]
        # Of a drift that needs more terms the first are there already.
        known = sum(drifts) if judged.term.family == DRIFT else 0
        background = np.column_stack([background, judged.term.columns[:, known:]])
        added.append(ModelledTerm(judged.term, slice(start, background.shape[1])))
    problem = replace(prepared.problem, background=background)
    return replace(prepared, problem=problem), added


def _recomputed_columns(
    prepared: Prepared,
    diagnostics: ResidualDiagnostics,
    nuisance_terms: Sequence[ModelledTerm],
    families: set[str],
) -> tuple[Prepared, list[ModelledTerm]]:
    """Return the problem with the columns of ``families`` as the fit of ``diagnostics`` has them."""
    background, renewed = prepared.problem.background.copy(), []
    for modelled in nuisance_terms:
        term = modelled.term
        if term.family in families:
            term = diagnostics.model_errors.again(term)
            background[:, modelled.columns] = term.columns
        renewed.append(ModelledTerm(term, modelled.columns))
    return replace(prepared, problem=replace(prepared.problem, background=background)), renewed


def _grown(
    prepared: Prepared, model: ChosenModel, term: ModelErrorTerm, budget: EvaluationBudget
) -> tuple[Prepared, ChosenModel] | None:
    """Return the model with the poles of ``term``, or None where that describes nothing better."""
    if term.family not in (CREEP, MODE):
        return None
    problem, new = prepared.problem, poles_of(term)
    decays = float(np.min(-new.real)) * len(problem.input) * problem.period
    if term.family == CREEP or decays < _SETTLED_DECAYS:
        # What has not died away at the end has not when a period begins anew.
        problem = replace(problem, fits_initial_condition=True)
    starts = _FASTER if term.family == CREEP else _MODE_FREQUENCY_RATIOS
    tried = [fit_with_added_poles(problem, base, new, starts, budget) for base in _bases(model)]
    # The chosen one may owe poles to what ``term`` describes: with it, fewer may do.
    found = [
        Candidate(fitted, information(fitted))
        for fitted in tried
        if fitted is not None and _decays(fitted, problem)
    ]
    best = min(found, key=lambda candidate: candidate.bic, default=None)
    chosen = model.chosen.fit
    if problem is not prepared.problem:
        # What rang before the record is priced on both sides.
        chosen = fit(problem, chosen.structure, [chosen.nonlinear], budget=budget)
    if best is None or best.bic >= information(chosen):
        return None
    grown = replace(model, chosen=best, candidates=[*model.candidates, best])
    return replace(prepared, problem=problem), grown


def _bases(model: ChosenModel) -> list[Fit]:
    """Return the fits that a pole may be added to: the chosen one, and a plain one.

    That one is chosen by the same rule: a single lag beside a relaxation has no roll-off, so its
    band would be far too narrow at the upper end.
    """
    chosen, candidates = model.chosen.fit, _plain_candidates(model)
    plain = choose_candidate(candidates).fit if candidates else chosen
    return [chosen] if plain is chosen else [chosen, plain]


def _best_plain(model: ChosenModel) -> Fit | None:
    """Return the best fit of a structure and its roll-off alone, if one was tried."""
    plain = _plain_candidates(model)
    return min(plain, key=lambda candidate: candidate.bic).fit if plain else None


def _plain_candidates(model: ChosenModel) -> list[Candidate]:
    return [c for c in model.candidates if c.fit.structure.poles <= _PLAIN_POLES]


def _decays(found: Fit, problem: Problem) -> bool:
    """Return True if every pole of ``found`` forgets within the record."""
    slowest = float(np.min(-found.dynamics.poles().real))
    return slowest * len(problem.input) * problem.period > _LEAST_DECAYS
