"""Make the certificate of an identification from its evidence and findings.

The static gains are regressions on the plateaus. With a reference sensor on the same motion there
are three, and two of them show whether the scale of the probe or that of the encoder is wrong.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, replace

import numpy as np

from omsm_ros.core.calibration.certificate import (
    CandidateFit,
    Certificate,
    GainEstimate,
    Origin,
    PartsCompared,
    Residual,
    Response,
    StaticGain,
    Structure,
    TwoMassModel,
    Validity,
)
from omsm_ros.core.calibration.finding import Finding
from omsm_ros.core.calibration.latency import unresolved_latency
from omsm_ros.core.estimation.model_order import Candidate
from omsm_ros.core.estimation.steps import Edge, find_steps
from omsm_ros.core.identification.checks import limits_of
from omsm_ros.core.identification.covariance_terms import inter_sample_delay_bound
from omsm_ros.core.identification.evidence import IdentificationEvidence
from omsm_ros.core.identification.model_error_checks import model_errors_of
from omsm_ros.core.lti.frequency_response import low_frequency_delay_uncertainty
from omsm_ros.core.lti.modes import (
    FITTED,
    TwoMassFit,
    finite_values,
    fit_two_mass,
    modal_remainder,
    mode_entries,
    oscillations,
    response_features,
)
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.model_errors.residual_diagnostics import Contrast
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.streams.motion_record import MotionRecord
from omsm_ros.errors import StepTestError
from omsm_ros.linear_algebra import unit_columns

# Evenly over the band; a covariance of seven coefficients has no more directions than that.
_LINES = 40
# Root of the reduced χ², with one or two degrees of freedom: chance exceeds it three times in a
# thousand at most.
_GREATEST_MISFIT = 3.0
# Beyond this relative uncertainty of a mass its linear propagation does not hold.
_GREATEST_UNCERTAINTY = 0.5


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
        structure=_structure(evidence.model.chosen),
        candidates=tuple(
            CandidateFit(_structure(c), c.bic, c.fit.rms) for c in evidence.model.candidates
        ),
        residual=_residual(evidence),
        response=_response(evidence, table_mass),
        static_gain=_static_gain(evidence),
        model_errors=model_errors_of(evidence.searched, len(record) * record.sample_period),
        undetected=evidence.undetected,
        consistency=tuple(_parts(contrast) for contrast in evidence.contrasts),
        noise_covariance=tuple(known.from_noise.ravel().tolist()),
    ).judged(findings)


def _structure(candidate: Candidate) -> Structure:
    structure = candidate.fit.structure
    return Structure(structure.poles, structure.zeros, structure.delay)


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
        independence_p=evidence.searched.diagnostics.independence,
        response_agreement=evidence.response_difference,
        timing_scatter_s=tests.timing,
        axis_timing_scatter_s=tests.axis_timing,
        encoder_noise_m=None if noise is None else float(np.sqrt(np.mean(noise**2))),
        samples=dict(evidence.record.counts) | compared,
    )


def _response(evidence: IdentificationEvidence, table_mass: float | None) -> Response:
    dynamics, known, prepared = evidence.dynamics, evidence.known, evidence.prepared
    problem, reference = prepared.problem, evidence.reference
    return Response(
        low_frequency_delay_s=dynamics.low_frequency_delay,
        low_frequency_delay_uncertainty_s=low_frequency_delay_uncertainty(
            dynamics, known.covariance
        ),
        inter_sample_delay_bound_s=inter_sample_delay_bound(
            problem.input, prepared.steps, problem.period
        ),
        reference_lag_s=None if reference is None else reference.value,
        reference_lag_uncertainty_s=None if reference is None else reference.uncertainty,
        shape=finite_values(response_features(dynamics, 0.5 / problem.period)),
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


def _parts(contrast: Contrast) -> PartsCompared:
    def known(value: float) -> float | None:
        return float(value) if np.isfinite(value) else None

    return PartsCompared(
        parts=contrast.parts,
        gain_difference=known(contrast.gain),
        gain_difference_uncertainty=known(contrast.gain_uncertainty),
        lag_difference_s=known(contrast.lag),
        lag_difference_uncertainty_s=known(contrast.lag_uncertainty),
        p=contrast.p,
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
        if _plausible(fitted):
            return TwoMassModel(
                table_mass_kg=mass,
                model=asdict(fitted.model),
                relative_uncertainty=dict(zip(FITTED, fitted.uncertainty.tolist(), strict=True)),
                misfit=fitted.misfit,
                collocated=collocated,
            )
    return None


def _plausible(fitted: TwoMassFit) -> bool:
    known = bool(np.all(fitted.uncertainty < _GREATEST_UNCERTAINTY))
    return fitted.misfit < _GREATEST_MISFIT and known


# Rest after an edge that is not averaged, for the response to settle.
_SETTLE_S = 0.1
# GainEstimate, drift and offset are three unknowns.
_LEAST_PLATEAUS = 4


def static_gains(record: MotionRecord) -> StaticGain:
    """Return the travel of one per travel of the other, magnitudes.

    From the means of the plateaus, with offset and linear drift fitted. The uncertainty is that of
    the regression over plateaus, so it contains whatever makes them scatter: noise, backlash,
    slip. Raises StepTestError with fewer than four plateaus.
    """
    steps = find_steps(record.z, record.sample_period)
    rests = _stationary_segments(steps.edges, len(record), round(_SETTLE_S / record.sample_period))
    readings = np.where(record.ok, record.distance, np.nan)
    time = _means(np.arange(len(record), dtype=np.float64), rests)
    encoder, probe = _means(record.z, rests), _means(np.asarray(readings), rests)
    if record.reference is None:
        return StaticGain(probe_per_encoder=_ratio(encoder, probe, time))
    reference = _means(record.reference, rests)
    return StaticGain(
        probe_per_encoder=_ratio(encoder, probe, time),
        probe_per_reference=_ratio(reference, probe, time),
        reference_per_encoder=_ratio(encoder, reference, time),
    )


def _stationary_segments(
    edges: tuple[Edge, ...], samples: int, settle: int
) -> list[tuple[int, int]]:
    starts = [0, *(edge.stop + settle for edge in edges)]
    stops = [*(edge.start for edge in edges), samples]
    rests = [(a, b) for a, b in zip(starts, stops, strict=True) if b - a >= 5]
    if len(rests) < _LEAST_PLATEAUS:
        raise StepTestError("identification.few_plateaus", found=len(rests), least=_LEAST_PLATEAUS)
    return rests


def _means(values: FloatArray, rests: list[tuple[int, int]]) -> FloatArray:
    means = [
        float(np.mean(part[np.isfinite(part)])) if np.any(np.isfinite(part)) else np.nan
        for part in (values[a:b] for a, b in rests)
    ]
    return np.asarray(means)


def _ratio(travel: FloatArray, other: FloatArray, time: FloatArray) -> GainEstimate:
    known = np.isfinite(travel) & np.isfinite(other)
    if np.sum(known) < _LEAST_PLATEAUS:
        raise StepTestError(
            "identification.few_plateaus", found=int(np.sum(known)), least=_LEAST_PLATEAUS
        )
    x, t, y = travel[known], time[known], other[known]
    columns = np.column_stack([x - x.mean(), t / t[-1], np.ones(len(x))])
    unit, scale = unit_columns(columns)
    inverse = np.linalg.pinv(unit)
    solved = inverse @ y
    residual = y - unit @ solved
    variance = float(residual @ residual) / max(len(y) - 3, 1)
    uncertainty = np.sqrt(variance * (inverse[0] @ inverse[0])) / scale[0]
    return GainEstimate(float(abs(solved[0]) / scale[0]), float(uncertainty))
