"""Name the deviations from a linear, steady response that were found, and state what they cost.

A deviation that was modelled is a reservation: its uncertainty is in the band and in the budget.
One that is significant and could not be modelled rejects the calibration. A cause is named only
where the final fit still shows it: what was modelled before a better explanation was found may
have taken a part of that explanation.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from omsm_ros.core.calibration.certificate import (
    REJECTS,
    RESERVATION,
    Finding,
    ModelError,
    ModelErrors,
)
from omsm_ros.core.estimation.covariance import parameter_covariance
from omsm_ros.core.estimation.model_order import fit
from omsm_ros.core.estimation.noise import VERY_STRONG
from omsm_ros.core.identification.evidence import IdentificationEvidence
from omsm_ros.core.identification.model_error_search import ModelledTerm, SearchResult
from omsm_ros.core.lti.frequency_response import response_band
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
from omsm_ros.core.model_errors.residual_diagnostics import FALSE_ALARM, ResidualDiagnostics

# Standard uncertainty of a height over the size of an error: the rms of a sine. Backlash and
# friction lag by their whole half widths together; drift and linearity are no errors of motion.
_PER_SIZE = {PERIODIC: 0.5**0.5, VIBRATION: 0.5**0.5}
_AT_REVERSALS = (BACKLASH, FRICTION)
# Codes of a model error: found and modelled, and found only. Stiffening has no model.
_CODES = {
    BACKLASH: ("identification.backlash", "identification.unmodelled_backlash"),
    FRICTION: ("identification.friction", "identification.unmodelled_friction"),
    LINEARITY: ("identification.linearity", "identification.unmodelled_linearity"),
    PERIODIC: ("identification.periodic", "identification.unmodelled_periodic"),
    VIBRATION: ("identification.vibration", "identification.unmodelled_vibration"),
    DRIFT: ("identification.drift", "identification.unmodelled_drift"),
    CREEP: ("identification.creep", "identification.unmodelled_creep"),
    MODE: ("identification.mode", "identification.unmodelled_mode"),
    STIFFENING: ("", "identification.unmodelled_stiffening"),
}
# Families of which one may explain the residual of another, as causes in words.
_MAY_LOOK_ALIKE = {
    BACKLASH: "backlash",
    FRICTION: "friction",
    LINEARITY: "nonlinear scale of the probe",
    PERIODIC: "periodic error",
    DRIFT: "drift",
    CREEP: "creep",
}
# Name of the parameter of a family in the values of a finding.
_PARAMETERS = {
    CREEP: "time_constant_s",
    MODE: "frequency_hz",
    VIBRATION: "frequency_hz",
    FRICTION: "travel_m",
    PERIODIC: "period_m",
}


@dataclass(frozen=True)
class Size:
    """Size of a term that was fitted as a nuisance and its standard uncertainty [m].

    significant: whether the final fit still shows it
    """

    value: float
    uncertainty: float
    significant: bool


def model_errors(searched: SearchResult) -> Iterator[Finding]:
    """Yield a reservation for each deviation that was modelled, a rejection for each other one."""
    period = searched.prepared.problem.period
    for judged in searched.unmodelled:
        size = float(np.linalg.norm(judged.score.size))
        values = _values(judged.term, size, period)
        values["p"] = float(np.exp(max(judged.log_p, -690)))
        limits = {"false_alarm_p": FALSE_ALARM}
        yield Finding(_CODES[judged.term.family][1], REJECTS, values, limits)
    sizes, _ = _sizes(searched)
    pairs = zip(searched.nuisance_terms, sizes, strict=True)
    shown = [(modelled, found.value) for modelled, found in pairs if found.significant]
    drifts = any(modelled.term.family == DRIFT for modelled, _ in shown)
    for modelled, size in shown:
        term = modelled.term
        # A drift that wanders has power at low frequencies, where a line is a part of it.
        slow = term.parameter * searched.diagnostics.plateau < 1
        if drifts and slow and term.family == VIBRATION:
            continue
        code, values = _CODES[term.family][0], _values(term, size, period)
        alike = _alike(searched, modelled) if term.family in _MAY_LOOK_ALIKE else []
        if alike:
            code = "identification.undecided"
            values["causes"] = [_MAY_LOOK_ALIKE[name] for name in (term.family, *alike)]
        yield Finding(code, RESERVATION, values)
    for term in searched.added_poles:
        values = _values(term, None, period)
        yield Finding(_CODES[term.family][0], RESERVATION, values)


def _alike(searched: SearchResult, modelled: ModelledTerm) -> list[str]:
    problem, fitted = searched.prepared.problem, searched.model.chosen.fit
    kept = np.ones(problem.background.shape[1], np.bool_)
    kept[modelled.columns] = False
    without = replace(problem, background=problem.background[:, kept])
    again = fit(without, fitted.structure, [fitted.nonlinear])
    tested = ResidualDiagnostics(without, again, searched.prepared.steps, {*_MAY_LOOK_ALIKE})
    # None of the terms is exactly what a machine does: twice what counts as very strong decides.
    least = tested.evidence(tested.tested(modelled.term)) - 2 * VERY_STRONG
    return [
        name
        for name, test in tested.best.items()
        if name != modelled.term.family and tested.evidence(test) > least
    ]


def model_errors_of(searched: SearchResult, duration: float) -> ModelErrors:
    """Return what was modelled and what it costs, for the certificate; ``duration`` [s]."""
    sizes, at_reversals = _sizes(searched)
    pairs = list(zip(searched.nuisance_terms, sizes, strict=True))
    costs = [at_reversals] + [
        _PER_SIZE.get(modelled.term.family, 0.0) * float(np.hypot(found.value, found.uncertainty))
        for modelled, found in pairs
    ]
    nuisance = [
        ModelError(
            family=modelled.term.family,
            parameter=modelled.term.parameter,
            size_m=found.value,
            uncertainty_m=found.uncertainty,
        )
        for modelled, found in pairs
    ]
    added_poles = [ModelError(family=t.family, parameter=t.parameter) for t in searched.added_poles]
    backlash = [2 * found.value for m, found in pairs if m.term.family == BACKLASH]
    return ModelErrors(
        modelled=(*nuisance, *added_poles),
        motion_error_m=float(np.sqrt(np.sum(np.square(costs)))),
        backlash_m=max(backlash, default=0.0),
        drift_m_s=2 * float(searched.model.chosen.fit.background[1]) / duration,
    )


def accuracy_on(evidence: IdentificationEvidence) -> float:
    """Return the standard uncertainty [m] of a height of the intended scan from the response."""
    use, duration = evidence.use, len(evidence.record) * evidence.record.sample_period
    band = response_band(evidence.dynamics, evidence.known.covariance, use.frequencies_hz)
    errors = np.hypot(band.gain, band.phase) * use.rms_m
    motion = model_errors_of(evidence.searched, duration).motion_error_m or 0.0
    return float(np.hypot(np.linalg.norm(errors), motion))


def _values(term: ModelErrorTerm, size: float | None, period: float) -> dict[str, object]:
    values: dict[str, object] = {} if size is None else {"size_m": size}
    if term.family in _PARAMETERS:
        values[_PARAMETERS[term.family]] = term.parameter
    if term.family == VIBRATION:
        values["alias_hz"] = 1 / period - term.parameter
    return values


def _sizes(searched: SearchResult) -> tuple[Sequence[Size], float]:
    """Return the size of each nuisance term, and what those at reversals cost [m].

    Backlash and friction look alike, and what one has too much the other has too little.
    """
    fit, problem = searched.model.chosen.fit, searched.prepared.problem
    if not searched.nuisance_terms:
        return [], 0.0
    columns = problem.sensitivity(fit)
    covariance = parameter_covariance(problem, columns, fit.residual)
    first = columns.shape[1] - problem.background.shape[1]
    of_background = covariance[first:, first:]
    at_reversals = np.zeros(problem.background.shape[1])
    found = []
    for modelled in searched.nuisance_terms:
        coefficients = fit.background[modelled.columns]
        spread = of_background[modelled.columns, modelled.columns]
        if modelled.term.family in _AT_REVERSALS:
            # The further column is its unknown state at the start.
            coefficients, spread = coefficients[:1], spread[:1, :1]
            at_reversals[modelled.columns.start] = 1.0
        inverse = np.linalg.pinv(spread, rcond=1e-9, hermitian=True)
        wald = stats.chi2.sf(float(coefficients @ inverse @ coefficients), len(coefficients))
        significant = bool(wald * modelled.term.trials < FALSE_ALARM)
        if modelled.term.family == DRIFT:
            value = float(np.std(problem.background[:, modelled.columns] @ coefficients))
            uncertainty = float(np.sqrt(max(np.trace(spread), 0.0) / 2))
        else:
            value = float(np.linalg.norm(coefficients))
            uncertainty = float(np.sqrt(max(np.trace(spread), 0.0)))
        found.append(Size(value, uncertainty, significant))
    variance = max(float(at_reversals @ of_background @ at_reversals), 0.0)
    return found, float(np.hypot(at_reversals @ fit.background, np.sqrt(variance)))
