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

from omsm_ros.core.estimation.model_order import Candidate, information
from omsm_ros.core.estimation.model_order import choose as choose_candidate
from omsm_ros.core.estimation.model_structure import Structure
from omsm_ros.core.estimation.noise import without_unfollowed
from omsm_ros.core.estimation.output_error import Fit, Problem, evaluated, fit
from omsm_ros.core.estimation.preparation import Prepared
from omsm_ros.core.identification.model_choice import Model, chosen_alike, no_worse
from omsm_ros.core.model_errors.families import (
    BACKLASH,
    CREEP,
    DRIFT,
    FRICTION,
    LINEARITY,
    MODE,
    PERIODIC,
    VIBRATION,
    Term,
)
from omsm_ros.core.model_errors.residual_diagnostics import Judged, Survey
from omsm_ros.core.model_errors.undetected import as_fitted, poles_of, with_poles

# Each models one departure; a machine with more is not one to measure with.
_MOST_ROUNDS = 6
_BESIDE = {BACKLASH, DRIFT, FRICTION, LINEARITY, PERIODIC, VIBRATION}
# Their columns follow the fitted response, which they improve.
_TURNING = {BACKLASH, FRICTION}
_SLOW = {BACKLASH, CREEP, DRIFT, FRICTION, LINEARITY}
# Odds below which the data do not choose, as a logarithm (Kass and Raftery 1995: very strong).
_UNDECIDED = 5.0
# A decay slower than the record is a drift.
_LEAST_DECAYS = 1.0
# A ring that has decayed by fewer e-folds at the end of the record is still felt at its beginning,
# where the period begins anew: a thousandth of it is left after seven.
_FORGOTTEN_DECAYS = 7.0
# A structure and its roll-off; what is not linear looks like many more.
_PLAIN_POLES = 2
# Two time constants a decade apart look much the same: the fit starts at several. Of modes those
# looked for lie six per cent apart.
_FASTER = (1.0, 2.0, 5.0)
_BESIDE_MODE = (1.0, 0.97, 1.03)
# As a logarithm; a mode that rings seven times is as wide.
_SAME_LINE = 0.1


@dataclass(frozen=True, eq=False)
class ModelledTerm:
    """A departure with columns of its own in the background, at ``columns``."""

    term: Term
    columns: slice


@dataclass(frozen=True, eq=False)
class Searched:
    """What was fitted in the end.

    beside: departures in the background;  in_response: those that became poles
    unmodelled: significant, but no model describes them;  survey: of the last fit
    without: survey of the fit before each of ``in_response`` was added
    """

    prepared: Prepared
    model: Model
    survey: Survey
    beside: Sequence[ModelledTerm] = ()
    in_response: Sequence[Term] = ()
    unmodelled: Sequence[Judged] = ()
    without: Sequence[Survey] = ()


Choose = Callable[[Prepared], tuple[Prepared, Model]]


def search(prepared: Prepared, choose: Choose, *, may_grow: bool = True) -> Searched:
    """Add departures to the problem or to the model until the residual shows no more.

    choose: fits a prepared problem anew;  may_grow: poles may be added to the model
    """
    prepared, beside, model = _first(prepared, choose)
    grown: list[Term] = []
    without: list[Survey] = []
    settled: set[str] = set()
    modes: list[float] = []
    refused: set[str] = set() if may_grow else {CREEP, MODE}
    survey = Survey(prepared.problem, model.chosen.fit, prepared.steps)
    for _ in range(_MOST_ROUNDS):
        shown = _but_lines(survey.significant(refused | settled), modes)
        if not shown or prepared.problem.effort.spent:
            break
        columns = _beside(survey, shown)
        again = {c.term.family for c in columns} & _TURNING & {b.term.family for b in beside}
        if again:
            prepared, beside = _renewed(prepared, survey, beside, again)
            settled |= again
            prepared, model = _again(prepared, model, choose)
        elif columns:
            prepared, added = _with_columns(prepared, columns, beside)
            beside += added
            prepared, model = _again(prepared, model, choose)
            grown, without = [], []
        else:
            larger = _grown(prepared, model, shown[0].term)
            modes += [shown[0].term.parameter] if shown[0].term.family == MODE else []
            if larger is None:
                refused.add(shown[0].term.family)
                continue
            prepared, model = larger
            grown.append(as_fitted(shown[0].term, model.chosen.fit))
            without.append(survey)
        survey = Survey(prepared.problem, model.chosen.fit, prepared.steps)
    return Searched(prepared, model, survey, beside, grown, survey.significant(settled), without)


