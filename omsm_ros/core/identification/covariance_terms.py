"""What makes the response less certain than the noise of the probe does?

A term is a source of error that the data cannot show. It adds to the covariance of the
coefficients, and its finding stands in the certificate. To add one, write a function of the same
signature as :func:`hidden_motion` and append it to :data:`COVARIANCE_TERMS`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from omsm_ros.core.departures.reference_lag import ReferenceLag, reference_lag
from omsm_ros.core.dynamics.response_band import low_frequency_delay_uncertainty
from omsm_ros.core.fitting.covariance import hidden_motion_covariance
from omsm_ros.core.fitting.output_error import Fit
from omsm_ros.core.fitting.preparation import Prepared
from omsm_ros.core.identification.finding import Finding
from omsm_ros.core.identification.inter_sample_bias import inter_sample_delay_bound
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.core.samples.motion_record import MotionRecord
from omsm_ros.readable import quantity

HARMLESS_DELAY_S = 7e-6
"""Five nanometres on the paper's scan, whose Z moves at 0.7 mm/s (rms)."""

# A nanometre and a half on the paper's scan, whose Z moves at 0.7 mm/s (rms).
_GREATEST_REFERENCE_LAG_S = 2e-6
# Standard uncertainties beyond which a lag is no chance.
_CLEARLY = 5.0


@dataclass(frozen=True, eq=False)
class CovarianceTerm:
    """covariance: (p, p), order numerator, denominator[1:], delay;  finding: on its cause"""

    covariance: FloatArray
    finding: Finding = field(default_factory=Finding)


def hidden_motion(prepared: Prepared, fit: Fit, from_noise: FloatArray) -> CovarianceTerm:
    """Return the term of motion that an edge may hide between two samples.

    from_noise: (p, p) covariance of the coefficients from the noise of probe and encoder
    """
    problem = prepared.problem
    bound = inter_sample_delay_bound(problem.input, prepared.steps, problem.period)
    delay_noise = low_frequency_delay_uncertainty(fit.dynamics, from_noise)
    return CovarianceTerm(
        hidden_motion_covariance(fit.dynamics, bound, problem.period),
        hidden_motion_finding(bound, delay_noise),
    )


def hidden_motion_finding(bound: float, delay_noise: float) -> Finding:
    """Reject edges whose bound on the bias of the delay [s] exceeds its noise [s]."""
    reasons: tuple[str, ...] = ()
    if bound > max(delay_noise, HARMLESS_DELAY_S):
        reasons = (
            f"motion between samples may shift the lag by {quantity(bound, 's')}: the edges are "
            "too sharp for the sampling; use jerk-limited or dithered edges, or sample faster",
        )
    return Finding({"inter_sample_delay_bound_s": bound}, reasons=reasons)


def reference_delay(record: MotionRecord, fit: Fit) -> CovarianceTerm:
    """Return the term of the lag of the reference sensor, where it was the input.

    A correction filters the encoder, so the lag of the reference would be missing from it.
    """
    size = len(fit.dynamics.numerator) + len(fit.dynamics.denominator)
    covariance, lag = np.zeros((size, size)), reference_lag(record)
    if lag is None:
        return CovarianceTerm(covariance)
    covariance[-1, -1] = lag.value**2 + lag.uncertainty**2
    return CovarianceTerm(covariance, reference_finding(lag))


def reference_finding(lag: ReferenceLag) -> Finding:
    """Reject a reference that is clearly late, or early, against the encoder."""
    entries = {"reference_lag_s": lag.value, "reference_lag_uncertainty_s": lag.uncertainty}
    if abs(lag.value) <= max(_CLEARLY * lag.uncertainty, _GREATEST_REFERENCE_LAG_S):
        return Finding(entries)
    word = "late" if lag.value > 0 else "early"
    return Finding(
        entries,
        {"reference_lag_greatest_s": _GREATEST_REFERENCE_LAG_S},
        reasons=(
            f"the reference sensor is {quantity(abs(lag.value), 's')} {word} against the encoder "
            f"(u = {quantity(lag.uncertainty, 's', 2)}), and a correction filters the encoder: "
            "identify with input 'encoder', or remove the filter or averaging of the reference",
        ),
    )


COVARIANCE_TERMS: tuple[Callable[[Prepared, Fit, FloatArray], CovarianceTerm], ...] = (
    hidden_motion,
)
