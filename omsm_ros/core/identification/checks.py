"""Decide whether a calibration may be used: one check for each way in which it may be wrong.

A check returns the findings of one question, each with a code, values and limits. To add one,
write a function and append a call of it to :data:`CHECKS`, and the sentence of its code to
:mod:`omsm_ros.messages.identification`.
"""

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from omsm_ros.core.calibration.certificate import REJECTS, RESERVATION, WARNING, Finding
from omsm_ros.core.calibration.intended_use import IntendedUse
from omsm_ros.core.calibration.plausibility import check_covariance, check_dynamics
from omsm_ros.core.estimation.covariance import gain_uncertainty_alone
from omsm_ros.core.identification.covariance_terms import ReferenceLag, inter_sample_delay_bound
from omsm_ros.core.identification.evidence import IdentificationEvidence
from omsm_ros.core.identification.model_error_checks import accuracy_on, model_errors
from omsm_ros.core.lti.frequency_response import (
    COVERAGE_FACTOR,
    ResponseLimits,
    low_frequency_delay_uncertainty,
)
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.model_errors.residual_diagnostics import (
    FALSE_ALARM,
    HALVES,
    SIZES,
    UP_DOWN,
    Contrast,
)
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import CalibrationError

Findings = Iterator[Finding]

# Twice the largest value of a hundred records of the twin with noise, hum, drift and dropouts.
WORST_AGREEMENT = 2.5
# The square of a residual over that of the noise, above which the residual is not noise.
WORST_CHI_SQUARE = 1.3
# Below it the readings of a stationary axis are noisier than in motion: a mode still rings.
LEAST_CHI_SQUARE = 0.3
# Standard uncertainties beyond which a lag is not due to chance.
_SIGNIFICANT = 5.0
# Exposure, averaging and transmission of a probe take milliseconds, of a slow one some samples.
_LONGEST_LAG_S, _LONGEST_LAG_SAMPLES = 0.1, 5.0
# Linear probes are right to one per cent; one that sees Z at 10° reads 0.985 of it.
_SCALE_ERROR = 0.05
# Share of the variance of a reading above which encoder noise is warned of.
_NOTICEABLE_SHARE = 0.1


def separable_gain(uncertainty: float, limit: float) -> Findings:
    """Reject a motion that does not separate the static gain from the dynamics.

    uncertainty: standard, of the static gain whatever lag and curvature G has, relative
    limit: of the 95 % band of the gain, relative
    """
    if COVERAGE_FACTOR * uncertainty > limit:
        values = {"half_width": COVERAGE_FACTOR * uncertainty}
        yield Finding("identification.gain_not_separable", REJECTS, values, {"gain": limit})


def misfit(
    chi_square: float, noise: float, clearly_better: int | None, axis_timing: float = 0.0
) -> Findings:
    """Reject a mean square residual where the axis moves that is not that of the noise.

    chi_square: their ratio [1];  noise: standard deviation of a reading [m]
    clearly_better: number of poles that the data ask for instead of the order given, or None
    axis_timing: scatter in time of the readings of the axis [s]
    """
    values: dict[str, object] = {"chi_square": chi_square, "noise_m": noise}
    if chi_square < LEAST_CHI_SQUARE:
        limits = {"chi_square_least": LEAST_CHI_SQUARE}
        yield Finding("identification.noisy_rest", REJECTS, values, limits)
    if chi_square > WORST_CHI_SQUARE:
        limits = {"chi_square_greatest": WORST_CHI_SQUARE}
        if clearly_better is not None:
            values["better_order"] = clearly_better
            yield Finding("identification.wrong_order", REJECTS, values, limits)
        elif axis_timing > 0:
            values["scatter_s"] = axis_timing
            yield Finding("identification.residual_of_axis_timing", REJECTS, values, limits)
        else:
            yield Finding("identification.large_residual", REJECTS, values, limits)


def lead(
    lag: float, uncertainty: float, encoder_noise: float, probe_noise: float, harmless: float
) -> Findings:
    """Judge a probe that moves before the encoder by -``lag`` [s], u = ``uncertainty`` [s].

    encoder_noise, probe_noise: standard deviation of a reading [m];  harmless: delay [s]
    An encoder may be late, and is then late in a scan as well. But the noisier channel should be
    the probe.
    """
    if lag > -max(_SIGNIFICANT * uncertainty, harmless):
        return
    values = {"lead_s": -lag}
    if encoder_noise > probe_noise:
        noise = {"encoder_noise_m": encoder_noise, "probe_noise_m": probe_noise}
        yield Finding("identification.exchanged_channels", REJECTS, values | noise)
    else:
        yield Finding("identification.late_encoder", RESERVATION, values)


def late(lag: float, period: float) -> Findings:
    """Reserve a probe that answers later than probes do, by ``lag`` [s] at ``period`` [s]."""
    limit = max(_LONGEST_LAG_S, _LONGEST_LAG_SAMPLES * period)
    if lag >= limit:
        values = {"lag_s": lag, "samples": lag / period}
        yield Finding("identification.late_probe", RESERVATION, values, {"lag_greatest_s": limit})


