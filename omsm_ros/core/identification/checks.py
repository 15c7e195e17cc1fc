"""May this calibration be used? One check for each way in which it may be wrong.

A check turns numbers into a :class:`Finding`. To add one, write a function and append what
calls it to :data:`CHECKS`; its entries, limits, reasons and warnings then stand in the
certificate, and any reason rejects.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from omsm_ros.core.calibration.finding import Finding
from omsm_ros.core.estimation.covariance import gain_uncertainty_alone, parameter_covariance
from omsm_ros.core.estimation.output_error import Fit, Problem
from omsm_ros.core.identification.covariance_terms import HARMLESS_DELAY_S
from omsm_ros.core.identification.evidence import IdentificationEvidence
from omsm_ros.core.identification.model_error_search import ModelledTerm, SearchResult
from omsm_ros.core.identification.residual_tests import response_agreement
from omsm_ros.core.lti.frequency_response import (
    COVERAGE_FACTOR,
    ResponseLimits,
    frequency_response,
    low_frequency_delay_uncertainty,
)
from omsm_ros.core.lti.transfer_function import TransferFunction
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
from omsm_ros.core.model_errors.residual_diagnostics import FALSE_ALARM, ScoreTest
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.readable import p_value_text, percent, plain, quantity

# Say which departures from a linear, steady response were found, and what to do at the machine.
#
# A departure that was modelled is a reservation: its uncertainty is in the band and in the budget.
# One that is significant and could not be modelled rejects the calibration, with its cause.

# No benign one of a hundred test records (noise, hum, drift, dropouts) comes above it.
_WORST_AGREEMENT = 2.5
# Resolves 1 Hz.
_AGREEMENT_SEGMENT_S = 1.0
# A response that is the mean of fewer is known to a third at best.
_LEAST_SEGMENTS = 8
# Share of its size that a departure costs on a scan, as a standard uncertainty: a sine its rms.
# Backlash and friction lag by their whole half widths together.
_ON_SCAN = {PERIODIC: 0.5**0.5, VIBRATION: 0.5**0.5}
_TURNING = (BACKLASH, FRICTION)
_REMEDY = {
    CREEP: "let the joints of probe and target settle, and rest longer on each plateau",
    MODE: "look for what the machine stands on or carries loosely",
    BACKLASH: "tighten the mount of the probe, or preload it",
    FRICTION: "look for cables and seals that drag on the moving part",
    STIFFENING: "make smaller steps, as large as the deflections of a scan",
    LINEARITY: "use less of the probe's range, or linearise the probe",
    PERIODIC: "make steps that are no multiple of that period",
    VIBRATION: "find what runs at this frequency, or isolate the machine from it",
    DRIFT: "let the machine warm up and its joints settle, and shield it",
}


def model_errors(searched: SearchResult) -> Finding:
    """Report the departures that were modelled, and those that could not be."""
    fit, problem = searched.model.chosen.fit, searched.prepared.problem
    nuisance_terms, turning = _sizes(problem, fit, searched.nuisance_terms)
    costs = [turning] + [
        _ON_SCAN.get(modelled.term.family, 0.0) * float(np.hypot(size, uncertainty))
        for modelled, (size, uncertainty) in zip(
            searched.nuisance_terms, nuisance_terms, strict=True
        )
    ]
    entries = [
        _entry(modelled.term, size, uncertainty)
        for modelled, (size, uncertainty) in zip(
            searched.nuisance_terms, nuisance_terms, strict=True
        )
    ]
    backlash = [
        2 * size
        for modelled, (size, _) in zip(searched.nuisance_terms, nuisance_terms, strict=True)
        if modelled.term.family == BACKLASH
    ]
    return Finding(
        {
            "departures": entries + [_entry(term, None, None) for term in searched.added_poles],
            "motion_error_m": float(np.sqrt(np.sum(np.square(costs)))),
            "backlash_m": max(backlash, default=0.0),
        },
        {"false_alarm_p": FALSE_ALARM},
        reasons=tuple(_unmodelled_text(judged) for judged in searched.unmodelled),
        reservations=(
            *(
                f"{_term_text(modelled.term, size)}; it is modelled beside the response: "
                + _REMEDY[modelled.term.family]
                for modelled, (size, _) in zip(searched.nuisance_terms, nuisance_terms, strict=True)
            ),
            *(
                f"{_term_text(term, None)}; it is part of the response: {_REMEDY[term.family]}"
                for term in searched.added_poles
            ),
        ),
    )


def _entry(
    term: ModelErrorTerm, size: float | None, uncertainty: float | None
) -> dict[str, object]:
    return {
        "family": term.family,
        "parameter": term.parameter,
        "size_m": size,
        "uncertainty_m": uncertainty,
        "modelled": "in the response" if size is None else "beside it",
    }


def _sizes(
    problem: Problem, fit: Fit, nuisance_terms: Sequence[ModelledTerm]
) -> tuple[list[tuple[float, float]], float]:
    """Return each modelled term's size and standard uncertainty [m]; what turning costs [m].

    Backlash and friction look alike, and what one has too much the other has too little.
    """
    if not nuisance_terms:
        return [], 0.0
    columns = problem.sensitivity(fit)
    covariance = parameter_covariance(problem, columns, fit.residual)
    first = columns.shape[1] - problem.background.shape[1]
    sides = np.zeros(problem.background.shape[1])
    found = []
    for modelled in nuisance_terms:
        coefficients = fit.background[modelled.columns]
        part = slice(first + modelled.columns.start, first + modelled.columns.stop)
        spread = covariance[part, part]
        if modelled.term.family in _TURNING:
            # The further column is its unknown state at the start.
            coefficients, spread = coefficients[:1], spread[:1, :1]
            sides[modelled.columns.start] = 1.0
        if modelled.term.family == DRIFT:
            added = problem.background[:, modelled.columns] @ coefficients
            found.append((float(np.std(added)), float(np.sqrt(max(np.trace(spread), 0.0) / 2))))
            continue
        found.append(
            (float(np.linalg.norm(coefficients)), float(np.sqrt(max(np.trace(spread), 0.0))))
        )
    variance = max(float(sides @ covariance[first:, first:] @ sides), 0.0)
    return found, float(np.hypot(sides @ fit.background, np.sqrt(variance)))


def _term_text(term: ModelErrorTerm, size: float | None) -> str:
    large = "" if size is None else f" of {quantity(size, 'm')}"
    half = quantity(size or 0.0, "m")
    length = quantity(term.parameter, "m")
    frequency = quantity(term.parameter, "Hz", 4)
    return {
        CREEP: "slow relaxation (creep) with a time constant of "
        + quantity(term.parameter, "s", 2),
        MODE: f"a light mode at {frequency}",
        BACKLASH: f"backlash of ±{half}",
        FRICTION: f"friction that drags by ±{half} and slides after {length}",
        STIFFENING: "a stiffness that grows with the deflection",
        LINEARITY: f"the probe's scale changes over its range, by{large[3:]} at its ends",
        PERIODIC: f"an error{large} periodic in {length} of travel",
        VIBRATION: f"vibration{large} at {frequency}",
        DRIFT: f"drift{large} rms during the test, or the beginning of a relaxation",
    }[term.family]


def _unmodelled_text(judged: ScoreTest) -> str:
    size = float(np.linalg.norm(judged.score.size))
    by_chance = p_value_text(float(np.exp(max(judged.log_p, -690))))
    return (
        f"the residual shows {_term_text(judged.term, size)} (by chance: {by_chance}) that no model "
        f"describes: {_REMEDY[judged.term.family]}, and repeat the test"
    )


def independence(p_value: float, scatter: float = 0.0) -> Finding:
    """Reject a residual that follows the rate of the motion, see ``residual_tests``.

    scatter: of the readings in time [s]: behind it the structure shows badly
    """
    reasons: tuple[str, ...] = ()
    if p_value < FALSE_ALARM:
        cause = (
            "the machine does not answer linearly, or differently each time; look for what is "
            "loose or rubs, and compare with smaller steps"
        )
        if scatter > 0:
            cause = (
                f"readings that scatter in time by {quantity(scatter, 's')} hide the response; "
                "latch encoder and probe by one trigger, and repeat the test"
            )
        reasons = (
            f"the residual follows the motion (by chance: {p_value_text(p_value)}): {cause}",
        )
    return Finding({"independence_p": p_value}, {"independence_p_least": FALSE_ALARM}, reasons)


def agreement(problem: Problem, best: Fit, up_to: float) -> Finding:
    """Reject a response that one estimated without a model contradicts, 0 to ``up_to`` [Hz]."""
    residual = problem.on_grid(best.residual, 0.0)
    segment = min(round(_AGREEMENT_SEGMENT_S / problem.period), len(residual) // _LEAST_SEGMENTS)
    value = response_agreement(
        frequency_response(problem.input, residual, problem.period, max(segment, 16)), up_to
    )
    # It takes the residual for noise alike everywhere, which rounding without noise is not.
    if not np.isfinite(value) or problem.shared > 0:
        return Finding({"nonparametric_agreement": None})
    reasons: tuple[str, ...] = ()
    if value > _WORST_AGREEMENT:
        reasons = (
            "the response estimated without a model differs from the model by "
            f"{plain(value, 2)} times its variance, at most {_WORST_AGREEMENT:g} are chance: the "
            "model misses a part of "
            "the machine; make more steps of two heights, and look for what is loose",
        )
    return Finding(
        {"nonparametric_agreement": value}, {"agreement_greatest": _WORST_AGREEMENT}, reasons
    )


# A residual this much larger than the noise is not noise; its square is χ² per sample.
_WORST_CHI_SQUARE = 1.3
# A rest this much noisier than the motion is no measure of noise: something still rings.
_LEAST_CHI_SQUARE = 0.3
# Three times the highest content of the paper's scan, 1.5 Hz: with less there is no use for it.
_LEAST_TRUSTED_HZ = 5.0
# Standard uncertainties beyond which a lead is no chance.
_CLEARLY = 5.0
# Exposure, averaging and transmission of a probe take milliseconds, of a slow one some samples.
_LONGEST_LAG_S, _LONGEST_LAG_SAMPLES = 0.1, 5.0
# Linear probes keep a per cent, and see Z at 10° as 0.985.
_SCALE_MISMATCH = 0.05
# Of the variance of the probe's noise; the heights of a scan are noisier by a twentieth.
_REPORTABLE = 0.1


def misfit(
    chi_square: float, noise: float, clearly_better: int | None, axis_timing: float = 0.0
) -> Finding:
    """Compare the mean square of the residual where the axis moves with that of the noise.

    chi_square: their ratio [1];  noise: standard deviation of a reading [m]
    clearly_better: number of poles that the data ask for instead of the order given, or None
    axis_timing: scatter in time of the axis's readings [s]
    """
    reasons = []
    if chi_square > _WORST_CHI_SQUARE:
        reasons.append(
            f"where the axis moves the residual is {plain(chi_square)} times the noise of "
            f"{quantity(noise, 'm')} squared: " + _what_to_check(clearly_better, axis_timing)
        )
    if chi_square < _LEAST_CHI_SQUARE:
        reasons.append(
            f"where the axis moves the residual is only {plain(chi_square, 2)} times the noise "
            f"of {quantity(noise, 'm')} squared: the probe is not quiet where the axis "
            "rests; start the recording after a second of rest"
        )
    limits = {"chi_square_least": _LEAST_CHI_SQUARE, "chi_square_greatest": _WORST_CHI_SQUARE}
    return Finding({"chi_square": chi_square, "noise_m": noise}, limits, tuple(reasons))


def timing(scatter: float, of_axis: float = 0.0) -> Finding:
    """Reserve a record whose readings scatter in time by ``scatter`` [s], or the axis's."""
    entries = {"timing_scatter_s": scatter, "axis_timing_scatter_s": of_axis}
    return Finding(
        entries,
        reservations=tuple(
            f"the readings{whose} scatter in time by {quantity(found, 's')}: in a scan they are "
            "noisier by that times the speed along Z; latch encoder and probe by one trigger"
            for whose, found in (("", scatter), (" of the axis", of_axis))
            if found > 0
        ),
    )


