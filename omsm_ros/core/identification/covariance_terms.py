"""What makes the response less certain than the noise of the probe does?

A term states what the data cannot show: it adds to the covariance of the coefficients, and
its finding stands in the certificate. To add one, write a function of the same signature
as :func:`hidden_motion` and append it to :data:`COVARIANCE_TERMS`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from omsm_ros.core.dynamics.response_band import low_frequency_delay_uncertainty
from omsm_ros.core.fitting.covariance import hidden_motion_covariance
from omsm_ros.core.fitting.output_error import Fit
from omsm_ros.core.fitting.preparation import Prepared
from omsm_ros.core.identification.finding import Finding
from omsm_ros.core.identification.inter_sample_bias import inter_sample_delay_bound
from omsm_ros.core.samples.blocks import FloatArray

# 3 mdeg at 15 Hz, below anything a scan would notice.
_HARMLESS_DELAY_S = 0.5e-6


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
    if bound > max(delay_noise, _HARMLESS_DELAY_S):
        reasons = (
            f"motion between samples may shift the lag by {bound * 1e6:.1f} µs: the edges are "
            "too sharp for the sampling; use jerk-limited or dithered edges, or sample faster",
        )
    return Finding({"inter_sample_delay_bound_s": bound}, reasons=reasons)


COVARIANCE_TERMS: tuple[Callable[[Prepared, Fit, FloatArray], CovarianceTerm], ...] = (
    hidden_motion,
)
