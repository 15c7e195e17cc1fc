"""A calibration: the identified dynamics, how well they are known, and what they belong to."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from math import hypot, sqrt
from typing import Any

import numpy as np

from omsm_ros.core.lti.frequency_response import low_frequency_delay_uncertainty
from omsm_ros.core.lti.transfer_function import ComplexArray, TransferFunction
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import CalibrationError, ConfigurationError, OmsmError
from omsm_ros.quantities import (
    DELAY,
    FREQUENCY,
    GAIN,
    GAIN_UNCERTAINTY,
    LAG,
    ORDER,
    SAMPLE_PERIOD,
    SHARE,
    TIME_CONSTANT,
    TIME_UNCERTAINTY,
    shown,
)
from omsm_ros.readable import plain, quantity
from omsm_ros.units import NANOSECONDS_PER_S

# How much of a calibration's lag is latency of the probe, and how well is that known?
#
# A structure that lags moves Z alone. A probe that is late saw an earlier place of the part,
# so X and C must be delayed too. A step test sees the sum of both and cannot separate them;
# scans of one part at several speeds or in both directions can.

ENTRY = "latency"
UNRESOLVED, REVERSAL, SPEEDS, DECLARED = "unresolved", "reversal", "several speeds", "declared"
SOURCES = (UNRESOLVED, REVERSAL, SPEEDS, DECLARED)

# Standard uncertainties by which a delay may be longer than the lag that it is a part of.
_CLEARLY = 3.0
REMEDY = (
    "scan the part at two spindle speeds and run 'omsm selfcal', or in both directions and run "
    "'omsm reversal', or declare it with 'omsm latency'"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Latency:
    """The part of the lag by which X, Y, B and C are delayed.

    delay_s: of the probe against the slides;  uncertainty_s: of it, k = 1, None if unknown
    share: of the whole lag [1], None where it is not known or there is no lag
    beside_z_s: standard uncertainty of the delay that the lag of Z does not share; it alone
        moves a height where Z follows the surface
    source: one of ``SOURCES``;  reason: in words

    Raises ConfigurationError for values that no probe has.
    """

    delay_s: float
    uncertainty_s: float | None
    beside_z_s: float
    share: float | None
    source: str
    reason: str

    def __post_init__(self) -> None:
        LAG.checked(self.delay_s, ConfigurationError, "latency")
        TIME_UNCERTAINTY.checked(self.beside_z_s, ConfigurationError, "latency beside Z")
        if self.uncertainty_s is not None:
            TIME_UNCERTAINTY.checked(self.uncertainty_s, ConfigurationError, "latency")
        if self.share is not None:
            SHARE.checked(self.share, ConfigurationError, "share of the latency")
        if self.source not in SOURCES:
            raise ConfigurationError(
                f"latency by {shown(self.source)}, expected one of {', '.join(SOURCES)}"
            )
        if not (isinstance(self.reason, str) and self.reason.strip()):
            raise ConfigurationError("a latency needs a reason: say where the figure comes from")

    @property
    def resolved(self) -> bool:
        """False if nothing separates latency from structure."""
        return self.source != UNRESOLVED

    @classmethod
    def of_entry(cls, entry: object) -> Latency:
        """Return the inverse of :meth:`entry`; raise CalibrationError if it is none."""
        names = {field.name for field in fields(cls)}
        if not isinstance(entry, Mapping) or set(entry) != names:
            raise CalibrationError(
                f"certificate: latency is {shown(entry)}, expected {', '.join(sorted(names))}; "
                "declare it again with 'omsm latency'"
            )
        try:
            return cls(**entry)
        except OmsmError as err:
            raise CalibrationError(f"certificate: {err}") from err

    def entry(self) -> dict[str, Any]:
        """Return the JSON values of ``certificate["latency"]``."""
        return asdict(self)


def latency_of(calibration: Calibration) -> Latency:
    """Return what ``calibration`` says of its latency; unresolved if it says nothing."""
    if ENTRY in calibration.certificate:
        return Latency.of_entry(calibration.certificate[ENTRY])
    return unresolved_latency(calibration.dynamics.low_frequency_delay)


def unresolved_latency(lag: float) -> Latency:
    """Return what is known without a test: any part of ``lag`` [s] may be latency.

    X and C are not delayed, for nothing says that they should be. The true delay lies anywhere
    between 0 and the lag, uniformly: its rms from zero is lag/√3.
    """
    spread = abs(lag) / sqrt(3.0)
    return Latency(
        delay_s=0.0,
        uncertainty_s=spread,
        beside_z_s=spread,
        share=None,
        source=UNRESOLVED,
        reason="a step test alone cannot separate latency of the probe from lag of the structure",
    )


def declared_latency(lag: float, delay: float, uncertainty: float, reason: str) -> Latency:
    """Return a latency of ``delay`` ± ``uncertainty`` [s] of the whole ``lag`` [s] as stated.

    Raises ConfigurationError for a delay or uncertainty that no probe has, or without a reason.
    """
    return Latency(
        delay_s=delay,
        uncertainty_s=uncertainty,
        beside_z_s=uncertainty,
        share=latency_share_of(delay, lag),
        source=DECLARED,
        reason=reason,
    )


def excess_latency_text(
    calibration: Calibration, delay: float, uncertainty: float = 0.0
) -> str | None:
    """Return what is wrong with a ``delay`` ± ``uncertainty`` [s] beyond the whole lag of Z.

    What is left of the lag would be a structure that moves before its slide.
    """
    lag, spread = (
        calibration.dynamics.low_frequency_delay,
        calibration.low_frequency_delay_uncertainty,
    )
    if delay <= max(lag, 0.0) + _CLEARLY * hypot(spread, uncertainty):
        return None
    return (
        f"a delay of the probe of {quantity(delay, 's')} is more than the whole lag of Z, "
        f"{quantity(lag, 's')} ± {quantity(spread, 's')}: give the probe's delay against the "
        "slides, in seconds"
    )


def latency_share_of(delay: float, lag: float) -> float | None:
    """Return the part of ``lag`` [s] that ``delay`` [s] is, None if there is no lag."""
    return delay / lag if lag else None


def with_latency(calibration: Calibration, latency: Latency) -> Calibration:
    """Return ``calibration`` with a certificate that says ``latency``."""
    certificate = {**calibration.certificate, ENTRY: latency.entry()}
    return replace(calibration, certificate=certificate)


# Can a machine have these dynamics, and can they be computed with?
#
# A calibration comes from a file or over the network. Numbers that no machine has (a delay of
# minutes, a pole in a million years) would not only be wrong: filters made of them take all memory.

# G_m(0) = 1 by definition; rounding of the coefficients leaves far less than this.
_UNIT_GAIN = 1e-6
# A wrong start is forgotten to 1e-9 after 21 time constants: some six million samples.
MAX_TIME_CONSTANT_SAMPLES = 300_000
# The filter has a section for two samples of delay, and each costs time for every sample.
MAX_DELAY_SAMPLES = 10_000
# Uncertainty of the response at the end of its trusted band that a coefficient alone may bring.
_MAX_UNCERTAINTY = 1e9
# Rounding makes a semidefinite correlation matrix this little indefinite.
_INDEFINITE = 1e-6


def check_dynamics(dynamics: TransferFunction, sample_period: float) -> None:
    """Raise CalibrationError for a G_m that no machine sampled every ``sample_period`` [s] has.

    Whether it is stable is the calibration's own question.
    """
    SAMPLE_PERIOD.checked(sample_period, CalibrationError, "sample_period")
    ORDER.checked(len(dynamics.denominator) - 1, CalibrationError, "order of the denominator")
    if abs(dynamics.dc_gain - 1) > _UNIT_GAIN:
        raise CalibrationError(
            f"G_m(0), the first coefficient of the numerator, is {dynamics.dc_gain!r}, expected 1; "
            "the gain at rest belongs in static_gain; identify it again"
        )
    DELAY.checked(dynamics.delay, CalibrationError)
    _check_samples("delay", dynamics.delay, sample_period, MAX_DELAY_SAMPLES)
    poles = checked_roots(dynamics, "poles")
    for roots in (poles, checked_roots(dynamics, "zeros")):
        for rate in abs(roots):
            TIME_CONSTANT.checked(_inverse(rate), CalibrationError, "time constant of G_m")
    if len(poles):
        slowest = _inverse(np.min(abs(poles.real)))
        TIME_CONSTANT.checked(slowest, CalibrationError, "slowest decay of G_m")
        _check_samples("slowest decay", slowest, sample_period, MAX_TIME_CONSTANT_SAMPLES)


def check_covariance(covariance: FloatArray, dynamics: TransferFunction, trusted: float) -> None:
    """Raise CalibrationError unless this is the covariance of the parameters of ``dynamics``.

    covariance: (p, p), order numerator, denominator[1:], delay
    trusted: highest frequency at which the response is trusted [Hz]
    """
    variance = np.diag(covariance)
    if np.any(variance < 0):
        raise CalibrationError("covariance has a negative variance; identify it again")
    deviation = np.sqrt(variance)
    scale = deviation[:, np.newaxis] * deviation
    if np.any(abs(covariance - covariance.T) > 1e-9 * scale):
        raise CalibrationError("covariance is not symmetric; identify it again")
    free = np.flatnonzero(np.diag(scale))
    correlation = (covariance / np.where(scale > 0, scale, 1.0))[np.ix_(free, free)]
    least = float(np.min(np.linalg.eigvalsh(correlation), initial=0.0))
    if least < -_INDEFINITE or np.any(covariance[scale == 0] != 0):
        raise CalibrationError(
            f"covariance has a negative eigenvalue, {least:.2g} of its correlations: "
            "no quantities vary together like that; identify it again"
        )
    _check_size(deviation, dynamics, trusted)


def check_certificate(certificate: Mapping[str, object]) -> None:
    """Raise CalibrationError for a verdict or a latency that others would take for another."""
    verdict = certificate.get("verdict", "")
    if not isinstance(verdict, str):
        raise CalibrationError(
            f"certificate: verdict is {shown(verdict)}, expected 'accepted' or 'rejected'; "
            "identify it again"
        )
    for name in ("reasons", "warnings"):
        texts = certificate.get(name, [])
        if not isinstance(texts, list) or not all(isinstance(text, str) for text in texts):
            raise CalibrationError(
                f"certificate: {name} is {shown(texts)}, expected a list of texts; identify again"
            )
    if ENTRY in certificate:
        Latency.of_entry(certificate[ENTRY])


def _inverse(rate: float) -> float:
    return 1 / float(rate) if rate else np.inf


def _check_samples(name: str, seconds: float, sample_period: float, most: int) -> None:
    if seconds > most * sample_period:
        raise CalibrationError(
            f"{name} of G_m is {quantity(seconds, 's', 4)}: {plain(seconds / sample_period)} "
            f"samples of {quantity(sample_period, 's', 4)}, expected at most {most}; "
            "identify it again"
        )


def checked_roots(dynamics: TransferFunction, kind: str) -> ComplexArray:
    """Return the ``kind`` of ``dynamics``, "poles" or "zeros" [rad/s].

    Raises CalibrationError where they cannot be computed.
    """
    with np.errstate(all="ignore"):
        try:
            roots = dynamics.poles() if kind == "poles" else dynamics.zeros()
        except (np.linalg.LinAlgError, ZeroDivisionError, OverflowError):
            roots = np.array([np.nan + 0j])
    if not np.all(np.isfinite(roots)):
        raise CalibrationError(
            f"the {kind} of the response cannot be computed: its coefficients span too many "
            "decades; identify it again"
        )
    return roots


def _check_size(deviation: FloatArray, dynamics: TransferFunction, trusted: float) -> None:
    omega = 2 * np.pi * trusted
    powers = [*range(len(dynamics.numerator)), *range(1, len(dynamics.denominator)), 1]
    with np.errstate(over="ignore"):
        at_end = deviation * omega ** np.array(powers, np.float64)
    if np.any(~(at_end <= _MAX_UNCERTAINTY)):
        raise CalibrationError(
            f"covariance leaves the response at {quantity(trusted, 'Hz', 4)} uncertain by a factor "
            f"of {plain(float(np.max(at_end)), 2)}; identify it again"
        )


SCHEMA = "omsm-calibration/1"
REJECTED, ACCEPTED = "rejected", "accepted"
RESERVED = "accepted with reservations"
# A difference of two covariances this little indefinite, of correlations, is rounding.
_ROUNDING = 1e-9

RECORDED = "recorded_ns"
"""Entry of a certificate: when its recording began [ns, ROS time], None where nobody knows."""

PROBE = "probe."
"""Begins the names of settings that the probe's driver reports by itself."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Calibration:
    """G_m with its covariance and the settings it was measured under.

    dynamics: G_m(s), fitted with G_m(0) = 1
    static_gain: probe travel per encoder travel at rest [1]; the corrector divides the
        probe's distance by it, for the encoder is the length standard
    sample_period: of the data it was identified from [s]
    valid_up_to: highest frequency at which the response is trusted [Hz]
    covariance: (p, p), order numerator, denominator[1:], delay; zero rows for fixed parameters
    settings: probe rate, exposure, averaging, machine, fixture …; JSON values
    certificate: how it was obtained and the verdict; JSON values

    Raises CalibrationError when the parts do not fit each other.
    """

    dynamics: TransferFunction
    static_gain: float
    sample_period: float
    valid_up_to: float
    covariance: FloatArray
    settings: Mapping[str, object] = field(default_factory=dict)
    certificate: Mapping[str, object] = field(default_factory=dict)

    def __post_init__(self) -> None:
        GAIN.checked(self.static_gain, CalibrationError, "static_gain")
        SAMPLE_PERIOD.checked(self.sample_period, CalibrationError, "sample_period")
        FREQUENCY.checked(self.valid_up_to, CalibrationError, "valid_up_to")
        p = len(self.dynamics.numerator) + len(self.dynamics.denominator)
        if self.covariance.shape != (p, p) or not np.all(np.isfinite(self.covariance)):
            raise CalibrationError(
                f"covariance of shape {self.covariance.shape!r}, expected ({p}, {p}) finite "
                "numbers; identify it again"
            )
        if not self.dynamics.is_stable:
            raise CalibrationError(
                f"G_m is unstable: poles {self.dynamics.poles()!r} rad/s; identify it again"
            )

    @property
    def static_gain_uncertainty(self) -> float:
        """Standard uncertainty of the static gain [1], 0 where the certificate states none.

        Raises CalibrationError where what it states is none.
        """
        name = "static_gain_uncertainty"
        stated = self.certificate.get(name, 0.0)
        return float(GAIN_UNCERTAINTY.checked(stated, CalibrationError, name))

    @property
    def low_frequency_delay_uncertainty(self) -> float:
        """Standard uncertainty of the delay of slow motion [s]."""
        return low_frequency_delay_uncertainty(self.dynamics, self.covariance)

    @property
    def noise_covariance(self) -> FloatArray:
        """Covariance (p, p) by which repeated step tests of one machine scatter.

        ``covariance`` holds besides what could hide in every one of them alike. Equal to it
        where the certificate does not separate the two.
        """
        stated = self.certificate.get("noise_covariance")
        if (
            not isinstance(stated, list)
            or len(stated) != self.covariance.size
            or not all(type(value) in (int, float) for value in stated)
        ):
            return self.covariance
        return np.asarray(stated, np.float64).reshape(self.covariance.shape)

    @property
    def undetected_error_covariance(self) -> FloatArray:
        """Covariance (p, p) of what the step test could not show, beyond its noise.

        Zero where the certificate does not separate the two.
        """
        undetected = self.covariance - self.noise_covariance
        deviation = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        scale = np.where(deviation > 0, deviation, 1.0)
        least = float(np.min(np.linalg.eigvalsh(undetected / np.outer(scale, scale))))
        return undetected if least > -_ROUNDING else np.zeros_like(undetected)

    @property
    def low_frequency_delay_noise(self) -> float:
        """Standard deviation of the delay of slow motion [s] over repeated step tests."""
        return low_frequency_delay_uncertainty(self.dynamics, self.noise_covariance)

    def content(self) -> dict[str, object]:
        """Return the calibration as JSON values, without its id."""
        return {
            "schema": SCHEMA,
            "numerator": self.dynamics.numerator.tolist(),
            "denominator": self.dynamics.denominator.tolist(),
            "delay": float(self.dynamics.delay),
            "static_gain": float(self.static_gain),
            "sample_period": float(self.sample_period),
            "valid_up_to": float(self.valid_up_to),
            "covariance": self.covariance.ravel().tolist(),
            "settings": dict(self.settings),
            "certificate": dict(self.certificate),
        }

    @classmethod
    def from_content(cls, content: Mapping[str, Any]) -> Calibration:
        """Return the inverse of :meth:`content`, for values of the right types.

        This is the door for calibrations, from a file or over the network: raises
        CalibrationError for one that no machine has, or that cannot be computed with.
        """
        try:
            dynamics = TransferFunction(
                np.asarray(content["numerator"], np.float64),
                np.asarray(content["denominator"], np.float64),
                float(content["delay"]),
            )
        except OmsmError as err:
            raise CalibrationError(str(err)) from err
        sample_period = float(content["sample_period"])
        check_dynamics(dynamics, sample_period)
        check_certificate(content["certificate"])
        p = len(dynamics.numerator) + len(dynamics.denominator)
        covariance = np.asarray(content["covariance"], np.float64)
        calibration = cls(
            dynamics=dynamics,
            static_gain=float(content["static_gain"]),
            sample_period=sample_period,
            valid_up_to=float(content["valid_up_to"]),
            covariance=covariance.reshape(p, p) if covariance.size == p * p else covariance,
            settings=content["settings"],
            certificate=content["certificate"],
        )
        for covariance in (calibration.covariance, calibration.noise_covariance):
            check_covariance(covariance, dynamics, calibration.valid_up_to)
        return calibration

    @cached_property
    def id(self) -> str:
        """SHA-256 over the canonical content, hexadecimal."""
        return content_id(self.content())