def encoder_noise(errors_in_variables: FloatArray | None, noise: float) -> Finding:
    """Tell of noise that was ``errors_in_variables`` by the probe, (n,) [m], and taken out of the input.

    noise: standard deviation of a reading of the probe [m]; what adds little to it is not warned of
    """
    if errors_in_variables is None:
        return Finding({"encoder_noise_m": None})
    found = float(np.sqrt(np.mean(errors_in_variables**2)))
    worth_telling = found**2 > _REPORTABLE * noise**2
    return Finding(
        {"encoder_noise_m": found},
        warnings=(
            f"the positions of the axis have noise of {quantity(found, 'm')} (rms) that the probe "
            "did not follow; the response is fitted without it, but each height of a scan has it: "
            "check the signals of the encoder and their shielding",
        )
        if worth_telling
        else (),
    )


def dropouts(spikes: int) -> Finding:
    """Tell of single positions of the axis that its encoder read wrongly."""
    if not spikes:
        return Finding()
    return Finding(
        warnings=(
            f"single positions of the axis ({spikes}) stood apart from those around them and were "
            "replaced; a scan keeps such points: check the cable of the encoder, and its scale for "
            "dirt",
        ),
    )


def two_clocks(by_stamps: bool) -> Finding:
    """Reserve a record whose streams were joined by the stamps of two clocks."""
    if not by_stamps:
        return Finding()
    return Finding(
        reservations=(
            "probe and axes were joined by their stamps: what their clocks differ by is part of "
            "the lag, and in no uncertainty; keep both clocks as they are for the scan, or latch "
            "both by one trigger",
        )
    )