def scale(gain: float) -> Findings:
    """Reserve a static ``gain`` [1] that no probe has against an encoder that is right."""
    if abs(gain - 1) >= _SCALE_ERROR:
        limits = {"scale_error_greatest": _SCALE_ERROR}
        yield Finding("identification.scale", RESERVATION, {"gain": gain}, limits)


def timing(scatter: float, of_axis: float = 0.0) -> Findings:
    """Reserve a record whose readings scatter in time by ``scatter`` [s], or those of the axis."""
    if scatter > 0:
        yield Finding("identification.timing_scatter", RESERVATION, {"scatter_s": scatter})
    if of_axis > 0:
        yield Finding("identification.axis_timing_scatter", RESERVATION, {"scatter_s": of_axis})


def encoder_noise(errors_in_variables: FloatArray | None, noise: float) -> Findings:
    """Warn of encoder noise that the probe does not show, (n,) [m], removed from the input.

    noise: standard deviation of a reading of the probe [m]
    """
    if errors_in_variables is None:
        return
    found = float(np.sqrt(np.mean(errors_in_variables**2)))
    if found**2 > _NOTICEABLE_SHARE * noise**2:
        yield Finding("identification.encoder_noise", WARNING, {"noise_m": found})


def dropouts(spikes: int) -> Findings:
    """Warn of single positions of the axis that its encoder read wrongly."""
    if spikes:
        yield Finding("identification.axis_spikes", WARNING, {"count": spikes})


def two_clocks(by_stamps: bool) -> Findings:
    """Reserve a record whose streams were joined by the stamps of two clocks."""
    if by_stamps:
        yield Finding("identification.two_clocks", RESERVATION)


def complete_search(incomplete: bool) -> Findings:
    """Reserve a model whose search was cut short."""
    if incomplete:
        yield Finding("estimation.search_incomplete", RESERVATION)


def independence(p_value: float, scatter: float = 0.0) -> Findings:
    """Reject a residual that follows the rate of the motion, see ``residual_tests``.

    scatter: of the readings in time [s]; a large one conceals the response
    """
    if p_value >= FALSE_ALARM:
        return
    limits, values = {"independence_p_least": FALSE_ALARM}, {"p": p_value}
    if scatter > 0:
        values["scatter_s"] = scatter
        yield Finding("identification.dependent_by_timing", REJECTS, values, limits)
    else:
        yield Finding("identification.dependent_residual", REJECTS, values, limits)


def agreement(difference: float | None) -> Findings:
    """Reject a response that one estimated without a model contradicts."""
    if difference is not None and difference > WORST_AGREEMENT:
        limits = {"agreement_greatest": WORST_AGREEMENT}
        yield Finding("identification.disagreement", REJECTS, {"difference": difference}, limits)


def inter_sample_motion(bound: float, delay_noise: float, harmless: float) -> Findings:
    """Reject edges whose bound on the bias of the delay [s] exceeds its noise [s].

    harmless: delay whose effect on the intended scan is small [s]
    """
    limit = max(delay_noise, harmless)
    if bound > limit:
        limits = {"inter_sample_delay_greatest_s": limit}
        yield Finding("identification.sharp_edges", REJECTS, {"bound_s": bound}, limits)


def late_reference(lag: ReferenceLag | None, harmless: float) -> Findings:
    """Reject a reference that is clearly late, or early, against the encoder.

    harmless: delay whose effect on the intended scan is small [s]
    """
    if lag is None or abs(lag.value) <= max(_SIGNIFICANT * lag.uncertainty, harmless):
        return
    code = "identification.late_reference" if lag.value > 0 else "identification.early_reference"
    values = {"lag_s": abs(lag.value), "uncertainty_s": lag.uncertainty}
    yield Finding(code, REJECTS, values, {"reference_lag_greatest_s": harmless})


def dynamic_gain_finding(
    uncertainty: float, time_constant: float, plateau: float, limit: float
) -> Findings:
    """Reject a test whose dynamic gain is too uncertain relative to the static gain.

    uncertainty: standard, of that gain, relative, from a relaxation of ``time_constant`` [s]
    plateau: time from edge to edge [s];  limit: of the 95 % band, relative
    """
    if COVERAGE_FACTOR * uncertainty <= limit:
        return
    values = {
        "half_width": COVERAGE_FACTOR * uncertainty,
        "time_constant_s": time_constant,
        "plateau_s": plateau,
    }
    code = (
        "identification.creep_within_plateau"
        if time_constant <= plateau
        else "identification.creep_beyond_plateau"
    )
    yield Finding(code, REJECTS, values, {"gain": limit})


_DIFFERENT_PARTS = {
    UP_DOWN: "identification.directions_differ",
    HALVES: "identification.halves_differ",
    SIZES: "identification.sizes_differ",
}