def _first(prepared: Prepared, choose: Choose) -> tuple[Prepared, list[ModelledTerm], Model]:
    """Return the problem and its model, beside what shows first or what its poles imitate."""
    prepared, beside = _with_columns(prepared, _drift(prepared))
    prepared, model = _quieter(*choose(prepared), choose)
    columns = _imitated(prepared, model)
    if columns:
        prepared, added = _with_columns(prepared, columns, beside)
        beside += added
        prepared, model = _again(prepared, model, choose)
    return prepared, beside, model


def _again(prepared: Prepared, model: Model, choose: Choose) -> tuple[Prepared, Model]:
    """Return a problem that has changed since ``model`` was chosen, and the model chosen anew."""
    prepared, found = choose(prepared)
    return prepared, no_worse(prepared.problem, found, model.chosen.fit)


def _quieter(prepared: Prepared, model: Model, choose: Choose) -> tuple[Prepared, Model]:
    """Return both without the encoder's own noise, if that describes more."""
    problem = without_unfollowed(prepared.problem, model.chosen.fit, prepared.steps.edges)
    if problem is None:
        return prepared, model
    quieter = replace(prepared, problem=problem)
    found = chosen_alike(problem, model)
    if found is None:
        quieter, found = choose(quieter)
    better = information(found.chosen.fit) < information(model.chosen.fit)
    return (quieter, found) if better else (prepared, model)


def _drift(prepared: Prepared) -> list[Judged]:
    """Return drift, if it shows before any model does: a model would take it for a slow pole."""
    problem = prepared.problem
    lag = fit(problem, Structure(0, 0, True), [np.array([0.1])])
    survey = Survey(problem, lag, prepared.steps, (CREEP, DRIFT))
    # What does not show in fewer samples of a long record need not be looked for in all.
    if survey.thinned is not None and not _shown_drift(survey.thinned):
        return []
    return _shown_drift(survey)


def _shown_drift(survey: Survey) -> list[Judged]:
    shown = _beside(survey, survey.significant())
    return [judged for judged in shown if judged.term.family == DRIFT]


def _imitated(prepared: Prepared, model: Model) -> list[Judged]:
    """Return departures that poles of ``model`` imitate: beside them a plain model describes more.

    What is not linear is not bent into poles where fewer of them and its own columns do better.
    """
    chosen, best = model.chosen, _best_plain(model)
    if chosen.fit.structure.poles <= _PLAIN_POLES or best is None:
        return []
    survey = Survey(prepared.problem, best, prepared.steps, _BESIDE)
    fewer = survey.thinned
    # As above: of a long record not all are looked at where fewer do not ask for it.
    if fewer is not None:
        there = evaluated(fewer.problem, chosen.fit.structure, chosen.fit.nonlinear)
        if not _describing_more(prepared, fewer, there):
            return []
    return _describing_more(prepared, survey, chosen.fit)


def _describing_more(prepared: Prepared, survey: Survey, chosen: Fit) -> list[Judged]:
    """Return what shows, if the fit of ``survey`` describes more beside it than ``chosen`` does."""
    columns = _beside(survey, survey.significant())
    if not columns:
        return []
    plain, before = survey.fitted, replace(prepared, problem=survey.problem)
    problem = _with_columns(before, columns)[0].problem
    beside = fit(problem, plain.structure, [plain.nonlinear])
    further = problem.background.shape[1] - survey.problem.background.shape[1]
    better = information(beside) + further * np.log(beside.samples) < information(chosen)
    return columns if better else []


