"""The certificate of a calibration: how it was obtained, and whether to trust it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from itertools import chain

import numpy as np

from omsm_ros.core.dynamics.calibration import ACCEPTED, REJECTED, RESERVED
from omsm_ros.core.dynamics.latency import ENTRY, unresolved
from omsm_ros.core.dynamics.masses_and_springs import finite_values, shape
from omsm_ros.core.dynamics.modes import modal_remainder, mode_entries
from omsm_ros.core.dynamics.response_band import low_frequency_delay_uncertainty
from omsm_ros.core.fitting.order_choice import Candidate
from omsm_ros.core.identification.evidence import Evidence
from omsm_ros.core.identification.finding import Finding
from omsm_ros.core.identification.model_choice import Model
from omsm_ros.core.identification.static_gains import static_gains
from omsm_ros.core.identification.two_masses import two_mass_entry
from omsm_ros.core.samples.motion_record import MotionRecord
from omsm_ros.errors import StepTestError
from omsm_ros.readable import quantity


def certificate_of(
    evidence: Evidence, findings: Sequence[Finding], table_mass: float | None
) -> dict[str, object]:
    """Return a dict of JSON values, ending with ``reasons``, ``warnings`` and ``verdict``.

    table_mass: moving mass of the table [kg], None if it is not known
    """
    known, valid_from = evidence.known, 1 / (2 * np.pi * evidence.searched.survey.slowest_creep)
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


def _order_entries(model: Model) -> dict[str, object]:
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


def _residual_entries(evidence: Evidence) -> dict[str, object]:
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


def _response_entries(evidence: Evidence) -> dict[str, object]:
    dynamics, known = evidence.dynamics, evidence.known
    return {
        ENTRY: unresolved(dynamics.low_frequency_delay).entry(),
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