def lead(lag: float, uncertainty: float, encoder_noise: float, probe_noise: float) -> Finding:
    """Judge a probe that moves before the encoder by -``lag`` [s], u = ``uncertainty`` [s].

    encoder_noise, probe_noise: standard deviation of a reading [m]
    An encoder may be late, and a scan is late by the same. But the noisier channel is the probe.
    """
    if lag > -max(_CLEARLY * uncertainty, HARMLESS_DELAY_S):
        return Finding()
    early = f"the probe moves {quantity(-lag, 's')} before the encoder"
    if encoder_noise > probe_noise:
        return Finding(
            reasons=(
                f"{early}, and the encoder is noisier ({quantity(encoder_noise, 'm')}) than the "
                f"probe ({quantity(probe_noise, 'm')}): the two channels are exchanged; exchange "
                "their columns or topics",
            )
        )
    return Finding(
        reservations=(
            f"{early}: the encoder is read late; latch both by one trigger, or keep it exactly so "
            "in the scan",
        )
    )


def late(lag: float, period: float) -> Finding:
    """Reserve a probe that answers later than probes do, by ``lag`` [s] at ``period`` [s]."""
    if lag < max(_LONGEST_LAG_S, _LONGEST_LAG_SAMPLES * period):
        return Finding()
    return Finding(
        reservations=(
            f"the probe answers {quantity(lag, 's')} after the encoder, {plain(lag / period)} "
            "samples, longer than probes and structures take: their counters or clocks are off by "
            "as much; restart both drivers together, or keep them exactly so in the scan",
        )
    )