def _but_lines(shown: Sequence[Judged], modes: Sequence[float]) -> list[Judged]:
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


def _beside(survey: Survey, shown: Sequence[Judged]) -> list[Judged]:
    """Return those to fit in the background now: the clearest, and its equals among the slow."""
    if not shown:
        return []
    first = shown[0]
    equals = [
        other
        for other in shown[1:]
        if {first.term.family, other.term.family} <= _SLOW
        and survey.evidence(other) > survey.evidence(first) - _UNDECIDED
    ]
    chosen = [judged for judged in (first, *equals) if judged.term.family in _BESIDE]
    turning = [judged for judged in chosen if judged.term.family in _TURNING]
    # Backlash and friction look so much alike that both at once cancel at any size.
    return [judged for judged in chosen if judged not in turning[1:]]


def _with_columns(
    prepared: Prepared, shown: Sequence[Judged], before: Sequence[ModelledTerm] = ()
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


def _renewed(
    prepared: Prepared, survey: Survey, beside: Sequence[ModelledTerm], families: set[str]
) -> tuple[Prepared, list[ModelledTerm]]:
    """Return the problem with the columns of ``families`` as the fit of ``survey`` has them."""
    background, renewed = prepared.problem.background.copy(), []
    for modelled in beside:
        term = modelled.term
        if term.family in families:
            term = survey.departures.again(term)
            background[:, modelled.columns] = term.columns
        renewed.append(ModelledTerm(term, modelled.columns))
    return replace(prepared, problem=replace(prepared.problem, background=background)), renewed


def _grown(prepared: Prepared, model: Model, term: Term) -> tuple[Prepared, Model] | None:
    """Return the model with the poles of ``term``, or None where that describes nothing better."""
    if term.family not in (CREEP, MODE):
        return None
    problem, new = prepared.problem, poles_of(term)
    decays = float(np.min(-new.real)) * len(problem.input) * problem.period
    if term.family == CREEP or decays < _FORGOTTEN_DECAYS:
        # What has not died away at the end has not when a period begins anew.
        problem = replace(problem, fits_initial_condition=True)
    starts = _FASTER if term.family == CREEP else _BESIDE_MODE
    tried = [with_poles(problem, base, new, starts) for base in _bases(model)]
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
        chosen = fit(problem, chosen.structure, [chosen.nonlinear])
    if best is None or best.bic >= information(chosen):
        return None
    grown = replace(model, chosen=best, candidates=[*model.candidates, best])
    return replace(prepared, problem=problem), grown


def _bases(model: Model) -> list[Fit]:
    """Return the fits that a pole may be added to: the chosen one, and a plain one.

    That one is chosen by the same rule: a single lag beside a relaxation has no roll-off, so its
    band would be far too narrow at the upper end.
    """
    chosen, candidates = model.chosen.fit, _plain(model)
    plain = choose_candidate(candidates).fit if candidates else chosen
    return [chosen] if plain is chosen else [chosen, plain]


def _best_plain(model: Model) -> Fit | None:
    """Return the best fit of a structure and its roll-off alone, if one was tried."""
    plain = _plain(model)
    return min(plain, key=lambda candidate: candidate.bic).fit if plain else None


def _plain(model: Model) -> list[Candidate]:
    return [c for c in model.candidates if c.fit.structure.poles <= _PLAIN_POLES]


def _decays(found: Fit, problem: Problem) -> bool:
    """Return True if every pole of ``found`` forgets within the record."""
    slowest = float(np.min(-found.dynamics.poles().real))
    return slowest * len(problem.input) * problem.period > _LEAST_DECAYS
