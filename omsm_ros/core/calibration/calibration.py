"""A calibration: identified dynamics with their uncertainty, and the settings they hold for.

Certificates of schema "omsm-calibration/1" have flat names, and findings as sentences.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from math import hypot
from typing import Any

import numpy as np

from omsm_ros.core.calibration.certificate import (
    ACCEPTED,
    CERTIFICATE_SCHEMA,
    REJECTED,
    REJECTS,
    RESERVATION,
    RESERVED,
    TEXT,
    WARNING,
    Certificate,
    Residual,
    Response,
    from_json,
)
from omsm_ros.core.calibration.latency import Latency, unresolved_latency
from omsm_ros.core.calibration.plausibility import check_covariance, check_dynamics
from omsm_ros.core.lti.frequency_response import low_frequency_delay_uncertainty
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import CalibrationError, Notice, OmsmError
from omsm_ros.quantities import FREQUENCY, GAIN, SAMPLE_PERIOD
from omsm_ros.units import NANOSECONDS_PER_S

SCHEMA = "omsm-calibration/2"
SCHEMA_1 = "omsm-calibration/1"
# Standard uncertainties by which a delay may be longer than the lag that it is a part of.
_SIGNIFICANT = 3.0
# A difference of two covariances this little indefinite, of correlations, is rounding.
_ROUNDING = 1e-9

# Axes besides Z whose motion may reach the probe; key of their responses in a file.
FURTHER_AXES = ("x", "y", "b", "c")
FURTHER = "further_axes"

PROBE = "probe."
"""Prefix of the names of settings that the driver of the probe reports."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Calibration:
    """G_m with its covariance and the settings it was measured under.

    dynamics: G_m(s), fitted with G_m(0) = 1
    static_gain: static probe travel per encoder travel [1]; the corrector divides the
        probe's distance by it, for the encoder is the length standard
    sample_period: of the data it was identified from [s]
    valid_up_to: highest frequency at which the response is trusted [Hz]
    covariance: (p, p), order numerator, denominator[1:], delay; zero rows for fixed parameters
    settings: probe rate, exposure, averaging, machine, fixture …; JSON values
    certificate: how it was obtained and the verdict
    further: responses of the probe to further axes, by their names: numerators over the same
        denominator and delay, ascending powers of s, relative to the static gain
    joint: covariance (P, P) from noise, in the order of ``covariance``, then the numerators

    Raises CalibrationError when the parts do not fit each other.
    """

    dynamics: TransferFunction
    static_gain: float
    sample_period: float
    valid_up_to: float
    covariance: FloatArray
    settings: Mapping[str, object] = field(default_factory=dict)
    certificate: Certificate = field(default_factory=Certificate)
    further: Mapping[str, FloatArray] = field(default_factory=dict)
    joint: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    def __post_init__(self) -> None:
        GAIN.checked(self.static_gain, CalibrationError, "static_gain")
        SAMPLE_PERIOD.checked(self.sample_period, CalibrationError, "sample_period")
        FREQUENCY.checked(self.valid_up_to, CalibrationError, "valid_up_to")
        p = len(self.dynamics.numerator) + len(self.dynamics.denominator)
        if self.covariance.shape != (p, p) or not np.all(np.isfinite(self.covariance)):
            raise CalibrationError(
                "calibration.covariance_shape", shape=repr(self.covariance.shape), size=p
            )
        self._check_further(p)
        if not self.dynamics.is_stable:
            raise CalibrationError("calibration.unstable", poles=repr(self.dynamics.poles()))

    def _check_further(self, p: int) -> None:
        proper = [len(n) <= len(self.dynamics.denominator) for n in self.further.values()]
        known = set(self.further) <= set(FURTHER_AXES) and all(map(len, self.further.values()))
        total = p + sum(map(len, self.further.values())) if self.further else 0
        finite = all(np.all(np.isfinite(n)) for n in (*self.further.values(), self.joint))
        if not (known and all(proper) and finite and self.joint.shape == (total, total)):
            raise CalibrationError(
                "calibration.further", axes=", ".join(self.further), known=", ".join(FURTHER_AXES)
            )

    def further_gain_u(self, name: str) -> float:
        """Return the standard uncertainty of the static response to a further axis."""
        before = [len(n) for n in self.further.values()][: list(self.further).index(name)]
        place = len(self.covariance) + sum(before)
        return float(np.sqrt(max(self.joint[place, place], 0.0)))

    @property
    def static_gain_uncertainty(self) -> float:
        """Standard uncertainty of the static gain [1], 0 where the certificate states none."""
        return self.certificate.static_gain.uncertainty or 0.0

    @property
    def low_frequency_delay_uncertainty(self) -> float:
        """Standard uncertainty of the delay of slow motion [s]."""
        return low_frequency_delay_uncertainty(self.dynamics, self.covariance)

    @property
    def noise_covariance(self) -> FloatArray:
        """Covariance (p, p) by which repeated step tests of one machine scatter.

        ``covariance`` also contains undetected model errors, which are the same in all of them.
        Equal to it where the certificate does not separate the two.
        """
        stated = self.certificate.noise_covariance
        if len(stated) != self.covariance.size:
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

    @property
    def latency(self) -> Latency:
        """Stated latency of the probe; an unresolved one where nothing is stated."""
        stated = self.certificate.latency
        return unresolved_latency(self.dynamics.low_frequency_delay) if stated is None else stated

    def content(self) -> dict[str, object]:
        """Return the calibration as JSON values, without its id."""
        further = {
            "numerators": {name: numerator.tolist() for name, numerator in self.further.items()},
            "covariance": self.joint.ravel().tolist(),
        }
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
            "certificate": self.certificate.content(),
        } | ({FURTHER: further} if self.further else {})

    @classmethod
    def from_content(cls, content: Mapping[str, Any]) -> Calibration:
        """Return the inverse of :meth:`content`, for values of the right types; reads version 1.

        Every calibration from a file or over the network passes here: raises CalibrationError for
        one that no machine has, or that cannot be computed with.
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
        p = len(dynamics.numerator) + len(dynamics.denominator)
        covariance = np.asarray(content["covariance"], np.float64)
        calibration = cls(
            dynamics=dynamics,
            static_gain=float(content["static_gain"]),
            sample_period=sample_period,
            valid_up_to=float(content["valid_up_to"]),
            covariance=covariance.reshape(p, p) if covariance.size == p * p else covariance,
            settings=content["settings"],
            certificate=certificate_from_content(content["certificate"]),
            **_further_of(content.get(FURTHER)),
        )
        for covariance in (calibration.covariance, calibration.noise_covariance):
            check_covariance(covariance, dynamics, calibration.valid_up_to)
        return calibration

    @cached_property
    def id(self) -> str:
        """SHA-256 over the canonical content, hexadecimal."""
        return content_id(self.content())


def _further_of(content: Any) -> dict[str, Any]:
    if content is None:
        return {}
    covariance = np.asarray(content["covariance"], np.float64)
    size = round(len(covariance) ** 0.5)
    if size**2 != len(covariance):
        raise CalibrationError("calibration.covariance_shape", shape=len(covariance), size=size)
    numerators = content["numerators"].items()
    return {
        "further": {name: np.asarray(one, np.float64) for name, one in numerators},
        "joint": covariance.reshape(size, size),
    }


def certificate_from_content(content: Mapping[str, Any]) -> Certificate:
    """Return the certificate of JSON values of either version; CalibrationError if malformed."""
    if content.get("schema") == CERTIFICATE_SCHEMA:
        return Certificate.from_content(content)
    return certificate_of_version_1(content)


def age_at(calibration: Calibration, moment_ns: int | None) -> float | None:
    """Return how long before ``moment_ns`` [ns, ROS time] a calibration was recorded [s].

    None where one of the times is not known; negative for a calibration that is newer.
    """
    recorded = calibration.certificate.origin.recorded_ns
    if moment_ns is None or recorded is None:
        return None
    return (moment_ns - recorded) / NANOSECONDS_PER_S


def excess_latency_text(
    calibration: Calibration, delay: float, uncertainty: float = 0.0
) -> Notice | None:
    """Return a notice on a ``delay`` ± ``uncertainty`` [s] beyond the whole lag of Z, else None.

    A longer latency is not plausible: the structure would have to move before its slide.
    """
    lag = calibration.dynamics.low_frequency_delay
    spread = calibration.low_frequency_delay_uncertainty
    if delay <= max(lag, 0.0) + _SIGNIFICANT * hypot(spread, uncertainty):
        return None
    return Notice("calibration.latency_beyond_lag", delay=delay, lag=lag, uncertainty=spread)


def with_latency(calibration: Calibration, latency: Latency) -> Calibration:
    """Return ``calibration`` with a certificate that states ``latency``."""
    return replace(calibration, certificate=replace(calibration.certificate, latency=latency))


def content_id(content: Mapping[str, object]) -> str:
    """Return SHA-256 of the canonical JSON of ``content``: sorted keys, shortest exact numbers."""
    canonical = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(canonical.encode()).hexdigest()


def settings_with(
    stated: Mapping[str, object], probe: Sequence[Mapping[str, object]]
) -> dict[str, object]:
    """Return the settings of a calibration: as ``stated``, and as the probe reported.

    probe: each state that the probe's driver reported during the motion
    Raises CalibrationError where they contradict each other.
    """
    merged = dict(stated)
    for state in probe:
        for name, value in state.items():
            if merged.setdefault(name, value) != value:
                raise CalibrationError(
                    "calibration.changed_setting", name=name, first=merged[name], then=value
                )
    return merged


# Where an entry of version 1 stands now; a path of two names is a group and its field.
_PLACES_1 = {
    **{name: ("origin", name) for name in ("input", "recorded_ns")},
    **{
        name: (name,)
        for name in ("structure", "noise_covariance", "consistency", "latency", "self_calibration")
    },
    "valid_from": ("validity", "from_hz"),
    "shown_up_to_hz": ("validity", "excited_up_to_hz"),
    "residual_rms_m": ("residual", "rms_m"),
    "nonparametric_agreement": ("residual", "response_agreement"),
    "static_gain_uncertainty": ("static_gain", "uncertainty"),
    "polarity": ("static_gain", "polarity"),
    "departures": ("model_errors", "modelled"),
    "could_hide": ("undetected", "terms"),
    "gain_above_rest_u": ("undetected", "gain_u"),
    "plateau_that_would_tell_s": ("undetected", "plateau_needed_s"),
    "plateau_s": ("undetected", "plateau_s"),
    **{
        one.name: (group, one.name)
        for group, kind in (("residual", Residual), ("response", Response))
        for one in fields(kind)
    },
    **{name: ("model_errors", name) for name in ("motion_error_m", "backlash_m", "drift_m_s")},
}
# The calibration itself has the gain, the structure has the order, and the terms that may be
# undetected tell which is the largest.
_REDUNDANT_1 = {"static_gain", "order", "hidden_mostly"}
_LATENCY_NAMES_1 = {"beside_z_s": "unshared_s"}
_LISTS_1 = {"reasons": REJECTS, "reservations": RESERVATION, "warnings": WARNING}
_READ_APART_1 = {"verdict", "limits", "candidates", "static_gains", *_LISTS_1}


def certificate_of_version_1(entries: Mapping[str, Any]) -> Certificate:
    """Return the certificate of a file of version 1; raise CalibrationError if it is malformed."""
    content: dict[str, Any] = {"findings": _findings(entries), "further": {}}
    if entries.get("verdict") is not None:
        content["verdict"] = _verdict(entries["verdict"])
    for name, value in entries.items():
        if name in _READ_APART_1 or name in _REDUNDANT_1 or value is None:
            continue
        if name not in _PLACES_1:
            content["further"][name] = value
            continue
        *group, field = _PLACES_1[name]
        (content.setdefault(group[0], {}) if group else content)[field] = value
    limits = entries.get("limits")
    if isinstance(limits, Mapping):
        content["limits"] = dict(limits)
        band = {name: limits[name] for name in ("gain", "phase_rad") if name in limits}
        content["validity"] = content.get("validity", {}) | band
    candidates, names = entries.get("candidates"), ("poles", "zeros", "delay")
    content["candidates"] = [
        {"structure": {n: c[n] for n in names}, "bic": c["bic"], "rms_m": c["rms_m"]}
        for c in (candidates if isinstance(candidates, list) else ())
        if isinstance(c, Mapping) and {*names, "bic", "rms_m"} <= c.keys()
    ]
    for name, gain in (entries.get("static_gains") or {}).items():
        content.setdefault("static_gain", {})[name] = gain
    latency = content.get("latency")
    if isinstance(latency, Mapping):
        content["latency"] = {_LATENCY_NAMES_1.get(k, k): v for k, v in latency.items()}
    for error in content.get("model_errors", {}).get("modelled", ()):
        error.pop("modelled", None)
    certificate: Certificate = from_json(Certificate, content, "certificate")
    return certificate


def _verdict(stated: object) -> str:
    """Return the verdict that a sentence begins with, as "accepted, supported by data from …"."""
    for verdict in (RESERVED, ACCEPTED, REJECTED):
        if isinstance(stated, str) and stated.startswith(verdict):
            return verdict
    raise CalibrationError(
        "calibration.verdict",
        verdict=repr(stated)[:80],
        known=f"{ACCEPTED}, {RESERVED}, {REJECTED}",
    )


def _findings(entries: Mapping[str, Any]) -> list[dict[str, Any]]:
    found = []
    for name, severity in _LISTS_1.items():
        texts = entries.get(name, [])
        if not isinstance(texts, list) or not all(isinstance(text, str) for text in texts):
            raise CalibrationError(
                "calibration.mistyped",
                name=f"certificate.{name}",
                value=repr(texts)[:80],
                expected="a list of texts",
            )
        found += [{"code": TEXT, "severity": severity, "values": {"text": t}} for t in texts]
    return found