def scale(gain: float) -> Finding:
    """Reserve a static ``gain`` [1] that no probe has before an encoder that is right."""
    if abs(gain - 1) < _SCALE_MISMATCH:
        return Finding()
    return Finding(
        reservations=(
            f"the probe shows {plain(gain)} of the travel of Z, where probes keep a per cent: "
            "check counts_per_unit of Z, where an error is one of every height, the scale of the "
            "probe, and its angle to Z",
        )
    )


def _what_to_check(clearly_better: int | None, axis_timing: float) -> str:
    if clearly_better is not None:
        return (
            "the model misses something; the order asked for is wrong, "
            f"{clearly_better} poles describe the record far better"
        )
    if axis_timing > 0:
        return (
            f"the readings of the axis scatter in time by {quantity(axis_timing, 's')}; latch "
            "encoder and probe by one trigger, and repeat the test"
        )
    return "the model misses something; check for backlash, a loose mount or a clipped probe"


def separable_gain(uncertainty: float, limit: float) -> Finding:
    """Reject a motion that does not separate the static gain from the dynamics.

    uncertainty: standard, of the static gain whatever lag and curvature G has, relative
    limit: of the 95 % band of the gain, relative
    """
    if COVERAGE_FACTOR * uncertainty <= limit:
        return Finding()
    return Finding(
        reasons=(
            "the motion does not separate the static gain from the dynamics (the gain alone is "
            f"uncertain by {percent(COVERAGE_FACTOR * uncertainty)}): move in steps, or "
            "at several frequencies at once",
        )
    )


