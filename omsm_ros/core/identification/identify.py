"""Identify G_m from a motion of the axis and the readings of a probe on a fixed target.

On a fixed target ``distance = offset + drift · t - static_gain · (G_m u)(t)``; G_m(0) = 1.

| step | where |
|---|---|
| prepare the record for a fit | :mod:`omsm_ros.core.estimation.preparation` |
| choose and fit a model | :mod:`model_choice` |
| model what the residual shows besides | :mod:`model_error_search` |
| covariance from noise, and its further terms | :mod:`response_uncertainty` |
| checks | :mod:`checks` |
| certificate and verdict | :func:`certificate_of` |

The static gains are regressions on the plateaus. With a reference sensor on the same motion there
are three, and two of them show whether the scale of the probe or that of the encoder is wrong.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.calibration.certificate import (
    CandidateFit,
    Certificate,
    Finding,
    GainEstimate,
    Origin,
    Residual,
    Response,
    StaticGain,
    TwoMassModel,
    Validity,
)
from omsm_ros.core.calibration.intended_use import PAPER_USE, IntendedUse
from omsm_ros.core.calibration.latency import unresolved_latency
from omsm_ros.core.estimation.covariance import with_random_walk
from omsm_ros.core.estimation.model_structure import Fit
from omsm_ros.core.estimation.optimisation import EvaluationBudget
from omsm_ros.core.estimation.preparation import Prepared, check_gain, joined_recordings, prepare
from omsm_ros.core.estimation.steps import find_steps
from omsm_ros.core.identification.checks import CHECKS, limits_of, model_errors_of
from omsm_ros.core.identification.model_choice import ChosenModel, model_from_start
from omsm_ros.core.identification.model_error_search import SearchResult, search_model_errors
from omsm_ros.core.identification.response_uncertainty import (
    IdentificationEvidence,
    contrast_covariance,
    inflate_to_free_choice,
    priors_of,
    reference_lag,
    response_uncertainty,
    undetected_covariance,
)
from omsm_ros.core.lti.frequency_response import ResponseLimits, low_frequency_delay_uncertainty
from omsm_ros.core.lti.modes import (
    FITTED,
    fit_two_mass,
    modal_remainder,
    mode_entries,
    oscillations,
    response_features,
)
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.model_errors.families import DRIFT, MODE
from omsm_ros.core.model_errors.residual_diagnostics import contrasts
from omsm_ros.core.model_errors.undetected import alternative_mode_covariance
from omsm_ros.core.streams.blocks import FloatArray, IntArray
from omsm_ros.core.streams.motion_record import MotionRecord
from omsm_ros.errors import ConfigurationError, IdentificationError, StepTestError
from omsm_ros.linear_algebra import one_blas_thread, unit_columns
from omsm_ros.quantities import MASS

NO_ORIGIN = Origin()
Progress = Callable[..., object]
# Stages of an identification, as the action states them.
STEPS, ORDER, UNCERTAINTY = "steps", "order", "uncertainty"
# The setting without which masses, springs and dampers are known only per mass of the table.
TABLE_MASS_SETTING = "table_mass_kg"
# valid_up_to of a calibration that is trusted nowhere, below the frequency of any motion.
_UNTRUSTED_HZ = 1e-3
# Factor by which creep, drift or backlash may change the gain of the first model; beyond it the
# probe measures something else, and the search for model errors would take half a minute.
_GAIN_SLACK = 10.0
# Evenly over the band; a covariance of seven coefficients has no more directions than that.
_LINES = 40
# Root of the reduced χ², with one or two degrees of freedom: chance exceeds it three times in a
# thousand at most.
_GREATEST_MISFIT = 3.0
# Beyond this relative uncertainty of a mass its linear propagation does not hold.
_GREATEST_UNCERTAINTY = 0.5


@dataclass(frozen=True, eq=False)
class Identification:
    """A calibration, and the fit that it certifies.

    prepared: the problem that was fitted: input, output, which samples are compared
    fit: of ``prepared.problem``; its residual is the one that the certificate speaks of
    """

    calibration: Calibration
    prepared: Prepared
    fit: Fit


@contextmanager
def _solvable() -> Iterator[None]:
    try:
        yield
    except np.linalg.LinAlgError as err:
        raise IdentificationError("identification.singular", why=str(err)) from err


@one_blas_thread()
@_solvable()
def identify(
    record: MotionRecord,
    *,
    order: int = 0,
    input: str = "encoder",
    settings: Mapping[str, object] | None = None,
    use: IntendedUse = PAPER_USE,
    origin: Origin = NO_ORIGIN,
    budget: EvaluationBudget | None = None,
    progress: Progress = lambda stage, **numbers: None,
) -> Identification:
    """Return the calibration that ``record`` supports, with the fit behind it.

    order: number of poles, 0 to choose it. Uncertainties of an order that is asked for are
        never smaller than those of the free choice.
    input: "encoder", or "reference" to take the second sensor as the motion
    settings: what the calibration holds for, kept as it is; with "table_mass_kg" the masses
        and springs of a response that is that of two masses are in SI, else per table mass
    use: the scans that will be corrected, and the accuracy asked for; limits follow from it
    origin: who recorded it with what and when, for the certificate
    budget: of the model search; None for the default. A search that it cuts short is reported.
    progress: called with "steps", "order" and "uncertainty"; what it raises ends the computation

    Raises StepTestError when there is no usable motion, IdentificationError when the probe
    did not measure it, ConfigurationError for an impossible input or mass. A model that cannot be
    trusted is returned with the verdict "rejected" in its certificate.
    """
    mass, priors = table_mass(settings or {}), priors_of(settings or {})
    record = joined_recordings([record])
    prepared = prepare(record, input)
    progress(STEPS, steps=len(prepared.steps.edges))
    budget = budget or EvaluationBudget()
    budget.watch = lambda poles, done: progress(ORDER, order=poles, evaluations=done)
    choose = partial(_chosen, order=order)
    searched = search_model_errors(prepared, choose, budget, may_grow=not order)
    progress(UNCERTAINTY)
    best = searched.model.chosen.fit
    check_gain(best.gain)
    evidence = _evidence(record, searched, input, priors, use)
    findings = [finding for check in CHECKS for finding in check(evidence)]
    calibration = Calibration(
        dynamics=best.dynamics,
        static_gain=abs(best.gain),
        sample_period=record.sample_period,
        valid_up_to=max(evidence.known.valid_up_to, _UNTRUSTED_HZ),
        covariance=evidence.known.covariance,
        settings=dict(settings or {}),
        certificate=certificate_of(evidence, findings, replace(origin, input=input), mass),
        **_further(record, evidence),
    )
    # A new problem has none of the spectra that fits keep, and can be sent to another process.
    prepared = replace(searched.prepared, problem=replace(searched.prepared.problem))
    return Identification(calibration, prepared, best)


def _further(record: MotionRecord, evidence: IdentificationEvidence) -> dict[str, Any]:
    """Return the numerators of the further axes of ``record``, relative to the static gain."""
    if not record.further:
        return {}
    best = evidence.fit
    places = evidence.prepared.problem.further_numerators(best)
    unit = best.gain * best.scaled.rate ** np.arange(best.structure.poles + 1.0)
    numerators = (np.asarray(best.driven[place] / unit) for place in places)
    return {
        "further": dict(zip(record.further, numerators, strict=True)),
        "joint": evidence.known.joint,
    }


def _evidence(
    record: MotionRecord,
    searched: SearchResult,
    input: str,
    priors: Mapping[str, float],
    use: IntendedUse,
) -> IdentificationEvidence:
    """Return what the checks use: the uncertainty of the response, and what it consists of."""
    prepared, model, limits = searched.prepared, searched.model, ResponseLimits()
    drift = [added.columns for added in searched.nuisance_terms if added.term.family == DRIFT]
    best, diagnostics = model.chosen.fit, searched.diagnostics
    further, undetected = undetected_covariance(diagnostics, priors, drift, use)
    further += [
        alternative_mode_covariance(before, term, best)
        for before, term in zip(searched.without, searched.added_poles, strict=True)
        if term.family == MODE
    ]
    compared = contrasts(diagnostics)
    further.append(contrast_covariance(compared, best.dynamics))
    reference = reference_lag(record) if input == "reference" else None
    if reference is not None:
        # A correction filters the encoder, so the lag of the reference would be missing from it.
        further[-1][-1, -1] += reference.value**2 + reference.uncertainty**2
    known = response_uncertainty(prepared, model, limits, further)
    if model.free is not None:
        known = inflate_to_free_choice(known, prepared, model, model.free, limits)
    return IdentificationEvidence(
        record, prepared, model, known, limits, searched, undetected, compared, reference, use
    )


def table_mass(settings: Mapping[str, object]) -> float | None:
    """Return the moving mass of the table [kg] among the settings, or None if it is not there.

    Raises ConfigurationError unless it is the mass of a table.
    """
    value = settings.get(TABLE_MASS_SETTING)
    if value is None:
        return None
    return float(MASS.checked(value, ConfigurationError, f"setting {TABLE_MASS_SETTING!r}"))


def _chosen(
    prepared: Prepared, budget: EvaluationBudget, **choice: Any
) -> tuple[Prepared, ChosenModel]:
    prepared, model = model_from_start(prepared, budget, **choice)
    check_gain(model.chosen.fit.gain, slack=_GAIN_SLACK)
    return prepared, model


def certificate_of(
    evidence: IdentificationEvidence,
    findings: Iterable[Finding],
    origin: Origin,
    table_mass: float | None,
) -> Certificate:
    """Return the certificate with the verdict that ``findings`` support.

    table_mass: moving mass of the table [kg], None if it is not known
    """
    record, known = evidence.record, evidence.known
    return Certificate(
        limits=limits_of(evidence),
        origin=origin,
        validity=Validity(
            from_hz=1 / (2 * np.pi * evidence.searched.diagnostics.longest_time_constant),
            excited_up_to_hz=known.excited_up_to,
            gain=evidence.limits.gain,
            phase_rad=evidence.limits.phase,
            use=evidence.use,
        ),
        latency=unresolved_latency(evidence.dynamics.low_frequency_delay),
        structure=evidence.model.chosen.fit.structure,
        candidates=tuple(
            CandidateFit(c.fit.structure, c.bic, c.fit.rms) for c in evidence.model.candidates
        ),
        residual=_residual(evidence),
        response=_response(evidence, table_mass),
        static_gain=_static_gain(evidence),
        model_errors=model_errors_of(evidence.searched, len(record) * record.sample_period),
        undetected=evidence.undetected,
        consistency=tuple(evidence.contrasts),
        noise_covariance=tuple(known.from_noise.ravel().tolist()),
    ).judged(findings)


def _residual(evidence: IdentificationEvidence) -> Residual:
    prepared, tests, problem = evidence.prepared, evidence.residual, evidence.prepared.problem
    compared = {"spikes": prepared.spikes, "compared": evidence.fit.samples}
    compared |= {"axis_spikes": prepared.axis_spikes} if prepared.axis_spikes else {}
    noise = problem.errors_in_variables
    return Residual(
        rms_m=evidence.fit.rms,
        noise_m=tests.noise,
        chi_square=tests.chi_square,
        edges=len(prepared.steps.edges),
        whiteness_p=tests.whiteness,
        independence_p=evidence.searched.p_value,
        response_agreement=evidence.response_difference,
        timing_scatter_s=tests.timing,
        axis_timing_scatter_s=tests.axis_timing,
        encoder_noise_m=None if noise is None else float(np.sqrt(np.mean(noise**2))),
        samples=dict(evidence.record.counts) | compared,
    )


def _response(evidence: IdentificationEvidence, table_mass: float | None) -> Response:
    dynamics, known, reference = evidence.dynamics, evidence.known, evidence.reference
    return Response(
        low_frequency_delay_s=dynamics.low_frequency_delay,
        low_frequency_delay_uncertainty_s=low_frequency_delay_uncertainty(
            dynamics, known.covariance
        ),
        inter_sample_delay_bound_s=evidence.inter_sample_delay,
        reference_lag_s=None if reference is None else reference.value,
        reference_lag_uncertainty_s=None if reference is None else reference.uncertainty,
        shape=response_features(dynamics, 0.5 / evidence.record.sample_period),
        modes=tuple(mode_entries(dynamics, known.covariance)),
        modal_remainder=modal_remainder(dynamics, known.valid_up_to),
        two_mass=two_mass_model(dynamics, known.covariance, known.valid_up_to, table_mass),
    )


def _static_gain(evidence: IdentificationEvidence) -> StaticGain:
    try:
        found = static_gains(evidence.record)
    except StepTestError:
        found = StaticGain()
    return replace(
        found,
        uncertainty=float(np.sqrt(evidence.known.gain_variance)),
        polarity=-int(np.sign(evidence.fit.gain)),
    )


def two_mass_model(
    dynamics: TransferFunction, covariance: FloatArray, up_to: float, mass: float | None
) -> TwoMassModel | None:
    """Return the two-mass model that agrees with ``dynamics`` to ``up_to`` [Hz]; None without one.

    mass: of the table [kg]; None when it is not known: then m1 is 1, and the others are per
        mass of the table

    Eq. 7 is tried first (the probe on the second mass), then the driven mass itself.
    """
    if not up_to > 0 or len(oscillations(dynamics)) < 2:
        return None
    lines = np.linspace(up_to / _LINES, up_to, _LINES)
    for collocated in (False, True):
        fitted = fit_two_mass(
            dynamics,
            covariance,
            table_mass=1.0 if mass is None else mass,
            collocated=collocated,
            frequencies=lines,
        )
        if np.all(fitted.uncertainty < _GREATEST_UNCERTAINTY) and fitted.misfit < _GREATEST_MISFIT:
            return TwoMassModel(
                table_mass_kg=mass,
                model=asdict(fitted.model),
                relative_uncertainty=dict(zip(FITTED, fitted.uncertainty.tolist(), strict=True)),
                misfit=fitted.misfit,
                collocated=collocated,
            )
    return None


# Rest after an edge that is not averaged, for the response to settle.
_SETTLE_S = 0.1
# Variance of a random walk over the record that is tried, over that of a plateau's mean.
_WALK_SHARES = (0.0, *np.geomspace(1e-2, 1e4, 25))
# GainEstimate, drift and offset are three unknowns.
_LEAST_PLATEAUS = 4


def static_gains(record: MotionRecord) -> StaticGain:
    """Return the travel of one per travel of the other, magnitudes.

    From the means of the plateaus, with offset, linear drift and the further axes fitted, in white
    noise and a random walk of the most likely size. The uncertainty is that of the regression over
    plateaus, so it contains whatever makes them scatter: noise, drift, backlash, slip.

    Raises StepTestError with fewer than four plateaus.
    """
    steps = find_steps(record.z, record.sample_period)
    begun = [0, *(edge.stop + round(_SETTLE_S / record.sample_period) for edge in steps.edges)]
    ended = [*(edge.start for edge in steps.edges), len(record)]
    whole = [(a, b) for a, b in zip(begun, ended, strict=True) if b - a >= 5]
    if len(whole) < _LEAST_PLATEAUS:
        raise StepTestError("identification.few_plateaus", found=len(whole), least=_LEAST_PLATEAUS)
    rests = [
        piece
        for a, b in whole
        for piece in pairwise([a, *(start for start in record.starts if a < start < b), b])
    ]
    readings = np.where(record.ok, record.distance, np.nan)
    time = _means(np.arange(len(record), dtype=np.float64), rests)
    part = np.searchsorted(record.starts, [start for start, _ in rests], side="right")
    encoder, probe = _means(record.z, rests), _means(np.asarray(readings), rests)
    further = [_means(motion, rests) for motion in record.further.values()]
    ratio = partial(_ratio, further=further, time=time, part=part)
    found = StaticGain(probe_per_encoder=ratio(encoder, probe))
    if record.reference is None:
        return found
    reference = _means(record.reference, rests)
    found = replace(found, probe_per_reference=ratio(reference, probe))
    return replace(found, reference_per_encoder=ratio(encoder, reference))


def _means(values: FloatArray, rests: list[tuple[int, int]]) -> FloatArray:
    means = [
        float(np.mean(part[np.isfinite(part)])) if np.any(np.isfinite(part)) else np.nan
        for part in (values[a:b] for a, b in rests)
    ]
    return np.asarray(means)


def _ratio(
    travel: FloatArray,
    other: FloatArray,
    further: Sequence[FloatArray],
    time: FloatArray,
    part: IntArray,
) -> GainEstimate:
    """Return ``other`` per ``travel``, means of the plateaus (k,), with ``further`` axes fitted.

    part: number of the recording of each plateau, with its own offset and drift
    """
    known = np.isfinite(travel) & np.isfinite(other)
    if np.sum(known) < _LEAST_PLATEAUS:
        raise StepTestError(
            "identification.few_plateaus", found=int(np.sum(known)), least=_LEAST_PLATEAUS
        )
    t, y = time[known], other[known]
    own = [part[known] == number for number in np.unique(part[known])]
    each = [column for one in own for column in (one, one * t / t[-1])]
    moved = [motion[known] - motion[known].mean() for motion in (travel, *further)]
    columns = np.column_stack([*moved, *each]).astype(np.float64)
    unit, scale = unit_columns(columns)
    first = np.diff(part[known], prepend=-1) != 0
    walked = np.where(first, t, np.diff(t, prepend=0.0)) / t[-1]
    tried = [with_random_walk(unit, y, first, share * walked) for share in _WALK_SHARES]
    _, solved, uncertainty = max(tried)
    return GainEstimate(abs(solved) / float(scale[0]), uncertainty / float(scale[0]))
