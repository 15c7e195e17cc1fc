"""Decide whether a calibration may be used: one check for each way in which it may be wrong.

A check takes the evidence and yields findings, each with a code, values and limits. To add one,
write a function and append it to :data:`CHECKS`, and the sentence of its code to
:mod:`omsm_ros.messages.identification`.

A deviation from a linear, steady response that was modelled is a reservation: its uncertainty is in
the band and in the budget. One that is significant and could not be modelled rejects the
calibration. A cause is named only where the final fit still shows it: what was modelled before a
better explanation was found may have taken a part of that explanation.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from omsm_ros.core.calibration.certificate import (
    REJECTS,
    RESERVATION,
    WARNING,
    Finding,
    ModelError,
    ModelErrors,
)
from omsm_ros.core.calibration.plausibility import check_covariance, check_dynamics
from omsm_ros.core.estimation.covariance import gain_uncertainty_alone, parameter_covariance
from omsm_ros.core.estimation.model_order import fit
from omsm_ros.core.estimation.noise import CLEARLY, VERY_STRONG
from omsm_ros.core.identification.model_error_search import ModelledTerm, SearchResult
from omsm_ros.core.identification.residual_tests import NOTICEABLE
from omsm_ros.core.identification.response_uncertainty import IdentificationEvidence
from omsm_ros.core.lti.frequency_response import (
    COVERAGE_FACTOR,
    low_frequency_delay_uncertainty,
    response_band,
)
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
from omsm_ros.core.model_errors.residual_diagnostics import (
    FALSE_ALARM,
    HALVES,
    SIZES,
    UP_DOWN,
    ResidualDiagnostics,
    differ,
)
from omsm_ros.errors import CalibrationError

Findings = Iterator[Finding]

# Twice the largest value of a hundred records of the twin with noise, hum, drift and dropouts.
WORST_AGREEMENT = 2.5
# The square of a residual over that of the noise, above which the residual is not noise.
WORST_CHI_SQUARE = 1.3
# Below it the readings of a stationary axis are noisier than in motion: a mode still rings.
LEAST_CHI_SQUARE = 0.3
# Exposure, averaging and transmission of a probe take milliseconds, of a slow one some samples.
_LONGEST_LAG_S, _LONGEST_LAG_SAMPLES = 0.1, 5.0
# Linear probes are right to one per cent; one that sees Z at 10° reads 0.985 of it.
_SCALE_ERROR = 0.05


def separable_gain(e: IdentificationEvidence) -> Findings:
    """Reject a motion that does not separate the static gain from lag and curvature of G."""
    half_width = COVERAGE_FACTOR * gain_uncertainty_alone(e.prepared.problem, e.fit)
    if half_width > e.limits.gain:
        values, limits = {"half_width": half_width}, {"gain": e.limits.gain}
        yield Finding("identification.gain_not_separable", REJECTS, values, limits)


def misfit(e: IdentificationEvidence) -> Findings:
    """Reject a mean square residual where the axis moves that is not that of the noise."""
    chi_square = e.residual.chi_square
    values: dict[str, object] = {"chi_square": chi_square, "noise_m": e.residual.noise}
    if chi_square < LEAST_CHI_SQUARE:
        limits = {"chi_square_least": LEAST_CHI_SQUARE}
        yield Finding("identification.noisy_rest", REJECTS, values, limits)
    if chi_square > WORST_CHI_SQUARE:
        limits = {"chi_square_greatest": WORST_CHI_SQUARE}
        code = "identification.large_residual"
        if e.known.clearly_better is not None:
            values["better_order"] = e.known.clearly_better
            code = "identification.wrong_order"
        elif e.residual.axis_timing > 0:
            values["scatter_s"] = e.residual.axis_timing
            code = "identification.residual_of_axis_timing"
        yield Finding(code, REJECTS, values, limits)


def latency(e: IdentificationEvidence) -> Findings:
    """Judge a probe that moves before the encoder, or later than probes do.

    An encoder may be late, and is then late in a scan as well. But the noisier channel should be
    the probe.
    """
    lag, period = e.dynamics.low_frequency_delay, e.prepared.problem.period
    uncertainty = low_frequency_delay_uncertainty(e.dynamics, e.known.covariance)
    left, by_noise = e.lag_in_residual
    lead, uncertainty = -lag - left, max(uncertainty, by_noise)
    if lead >= max(CLEARLY * uncertainty, e.use.harmless_delay_s):
        noise = {"encoder_noise_m": e.prepared.steps.noise, "probe_noise_m": e.residual.noise}
        if noise["encoder_noise_m"] > noise["probe_noise_m"]:
            yield Finding("identification.exchanged_channels", REJECTS, {"lead_s": lead} | noise)
        else:
            yield Finding("identification.late_encoder", RESERVATION, {"lead_s": lead})
    limit = max(_LONGEST_LAG_S, _LONGEST_LAG_SAMPLES * period)
    if lag >= limit:
        values = {"lag_s": lag, "samples": lag / period}
        yield Finding("identification.late_probe", RESERVATION, values, {"lag_greatest_s": limit})


def recording(e: IdentificationEvidence) -> Findings:
    """Reserve a scale that no probe has, readings that scatter in time, and two clocks.

    Warn of encoder noise that the probe does not show, and of positions that were read wrongly.
    """
    if abs(abs(e.fit.gain) - 1) >= _SCALE_ERROR:
        values, limits = {"gain": abs(e.fit.gain)}, {"scale_error_greatest": _SCALE_ERROR}
        yield Finding("identification.scale", RESERVATION, values, limits)
    for code, scatter in (
        ("identification.timing_scatter", e.residual.timing),
        ("identification.axis_timing_scatter", e.residual.axis_timing),
    ):
        if scatter > 0:
            yield Finding(code, RESERVATION, {"scatter_s": scatter})
    errors = e.prepared.problem.errors_in_variables
    found = 0.0 if errors is None else float(np.sqrt(np.mean(errors**2)))
    if found**2 > NOTICEABLE * e.residual.noise**2:
        yield Finding("identification.encoder_noise", WARNING, {"noise_m": found})
    if e.prepared.axis_spikes:
        yield Finding("identification.axis_spikes", WARNING, {"count": e.prepared.axis_spikes})
    if e.record.by_stamps:
        yield Finding("identification.two_clocks", RESERVATION)


def searched(e: IdentificationEvidence) -> Findings:
    """State the model errors that were found, and a search that was cut short."""
    yield from model_errors(e.searched)
    if e.searched.incomplete:
        yield Finding("estimation.search_incomplete", RESERVATION)


def independence(e: IdentificationEvidence) -> Findings:
    """Reject a residual that follows the rate of the motion; scatter in time may conceal it."""
    if e.searched.p_value >= FALSE_ALARM:
        return
    code, values = "identification.dependent_residual", {"p": e.searched.p_value}
    scatter = max(e.residual.timing, e.residual.axis_timing)
    if scatter > 0:
        code, values["scatter_s"] = "identification.dependent_by_timing", scatter
    yield Finding(code, REJECTS, values, {"independence_p_least": FALSE_ALARM})


def agreement(e: IdentificationEvidence) -> Findings:
    """Reject a response that one estimated without a model contradicts."""
    difference = e.response_difference
    if difference is not None and difference > WORST_AGREEMENT:
        limits = {"agreement_greatest": WORST_AGREEMENT}
        yield Finding("identification.disagreement", REJECTS, {"difference": difference}, limits)


def inter_sample_motion(e: IdentificationEvidence) -> Findings:
    """Reject edges whose bound on the bias of the delay exceeds its noise and a harmless delay."""
    noise = low_frequency_delay_uncertainty(e.dynamics, e.known.from_noise)
    limit, bound = max(noise, e.use.harmless_delay_s), e.inter_sample_delay
    if bound > limit:
        limits = {"inter_sample_delay_greatest_s": limit}
        yield Finding("identification.sharp_edges", REJECTS, {"bound_s": bound}, limits)


def dynamic_gain(e: IdentificationEvidence) -> Findings:
    """Reject a test whose dynamic gain is too uncertain relative to the static gain.

    It is uncertain by a relaxation, which may be longer than the time from edge to edge.
    """
    time_constant, plateau = e.undetected.plateau_needed_s or 0.0, e.searched.diagnostics.plateau
    half_width = COVERAGE_FACTOR * (e.undetected.gain_u or 0.0)
    if half_width <= e.limits.gain:
        return
    values = {"half_width": half_width, "time_constant_s": time_constant, "plateau_s": plateau}
    code = (
        "identification.creep_within_plateau"
        if time_constant <= plateau
        else "identification.creep_beyond_plateau"
    )
    yield Finding(code, REJECTS, values, {"gain": e.limits.gain})


_DIFFERENT_PARTS = {
    UP_DOWN: "identification.directions_differ",
    HALVES: "identification.halves_differ",
    SIZES: "identification.sizes_differ",
}


def consistency(e: IdentificationEvidence) -> Findings:
    """Reserve a test whose parts differ by more than chance; of recordings, name the one apart."""
    differing = [contrast for contrast in e.contrasts if differ(contrast)]
    recordings = [c for c in differing if c.parts not in _DIFFERENT_PARTS]
    farthest = max(
        recordings,
        key=lambda c: abs(c.lag_difference_s or 0.0) / (c.lag_difference_uncertainty_s or np.inf),
        default=None,
    )
    for contrast in differing:
        values: dict[str, object] = {"lag_s": contrast.lag_difference_s, "p": contrast.p}
        values["gain"] = contrast.gain_difference
        code = _DIFFERENT_PARTS.get(contrast.parts)
        if code is None:
            if contrast is not farthest:
                continue
            code, values["parts"] = "identification.recordings_differ", contrast.parts
        yield Finding(code, RESERVATION, values, {"consistency_p_least": FALSE_ALARM})


def late_reference(e: IdentificationEvidence) -> Findings:
    """Reject a reference that is clearly late, or early, against the encoder."""
    lag, harmless = e.reference, e.use.harmless_delay_s
    if lag is None or abs(lag.value) <= max(CLEARLY * lag.uncertainty, harmless):
        return
    code = "identification.late_reference" if lag.value > 0 else "identification.early_reference"
    values = {"lag_s": abs(lag.value), "uncertainty_s": lag.uncertainty}
    yield Finding(code, REJECTS, values, {"reference_lag_greatest_s": harmless})


def usable(e: IdentificationEvidence) -> Findings:
    """Reject dynamics that a corrector refuses, such as a pole too slow for any machine."""
    try:
        check_dynamics(e.dynamics, e.record.sample_period)
        check_covariance(e.known.covariance, e.dynamics, e.known.valid_up_to)
    except CalibrationError as err:
        values = {"order": len(e.dynamics.denominator) - 1, "why": str(err)}
        yield Finding("identification.unusable", REJECTS, values)


def trusted_range(e: IdentificationEvidence) -> Findings:
    """Reject a response that is not known within the limits as far as the use needs."""
    up_to, least = e.known.valid_up_to, e.use.least_valid_up_to_hz
    stated = {"gain": e.limits.gain, "phase_rad": e.limits.phase, "valid_up_to_least_hz": least}
    if up_to == 0:
        # More of the same steps do not reduce what a drift or a relaxation leaves uncertain.
        yield Finding("identification.unknown_response", REJECTS, limits=stated)
    elif up_to < least:
        yield Finding("identification.narrow_band", REJECTS, {"up_to_hz": up_to}, stated)


def accuracy(e: IdentificationEvidence) -> Findings:
    """Reserve a calibration that does not reach the accuracy asked for on the intended scan."""
    if not e.use.accuracy_m:
        return
    reached = 2 * accuracy_on(e)
    if reached > e.use.accuracy_m:
        limits = {"accuracy_m": e.use.accuracy_m}
        yield Finding("identification.accuracy", RESERVATION, {"reached_m": reached}, limits)


def requested_order(e: IdentificationEvidence) -> Findings:
    """Warn of uncertainties that are enlarged, see ``inflate_to_free_choice``."""
    if e.known.widened > 1:
        values = {"order": e.fit.structure.poles, "factor": e.known.widened}
        yield Finding("identification.requested_order", WARNING, values)


# Standard uncertainty of a height over the size of an error: the rms of a sine. Backlash and
# friction lag by their whole half widths together; drift and linearity are no errors of motion.
_PER_SIZE = {PERIODIC: 0.5**0.5, VIBRATION: 0.5**0.5}
_AT_REVERSALS = (BACKLASH, FRICTION)
_MODELLED_CODES = {
    BACKLASH: "identification.backlash",
    FRICTION: "identification.friction",
    LINEARITY: "identification.linearity",
    PERIODIC: "identification.periodic",
    VIBRATION: "identification.vibration",
    DRIFT: "identification.drift",
    CREEP: "identification.creep",
    MODE: "identification.mode",
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


def model_errors(searched: SearchResult) -> Findings:
    """Yield a rejection for a deviation without a model, else a reservation for each other."""
    if searched.stiffening is not None:
        # Terms that were fitted without it may only imitate it.
        chance = float(np.exp(max(searched.stiffening.log_p, -690)))
        limits = {"false_alarm_p": FALSE_ALARM}
        yield Finding("identification.stiffening", REJECTS, {"p": chance}, limits)
        return
    sizes, period = _sizes(searched)[0], searched.prepared.problem.period
    pairs = zip(searched.nuisance_terms, sizes, strict=True)
    shown = [(modelled, found.value) for modelled, found in pairs if found.significant]
    drifts = any(modelled.term.family == DRIFT for modelled, _ in shown)
    for modelled, size in shown:
        term = modelled.term
        # A drift that wanders has power at low frequencies, where a line is a part of it.
        slow = term.parameter * searched.diagnostics.plateau < 1
        if drifts and slow and term.family == VIBRATION:
            continue
        code, values = _MODELLED_CODES[term.family], _values(term, size, period)
        alike = _alike(searched, modelled) if term.family in _MAY_LOOK_ALIKE else []
        if alike:
            code = "identification.undecided"
            values["causes"] = [_MAY_LOOK_ALIKE[name] for name in (term.family, *alike)]
        yield Finding(code, RESERVATION, values)
    for term in searched.added_poles:
        yield Finding(_MODELLED_CODES[term.family], RESERVATION, _values(term, None, period))


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
        drifts, columns = modelled.term.family == DRIFT, problem.background[:, modelled.columns]
        value = np.std(columns @ coefficients) if drifts else np.linalg.norm(coefficients)
        uncertainty = np.sqrt(max(np.trace(spread), 0.0) / (1 + drifts))
        found.append(Size(float(value), float(uncertainty), significant))
    variance = max(float(at_reversals @ of_background @ at_reversals), 0.0)
    return found, float(np.hypot(at_reversals @ fit.background, np.sqrt(variance)))


CHECKS: tuple[Callable[[IdentificationEvidence], Findings], ...] = (
    # A motion that does not determine the gain makes every other finding meaningless.
    separable_gain,
    misfit,
    latency,
    recording,
    searched,
    independence,
    agreement,
    inter_sample_motion,
    dynamic_gain,
    consistency,
    late_reference,
    usable,
    trusted_range,
    accuracy,
    requested_order,
)
"""Every check, in the order in which findings are stated."""


def limits_of(evidence: IdentificationEvidence) -> dict[str, float]:
    """Return the limits that values of the certificate are compared with."""
    return {
        "chi_square_least": LEAST_CHI_SQUARE,
        "chi_square_greatest": WORST_CHI_SQUARE,
        "false_alarm_p": FALSE_ALARM,
        "independence_p_least": FALSE_ALARM,
        "agreement_greatest": WORST_AGREEMENT,
        "consistency_p_least": FALSE_ALARM,
        "gain": evidence.limits.gain,
        "phase_rad": evidence.limits.phase,
        "valid_up_to_least_hz": evidence.use.least_valid_up_to_hz,
        "harmless_delay_s": evidence.use.harmless_delay_s,
    }
