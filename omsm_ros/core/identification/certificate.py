"""The certificate of a calibration: how it was obtained, and whether to trust it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from itertools import chain

import numpy as np

from omsm_ros.core.dynamics.frequency_response import frequency_response
from omsm_ros.core.dynamics.masses_and_springs import finite_values, shape
from omsm_ros.core.dynamics.modes import modal_remainder, mode_entries
from omsm_ros.core.dynamics.response_band import low_frequency_delay_uncertainty
from omsm_ros.core.fitting.order_choice import Candidate
from omsm_ros.core.fitting.output_error import Fit, Problem
from omsm_ros.core.identification.evidence import Evidence
from omsm_ros.core.identification.finding import Finding
from omsm_ros.core.identification.model_choice import Model
from omsm_ros.core.identification.residual_tests import response_agreement
from omsm_ros.core.identification.static_gains import static_gains
from omsm_ros.core.identification.two_masses import two_mass_entry
from omsm_ros.core.samples.motion_record import MotionRecord
from omsm_ros.errors import StepTestError

_AGREEMENT_SEGMENT_S = 1.0
_LEAST_SEGMENTS = 8
# Of the band up to half the sampling rate; the last line below it stands for the whole.
_WHOLE_BAND = 0.999


def certificate_of(
    evidence: Evidence, findings: Sequence[Finding], table_mass: float | None
) -> dict[str, object]:
    """Return a dict of JSON values, ending with ``reasons``, ``warnings`` and ``verdict``.

    table_mass: moving mass of the table [kg], None if it is not known
    """
    nyquist = 0.5 / evidence.prepared.problem.period
    limits = dict(chain.from_iterable(finding.limits.items() for finding in findings))
    entries = dict(chain.from_iterable(finding.entries.items() for finding in findings))
    reasons = list(chain.from_iterable(finding.reasons for finding in findings))
    warnings = list(chain.from_iterable(finding.warnings for finding in findings))
    return {
        **_order_entries(evidence.model),
        **_residual_entries(evidence),
        **_response_entries(evidence),
        **_gain_entries(evidence),
        "two_mass": two_mass_entry(
            evidence.dynamics, evidence.known.covariance, evidence.known.valid_up_to, table_mass
        ),
        **entries,
        "limits": limits,
        "warnings": warnings,
        "reasons": reasons,
        "verdict": verdict(reasons, evidence.known.valid_up_to, nyquist),
    }


def verdict(reasons: Sequence[str], valid_up_to: float, nyquist: float) -> str:
    """Return "rejected", "accepted", or "accepted up to" a frequency [Hz] below ``nyquist``."""
    if reasons:
        return "rejected"
    if valid_up_to < _WHOLE_BAND * nyquist:
        return f"accepted up to {valid_up_to:.0f} Hz"
    return "accepted"


def _order_entries(model: Model) -> dict[str, object]:
    return {
        "order": model.chosen.fit.structure.poles,
        "structure": _structure(model.chosen),
        "singular_values": [float(v) for v in model.vote.singular_values],
        "singular_value_order": model.vote.order,
        "candidates": [
            _structure(c) | {"bic": c.bic, "rms_m": c.fit.rms, "held_out_m": _number(c.held_out)}
            for c in model.candidates
        ],
    }


def _structure(candidate: Candidate) -> dict[str, object]:
    structure = candidate.fit.structure
    return {"poles": structure.poles, "zeros": structure.zeros, "delay": structure.delay}


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _residual_entries(evidence: Evidence) -> dict[str, object]:
    prepared, tests = evidence.prepared, evidence.residual
    compared = {"spikes": prepared.spikes, "compared": evidence.fit.samples}
    return {
        "residual_rms_m": evidence.fit.rms,
        "edges": len(prepared.steps.edges),
        "whiteness_p": tests.whiteness,
        "independence_p": tests.independence,
        "nonparametric_agreement": _agreement(
            prepared.problem, evidence.fit, evidence.known.valid_up_to
        ),
        "samples": dict(evidence.record.counts) | compared,
    }


def _response_entries(evidence: Evidence) -> dict[str, object]:
    dynamics, known = evidence.dynamics, evidence.known
    return {
        "low_frequency_delay_s": dynamics.low_frequency_delay,
        "low_frequency_delay_uncertainty_s": low_frequency_delay_uncertainty(
            dynamics, known.covariance
        ),
        "shown_up_to_hz": known.shown_up_to,
        "shape": finite_values(shape(dynamics, 0.5 / evidence.prepared.problem.period)),
        "modes": mode_entries(dynamics, known.covariance),
        "modal_remainder": modal_remainder(dynamics, known.valid_up_to),
    }


def _gain_entries(evidence: Evidence) -> dict[str, object]:
    """What is seen beside the response: gain, drift, backlash."""
    best, column = evidence.fit, evidence.prepared.backlash_column
    duration = len(evidence.record) * evidence.record.sample_period
    return {
        "static_gain": abs(best.gain),
        "static_gain_uncertainty": float(np.sqrt(evidence.known.gain_variance)),
        "static_gains": _attributed(evidence.record),
        "polarity": -int(np.sign(best.gain)),
        "drift_m_s": 2 * float(best.background[1]) / duration,
        "backlash_m": 0.0 if column is None else 2 * abs(float(best.background[column])),
    }


def _attributed(record: MotionRecord) -> dict[str, object] | None:
    """Gains between probe, encoder and reference; None where there are too few plateaus."""
    try:
        return asdict(static_gains(record))
    except StepTestError:
        return None


def _agreement(problem: Problem, best: Fit, up_to: float) -> float | None:
    residual = problem.on_grid(best.residual, 0.0)
    segment = min(round(_AGREEMENT_SEGMENT_S / problem.period), len(residual) // _LEAST_SEGMENTS)
    segment = max(segment, 16)
    value = response_agreement(
        frequency_response(problem.input, residual, problem.period, segment), up_to
    )
    return value if np.isfinite(value) else None
