"""Identify G_m from a motion of the axis and what the probe saw of a fixed target.

On a fixed target ``distance = offset + drift · t - static_gain · (G_m u)(t)``; G_m(0) = 1.

| step | where |
|---|---|
| the record becomes a problem to fit | :mod:`omsm_ros.core.fitting.preparation` |
| a model is chosen and fitted | :mod:`model_choice` |
| what the residual shows besides is modelled | :mod:`departure_search` |
| its covariance from noise | :mod:`response_uncertainty` |
| further terms of it | :mod:`covariance_terms`, :mod:`hidden_terms`, :mod:`consistency` |
| checks | :mod:`checks` |
| certificate and verdict | :mod:`certificate` |
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import wraps
from typing import ParamSpec

import numpy as np

from omsm_ros.core.departures.families import DRIFT
from omsm_ros.core.dynamics.calibration import RECORDED, Calibration
from omsm_ros.core.dynamics.response_band import ResponseLimits
from omsm_ros.core.fitting.axis_steps import check_axis_steps
from omsm_ros.core.fitting.output_error import Fit
from omsm_ros.core.fitting.preparation import Prepared, check_gain, prepare
from omsm_ros.core.identification.certificate import certificate_of
from omsm_ros.core.identification.checks import CHECKS, RANGE_CHECKS
from omsm_ros.core.identification.consistency import consistency
from omsm_ros.core.identification.covariance_terms import reference_delay
from omsm_ros.core.identification.departure_search import search
from omsm_ros.core.identification.evidence import Evidence
from omsm_ros.core.identification.finding import Finding
from omsm_ros.core.identification.hidden_terms import hidden_covariance, other_modes
from omsm_ros.core.identification.model_choice import Model, model_from_start
from omsm_ros.core.identification.response_uncertainty import no_surer, response_uncertainty
from omsm_ros.core.identification.two_masses import table_mass
from omsm_ros.core.samples.motion_record import MotionRecord
from omsm_ros.errors import IdentificationError

DEFAULT_LIMITS = ResponseLimits()
Parameters = ParamSpec("Parameters")
# A calibration that is trusted nowhere says so by a frequency below anything that moves.
_TRUSTED_NOWHERE_HZ = 1e-3
# What creep, drift or play beside the first model may still change of its gain; beyond it the probe
# saw something else, and to look for departures in that takes half a minute.
_STILL_THE_SAME_SIGNAL = 10.0


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


@_solvable
def identify(
    record: MotionRecord,
    *,
    order: int = 0,
    input: str = "encoder",
    settings: Mapping[str, object] | None = None,
    recorded_ns: int | None = None,
) -> Identification:
    """Return the calibration that ``record`` supports, with the fit behind it.

    order: number of poles, 0 to choose it. Uncertainties of an order that is asked for are
        never smaller than those of the free choice.
    input: "encoder", or "reference" to take the second sensor as the motion
    settings: what the calibration belongs to, kept as it is; with "table_mass_kg" the masses
        and springs of a response that is that of two masses are in SI, else per table mass
    recorded_ns: when the recording began [ns, ROS time], None where nobody knows

    Raises StepTestError when there is no usable motion, IdentificationError when the probe
    did not see it, ConfigurationError for an input or a mass that cannot be. A model that can
    be had but not trusted is returned with the verdict "rejected" in its certificate.
    """
    mass, limits = table_mass(settings or {}), DEFAULT_LIMITS
    prepared = prepare(record, input)
    check_axis_steps(prepared)
    searched = search(prepared, lambda prepared: _chosen(prepared, order), may_grow=not order)
    prepared, model = searched.prepared, searched.model
    check_gain(model.chosen.fit.gain)
    drift = [beside.columns for beside in searched.beside if beside.term.family == DRIFT]
    hidden = hidden_covariance(searched.survey, settings or {}, limits, drift)
    hidden += other_modes(searched.without, searched.in_response, model.chosen.fit)
    hidden += [consistency(searched.survey)]
    hidden += [reference_delay(record, model.chosen.fit)] if input == "reference" else []
    known = response_uncertainty(prepared, model, limits, hidden)
    if model.free is not None:
        known = no_surer(known, prepared, model, model.free, limits)
    evidence = Evidence(record, prepared, model, known, limits, searched)
    findings = _findings(evidence)
    best, origin = model.chosen.fit, {"input": input, RECORDED: recorded_ns}
    calibration = Calibration(
        dynamics=best.dynamics,
        static_gain=abs(best.gain),
        sample_period=record.sample_period,
        valid_up_to=max(known.valid_up_to, _TRUSTED_NOWHERE_HZ),
        covariance=known.covariance,
        settings=dict(settings or {}),
        certificate=origin | certificate_of(evidence, findings, mass),
    )
    return Identification(calibration, prepared, best)


def _chosen(prepared: Prepared, order: int) -> tuple[Prepared, Model]:
    prepared, model = model_from_start(prepared, order)
    check_gain(model.chosen.fit.gain, slack=_STILL_THE_SAME_SIGNAL)
    return prepared, model


def _findings(evidence: Evidence) -> list[Finding]:
    """Return what is wrong, then what a right model leaves open, then how far that reaches."""
    wrong, range_ = ([check(evidence) for check in part] for part in (CHECKS, RANGE_CHECKS))
    return [*wrong, *evidence.known.findings, *range_]