def age_at(calibration: Calibration, moment_ns: int | None) -> float | None:
    """Return how long before ``moment_ns`` [ns, ROS time] a calibration was recorded [s].

    None where nobody knows when either was; negative for one that is newer.
    """
    recorded = calibration.certificate.get(RECORDED)
    if moment_ns is None or type(recorded) is not int:
        return None
    return (moment_ns - recorded) / NANOSECONDS_PER_S


def verdict_of(calibration: Calibration) -> tuple[str, list[str]]:
    """Return the verdict of the certificate, empty if it has none, and its reasons."""
    reasons = calibration.certificate.get("reasons")
    texts = [str(reason) for reason in reasons] if isinstance(reasons, list) else []
    return str(calibration.certificate.get("verdict", "")), texts


def content_id(content: Mapping[str, object]) -> str:
    """Return SHA-256 of the canonical JSON of ``content``: sorted keys, shortest exact numbers."""
    canonical = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(canonical.encode()).hexdigest()


def settings_with(
    stated: Mapping[str, object], probe: Sequence[Mapping[str, object]]
) -> dict[str, object]:
    """Return what a calibration belongs to: as ``stated``, and as the probe reported.

    probe: each state that the probe's driver reported during the motion
    Raises CalibrationError where they contradict each other: the motion belongs to no setting.
    """
    merged = dict(stated)
    for state in probe:
        for name, value in state.items():
            if merged.setdefault(name, value) != value:
                raise CalibrationError(
                    f"setting {name} is {merged[name]!r}, then {value!r} of one motion; leave the "
                    "probe as it is set while it is recorded, and record again"
                )
    return merged
