"""How well is the response of a chosen model known, and up to which frequency is it trusted?"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import fft, linalg, signal

from omsm_ros.core.estimation.covariance import noise_spectrum, parameter_covariance
from omsm_ros.core.estimation.model_structure import Fit
from omsm_ros.core.estimation.noise import VERY_STRONG
from omsm_ros.core.estimation.output_error import Problem
from omsm_ros.core.estimation.preparation import Prepared
from omsm_ros.core.identification.covariance_terms import COVARIANCE_TERMS
from omsm_ros.core.identification.model_choice import ChosenModel
from omsm_ros.core.lti.frequency_response import (
    GRID_POINTS,
    Band,
    ResponseLimits,
    excited_up_to,
    response_band,
    trusted_up_to,
    widening,
)
from omsm_ros.core.streams.blocks import FloatArray


@dataclass(frozen=True, eq=False)
class ResponseUncertainty:
    """How well the chosen model is known.

    covariance: (p, p) of the coefficients, all terms included;  from_noise: (p, p) without them
    gain_variance: of the static gain [1]
    joint: (P, P) from noise, of the coefficients and of the numerators of all further axes
    excited_up_to: [Hz] beyond which the motion would show no error of the response
    valid_up_to: [Hz] up to which the response is trusted; 0 if nowhere
    widened: factor on the uncertainties;  clearly_better: number of poles, see
        inflate_to_free_choice
    """

    covariance: FloatArray
    from_noise: FloatArray
    gain_variance: float
    excited_up_to: float
    valid_up_to: float
    joint: FloatArray
    widened: float = 1.0
    clearly_better: int | None = None


def response_uncertainty(
    prepared: Prepared,
    model: ChosenModel,
    limits: ResponseLimits,
    further: Sequence[FloatArray] = (),
) -> ResponseUncertainty:
    """Return how well the chosen fit of ``model`` is known: noise, then each further term.

    further: covariances (p, p) of what the residual of this fit cannot show
    """
    problem, best = prepared.problem, model.chosen.fit
    size, dynamics = best.structure.size, best.dynamics
    passed = replace(dynamics, numerator=best.gain * dynamics.numerator)
    every = parameter_covariance(
        problem, problem.sensitivity(best), best.residual, passed, walks=True
    )
    transform = best.scaled.coefficient_jacobian(best.nonlinear)
    from_noise = _symmetric(transform @ every[:size, :size] @ transform.T)
    terms = [*(term(prepared, best) for term in COVARIANCE_TERMS), *further]
    covariance = _symmetric(from_noise + np.sum(terms, axis=0))
    shown = _excited_up_to(problem, best, limits)
    band = response_band(dynamics, covariance, _frequencies(problem))
    return ResponseUncertainty(
        covariance=covariance,
        from_noise=from_noise,
        gain_variance=float(every[size, size]),
        excited_up_to=shown,
        valid_up_to=_trusted_up_to(model, band, limits, shown),
        joint=_joint_covariance(problem, best, transform, every),
    )


def _joint_covariance(
    problem: Problem, best: Fit, transform: FloatArray, every: FloatArray
) -> FloatArray:
    """Return the covariance (P, P) of the coefficients and of the numerators of further axes.

    every: of the parameters of ``problem.sensitivity``;  transform: of the first of them
    A numerator is relative to the static gain, as that of Z is.
    """
    size, places = best.structure.size, problem.further_numerators(best)
    powers = np.tile(np.arange(best.structure.poles + 1.0), len(places))
    unit = 1 / (best.gain * best.scaled.rate**powers)
    driven = best.driven[len(best.numerator) :][: len(powers)]
    by_further = np.column_stack([-driven / best.gain * unit, np.diag(unit)])
    jacobian = linalg.block_diag(transform, by_further)
    last = size + 1 + len(powers)
    return _symmetric(jacobian @ every[:last, :last] @ jacobian.T)


def inflate_to_free_choice(
    known: ResponseUncertainty,
    prepared: Prepared,
    model: ChosenModel,
    free: ChosenModel,
    limits: ResponseLimits,
) -> ResponseUncertainty:
    """Return ``known`` of a requested order, inflated to the uncertainty of the ``free`` choice.

    An order that is too low has few parameters with little noise, and a bias beyond the excited
    frequencies that no residual shows. The free choice shows how large this can be.
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
    better = free.chosen.bic < model.chosen.bic - 2 * VERY_STRONG
    return replace(
        known,
        covariance=covariance,
        joint=factor**2 * known.joint,
        valid_up_to=_trusted_up_to(model, band, limits, known.excited_up_to),
        widened=factor,
        clearly_better=other.structure.poles if better else None,
    )


def _trusted_up_to(model: ChosenModel, band: Band, limits: ResponseLimits, shown: float) -> float:
    chosen = model.chosen.fit.dynamics.response(band.frequency)
    gain, phase = np.zeros(len(chosen)), np.zeros(len(chosen))
    best = min(c.bic for c in model.candidates)
    for other in model.candidates:
        # BIC is twice the log odds.
        if other.bic < best + 2 * VERY_STRONG:
            difference = np.log(other.fit.dynamics.response(band.frequency) / chosen)
            gain = np.maximum(gain, np.abs(difference.real))
            phase = np.maximum(phase, np.abs(difference.imag))
    return min(trusted_up_to(band, limits, Band(band.frequency, gain, phase)), shown)


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
    return np.asarray(np.geomspace(1e-4 * nyquist, nyquist, GRID_POINTS))
