"""How well is the response of a chosen model known, and up to which frequency is it trusted?

Terms beyond the noise of the probe are of sources of error that data cannot show.
Each adds to the covariance of the coefficients. To add one, write a function of the same signature
as :func:`inter_sample_motion` and append it to :data:`COVARIANCE_TERMS`.

Motion beyond half the sampling rate is aliased into the samples. Edges that are synchronous with
the samples are aliased alike every time: the fit then finds a lag that does not exist, with white
residuals. The content of the encoder near half the sampling rate bounds it.

A model error that is not significant may still be there, up to the size at which it would have been
significant. The fitted coefficients then imitate a part of it, which shifts them. Its size is known
as N(estimate, uncertainty²), so its mean square is estimate² + uncertainty²: the shift of that
size is added to the covariance, unless the user declares a smaller prior.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy import fft, linalg, signal

from omsm_ros.core.calibration.certificate import PartsCompared, Undetected, UndetectedEntry
from omsm_ros.core.calibration.intended_use import PAPER_USE, IntendedUse
from omsm_ros.core.estimation.covariance import noise_spectrum, parameter_covariance
from omsm_ros.core.estimation.model_structure import Fit
from omsm_ros.core.estimation.noise import VERY_STRONG
from omsm_ros.core.estimation.output_error import Problem
from omsm_ros.core.estimation.preparation import Prepared
from omsm_ros.core.estimation.steps import LEAST_SAMPLES, Edge, Steps
from omsm_ros.core.identification.model_choice import ChosenModel
from omsm_ros.core.identification.model_error_search import SearchResult
from omsm_ros.core.identification.residual_tests import (
    ResidualTests,
    residual_tests,
    response_difference,
)
from omsm_ros.core.lti.frequency_response import (
    GRID_POINTS,
    Band,
    ResponseLimits,
    excited_up_to,
    response_band,
    trusted_up_to,
    widening,
)
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.model_errors.families import CREEP
from omsm_ros.core.model_errors.residual_diagnostics import ResidualDiagnostics, differ
from omsm_ros.core.model_errors.undetected import (
    UNDETECTED,
    UndetectedTerm,
    undetected_terms,
    with_slow_creep,
)
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.streams.motion_record import MotionRecord
from omsm_ros.errors import ConfigurationError
from omsm_ros.linear_algebra import basis_and_inverse, unit_columns
from omsm_ros.quantities import shown

# Greatest |G| assumed beyond half the sampling rate.
_GREATEST_GAIN_BEYOND = 5.0
# Band of the spectrum of the encoder, in parts of the sampling rate, that is extrapolated.
_TOP_BAND = (0.35, 0.5)
# Samples of rest on either side of an edge, so that its spectrum has no leakage.
_MARGIN_SAMPLES = 20


def inter_sample_delay_bound(motion: FloatArray, steps: Steps, sample_period: float) -> float:
    """Return a bound on the bias of the low-frequency delay [s] by motion between samples.

    With U the spectrum of an edge of height A, its aliases at low frequencies are U at the
    sampling rate on both sides, so the lag shifts by up to ``2 |U(f_s)| (1 + |G|) / A``.
    U(f_s) is extrapolated from the content below f_s / 2 at the rate at which an edge with
    finite acceleration falls, 1/f³. A motion without edges is taken as one long edge.
    """
    increments = np.diff(motion)
    pieces = [
        increments[max(edge.start - _MARGIN_SAMPLES, 0) : edge.stop + _MARGIN_SAMPLES]
        for edge in steps.edges
    ] or [increments * np.hanning(len(increments))]
    energy = 0.0
    for piece in pieces:
        frequency = np.fft.rfftfreq(len(piece))
        band = (frequency >= _TOP_BAND[0]) & (frequency <= _TOP_BAND[1])
        doubled = np.abs(1 - np.exp(-2j * np.pi * frequency[band])) ** 2
        power = np.abs(np.fft.rfft(piece))[band] ** 2
        # Less what noise of the encoder gives.
        energy += float(np.mean(power - len(piece) * steps.noise**2 * doubled))
    height = sum(float(np.sum(np.abs(piece))) ** 2 for piece in pieces)
    if energy <= 0:
        return 0.0
    # |ΔU| = |1 - exp(-jωT)| |U| is nearly 2 |U| / T at the top.
    at_top = 0.5 * sample_period * np.sqrt(energy / height)
    at_rate = at_top * (0.5 * sum(_TOP_BAND)) ** 3
    return float(2 * at_rate * (1 + _GREATEST_GAIN_BEYOND))


@dataclass(frozen=True, slots=True)
class ReferenceLag:
    """Lag of the reference behind the encoder [s] and its standard uncertainty [s]."""

    value: float
    uncertainty: float


def reference_lag(record: MotionRecord) -> ReferenceLag | None:
    """Return the lag of the reference; None where too little of both was recorded.

    To first order of the lag, ``reference = gain · (z - lag · dz/dt) + offset + drift``.
    """
    if record.reference is None:
        return None
    known = np.isfinite(record.reference)
    if record.z_lost is not None:
        known &= ~record.z_lost
    if np.sum(known) < LEAST_SAMPLES:
        return None
    columns = np.column_stack(
        [
            record.z - np.mean(record.z),
            -np.gradient(record.z, record.sample_period),
            np.ones(len(record)),
            np.linspace(-1.0, 1.0, len(record)),
        ]
    )[known]
    unit, scale = unit_columns(columns)
    inverse = np.linalg.pinv(unit)
    found = inverse @ record.reference[known]
    residual = record.reference[known] - unit @ found
    spread = float(np.sqrt(residual @ residual / (len(residual) - 4) * (inverse[1] @ inverse[1])))
    gain = float(found[0] / scale[0])
    if gain == 0:
        return None
    return ReferenceLag(float(found[1] / scale[1]) / gain, abs(spread / scale[1] / gain))


def inter_sample_motion(prepared: Prepared, fit: Fit) -> FloatArray:
    """Return the covariance (p, p) of the coefficients by motion between the samples of an edge.

    Each corner of a motion, where its fourth difference is, aliases to an impulse in the output and
    to one in the input, which passes the response. They are at the same place of every edge, and as
    large as the bound on the lag, whose distribution is taken as uniform.
    """
    problem, samples = prepared.problem, len(prepared.problem.used)
    bound = inter_sample_delay_bound(problem.input, prepared.steps, problem.period)
    basis, inverse = basis_and_inverse(problem.sensitivity(fit), float(np.finfo(float).eps))
    transform = fit.scaled.coefficient_jacobian(fit.nonlinear)
    shifted = np.zeros((len(transform), samples))
    shifted[:, problem.used] = transform @ inverse[: fit.structure.size] @ basis.T
    response = fit.dynamics.response(fft.rfftfreq(samples, problem.period))
    through = fft.irfft(fft.rfft(shifted) * response.conj(), samples)
    whole = Edge(0, samples, float(np.sum(np.abs(np.diff(problem.input)))))
    edges = prepared.steps.edges or (whole,)
    length = max(edge.stop - edge.start for edge in edges)
    effects, weights = np.zeros((2, len(transform), length)), np.zeros(length)
    corners = np.pad(np.diff(problem.input, 4), 2) ** 2
    every = np.array([_GREATEST_GAIN_BEYOND * shifted, through])
    for edge in edges:
        part, count = slice(edge.start, edge.stop), edge.stop - edge.start
        effects[..., :count] += edge.height * every[..., part]
        weights[:count] += corners[part]
    # One corner has two fourth differences of like size, before and after it.
    size = fit.gain * bound / (1 + _GREATEST_GAIN_BEYOND) / problem.period
    weights *= size**2 / 3 / (0.5 * np.sum(weights) or 1.0)
    return np.asarray(np.sum(effects * weights @ np.swapaxes(effects, 1, 2), axis=0))


COVARIANCE_TERMS: tuple[Callable[[Prepared, Fit], FloatArray], ...] = (inter_sample_motion,)
"""Terms that add to the covariance (p, p) of every fit."""


def contrast_covariance(found: Sequence[PartsCompared], dynamics: TransferFunction) -> FloatArray:
    """Return the covariance (p, p) of parts of a test that differ; zero where none do.

    The whole difference counts as a standard uncertainty: a scan moves less than a step, so its
    response need not lie between those of the two parts.
    """
    gain = np.concatenate([dynamics.numerator, np.zeros(len(dynamics.denominator))])
    lag = np.zeros_like(gain)
    lag[-1] = 1.0
    rows = [
        row
        for c in found
        if differ(c)
        for row in ((c.gain_difference or 0.0) * gain, (c.lag_difference_s or 0.0) * lag)
    ]
    stacked = np.asarray(rows).reshape(-1, len(gain))
    return np.asarray(stacked.T @ stacked)


def undetected_covariance(
    diagnostics: ResidualDiagnostics,
    priors: Mapping[str, float],
    drift: Sequence[slice],
    use: IntendedUse,
) -> tuple[list[FloatArray], Undetected]:
    """Return covariances (p, p) of undetected terms, and the terms for the certificate.

    drift: columns of the background that model a drift
    priors: see :func:`priors_of`; a term is taken no larger than its prior
    """
    terms = undetected_terms(diagnostics, drift, use)
    gain, slowest = max(
        ((_carried(t, priors) * t.above, t.parameter) for t in terms if t.family == CREEP),
        default=(0.0, 0.0),
    )
    found = Undetected(
        terms=tuple(_entry(term, priors) for term in terms),
        gain_u=gain,
        plateau_s=diagnostics.plateau,
        plateau_needed_s=slowest,
        slowest_creep_s=with_slow_creep(diagnostics).longest_time_constant,
        lowest_mode_hz=1 / diagnostics.plateau,
    )
    return [term.covariance(_carried(term, priors)) for term in terms], found


def priors_of(settings: Mapping[str, object]) -> dict[str, float]:
    """Return the "priors" of ``settings``, standard uncertainties by the name of a family.

    Raises ConfigurationError for a prior of another family, or that is no positive number.
    """
    stated = settings.get("priors", {})
    if not isinstance(stated, Mapping):
        raise ConfigurationError("identification.priors", value=repr(stated))
    for name, value in stated.items():
        if name not in UNDETECTED:
            known = ", ".join(map(repr, UNDETECTED))
            raise ConfigurationError(
                "identification.unknown_prior", family=shown(name), known=known
            )
        if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
            raise ConfigurationError("identification.prior", family=name, value=repr(value))
    return {str(name): float(value) for name, value in stated.items()}


def _carried(term: UndetectedTerm, priors: Mapping[str, float]) -> float:
    return min(term.carried, priors.get(term.family, np.inf))


def _entry(term: UndetectedTerm, priors: Mapping[str, float]) -> UndetectedEntry:
    carried, missed = _carried(term, priors), term.effect * term.missed
    return UndetectedEntry(
        family=term.family,
        parameter=float(term.parameter),
        size=term.size,
        uncertainty=term.uncertainty,
        missed=term.missed if np.isfinite(term.missed) else None,
        carried=carried,
        prior=priors.get(term.family),
        effect_on_scan_m=term.effect * carried,
        missed_effect_on_scan_m=missed if np.isfinite(missed) else None,
    )


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
    return np.asarray(0.5 / problem.period * np.geomspace(1e-4, 1, GRID_POINTS))


@dataclass(frozen=True, eq=False)
class IdentificationEvidence:
    """The record, the problem fitted, the chosen model, and how well it is known.

    limits: of the 95 % band, within which the response is trusted
    searched: the model errors that were looked for;  undetected: those that may be left
    contrasts: differences between parts of the test
    reference: lag of the reference sensor, where it is the input
    use: the scans that the calibration is for
    """

    record: MotionRecord
    prepared: Prepared
    model: ChosenModel
    known: ResponseUncertainty
    limits: ResponseLimits
    searched: SearchResult
    undetected: Undetected = field(default_factory=Undetected)
    contrasts: Sequence[PartsCompared] = ()
    reference: ReferenceLag | None = None
    use: IntendedUse = PAPER_USE

    @property
    def fit(self) -> Fit:
        """The fit that is certified."""
        return self.model.chosen.fit

    @property
    def dynamics(self) -> TransferFunction:
        """G(s) with G(0) = 1."""
        return self.fit.dynamics

    @cached_property
    def inter_sample_delay(self) -> float:
        """Bound on the delay [s] by motion between samples."""
        problem = self.prepared.problem
        return inter_sample_delay_bound(problem.input, self.prepared.steps, problem.period)

    @cached_property
    def residual(self) -> ResidualTests:
        """Tests of the residual."""
        return residual_tests(self.prepared.problem, self.fit, self.prepared.steps)

    @cached_property
    def lag_in_residual(self) -> tuple[float, float]:
        """Lag that a search left in the residual where it was cut short, and its noise [s]."""
        problem, residual = self.prepared.problem, self.fit.residual
        rate = self.fit.gain * np.gradient(problem.motion, problem.period)[problem.used]
        power = float(rate @ rate)
        return -float(residual @ rate) / power, float(np.std(residual) / np.sqrt(power))

    @cached_property
    def response_difference(self) -> float | None:
        """Mean square difference from the response without a model, over its variance."""
        return response_difference(self.prepared.problem, self.fit, self.known.valid_up_to)
