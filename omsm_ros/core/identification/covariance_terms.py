"""Terms of the covariance beyond the noise of the probe: sources of error that data cannot show.

Each adds to the covariance of the coefficients. To add one, write a function of the same signature
as :func:`inter_sample_motion` and append it to :data:`COVARIANCE_TERMS`.

Motion beyond half the sampling rate is aliased into the samples. Edges that are synchronous with
the samples are aliased alike every time: the fit then finds a lag that does not exist, with white
residuals. The content of the encoder near half the sampling rate bounds it.

A model error that is not significant may still be there, up to the size at which it would have been
significant. The fitted coefficients then imitate a part of it, which shifts them. Its size is known
as N(estimate, uncertainty²), so its mean square is estimate² + uncertainty²: the shift of that
size is added to the covariance, unless the user declares a smaller prior.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from omsm_ros.core.calibration.certificate import PartsCompared, Undetected, UndetectedEntry
from omsm_ros.core.calibration.intended_use import IntendedUse
from omsm_ros.core.estimation.covariance import inter_sample_motion_covariance
from omsm_ros.core.estimation.model_structure import Fit
from omsm_ros.core.estimation.preparation import Prepared
from omsm_ros.core.estimation.steps import LEAST_SAMPLES, Steps
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.model_errors.families import CREEP
from omsm_ros.core.model_errors.residual_diagnostics import ResidualDiagnostics, differ
from omsm_ros.core.model_errors.undetected import (
    UNDETECTED,
    UndetectedTerm,
    undetected_terms,
    with_slow_creep,
)
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.core.streams.motion_record import MotionRecord
from omsm_ros.errors import ConfigurationError
from omsm_ros.linear_algebra import unit_columns
from omsm_ros.quantities import shown

# Greatest |G| assumed beyond half the sampling rate.
_GREATEST_GAIN_BEYOND = 5.0
# Band of the spectrum of the encoder, in parts of the sampling rate, that is extrapolated.
_TOP_BAND = (0.35, 0.5)
# Samples of rest on either side of an edge, so that its spectrum has no leakage.
_MARGIN_SAMPLES = 20


def inter_sample_delay_bound(motion: FloatArray, steps: Steps, sample_period: float) -> float:
    """Return a bound on the bias of the low-frequency delay [s] by motion between samples.

    With U the spectrum of an edge of height A, its aliases at low frequencies are U at the
    sampling rate on both sides, so the lag shifts by up to ``2 |U(f_s)| (1 + |G|) / A``.
    U(f_s) is extrapolated from the content below f_s / 2 at the rate at which an edge with
    finite acceleration falls, 1/f³. A motion without edges is taken as one long edge.
    """
    increments = np.diff(motion)
    pieces = [
        increments[max(edge.start - _MARGIN_SAMPLES, 0) : edge.stop + _MARGIN_SAMPLES]
        for edge in steps.edges
    ] or [increments * np.hanning(len(increments))]
    energy = 0.0
    for piece in pieces:
        frequency = np.fft.rfftfreq(len(piece))
        band = (frequency >= _TOP_BAND[0]) & (frequency <= _TOP_BAND[1])
        doubled = np.abs(1 - np.exp(-2j * np.pi * frequency[band])) ** 2
        power = np.abs(np.fft.rfft(piece))[band] ** 2
        # Less what noise of the encoder gives.
        energy += float(np.mean(power - len(piece) * steps.noise**2 * doubled))
    height = sum(float(np.sum(np.abs(piece))) ** 2 for piece in pieces)
    if energy <= 0:
        return 0.0
    # |ΔU| = |1 - exp(-jωT)| |U| is nearly 2 |U| / T at the top.
    at_top = 0.5 * sample_period * np.sqrt(energy / height)
    at_rate = at_top * (0.5 * sum(_TOP_BAND)) ** 3
    return float(2 * at_rate * (1 + _GREATEST_GAIN_BEYOND))


@dataclass(frozen=True, slots=True)
class ReferenceLag:
    """Lag of the reference behind the encoder [s] and its standard uncertainty [s]."""

    value: float
    uncertainty: float


def reference_lag(record: MotionRecord) -> ReferenceLag | None:
    """Return the lag of the reference; None where too little of both was recorded.

    To first order of the lag, ``reference = gain · (z - lag · dz/dt) + offset + drift``.
    """
    if record.reference is None:
        return None
    known = np.isfinite(record.reference)
    if record.z_lost is not None:
        known &= ~record.z_lost
    if np.sum(known) < LEAST_SAMPLES:
        return None
    columns = np.column_stack(
        [
            record.z - np.mean(record.z),
            -np.gradient(record.z, record.sample_period),
            np.ones(len(record)),
            np.linspace(-1.0, 1.0, len(record)),
        ]
    )[known]
    unit, scale = unit_columns(columns)
    inverse = np.linalg.pinv(unit)
    found = inverse @ record.reference[known]
    residual = record.reference[known] - unit @ found
    spread = float(np.sqrt(residual @ residual / (len(residual) - 4) * (inverse[1] @ inverse[1])))
    gain = float(found[0] / scale[0])
    if gain == 0:
        return None
    return ReferenceLag(float(found[1] / scale[1]) / gain, abs(spread / scale[1] / gain))


def inter_sample_motion(prepared: Prepared, fit: Fit) -> FloatArray:
    """Return the covariance (p, p) of motion between the samples of an edge."""
    problem = prepared.problem
    bound = inter_sample_delay_bound(problem.input, prepared.steps, problem.period)
    return inter_sample_motion_covariance(fit.dynamics, bound, problem.period)


COVARIANCE_TERMS: tuple[Callable[[Prepared, Fit], FloatArray], ...] = (inter_sample_motion,)
"""Terms that add to the covariance (p, p) of every fit."""


def contrast_covariance(found: Sequence[PartsCompared], dynamics: TransferFunction) -> FloatArray:
    """Return the covariance (p, p) of parts of a test that differ; zero where none do.

    The whole difference counts as a standard uncertainty: a scan moves less than a step, so its
    response need not lie between those of the two parts.
    """
    gain = np.concatenate([dynamics.numerator, np.zeros(len(dynamics.denominator))])
    lag = np.zeros_like(gain)
    lag[-1] = 1.0
    rows = [
        row
        for c in found
        if differ(c)
        for row in ((c.gain_difference or 0.0) * gain, (c.lag_difference_s or 0.0) * lag)
    ]
    stacked = np.asarray(rows).reshape(-1, len(gain))
    return np.asarray(stacked.T @ stacked)


def undetected_covariance(
    diagnostics: ResidualDiagnostics,
    priors: Mapping[str, float],
    drift: Sequence[slice],
    use: IntendedUse,
) -> tuple[list[FloatArray], Undetected]:
    """Return covariances (p, p) of undetected terms, and the terms for the certificate.

    drift: columns of the background that model a drift
    priors: see :func:`priors_of`; a term is taken no larger than its prior
    """
    terms = undetected_terms(diagnostics, drift, use)
    gain, slowest = max(
        ((_carried(t, priors) * t.above, t.parameter) for t in terms if t.family == CREEP),
        default=(0.0, 0.0),
    )
    found = Undetected(
        terms=tuple(_entry(term, priors) for term in terms),
        gain_u=gain,
        plateau_s=diagnostics.plateau,
        plateau_needed_s=slowest,
        slowest_creep_s=with_slow_creep(diagnostics).longest_time_constant,
        lowest_mode_hz=1 / diagnostics.plateau,
    )
    return [term.covariance(_carried(term, priors)) for term in terms], found


def priors_of(settings: Mapping[str, object]) -> dict[str, float]:
    """Return the "priors" of ``settings``, standard uncertainties by the name of a family.

    Raises ConfigurationError for a prior of another family, or that is no positive number.
    """
    stated = settings.get("priors", {})
    if not isinstance(stated, Mapping):
        raise ConfigurationError("identification.priors", value=repr(stated))
    for name, value in stated.items():
        if name not in UNDETECTED:
            known = ", ".join(map(repr, UNDETECTED))
            raise ConfigurationError(
                "identification.unknown_prior", family=shown(name), known=known
            )
        if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
            raise ConfigurationError("identification.prior", family=name, value=repr(value))
    return {str(name): float(value) for name, value in stated.items()}


def _carried(term: UndetectedTerm, priors: Mapping[str, float]) -> float:
    return min(term.carried, priors.get(term.family, np.inf))


def _entry(term: UndetectedTerm, priors: Mapping[str, float]) -> UndetectedEntry:
    carried, missed = _carried(term, priors), term.effect * term.missed
    return UndetectedEntry(
        family=term.family,
        parameter=float(term.parameter),
        size=term.size,
        uncertainty=term.uncertainty,
        missed=term.missed if np.isfinite(term.missed) else None,
        carried=carried,
        prior=priors.get(term.family),
        effect_on_scan_m=term.effect * carried,
        missed_effect_on_scan_m=missed if np.isfinite(missed) else None,
    )
