"""Identify G_m from a motion of the axis and what the probe saw of a fixed target.

On a fixed target ``distance = offset + drift · t - static_gain · (G_m u)(t)``; G_m(0) = 1.

| step | where |
|---|---|
| the record becomes a problem to fit | :mod:`omsm_ros.core.estimation.preparation` |
| a model is chosen and fitted | :mod:`model_choice` |
| what the residual shows besides is modelled | :mod:`departure_search` |
| its covariance from noise | :mod:`response_uncertainty` |
| further terms of it | :mod:`covariance_terms`, :mod:`undetected_terms`, :mod:`consistency` |
| checks | :mod:`checks` |
| certificate and verdict | :mod:`certificate` |
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial, wraps
from itertools import chain
from typing import ParamSpec

import numpy as np

from omsm_ros.core.calibration.calibration import (
    ACCEPTED,
    ENTRY,
    RECORDED,
    REJECTED,
    RESERVED,
    Calibration,
    unresolved_latency,
)
from omsm_ros.core.calibration.finding import Finding
from omsm_ros.core.estimation.model_order import Candidate
from omsm_ros.core.estimation.optimisation import EvaluationBudget
from omsm_ros.core.estimation.output_error import Fit
from omsm_ros.core.estimation.preparation import Prepared, check_axis_steps, check_gain, prepare
from omsm_ros.core.estimation.steps import Edge, find_steps
from omsm_ros.core.identification.checks import CHECKS, RANGE_CHECKS
from omsm_ros.core.identification.covariance_terms import consistency, reference_delay
from omsm_ros.core.identification.evidence import IdentificationEvidence
from omsm_ros.core.identification.model_choice import ChosenModel, model_from_start
from omsm_ros.core.identification.model_error_search import completeness, search_model_errors
from omsm_ros.core.identification.response_uncertainty import (
    alternative_modes,
    inflate_to_free_choice,
    response_uncertainty,
    undetected_error_covariance,
)
from omsm_ros.core.lti.frequency_response import ResponseLimits, low_frequency_delay_uncertainty
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
from omsm_ros.core.model_errors.families import DRIFT
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.streams.motion_record import MotionRecord
from omsm_ros.errors import ConfigurationError, IdentificationError, StepTestError
from omsm_ros.linear_algebra import one_blas_thread, unit_columns
from omsm_ros.quantities import MASS
from omsm_ros.readable import quantity

# Is the identified response that of two masses? The entry ``two_mass`` of a certificate.

# The setting without which masses, springs and dampers are known only per mass of the table.
TABLE_MASS_SETTING = "table_mass_kg"
# Evenly over the band; a covariance of seven coefficients has no more directions than that.
_LINES = 40
# Root of χ² per degree of freedom, of which there are one or two: beyond this, which chance
# exceeds three times in a thousand at most, it is another machine.
_GREATEST_MISFIT = 3.0
# A mass known worse than this, relative, is not known; its stated uncertainty is linearised.
_GREATEST_UNCERTAINTY = 0.5


def table_mass(settings: Mapping[str, object]) -> float | None:
    """Return the moving mass of the table [kg] among the settings, or None if it is not there.

    Raises ConfigurationError unless it is the mass of a table.
    """
    value = settings.get(TABLE_MASS_SETTING)
    if value is None:
        return None
    return float(MASS.checked(value, ConfigurationError, f"setting {TABLE_MASS_SETTING!r}"))


def two_mass_entry(
    dynamics: TransferFunction, covariance: FloatArray, up_to: float, mass: float | None
) -> dict[str, object] | None:
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
        if _believable(fitted):
            return {
                TABLE_MASS_SETTING: mass,
                "model": asdict(fitted.model),
                "relative_uncertainty": dict(zip(FITTED, fitted.uncertainty.tolist(), strict=True)),
                "misfit": fitted.misfit,
                "collocated": collocated,
            }
    return None


def _believable(fitted: TwoMassFit) -> bool:
    known = bool(np.all(fitted.uncertainty < _GREATEST_UNCERTAINTY))
    return fitted.misfit < _GREATEST_MISFIT and known


# The static gain, attributed: is it the probe's scale, or the encoder's?
#
# Plain regressions on the plateaus; with a reference sensor on the same motion, three gains
# of which two say who is wrong.

# Rest after an edge that is not averaged, for the response to settle.
_SETTLE_S = 0.1
# Gain, drift and offset are three unknowns.
_LEAST_PLATEAUS = 4


@dataclass(frozen=True, slots=True)
class GainEstimate:
    """A ratio of travels [1] and its standard uncertainty."""

    value: float
    uncertainty: float


@dataclass(frozen=True, slots=True)
class StaticGains:
    """Travel of one per travel of the other, magnitudes; None without a reference sensor."""

    probe_per_encoder: GainEstimate
    probe_per_reference: GainEstimate | None
    reference_per_encoder: GainEstimate | None


def static_gains(record: MotionRecord) -> StaticGains:
    """Return the gains from the means of the plateaus, offset and linear drift allowed for.

    The uncertainty is that of the regression over plateaus, so it holds for whatever makes
    them scatter: noise, backlash, slip. Raises StepTestError with fewer than four plateaus.
    """
    steps = find_steps(record.z, record.sample_period)
    rests = _stationary_segments(steps.edges, len(record), round(_SETTLE_S / record.sample_period))
    readings = np.where(record.ok, record.distance, np.nan)
    time = _means(np.arange(len(record), dtype=np.float64), rests)
    encoder, probe = _means(record.z, rests), _means(np.asarray(readings), rests)
    if record.reference is None:
        return StaticGains(_ratio(encoder, probe, time), None, None)
    reference = _means(record.reference, rests)
    return StaticGains(
        _ratio(encoder, probe, time),
        _ratio(reference, probe, time),
        _ratio(encoder, reference, time),
    )


def _stationary_segments(
    edges: tuple[Edge, ...], samples: int, settle: int
) -> list[tuple[int, int]]:
    starts = [0, *(edge.stop + settle for edge in edges)]
    stops = [*(edge.start for edge in edges), samples]
    rests = [(a, b) for a, b in zip(starts, stops, strict=True) if b - a >= 5]
    if len(rests) < _LEAST_PLATEAUS:
        raise StepTestError(
            f"{len(rests)!r} plateaus of rest, at least {_LEAST_PLATEAUS} are needed for a gain; "
            "make more steps or rest longer"
        )
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
            f"{int(np.sum(known))!r} plateaus with readings, at least {_LEAST_PLATEAUS} are needed"
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


# The certificate of a calibration: how it was obtained, and whether to trust it.


def certificate_of(
    evidence: IdentificationEvidence, findings: Sequence[Finding], table_mass: float | None
) -> dict[str, object]:
    """Return a dict of JSON values, ending with ``reasons``, ``warnings`` and ``verdict``.

    table_mass: moving mass of the table [kg], None if it is not known
    """
    known, valid_from = (
        evidence.known,
        1 / (2 * np.pi * evidence.searched.diagnostics.longest_time_constant),
    )
    limits = dict(chain.from_iterable(finding.limits.items() for finding in findings))
    entries = dict(chain.from_iterable(finding.entries.items() for finding in findings))
    reasons = list(chain.from_iterable(finding.reasons for finding in findings))
    warnings = list(chain.from_iterable(finding.warnings for finding in findings))
    reservations = list(chain.from_iterable(finding.reservations for finding in findings))
    return {
        **_order_entries(evidence.model),
        **_residual_entries(evidence),
        **_response_entries(evidence),
        **_gain_entries(evidence),
        "two_mass": two_mass_entry(
            evidence.dynamics, evidence.known.covariance, evidence.known.valid_up_to, table_mass
        ),
        **entries,
        "valid_from": valid_from,
        "limits": limits,
        "warnings": warnings,
        "reasons": reasons,
        "reservations": reservations,
        "verdict": verdict(reasons, reservations, valid_from, known.valid_up_to),
    }


def verdict(
    reasons: Sequence[str], reservations: Sequence[str], valid_from: float, valid_up_to: float
) -> str:
    """Return "rejected", or "accepted" and the band [Hz] that the data support.

    reservations: what was found in the data and is held by a wider band
    """
    if reasons:
        return REJECTED
    kept = RESERVED if reservations else ACCEPTED
    low, high = quantity(valid_from, "Hz", 2), quantity(valid_up_to, "Hz")
    return f"{kept}, supported by data from {low} to {high}"


def _order_entries(model: ChosenModel) -> dict[str, object]:
    return {
        "order": model.chosen.fit.structure.poles,
        "structure": _structure(model.chosen),
        "candidates": [
            _structure(c) | {"bic": c.bic, "rms_m": c.fit.rms} for c in model.candidates
        ],
    }


def _structure(candidate: Candidate) -> dict[str, object]:
    structure = candidate.fit.structure
    return {"poles": structure.poles, "zeros": structure.zeros, "delay": structure.delay}


def _residual_entries(evidence: IdentificationEvidence) -> dict[str, object]:
    prepared, tests = evidence.prepared, evidence.residual
    compared = {"spikes": prepared.spikes, "compared": evidence.fit.samples}
    compared |= {"axis_spikes": prepared.axis_spikes} if prepared.axis_spikes else {}
    return {
        "noise_covariance": evidence.known.from_noise.ravel().tolist(),
        "residual_rms_m": evidence.fit.rms,
        "edges": len(prepared.steps.edges),
        "whiteness_p": tests.whiteness,
        "samples": dict(evidence.record.counts) | compared,
    }


def _response_entries(evidence: IdentificationEvidence) -> dict[str, object]:
    dynamics, known = evidence.dynamics, evidence.known
    return {
        ENTRY: unresolved_latency(dynamics.low_frequency_delay).entry(),
        "low_frequency_delay_s": dynamics.low_frequency_delay,
        "low_frequency_delay_uncertainty_s": low_frequency_delay_uncertainty(
            dynamics, known.covariance
        ),
        "shown_up_to_hz": known.excited_up_to,
        "shape": finite_values(response_features(dynamics, 0.5 / evidence.prepared.problem.period)),
        "modes": mode_entries(dynamics, known.covariance),
        "modal_remainder": modal_remainder(dynamics, known.valid_up_to),
    }


def _gain_entries(evidence: IdentificationEvidence) -> dict[str, object]:
    """Return what the fit finds beside the response: gain and drift."""
    best = evidence.fit
    duration = len(evidence.record) * evidence.record.sample_period
    return {
        "static_gain": abs(best.gain),
        "static_gain_uncertainty": float(np.sqrt(evidence.known.gain_variance)),
        "static_gains": _attributed(evidence.record),
        "polarity": -int(np.sign(best.gain)),
        "drift_m_s": 2 * float(best.background[1]) / duration,
    }


def _attributed(record: MotionRecord) -> dict[str, object] | None:
    """Return gains between probe, encoder and reference; None where there are too few plateaus."""
    try:
        return asdict(static_gains(record))
    except StepTestError:
        return None


DEFAULT_LIMITS = ResponseLimits()
Parameters = ParamSpec("Parameters")
# A calibration that is trusted nowhere says so by a frequency below anything that moves.
_UNTRUSTED_HZ = 1e-3
# What creep, drift or play beside the first model may still change of its gain; beyond it the probe
# saw something else, and to look for departures in that takes half a minute.
_SAME_SIGNAL_CORRELATION = 10.0


@dataclass(frozen=True, eq=False)
class Identification:
    """A calibration, and the fit that it certifies.

    prepared: the problem that was fitted: input, output, which samples are compared
    fit: of ``prepared.problem``; its residual is the one that the certificate speaks of
    """

    calibration: Calibration
    prepared: Prepared
    fit: Fit


def _solvable(
    compute: Callable[Parameters, Identification],
) -> Callable[Parameters, Identification]:
    """Let no error of the linear algebra reach a user as such."""

    @wraps(compute)
    def computed(*args: Parameters.args, **options: Parameters.kwargs) -> Identification:
        try:
            return compute(*args, **options)
        except np.linalg.LinAlgError as err:
            raise IdentificationError(
                f"the recording cannot be fitted ({err}): its numbers are extreme or repeat each "
                "other; check the units of encoder and probe, and record again"
            ) from err

    return computed


@one_blas_thread()
@_solvable
def identify(
    record: MotionRecord,
    *,
    order: int = 0,
    input: str = "encoder",
    settings: Mapping[str, object] | None = None,
    recorded_ns: int | None = None,
    budget: EvaluationBudget | None = None,
) -> Identification:
    """Return the calibration that ``record`` supports, with the fit behind it.

    order: number of poles, 0 to choose it. Uncertainties of an order that is asked for are
        never smaller than those of the free choice.
    input: "encoder", or "reference" to take the second sensor as the motion
    settings: what the calibration belongs to, kept as it is; with "table_mass_kg" the masses
        and springs of a response that is that of two masses are in SI, else per table mass
    recorded_ns: when the recording began [ns, ROS time], None where nobody knows
    budget: of the model search; None for the default. A search that it cuts short is reported.

    Raises StepTestError when there is no usable motion, IdentificationError when the probe
    did not see it, ConfigurationError for an input or a mass that cannot be. A model that can
    be had but not trusted is returned with the verdict "rejected" in its certificate.
    """
    mass, limits = table_mass(settings or {}), DEFAULT_LIMITS
    prepared = prepare(record, input)
    check_axis_steps(prepared)
    searched = search_model_errors(
        prepared, partial(_chosen, order=order), budget, may_grow=not order
    )
    prepared, model = searched.prepared, searched.model
    check_gain(model.chosen.fit.gain)
    drift = [
        nuisance_terms.columns
        for nuisance_terms in searched.nuisance_terms
        if nuisance_terms.term.family == DRIFT
    ]
    undetected = undetected_error_covariance(searched.diagnostics, settings or {}, limits, drift)
    undetected += alternative_modes(searched.without, searched.added_poles, model.chosen.fit)
    undetected += [consistency(searched.diagnostics)]
    undetected += [reference_delay(record, model.chosen.fit)] if input == "reference" else []
    known = response_uncertainty(prepared, model, limits, undetected)
    if model.free is not None:
        known = inflate_to_free_choice(known, prepared, model, model.free, limits)
    evidence = IdentificationEvidence(record, prepared, model, known, limits, searched)
    findings = _findings(evidence)
    best, origin = model.chosen.fit, {"input": input, RECORDED: recorded_ns}
    calibration = Calibration(
        dynamics=best.dynamics,
        static_gain=abs(best.gain),
        sample_period=record.sample_period,
        valid_up_to=max(known.valid_up_to, _UNTRUSTED_HZ),
        covariance=known.covariance,
        settings=dict(settings or {}),
        certificate=origin | certificate_of(evidence, findings, mass),
    )
    return Identification(calibration, prepared, best)


def _chosen(
    prepared: Prepared, budget: EvaluationBudget, *, order: int
) -> tuple[Prepared, ChosenModel]:
    prepared, model = model_from_start(prepared, budget, order)
    check_gain(model.chosen.fit.gain, slack=_SAME_SIGNAL_CORRELATION)
    return prepared, model


def _findings(evidence: IdentificationEvidence) -> list[Finding]:
    """Return what is wrong, then what a right model leaves open, then how far that reaches."""
    wrong, range_ = ([check(evidence) for check in part] for part in (CHECKS, RANGE_CHECKS))
    return [*wrong, completeness(evidence.searched), *evidence.known.findings, *range_]
