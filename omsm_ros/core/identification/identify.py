"""Identify G_m from a motion of the axis and the readings of a probe on a fixed target.

On a fixed target ``distance = offset + drift · t - static_gain · (G_m u)(t)``; G_m(0) = 1.

| step | where |
|---|---|
| prepare the record for a fit | :mod:`omsm_ros.core.estimation.preparation` |
| choose and fit a model | :mod:`model_choice` |
| model what the residual shows besides | :mod:`model_error_search` |
| covariance from noise | :mod:`response_uncertainty` |
| further terms of the covariance | :mod:`covariance_terms` |
| checks | :mod:`checks`, :mod:`model_error_checks` |
| certificate and verdict | :mod:`certify` |
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial, wraps
from typing import ParamSpec

import numpy as np

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.calibration.certificate import Origin
from omsm_ros.core.calibration.intended_use import PAPER_USE, IntendedUse
from omsm_ros.core.estimation.optimisation import EvaluationBudget
from omsm_ros.core.estimation.output_error import Fit
from omsm_ros.core.estimation.preparation import Prepared, check_axis_steps, check_gain, prepare
from omsm_ros.core.identification.certify import certificate_of
from omsm_ros.core.identification.checks import CHECKS
from omsm_ros.core.identification.covariance_terms import (
    alternative_modes,
    contrast_covariance,
    delay_covariance,
    reference_lag,
    undetected_covariance,
)
from omsm_ros.core.identification.evidence import IdentificationEvidence
from omsm_ros.core.identification.model_choice import ChosenModel, model_from_start
from omsm_ros.core.identification.model_error_search import SearchResult, search_model_errors
from omsm_ros.core.identification.response_uncertainty import (
    inflate_to_free_choice,
    response_uncertainty,
)
from omsm_ros.core.lti.frequency_response import ResponseLimits
from omsm_ros.core.model_errors.families import DRIFT
from omsm_ros.core.model_errors.residual_diagnostics import contrasts
from omsm_ros.core.streams.motion_record import MotionRecord
from omsm_ros.errors import ConfigurationError, IdentificationError
from omsm_ros.linear_algebra import one_blas_thread
from omsm_ros.quantities import MASS

DEFAULT_LIMITS = ResponseLimits()
NO_ORIGIN = Origin()
Parameters = ParamSpec("Parameters")
# The setting without which masses, springs and dampers are known only per mass of the table.
TABLE_MASS_SETTING = "table_mass_kg"
# valid_up_to of a calibration that is trusted nowhere, below the frequency of any motion.
_UNTRUSTED_HZ = 1e-3
# Factor by which creep, drift or backlash may change the gain of the first model; beyond it the
# probe measures something else, and the search for model errors would take half a minute.
_GAIN_SLACK = 10.0


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
    """Convert LinAlgError to IdentificationError."""

    @wraps(compute)
    def computed(*args: Parameters.args, **options: Parameters.kwargs) -> Identification:
        try:
            return compute(*args, **options)
        except np.linalg.LinAlgError as err:
            raise IdentificationError("identification.singular", why=str(err)) from err

    return computed


@one_blas_thread()
@_solvable
def identify(
    record: MotionRecord,
    *,
    order: int = 0,
    input: str = "encoder",
    settings: Mapping[str, object] | None = None,
    use: IntendedUse = PAPER_USE,
    origin: Origin = NO_ORIGIN,
    budget: EvaluationBudget | None = None,
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

    Raises StepTestError when there is no usable motion, IdentificationError when the probe
    did not measure it, ConfigurationError for an impossible input or mass. A model that cannot be
    trusted is returned with the verdict "rejected" in its certificate.
    """
    mass = table_mass(settings or {})
    prepared = prepare(record, input)
    check_axis_steps(prepared)
    searched = search_model_errors(
        prepared, partial(_chosen, order=order), budget, may_grow=not order
    )
    prepared, model = searched.prepared, searched.model
    check_gain(model.chosen.fit.gain)
    best = model.chosen.fit
    evidence = _evidence(record, searched, input, settings or {}, use)
    findings = [finding for check in CHECKS for finding in check(evidence)]
    calibration = Calibration(
        dynamics=best.dynamics,
        static_gain=abs(best.gain),
        sample_period=record.sample_period,
        valid_up_to=max(evidence.known.valid_up_to, _UNTRUSTED_HZ),
        covariance=evidence.known.covariance,
        settings=dict(settings or {}),
        certificate=certificate_of(evidence, findings, replace(origin, input=input), mass),
    )
    return Identification(calibration, prepared, best)


def _evidence(
    record: MotionRecord,
    searched: SearchResult,
    input: str,
    settings: Mapping[str, object],
    use: IntendedUse,
) -> IdentificationEvidence:
    """Return what the checks use: the uncertainty of the response, and what it consists of."""
    prepared, model, limits = searched.prepared, searched.model, DEFAULT_LIMITS
    drift = [
        nuisance_terms.columns
        for nuisance_terms in searched.nuisance_terms
        if nuisance_terms.term.family == DRIFT
    ]
    best, diagnostics = model.chosen.fit, searched.diagnostics
    further, undetected = undetected_covariance(diagnostics, settings, drift, use)
    further += alternative_modes(searched.without, searched.added_poles, best)
    compared = contrasts(diagnostics)
    further.append(contrast_covariance(compared, best.dynamics))
    reference = reference_lag(record) if input == "reference" else None
    if reference is not None:
        further.append(delay_covariance(reference, len(further[-1])))
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
    prepared: Prepared, budget: EvaluationBudget, *, order: int
) -> tuple[Prepared, ChosenModel]:
    prepared, model = model_from_start(prepared, budget, order)
    check_gain(model.chosen.fit.gain, slack=_GAIN_SLACK)
    return prepared, model
