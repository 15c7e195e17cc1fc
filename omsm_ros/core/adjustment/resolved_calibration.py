"""Make a calibration from scans of one part, with or without a step test, and test for latency.

Reversal is self-calibration with a step test and two directions instead of two speeds: a late
reading belongs to a place earlier on the path, so reversing the spindle shifts it to the other
side; a mechanical lag of Z does not. On a surface that Z follows, an error of the delay of the
calibration has the same effect, so the result is not better than that delay.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
from scipy.special import chdtrc

from omsm_ros.core.adjustment.scan_data import ScanData
from omsm_ros.core.adjustment.self_calibration import (
    CURVATURE,
    DEFAULT_HARMONICS,
    DYNAMIC,
    GAIN,
    LAG,
    LATENCY,
    OWN,
    UNINFORMATIVE_CURVATURE_S2,
    UNINFORMATIVE_GAIN,
    UNINFORMATIVE_S,
    Prior,
    SelfCalibration,
    self_calibrate,
)
from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.calibration.certificate import (
    ACCEPTED,
    REJECTS,
    WARNING,
    Certificate,
    Finding,
    Residual,
    Response,
    StaticGain,
)
from omsm_ros.core.calibration.latency import REVERSAL, SPEEDS, Latency, latency_share_of
from omsm_ros.core.lti.frequency_response import COVERAGE_FACTOR, ResponseLimits
from omsm_ros.core.lti.transfer_function import TransferFunction, slow_motion_jacobian
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import DataError, Notice
from omsm_ros.units import RPM_RAD_S

SCOPE = Notice("adjustment.latency_scope")
"""Validity of a calibration whose latency is unknown."""
# Significance of a conflict with the prior: one clean run in a thousand.
_PRIOR_CONFLICT_P, _PRIOR_CONFLICT_SIGMAS = 1e-3, 3.0
# Relative stability of the speed of a spindle.
_SAME_SPEED = 0.01
# Poles of the low-order model over the sampling rate, above the excitation and below Nyquist.
_POLE_SHARE_OF_RATE = 0.2


def unit_calibration(sample_period: float, static_gain: float = 1.0) -> Calibration:
    """Return a calibration without correction, for data of ``sample_period`` [s]."""
    nothing = TransferFunction(np.ones(1), np.ones(1))
    return Calibration(
        dynamics=nothing,
        static_gain=static_gain,
        sample_period=sample_period,
        valid_up_to=0.5 / sample_period,
        covariance=np.zeros((2, 2)),
        certificate=Certificate(verdict=ACCEPTED),
    )


def without_step_test(gain_uncertainty: float = UNINFORMATIVE_GAIN) -> Prior:
    """Return an uninformative prior, for a machine without a step test.

    gain_uncertainty: relative, of the static gain
    """
    return Prior(
        np.diag([UNINFORMATIVE_S, UNINFORMATIVE_CURVATURE_S2, gain_uncertainty, UNINFORMATIVE_S])
        ** 2
    )


def after_step_test(calibration: Calibration) -> Prior:
    """Return the prior after a step test: the covariance of its lag, curvature and gain."""
    jacobian = slow_motion_jacobian(calibration.dynamics)
    covariance = np.zeros((DYNAMIC, DYNAMIC))
    covariance[:GAIN, :GAIN] = jacobian @ calibration.covariance @ jacobian.T
    relative = calibration.static_gain_uncertainty / calibration.static_gain
    covariance[GAIN, GAIN] = relative**2
    covariance[LATENCY, LATENCY] = UNINFORMATIVE_S**2
    return Prior(covariance)


def resolved(calibration: Calibration, found: SelfCalibration) -> Calibration:
    """Return ``calibration`` updated with the result of scans that were corrected with it.

    The covariance Σ of all parameters becomes ``Σ - K (J Σ Jᵀ - P) Kᵀ``, ``K = Σ Jᵀ (J Σ Jᵀ)⁻¹``.
    J is the Jacobian of lag and curvature, and P the covariance of both after the scans.
    """
    g, sigma = _moved(calibration, float(found.values[LAG]), float(found.values[CURVATURE]))
    jacobian = slow_motion_jacobian(g)
    prior = jacobian @ sigma @ jacobian.T
    gain = sigma @ jacobian.T @ _inverse_of_varying(prior)
    remaining = found.covariance[:GAIN, :GAIN].copy()
    if len(g.numerator) <= CURVATURE + 1:
        # A numerator of first degree cannot hold the curvature, so it adds to the uncertainty.
        remaining[CURVATURE, CURVATURE] += float(found.values[CURVATURE]) ** 2
    change = prior - remaining
    covariance = sigma - gain @ change @ gain.T
    lag = g.low_frequency_delay
    certificate = replace(
        calibration.certificate,
        self_calibration=_entries(found),
        latency=_latency(found, lag),
        response=replace(
            calibration.certificate.response,
            low_frequency_delay_s=lag,
            low_frequency_delay_uncertainty_s=float(np.sqrt(found.covariance[LAG, LAG])),
        ),
    )
    findings = list(_findings(found))
    return replace(
        calibration,
        dynamics=g,
        covariance=(covariance + covariance.T) / 2,
        certificate=certificate.judged(findings) if findings else certificate,
    )


def from_scans_alone(
    found: SelfCalibration, sample_period: float, static_gain: float, settings: Mapping[str, object]
) -> Calibration:
    """Return a calibration of low order from scans corrected with :func:`unit_calibration`.

    ``N/D e^{-τs}`` with two fast poles, an octave apart, and N from the estimated lag and
    curvature.
    """
    latency = max(float(found.values[LATENCY]), 0.0)
    total, curvature = float(found.values[LAG]), float(found.values[CURVATURE])
    lag = total - latency
    curvature += latency**2 / 2 - total * latency
    slow = sample_period / (2 * np.pi * _POLE_SHARE_OF_RATE)
    first, second = 1.5 * slow, 0.5 * slow**2
    denominator = np.array([1.0, first, second])
    numerator = np.array([1.0, first - lag, second - first * lag + curvature])
    by_found = np.zeros((6, DYNAMIC))
    by_found[1] = [-1, 0, 0, 1]
    by_found[2] = [-first - latency, 1, 0, first + latency - total]
    by_found[5, LATENCY] = 1.0
    dynamics = TransferFunction(numerator, denominator, latency)
    trusted = min(_highest_excited(found), 0.5 / sample_period)
    scope = [] if found.known[LATENCY] else [Finding(SCOPE.code, WARNING)]
    spread = float(np.sqrt(found.covariance[LAG, LAG]))
    # Without a step test a significantly negative lag is an error.
    negative = total < -_PRIOR_CONFLICT_SIGMAS * spread
    early = [Finding("adjustment.negative_lag", REJECTS, {"lag": -total})] if negative else []
    certificate = Certificate(
        self_calibration=_entries(found),
        latency=_latency(found, dynamics.low_frequency_delay),
        static_gain=StaticGain(
            uncertainty=float(np.sqrt(found.covariance[GAIN, GAIN])) * static_gain
        ),
        residual=Residual(noise_m=found.agreement.noise),
        response=Response(
            low_frequency_delay_s=dynamics.low_frequency_delay,
            low_frequency_delay_uncertainty_s=spread,
        ),
    ).judged([*scope, *early, *_findings(found)])
    return Calibration(
        dynamics=dynamics,
        static_gain=static_gain,
        sample_period=sample_period,
        valid_up_to=trusted,
        covariance=by_found @ found.covariance @ by_found.T,
        settings=settings,
        certificate=certificate,
    )


def _moved(
    calibration: Calibration, lag: float, curvature: float
) -> tuple[TransferFunction, FloatArray]:
    """Return G multiplied by ``1 - lag s + curvature s²`` at low frequency, and its covariance.

    Only the numerator changes. It is extended to the first degree, if the denominator allows it,
    to hold the lag.
    """
    g = calibration.dynamics
    degree = len(g.numerator) - 1
    wanted = min(max(degree, 1), len(g.denominator) - 1)
    grown = [0.0] * (wanted - degree)
    numerator = np.append(g.numerator, grown)
    factor = np.array([1.0, -lag, curvature])[: min(wanted, 2) + 1]
    numerator[: len(factor)] = np.convolve(numerator, factor)[: len(factor)]
    covariance = calibration.covariance
    for _ in grown:
        covariance = np.insert(np.insert(covariance, degree + 1, 0.0, 0), degree + 1, 0.0, 1)
    delay = g.delay if wanted else max(g.delay + lag, 0.0)
    return TransferFunction(numerator, g.denominator, delay), covariance


def _latency(found: SelfCalibration, lag: float) -> Latency:
    size = np.abs(found.speeds)
    source = REVERSAL if np.ptp(size) < _SAME_SPEED * np.max(size) else SPEEDS
    _, structure = found.structure
    # The part of the uncertainty that the covariance of the dynamics does not contain.
    structural_uncertainty = float(np.sqrt(max(structure**2 - found.covariance[LAG, LAG], 0.0)))
    if not found.known[LATENCY]:
        return Latency(
            delay_s=0.0,
            uncertainty_s=None,
            unshared_s=structural_uncertainty,
            share=None,
            source=source,
            reason=str(SCOPE),
        )
    delay = max(float(found.values[LATENCY]), 0.0)
    speeds = [f"{speed / RPM_RAD_S:.4g}" for speed in found.speeds]
    return Latency(
        delay_s=delay,
        uncertainty_s=float(np.sqrt(found.covariance[LATENCY, LATENCY])),
        unshared_s=structural_uncertainty,
        share=latency_share_of(delay, lag),
        source=source,
        reason=str(Notice("adjustment.origin", scans=len(speeds), speeds=speeds)),
    )


def _entries(found: SelfCalibration) -> dict[str, object]:
    return {
        "speeds_rad_s": list(found.speeds),
        "points": found.points,
        "residual_rms_m": found.residual,
        "left_on_this_surface_m": found.followed,
        "agreement": asdict(found.agreement),
        "surprise_chi2": found.prior_conflict,
        "between_scans": [
            {
                name: {"value": float(value), "uncertainty": float(spread)}
                for name, value, spread in zip(OWN, values, spreads, strict=True)
            }
            for values, spreads in zip(found.own, found.own_uncertainty, strict=True)
        ],
        "unidentifiable": [*map(str, undetermined(found))],
    }


def undetermined(found: SelfCalibration) -> list[Notice]:
    """Return the parameters that the scans did not determine, and how to determine them."""
    notices = []
    if not found.known[LATENCY]:
        notices.append(Notice("adjustment.latency_undetermined"))
    if not found.known[CURVATURE]:
        notices.append(Notice("adjustment.curvature_undetermined"))
    return [*notices, Notice("adjustment.gain_undetermined")]


def _findings(found: SelfCalibration) -> Iterator[Finding]:
    """Yield the reasons against the calibration that the scans give."""
    if not found.agreement.holds:
        values = {"disagreement": found.agreement.disagreement, "ratio": found.agreement.ratio}
        yield Finding("adjustment.scans_disagree", REJECTS, values)
    if chdtrc(GAIN, found.prior_conflict) < _PRIOR_CONFLICT_P:
        values = {"shift": float(found.values[LAG]), "chi2": found.prior_conflict}
        yield Finding("adjustment.step_test_conflict", REJECTS, values)
    latency, spread = (
        float(v) for v in (found.values[LATENCY], found.covariance[LATENCY, LATENCY])
    )
    if latency < -_PRIOR_CONFLICT_SIGMAS * np.sqrt(spread):
        yield Finding("adjustment.negative_latency", REJECTS, {"latency": -latency})


def _highest_excited(found: SelfCalibration) -> float:
    """Return the highest frequency [Hz] at which the surface shows errors of G at the limits."""
    known = found.agreement.noise * np.sqrt(2 / found.points)
    limits = ResponseLimits()
    excited = found.amplitudes * min(limits.gain, limits.phase) > COVERAGE_FACTOR * known
    highest = int(np.max(np.flatnonzero(excited), initial=0)) + 1
    return highest * max(map(abs, found.speeds)) / (2 * np.pi)


def _inverse_of_varying(matrix: FloatArray) -> FloatArray:
    """Return the inverse of a covariance (2, 2) whose rows have different units and may be zero."""
    deviation = np.sqrt(np.diag(matrix))
    scale = np.divide(1.0, deviation, out=np.zeros_like(deviation), where=deviation > 0)
    correlation = matrix * scale * scale[:, np.newaxis]
    return np.asarray(np.linalg.pinv(correlation, hermitian=True) * scale * scale[:, np.newaxis])


@dataclass(frozen=True)
class Reversal:
    """Lag of the readings of the probe relative to X and C, from scans in opposite directions.

    lag, uncertainty: [s], k = 1;  lag_of_z: of the calibration at low frequency [s]
    residual: rms [m];  used: number of fitted points
    latency: True if the lag of Z is latency, False if mechanical, None if undecided (3 u)
    calibration: updated with the result
    """

    lag: float
    uncertainty: float
    lag_of_z: float
    residual: float
    used: int
    latency: bool | None
    calibration: Calibration


def reversal(
    scans: Sequence[ScanData], calibration: Calibration, harmonics: int = DEFAULT_HARMONICS
) -> Reversal:
    """Return the lag of the probe relative to X and C from scans in opposite directions.

    scans: corrected with ``calibration``, two or more, of one surface
    harmonics: of the surface in a turn; more for a rougher surface

    Raises DataError for scans in one direction, scans that are too short, or a surface without
    slope along the path.
    """
    speeds = [scan.speed for scan in scans]
    if len(scans) > 1 and not min(speeds) < 0 < max(speeds):
        raise DataError("adjustment.one_direction")
    found = self_calibrate(scans, after_step_test(calibration), harmonics)
    lag, of_z = float(found.values[LATENCY]), calibration.dynamics.low_frequency_delay
    uncertainty = float(found.covariance[LATENCY, LATENCY] ** 0.5)
    return Reversal(
        lag=lag,
        uncertainty=uncertainty,
        lag_of_z=of_z,
        residual=found.residual,
        used=found.points,
        latency=_verdict(lag, uncertainty, of_z),
        calibration=resolved(calibration, found),
    )


def _verdict(lag: float, uncertainty: float, lag_of_z: float) -> bool | None:
    late, prompt = abs(lag - lag_of_z) <= 3 * uncertainty, abs(lag) <= 3 * uncertainty
    return late if late != prompt else None
