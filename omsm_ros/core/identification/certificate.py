"""The certificate of a calibration: how it was obtained, and whether to trust it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from omsm_ros.core.dynamics.response_band import COVERAGE_FACTOR, ResponseLimits
from omsm_ros.core.dynamics.transfer_function import TransferFunction
from omsm_ros.core.fitting.order_choice import Candidate
from omsm_ros.core.fitting.order_estimate import HankelVote

# A residual this much larger than the noise is not noise; its square is χ² per sample.
_WORST_CHI_SQUARE = 1.3
# A rest this much noisier than the motion is no measure of noise: something still rings.
_LEAST_CHI_SQUARE = 0.3
_LEAST_TRUSTED_HZ = 5.0
# 3 mdeg at 15 Hz, below anything a scan would notice.
_HARMLESS_DELAY_S = 0.5e-6


@dataclass(frozen=True)
class Evidence:
    """What the verdict rests on; SI units.

    chi_square: mean square of the residual where the axis moves over that of the noise
    noise: standard deviation of a reading, known or taken where the axis rests
    whiteness, independence: p-values of the residual's tests
    limits: of the 95 % band, within which the response is trusted up to ``valid_up_to``
    delay_noise, delay_uncertainty: of the low-frequency delay, from noise alone and in all
    gain_apart: standard uncertainty of the static gain, whatever lag and curvature G has
    widened: factor on all uncertainties, for an order asked for that leaves things open
    clearly_better: number of poles that the data ask for instead, or None
    """

    chi_square: float
    residual_rms: float
    noise: float
    whiteness: float
    independence: float
    valid_up_to: float
    limits: ResponseLimits
    nyquist: float
    delay_noise: float
    delay_uncertainty: float
    inter_sample_delay_bound: float
    gain_apart: float
    edges: int
    widened: float = 1.0
    clearly_better: int | None = None


def certify(
    dynamics: TransferFunction,
    chosen: Candidate,
    candidates: Sequence[Candidate],
    vote: HankelVote,
    evidence: Evidence,
    further: Mapping[str, object],
) -> dict[str, object]:
    """A dict of JSON values, ending with ``reasons``, ``warnings`` and ``verdict``."""
    structure = chosen.fit.structure
    reasons, warnings = _reasons(evidence), _warnings(dynamics, evidence)
    return {
        "order": structure.poles,
        "structure": _structure(chosen),
        "singular_values": [float(v) for v in vote.singular_values],
        "singular_value_order": vote.order,
        "candidates": [
            _structure(c) | {"bic": c.bic, "rms_m": c.fit.rms, "held_out_m": _number(c.held_out)}
            for c in candidates
        ],
        "chi_square": evidence.chi_square,
        "residual_rms_m": evidence.residual_rms,
        "noise_m": evidence.noise,
        "edges": evidence.edges,
        "whiteness_p": evidence.whiteness,
        "independence_p": evidence.independence,
        "low_frequency_delay_s": dynamics.low_frequency_delay,
        "low_frequency_delay_uncertainty_s": evidence.delay_uncertainty,
        "inter_sample_delay_bound_s": evidence.inter_sample_delay_bound,
        "limits": {
            "gain": evidence.limits.gain,
            "phase_rad": evidence.limits.phase,
            "chi_square_least": _LEAST_CHI_SQUARE,
            "chi_square_greatest": _WORST_CHI_SQUARE,
            "valid_up_to_least_hz": _LEAST_TRUSTED_HZ,
        },
        **further,
        "warnings": warnings,
        "reasons": reasons,
        "verdict": _verdict(reasons, evidence),
    }


def _structure(candidate: Candidate) -> dict[str, object]:
    structure = candidate.fit.structure
    return {"poles": structure.poles, "zeros": structure.zeros, "delay": structure.delay}


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _reasons(evidence: Evidence) -> list[str]:
    reasons = []
    if evidence.chi_square > _WORST_CHI_SQUARE:
        reasons.append(
            f"where the axis moves the residual is {evidence.chi_square:.2f} times the noise of "
            f"{evidence.noise * 1e9:.3g} nm squared: the model misses something; "
            + _what_to_check(evidence)
        )
    if evidence.chi_square < _LEAST_CHI_SQUARE:
        reasons.append(
            f"where the axis moves the residual is only {evidence.chi_square:.2g} times the noise "
            f"of {evidence.noise * 1e9:.3g} nm squared: the probe is not quiet where the axis "
            "rests, or the stated noise is too large; start the recording after a second of rest"
        )
    if COVERAGE_FACTOR * evidence.gain_apart > evidence.limits.gain:
        reasons.append(
            "the motion does not tell the static gain from the dynamics (its gain alone is "
            f"uncertain by {100 * COVERAGE_FACTOR * evidence.gain_apart:.2g} %): move in steps, or "
            "at several frequencies at once"
        )
    if evidence.valid_up_to < _LEAST_TRUSTED_HZ:
        reasons.append(
            f"the response is known within limits only up to {evidence.valid_up_to:.2g} Hz; "
            "make more or larger steps"
        )
    if evidence.inter_sample_delay_bound > max(evidence.delay_noise, _HARMLESS_DELAY_S):
        reasons.append(
            "motion between samples may shift the lag by "
            f"{evidence.inter_sample_delay_bound * 1e6:.1f} µs: the edges are too sharp for the "
            "sampling; use jerk-limited or dithered edges, or sample faster"
        )
    return reasons


def _what_to_check(evidence: Evidence) -> str:
    if evidence.clearly_better is not None:
        return f"the order asked for is wrong, {evidence.clearly_better} poles tell far more"
    return "check for backlash, a loose mount or a clipped probe"


def _warnings(dynamics: TransferFunction, evidence: Evidence) -> list[str]:
    widened = [
        f"order {len(dynamics.denominator) - 1} was asked for; without asking, more stays open "
        f"than it can state: its uncertainties are taken {evidence.widened:.2g} times as large"
    ]
    return widened[: evidence.widened > 1] + [
        f"pole at {mode.frequency:.0f} Hz lies beyond {evidence.valid_up_to:.0f} Hz, "
        "up to which the response is known within limits: it need not be a resonance"
        for mode in dynamics.modes()
        if mode.frequency > evidence.valid_up_to
    ]


def _verdict(reasons: list[str], evidence: Evidence) -> str:
    if reasons:
        return "rejected"
    if evidence.valid_up_to < 0.999 * evidence.nyquist:
        return f"accepted up to {evidence.valid_up_to:.0f} Hz"
    return "accepted"
