"""A calibration: the identified dynamics, how well they are known, and what they belong to."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from omsm_ros.core.dynamics import plausibility
from omsm_ros.core.dynamics.response_band import low_frequency_delay_uncertainty
from omsm_ros.core.dynamics.transfer_function import TransferFunction
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.errors import CalibrationError, OmsmError
from omsm_ros.quantities import FREQUENCY, GAIN, GAIN_UNCERTAINTY, SAMPLE_PERIOD
from omsm_ros.units import NANOSECONDS_PER_S

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
    def hidden_covariance(self) -> FloatArray:
        """Covariance (p, p) of what the step test could not show, beyond its noise.

        Zero where the certificate does not separate the two.
        """
        hidden = self.covariance - self.noise_covariance
        deviation = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        scale = np.where(deviation > 0, deviation, 1.0)
        least = float(np.min(np.linalg.eigvalsh(hidden / np.outer(scale, scale))))
        return hidden if least > -_ROUNDING else np.zeros_like(hidden)

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
        plausibility.check_dynamics(dynamics, sample_period)
        plausibility.check_certificate(content["certificate"])
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
            plausibility.check_covariance(covariance, dynamics, calibration.valid_up_to)
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
