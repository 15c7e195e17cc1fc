"""Identify G_m from a motion of the axis and what the probe saw of a fixed target.

On a fixed target ``distance = offset + drift · t - static_gain · (G_m u)(t)``; G_m(0) = 1.
See :mod:`preparation` for what is fitted, :mod:`order_choice` for how the structure is chosen,
:mod:`output_error` for the fit, :mod:`covariance` for how well G_m is then known, and
:mod:`certificate` for the verdict.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
from scipy import fft, signal

from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.core.dynamics.frequency_response import frequency_response
from omsm_ros.core.dynamics.masses_and_springs import finite_values, shape
from omsm_ros.core.dynamics.modes import modal_remainder, mode_entries
from omsm_ros.core.dynamics.response_band import (
    Band,
    ResponseLimits,
    response_band,
    shown_up_to,
    trusted_up_to,
    widening,
)
from omsm_ros.core.dynamics.transfer_function import TransferFunction
from omsm_ros.core.fitting.covariance import (
    gain_apart,
    hidden_motion_covariance,
    noise_spectrum,
    parameter_covariance,
)
from omsm_ros.core.fitting.initial_condition import still_decays
from omsm_ros.core.fitting.model_structure import Structure
from omsm_ros.core.fitting.order_choice import Candidate, choose, explore, held_out_rms
from omsm_ros.core.fitting.order_estimate import HankelVote, hankel_vote
from omsm_ros.core.fitting.output_error import Fit, Problem, fit
from omsm_ros.core.fitting.preparation import Prepared, check_gain, prepare
from omsm_ros.core.fitting.starting_points import StartingPoints
from omsm_ros.core.fitting.steps import held_out
from omsm_ros.core.identification.certificate import Evidence, certify
from omsm_ros.core.identification.inter_sample_bias import inter_sample_delay_bound
from omsm_ros.core.identification.residual_tests import (
    noise_colour,
    residual_tests,
    response_agreement,
)
from omsm_ros.core.identification.static_gains import static_gains
from omsm_ros.core.identification.two_masses import table_mass, two_mass_entry
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.core.samples.motion_record import MotionRecord
from omsm_ros.errors import StepTestError

DEFAULT_LIMITS = ResponseLimits()
_FREQUENCIES = 400
# Kass and Raftery: a difference in BIC above this is very strong evidence.
_EQUALLY_GOOD_BIC = 10.0
# A delay's uncertainty is read off the phase far below everything that moves.
_LOW_FREQUENCY_HZ = 1e-3
_AGREEMENT_SEGMENT_S = 1.0
_LEAST_SEGMENTS = 8


def identify(
    record: MotionRecord,
    *,
    order: int = 0,
    input: str = "encoder",
    settings: Mapping[str, object] | None = None,
    noise: float | None = None,
    limits: ResponseLimits = DEFAULT_LIMITS,
) -> Calibration:
    """The calibration that ``record`` supports, with its covariance and certificate.

    order: number of poles, 0 to choose it; to ask for one makes nothing better known
    input: "encoder", or "reference" to take the second sensor as the motion
    noise: known standard deviation of one reading of the probe [m], for χ²; None to take
        it where the axis rests
    limits: of the 95 % band, deciding ``valid_up_to``
    settings: what the calibration belongs to, kept as it is; with "table_mass_kg" the masses
        and springs of a response that is that of two masses are in SI, else per table mass

    Raises StepTestError when there is no usable motion, IdentificationError when the probe
    did not see it, ConfigurationError for an input or a mass that cannot be. A model that can
    be had but not trusted is returned with the verdict "rejected" in its certificate.
    """
    mass = table_mass(settings or {})
    prepared, model = _modelled(prepare(record, input), order)
    check_gain(model.chosen.fit.gain)
    known = _Known.of(prepared, model, limits)
    if order:
        known = _no_surer(known, prepared, model, limits)
    dynamics, covariance = model.chosen.fit.dynamics, known.covariance
    certificate = certify(
        dynamics,
        model.chosen,
        model.candidates,
        model.vote,
        _evidence(prepared, model, known, noise, limits),
        {"input": input}
        | _further(record, prepared, model, known)
        | {"two_mass": two_mass_entry(dynamics, covariance, known.valid_up_to, mass)},
    )
    return Calibration(
        dynamics=dynamics,
        static_gain=abs(model.chosen.fit.gain),
        sample_period=record.sample_period,
        valid_up_to=max(known.valid_up_to, _LOW_FREQUENCY_HZ),
        covariance=covariance,
        settings=dict(settings or {}),
        certificate=certificate,
    )


@dataclass(frozen=True, eq=False)
class Model:
    """The chosen candidate among those tried, and the vote of the singular values."""

    chosen: Candidate
    candidates: Sequence[Candidate]
    vote: HankelVote


def choose_model(prepared: Prepared, order: int = 0) -> Model:
    """Fit structures to the prepared problem and choose among them; ``order`` poles, or 0."""
    problem = prepared.problem
    lag = fit(problem, Structure(0, 0, True), [np.array([0.1])])
    static = lag.gain * problem.motion + problem.background @ lag.background
    deviation = (problem.seen - static) / lag.gain
    vote = hankel_vote(problem.motion, deviation, problem.used, problem.period)
    points = StartingPoints(problem, lag, vote)

    def fit_structure(structure: Structure, smaller: Sequence[Fit]) -> Fit:
        return fit(problem, structure, points.of(structure, smaller))

    colour = noise_colour(problem, lag, prepared.steps)
    candidates = explore(fit_structure, vote.order, order, colour)
    held = held_out(prepared.steps, len(problem.motion))
    chosen, candidates = choose(candidates, lambda f: held_out_rms(problem, f, held))
    return Model(chosen, candidates, vote)


def _modelled(prepared: Prepared, order: int) -> tuple[Prepared, Model]:
    """The model, with free decays in the problem where something still rang at its start."""
    model = choose_model(prepared, order)
    colour = noise_colour(prepared.problem, model.chosen.fit, prepared.steps)
    at_rest = not prepared.steps.moving[0]
    if not still_decays(prepared.problem, model.chosen.fit, colour, at_rest=at_rest):
        return prepared, model
    prepared = replace(prepared, problem=replace(prepared.problem, starts_moving=True))
    return prepared, choose_model(prepared, order)


@dataclass(frozen=True, eq=False)
class _Known:
    """How well the chosen model is known.

    covariance: of the coefficients, hidden motion included;  from_noise: without it
    shown_up_to: [Hz] beyond which the motion would show no error of the response
    widened: factor on the uncertainties, and clearly_better: number of poles, see _no_surer
    """

    covariance: FloatArray
    from_noise: FloatArray
    gain_variance: float
    hidden_delay: float
    shown_up_to: float
    valid_up_to: float
    widened: float = 1.0
    clearly_better: int | None = None

    @classmethod
    def of(cls, prepared: Prepared, model: Model, limits: ResponseLimits) -> _Known:
        problem, best = prepared.problem, model.chosen.fit
        size, dynamics = best.structure.size, best.dynamics
        passed = replace(dynamics, numerator=best.gain * dynamics.numerator)
        every = parameter_covariance(problem, problem.sensitivity(best), best.residual, passed)
        transform = best.scaled.coefficient_jacobian(best.shape)
        from_noise = _symmetric(transform @ every[:size, :size] @ transform.T)
        hidden = inter_sample_delay_bound(problem.motion, prepared.steps, problem.period)
        further = hidden_motion_covariance(dynamics, hidden, problem.period)
        covariance = _symmetric(from_noise + further)
        band = response_band(dynamics, covariance, _frequencies(problem))
        shown = _shown_up_to(problem, best, limits)
        valid = _trusted_up_to(model, band, limits, shown)
        return cls(covariance, from_noise, float(every[size, size]), hidden, shown, valid)


def _no_surer(known: _Known, prepared: Prepared, model: Model, limits: ResponseLimits) -> _Known:
    """What is known of an order that was asked for, no surer than without asking.

    Too low an order has few parameters, so little noise in them, and a bias beyond what the
    motion excites, which no residual shows. The free choice tells how much it leaves open.
    """
    free = choose_model(prepared)
    mine, other = model.chosen.fit, free.chosen.fit
    if mine.structure == other.structure or mine.structure.contains(other.structure):
        return known
    lines = _frequencies(prepared.problem)
    trusted = lines[lines <= known.valid_up_to]
    factor = widening(
        response_band(mine.dynamics, known.covariance, trusted),
        response_band(other.dynamics, _Known.of(prepared, free, limits).covariance, trusted),
        np.log(other.dynamics.response(trusted) / mine.dynamics.response(trusted)),
    )
    covariance = factor**2 * known.covariance
    band = response_band(mine.dynamics, covariance, lines)
    better = free.chosen.bic < model.chosen.bic - _EQUALLY_GOOD_BIC
    return replace(
        known,
        covariance=covariance,
        valid_up_to=_trusted_up_to(model, band, limits, known.shown_up_to),
        widened=factor,
        clearly_better=other.structure.poles if better else None,
    )


def _trusted_up_to(model: Model, band: Band, limits: ResponseLimits, shown: float) -> float:
    return min(trusted_up_to(band, limits, _disagreement(model, band)), shown)


def _shown_up_to(problem: Problem, best: Fit, limits: ResponseLimits) -> float:
    """Beyond this frequency [Hz] the data could not contradict the model ``best``."""
    length = len(problem.used)
    compared = np.flatnonzero(problem.used)
    taper = np.zeros(length)
    # From one end of what is compared to the other, so that no end breaks off.
    taper[compared[0] : compared[-1] + 1] = signal.windows.hann(compared[-1] + 1 - compared[0])
    answer = problem.output(best) - problem.background @ best.background
    seen = best.samples / (compared[-1] + 1 - compared[0])
    noise = noise_spectrum(best.residual, length) * float(taper @ taper) / seen
    return shown_up_to(
        np.asarray(fft.rfftfreq(length, problem.period)),
        np.asarray(fft.rfft(taper * (answer - np.mean(answer))), np.complex128),
        noise,
        limits,
    )


def _symmetric(matrix: FloatArray) -> FloatArray:
    return np.asarray(0.5 * (matrix + matrix.T))


def _delay_uncertainty(dynamics: TransferFunction, covariance: FloatArray) -> float:
    low = response_band(dynamics, covariance, np.array([_LOW_FREQUENCY_HZ]))
    return float(low.phase[0] / (2 * np.pi * _LOW_FREQUENCY_HZ))


def _evidence(
    prepared: Prepared,
    model: Model,
    known: _Known,
    noise: float | None,
    limits: ResponseLimits,
) -> Evidence:
    best, problem = model.chosen.fit, prepared.problem
    tests = residual_tests(problem, best, prepared.steps, noise)
    return Evidence(
        chi_square=tests.chi_square,
        residual_rms=best.rms,
        noise=tests.noise,
        whiteness=tests.whiteness,
        independence=tests.independence,
        valid_up_to=known.valid_up_to,
        limits=limits,
        nyquist=0.5 / problem.period,
        delay_noise=_delay_uncertainty(best.dynamics, known.from_noise),
        delay_uncertainty=_delay_uncertainty(best.dynamics, known.covariance),
        inter_sample_delay_bound=known.hidden_delay,
        gain_apart=gain_apart(problem, best),
        edges=len(prepared.steps.edges),
        widened=known.widened,
        clearly_better=known.clearly_better,
    )


def _further(
    record: MotionRecord, prepared: Prepared, model: Model, known: _Known
) -> dict[str, object]:
    best, column = model.chosen.fit, prepared.backlash_column
    polarity = -int(np.sign(best.gain))
    backlash = 0.0 if column is None else 2 * abs(float(best.background[column]))
    return {
        "static_gain": abs(best.gain),
        "static_gain_uncertainty": float(np.sqrt(known.gain_variance)),
        "polarity": polarity,
        "shown_up_to_hz": known.shown_up_to,
        "drift_m_s": 2 * float(best.background[1]) / (len(record) * record.sample_period),
        "backlash_m": backlash,
        "shape": finite_values(shape(best.dynamics, 0.5 / record.sample_period)),
        "modes": mode_entries(best.dynamics, known.covariance),
        "modal_remainder": modal_remainder(best.dynamics, known.valid_up_to),
        "static_gains": _attributed(record),
        "nonparametric_agreement": _agreement(prepared.problem, best, known.valid_up_to),
        "samples": dict(record.counts) | {"spikes": prepared.spikes, "compared": best.samples},
    }


def _attributed(record: MotionRecord) -> dict[str, object] | None:
    """Gains between probe, encoder and reference; None where there are too few plateaus."""
    try:
        return asdict(static_gains(record))
    except StepTestError:
        return None


def _agreement(problem: Problem, best: Fit, up_to: float) -> float | None:
    left = np.zeros(len(problem.used))
    left[problem.used] = best.residual
    segment = min(round(_AGREEMENT_SEGMENT_S / problem.period), len(left) // _LEAST_SEGMENTS)
    segment = max(segment, 16)
    value = response_agreement(
        frequency_response(problem.motion, left, problem.period, segment), up_to
    )
    return value if np.isfinite(value) else None


def _frequencies(problem: Problem) -> FloatArray:
    nyquist = 0.5 / problem.period
    return np.asarray(np.geomspace(1e-4 * nyquist, nyquist, _FREQUENCIES))


def _disagreement(model: Model, band: Band) -> Band:
    """Largest difference from any other candidate that describes the data about as well."""
    chosen = model.chosen.fit.dynamics.response(band.frequency)
    gain, phase = np.zeros(len(chosen)), np.zeros(len(chosen))
    best = min(c.bic for c in model.candidates)
    for other in model.candidates:
        if other.bic < best + _EQUALLY_GOOD_BIC:
            difference = np.log(other.fit.dynamics.response(band.frequency) / chosen)
            gain = np.maximum(gain, np.abs(difference.real))
            phase = np.maximum(phase, np.abs(difference.imag))
    return Band(band.frequency, gain, phase)
