"""How well is the response of a chosen model known, and up to which frequency is it trusted?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import fft, signal

from omsm_ros.core.calibration.finding import Finding
from omsm_ros.core.estimation.covariance import noise_spectrum, parameter_covariance
from omsm_ros.core.estimation.output_error import Fit, Problem
from omsm_ros.core.estimation.preparation import Prepared
from omsm_ros.core.identification.covariance_terms import COVARIANCE_TERMS, CovarianceTerm
from omsm_ros.core.identification.model_choice import ChosenModel
from omsm_ros.core.lti.frequency_response import (
    COVERAGE_FACTOR,
    Band,
    ResponseLimits,
    excited_up_to,
    response_band,
    trusted_up_to,
    widening,
)
from omsm_ros.core.model_errors.families import CREEP, MODE, ModelErrorTerm
from omsm_ros.core.model_errors.residual_diagnostics import ResidualDiagnostics
from omsm_ros.core.model_errors.undetected import (
    UNDETECTED,
    UndetectedTerm,
    alternative_mode_covariance,
    undetected_terms,
    with_slow_creep,
)
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import ConfigurationError
from omsm_ros.quantities import shown
from omsm_ros.readable import number, percent, quantity

# On a logarithmic grid over four decades: neighbours 2.3 % apart.
_FREQUENCIES = 400
# Kass and Raftery: a difference in BIC above this is very strong evidence.
_EQUALLY_GOOD_BIC = 10.0


@dataclass(frozen=True, eq=False)
class ResponseUncertainty:
    """How well the chosen model is known.

    covariance: (p, p) of the coefficients, all terms included;  from_noise: (p, p) without them
    gain_variance: of the gain of the probe per travel at rest [1]
    excited_up_to: [Hz] beyond which the motion would show no error of the response
    valid_up_to: [Hz] up to which the response is trusted; 0 if nowhere
    findings: of the terms of the covariance
    widened: factor on the uncertainties, and clearly_better: number of poles, see no_surer
    """

    covariance: FloatArray
    from_noise: FloatArray
    gain_variance: float
    excited_up_to: float
    valid_up_to: float
    findings: Sequence[Finding] = ()
    widened: float = 1.0
    clearly_better: int | None = None


def response_uncertainty(
    prepared: Prepared,
    model: ChosenModel,
    limits: ResponseLimits,
    undetected: Sequence[CovarianceTerm] = (),
) -> ResponseUncertainty:
    """Return how well the chosen fit of ``model`` is known: noise, then each further term.

    undetected: terms of what the residual of this very fit could hide
    """
    problem, best = prepared.problem, model.chosen.fit
    size, dynamics = best.structure.size, best.dynamics
    passed = replace(dynamics, numerator=best.gain * dynamics.numerator)
    every = parameter_covariance(problem, problem.sensitivity(best), best.residual, passed)
    transform = best.scaled.coefficient_jacobian(best.nonlinear)
    from_noise = _symmetric(transform @ every[:size, :size] @ transform.T)
    terms = [*(term(prepared, best, from_noise) for term in COVARIANCE_TERMS), *undetected]
    covariance = _symmetric(from_noise + np.sum([t.covariance for t in terms], axis=0))
    shown = _excited_up_to(problem, best, limits)
    band = response_band(dynamics, covariance, _frequencies(problem))
    return ResponseUncertainty(
        covariance=covariance,
        from_noise=from_noise,
        gain_variance=float(every[size, size]),
        excited_up_to=shown,
        valid_up_to=_trusted_up_to(model, band, limits, shown),
        findings=tuple(term.finding for term in terms),
    )


def inflate_to_free_choice(
    known: ResponseUncertainty,
    prepared: Prepared,
    model: ChosenModel,
    free: ChosenModel,
    limits: ResponseLimits,
) -> ResponseUncertainty:
    """Return what is known of an order that was asked for, no surer than the ``free`` choice.

    Too low an order has few parameters, so little noise in them, and a bias beyond what the
    motion excites, which no residual shows. The free choice says how much stays open.
    """
    mine, other = model.chosen.fit, free.chosen.fit
    if mine.structure == other.structure or mine.structure.contains(other.structure):
        return known
    lines = _frequencies(prepared.problem)
    trusted = lines[lines <= known.valid_up_to]
    free_covariance = response_uncertainty(prepared, free, limits).covariance
    factor = widening(
        response_band(mine.dynamics, known.covariance, trusted),
        response_band(other.dynamics, free_covariance, trusted),
        np.log(other.dynamics.response(trusted) / mine.dynamics.response(trusted)),
    )
    covariance = factor**2 * known.covariance
    band = response_band(mine.dynamics, covariance, lines)
    better = free.chosen.bic < model.chosen.bic - _EQUALLY_GOOD_BIC
    return replace(
        known,
        covariance=covariance,
        valid_up_to=_trusted_up_to(model, band, limits, known.excited_up_to),
        widened=factor,
        clearly_better=other.structure.poles if better else None,
    )


def _trusted_up_to(model: ChosenModel, band: Band, limits: ResponseLimits, shown: float) -> float:
    return min(trusted_up_to(band, limits, _disagreement(model, band)), shown)


def _excited_up_to(problem: Problem, best: Fit, limits: ResponseLimits) -> float:
    """Return the frequency [Hz] beyond which the data could not contradict the model ``best``."""
    length = len(problem.used)
    compared = np.flatnonzero(problem.used)
    taper = np.zeros(length)
    # From one end of what is compared to the other, so that no end breaks off.
    taper[compared[0] : compared[-1] + 1] = signal.windows.hann(compared[-1] + 1 - compared[0])
    answer = problem.modelled(best) - problem.background @ best.background
    compared_share = best.samples / (compared[-1] + 1 - compared[0])
    noise = noise_spectrum(best.residual, length) * float(taper @ taper) / compared_share
    return excited_up_to(
        np.asarray(fft.rfftfreq(length, problem.period)),
        np.asarray(fft.rfft(taper * (answer - np.mean(answer))), np.complex128),
        noise,
        limits,
    )


def _symmetric(matrix: FloatArray) -> FloatArray:
    return np.asarray(0.5 * (matrix + matrix.T))


def _frequencies(problem: Problem) -> FloatArray:
    nyquist = 0.5 / problem.period
    return np.asarray(np.geomspace(1e-4 * nyquist, nyquist, _FREQUENCIES))


def _disagreement(model: ChosenModel, band: Band) -> Band:
    """Return the largest difference from a candidate that describes the data about as well."""
    chosen = model.chosen.fit.dynamics.response(band.frequency)
    gain, phase = np.zeros(len(chosen)), np.zeros(len(chosen))
    best = min(c.bic for c in model.candidates)
    for other in model.candidates:
        if other.bic < best + _EQUALLY_GOOD_BIC:
            difference = np.log(other.fit.dynamics.response(band.frequency) / chosen)
            gain = np.maximum(gain, np.abs(difference.real))
            phase = np.maximum(phase, np.abs(difference.imag))
    return Band(band.frequency, gain, phase)


# What could hide in this very test, and how much would it cost on a scan?
#
# A term that is not significant may still be there, up to the size at which it would have been
# significant. The fitted coefficients then imitate a part of it, which shifts them. Its size is
# known
# as N(estimate, uncertainty²), so its mean square is estimate² + uncertainty²: the shift of that
# size is added to the covariance, unless the user declares a smaller prior.


def undetected_error_covariance(
    diagnostics: ResidualDiagnostics,
    settings: Mapping[str, object],
    limits: ResponseLimits,
    drift: Sequence[slice] = (),
) -> list[CovarianceTerm]:
    """Return the terms of the covariance, each with its entry for the certificate.

    limits: of the 95 % band, within which a response is trusted
    drift: columns of the background that model a drift
    settings: with "priors", an object of standard uncertainties by the name of a family, a
        term is taken no larger than its prior

    Raises ConfigurationError for a prior of another family, or that is no positive number.
    """
    priors = _priors(settings)
    terms = undetected_terms(diagnostics, drift)
    entries = [_entry(term, priors) for term in terms]
    covariance = [term.covariance(_carried(term, priors)) for term in terms]
    open_gain, slow = max(
        ((_carried(t, priors) * t.above, t.parameter) for t in terms if t.family == CREEP),
        default=(0.0, 0.0),
    )
    finding = dynamic_gain_finding(open_gain, slow, diagnostics.plateau, limits.gain)
    finding = replace(
        finding,
        entries={
            **finding.entries,
            "could_hide": entries,
            "hidden_mostly": _dominant_term_text(terms, priors),
            "plateau_s": diagnostics.plateau,
            "assumed": _assumptions(diagnostics),
        },
    )
    return [CovarianceTerm(c) for c in covariance] + [
        CovarianceTerm(np.zeros((_size(diagnostics.fitted),) * 2), finding)
    ]


def alternative_modes(
    without: Sequence[ResidualDiagnostics], terms: Sequence[ModelErrorTerm], fitted: Fit
) -> list[CovarianceTerm]:
    """Return the terms of what each light mode among ``terms`` may be instead.

    without: survey of the fit before each of ``terms`` became a part of ``fitted``
    """
    return [
        CovarianceTerm(alternative_mode_covariance(before, term, fitted))
        for before, term in zip(without, terms, strict=True)
        if term.family == MODE
    ]


def dynamic_gain_finding(
    size: float, time_constant: float, plateau: float, limit: float
) -> Finding:
    """Reject a test that leaves the gain of what moves too open against that at rest.

    size: standard uncertainty of it, relative, from a relaxation of ``time_constant`` [s]
    plateau: time from edge to edge [s];  limit: of the 95 % band, relative
    """
    entries = {"gain_above_rest_u": size, "plateau_that_would_tell_s": time_constant}
    if COVERAGE_FACTOR * size <= limit:
        return Finding(entries)
    open_gain, allowed = percent(COVERAGE_FACTOR * size), percent(limit)
    return Finding(
        entries,
        reasons=(
            f"drift or creep leaves the gain of what moves open by {open_gain} against that at "
            f"rest, at most {allowed} are allowed: " + _plateau_needed(time_constant, plateau),
        ),
    )


def _plateau_needed(time_constant: float, plateau: float) -> str:
    slow, rest = quantity(time_constant, "s", 2), quantity(plateau, "s", 2)
    if time_constant <= plateau:
        return (
            f"in this motion a relaxation of {slow} looks like static gain; move "
            f"in steps that rest {slow} or longer (omsm plan steps --dwell)"
        )
    return (
        f"a relaxation of {slow} does not show on plateaus of {rest}; let "
        f"the machine settle and rest {slow} on each plateau (omsm plan steps "
        "--dwell)"
    )


def _size(fitted: Fit) -> int:
    return len(fitted.dynamics.numerator) + len(fitted.dynamics.denominator)


def _priors(settings: Mapping[str, object]) -> dict[str, float]:
    stated = settings.get("priors", {})
    if not isinstance(stated, Mapping):
        raise ConfigurationError(f"settings: priors is {stated!r}, expected an object")
    for name, value in stated.items():
        if name not in UNDETECTED:
            raise ConfigurationError(
                f"settings: the prior of {shown(name)} is unknown, expected one of "
                f"{', '.join(map(repr, UNDETECTED))}"
            )
        if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
            raise ConfigurationError(
                f"settings: the prior of {name!r} is {value!r}, expected a positive number"
            )
    return {str(name): float(value) for name, value in stated.items()}


def _carried(term: UndetectedTerm, priors: Mapping[str, float]) -> float:
    return min(term.carried, priors.get(term.family, np.inf))


def _entry(term: UndetectedTerm, priors: Mapping[str, float]) -> dict[str, object]:
    carried = _carried(term, priors)
    return {
        "family": term.family,
        "parameter": term.parameter,
        "size": term.size,
        "uncertainty": term.uncertainty,
        "missed": number(term.missed),
        "carried": carried,
        "prior": priors.get(term.family),
        "effect_on_scan_m": term.effect * carried,
        "missed_effect_on_scan_m": number(term.effect * term.missed),
    }


def _dominant_term_text(terms: Sequence[UndetectedTerm], priors: Mapping[str, float]) -> str:
    """Return the words for what costs most of what could hide; empty where nothing could."""
    if not terms:
        return ""
    worst = max(terms, key=lambda term: term.effect * _carried(term, priors))
    return {
        CREEP: f"a slow relaxation (creep) of {worst.parameter:.3g} s",
        MODE: f"a light mode at {worst.parameter:.3g} Hz",
    }.get(worst.family, "a stiffness that grows with the deflection")


def _assumptions(diagnostics: ResidualDiagnostics) -> list[str]:
    slowest = with_slow_creep(diagnostics).longest_time_constant
    return [
        f"no relaxation slower than {quantity(slowest, 's')}",
        f"no mode below {quantity(1 / diagnostics.plateau, 'Hz', 2)}, the rate of the steps",
    ]