def consistency(found: Sequence[Contrast]) -> Findings:
    """Reserve a test whose parts differ by more than chance; of recordings, name the one apart."""
    differing = [contrast for contrast in found if contrast.significant]
    recordings = [c for c in differing if c.parts not in _DIFFERENT_PARTS]
    farthest = max(recordings, key=lambda c: abs(c.lag / c.lag_uncertainty), default=None)
    for contrast in differing:
        values: dict[str, object] = {"lag_s": contrast.lag, "gain": contrast.gain, "p": contrast.p}
        code = _DIFFERENT_PARTS.get(contrast.parts)
        if code is None:
            if contrast is not farthest:
                continue
            code, values["parts"] = "identification.recordings_differ", contrast.parts
        yield Finding(code, RESERVATION, values, {"consistency_p_least": FALSE_ALARM})


def trusted_range(valid_up_to: float, limits: ResponseLimits, least: float) -> Findings:
    """Reject a response that is not known within ``limits`` up to ``least`` [Hz]."""
    stated = {"gain": limits.gain, "phase_rad": limits.phase, "valid_up_to_least_hz": least}
    if valid_up_to == 0:
        # More of the same steps do not reduce what a drift or a relaxation leaves uncertain.
        yield Finding("identification.unknown_response", REJECTS, limits=stated)
    elif valid_up_to < least:
        yield Finding("identification.narrow_band", REJECTS, {"up_to_hz": valid_up_to}, stated)


def accuracy(use: IntendedUse, reached: float) -> Findings:
    """Reserve a calibration that does not reach the accuracy asked for.

    reached: standard uncertainty of a height of the intended scan [m]
    """
    if use.accuracy_m is not None and 2 * reached > use.accuracy_m:
        limits = {"accuracy_m": use.accuracy_m}
        yield Finding("identification.accuracy", RESERVATION, {"reached_m": 2 * reached}, limits)


def usable(
    dynamics: TransferFunction, covariance: FloatArray, valid_up_to: float, period: float
) -> Findings:
    """Reject dynamics that a corrector refuses, such as a pole too slow for any machine."""
    try:
        check_dynamics(dynamics, period)
        check_covariance(covariance, dynamics, valid_up_to)
    except CalibrationError as err:
        values = {"order": len(dynamics.denominator) - 1, "why": str(err)}
        yield Finding("identification.unusable", REJECTS, values)


def requested_order(order: int, factor: float) -> Findings:
    """Warn of uncertainties enlarged by ``factor``, see ``inflate_to_free_choice``."""
    if factor > 1:
        yield Finding("identification.requested_order", WARNING, {"order": order, "factor": factor})


CHECKS: tuple[Callable[[IdentificationEvidence], Findings], ...] = (
    # A motion that does not determine the gain makes every other finding meaningless.
    lambda e: separable_gain(gain_uncertainty_alone(e.prepared.problem, e.fit), e.limits.gain),
    lambda e: misfit(
        e.residual.chi_square, e.residual.noise, e.known.clearly_better, e.residual.axis_timing
    ),
    lambda e: lead(
        e.dynamics.low_frequency_delay,
        low_frequency_delay_uncertainty(e.dynamics, e.known.covariance),
        e.prepared.steps.noise,
        e.residual.noise,
        e.use.harmless_delay_s,
    ),
    lambda e: late(e.dynamics.low_frequency_delay, e.prepared.problem.period),
    lambda e: scale(abs(e.fit.gain)),
    lambda e: timing(e.residual.timing, e.residual.axis_timing),
    lambda e: encoder_noise(e.prepared.problem.errors_in_variables, e.residual.noise),
    lambda e: dropouts(e.prepared.axis_spikes),
    lambda e: two_clocks(e.record.by_stamps),
    lambda e: model_errors(e.searched),
    lambda e: complete_search(e.searched.incomplete),
    lambda e: independence(
        e.searched.diagnostics.independence, max(e.residual.timing, e.residual.axis_timing)
    ),
    lambda e: agreement(e.response_difference),
    lambda e: inter_sample_motion(
        inter_sample_delay_bound(
            e.prepared.problem.input, e.prepared.steps, e.prepared.problem.period
        ),
        low_frequency_delay_uncertainty(e.dynamics, e.known.from_noise),
        e.use.harmless_delay_s,
    ),
    lambda e: dynamic_gain_finding(
        e.undetected.gain_u or 0.0,
        e.undetected.plateau_needed_s or 0.0,
        e.searched.diagnostics.plateau,
        e.limits.gain,
    ),
    lambda e: consistency(e.contrasts),
    lambda e: late_reference(e.reference, e.use.harmless_delay_s),
    # How far the result may be trusted.
    lambda e: usable(e.dynamics, e.known.covariance, e.known.valid_up_to, e.record.sample_period),
    lambda e: trusted_range(e.known.valid_up_to, e.limits, e.use.least_valid_up_to_hz),
    lambda e: accuracy(e.use, accuracy_on(e) if e.use.accuracy_m else 0.0),
    lambda e: requested_order(e.fit.structure.poles, e.known.widened),
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