def trusted_range(valid_up_to: float, limits: ResponseLimits) -> Finding:
    """Reject a response that is not known within ``limits`` up to a few hertz."""
    allowed = {
        "gain": limits.gain,
        "phase_rad": limits.phase,
        "valid_up_to_least_hz": _LEAST_TRUSTED_HZ,
    }
    reasons: tuple[str, ...] = ()
    if valid_up_to == 0:
        # More of the same steps do not close what a drift or a relaxation leaves open.
        reasons = ("the response is known within limits at no frequency",)
    elif valid_up_to < _LEAST_TRUSTED_HZ:
        reasons = (
            f"the response is known within limits only up to {quantity(valid_up_to, 'Hz', 2)}; "
            "make more or larger steps",
        )
    return Finding(limits=allowed, reasons=reasons)


def requested_order(order: int, factor: float) -> Finding:
    """Warn of uncertainties that were taken ``factor`` times as large, see ``inflate_to_free_choice``."""
    if factor <= 1:
        return Finding()
    return Finding(
        warnings=(
            f"order {order} was asked for; without asking, more stays open than it can state: "
            f"its uncertainties are taken {plain(factor, 2)} times as large",
        )
    )


def poles_beyond_valid_range(
    dynamics: TransferFunction, valid_up_to: float, nyquist: float
) -> Finding:
    """Warn of poles beyond ``valid_up_to`` [Hz]: they shape the response, but are not known.

    One that is ten times faster than half the sampling rate shapes nothing, and is not named;
    nor is any where nothing is known.
    """
    return Finding(
        warnings=tuple(
            f"pole at {quantity(mode.frequency, 'Hz')} lies beyond {quantity(valid_up_to, 'Hz')}, "
            "up to which the response is known within limits: it need not be a resonance"
            for mode in dynamics.modes()
            if 0 < valid_up_to < mode.frequency < 10 * nyquist
        )
    )


CHECKS: tuple[Callable[[IdentificationEvidence], Finding], ...] = (
    # What the motion cannot tell makes every other finding meaningless.
    lambda e: separable_gain(gain_uncertainty_alone(e.prepared.problem, e.fit), e.limits.gain),
    lambda e: misfit(
        e.residual.chi_square, e.residual.noise, e.known.clearly_better, e.residual.axis_timing
    ),
    lambda e: lead(
        e.dynamics.low_frequency_delay,
        low_frequency_delay_uncertainty(e.dynamics, e.known.covariance),
        e.prepared.steps.noise,
        e.residual.noise,
    ),
    lambda e: late(e.dynamics.low_frequency_delay, e.prepared.problem.period),
    lambda e: scale(abs(e.fit.gain)),
    lambda e: timing(e.residual.timing, e.residual.axis_timing),
    lambda e: encoder_noise(e.prepared.problem.errors_in_variables, e.residual.noise),
    lambda e: dropouts(e.prepared.axis_spikes),
    lambda e: two_clocks(e.record.by_stamps),
    lambda e: model_errors(e.searched),
    lambda e: independence(
        e.searched.diagnostics.independence, max(e.residual.timing, e.residual.axis_timing)
    ),
    lambda e: agreement(e.prepared.problem, e.fit, e.known.valid_up_to),
)
"""What may be wrong with the record or the model."""

RANGE_CHECKS: tuple[Callable[[IdentificationEvidence], Finding], ...] = (
    lambda e: trusted_range(e.known.valid_up_to, e.limits),
    lambda e: requested_order(e.fit.structure.poles, e.known.widened),
    lambda e: poles_beyond_valid_range(
        e.dynamics, e.known.valid_up_to, 0.5 / e.prepared.problem.period
    ),
)
"""How far the result is trusted: what is open comes before how far that reaches."""
