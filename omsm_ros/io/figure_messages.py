"""Messages of figures to watch and to plot: certificate, account, verdict, probe and vibration."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from omsm_ros.core.calibration.calibration import PROBE, Calibration
from omsm_ros.core.streams.blocks import Account
from omsm_ros.io.message_mapping import Messages, header
from omsm_ros.units import MICROMETRE_M

if TYPE_CHECKING:  # it takes seconds to load, and most nodes do not need it
    from omsm_ros.core.ripple.accelerometer import VibrationLevels

_PERCENT = 0.01
# Settings of probes: name as the device reports it, field of the message, its unit in SI.
_PROBE_FIELDS: Mapping[str, tuple[str, float]] = {
    "rate": ("rate", 1.0),
    "averaging": ("averaging", 1),
    "lamp": ("lamp", _PERCENT),
    "full_scale": ("full_scale", MICROMETRE_M),
}
_PROBE_TEXTS = ("device", "model", "serial")


def _known(value: float | None) -> float:
    return float("nan") if value is None else float(value)


def certificate_message(messages: Messages, calibration: Calibration) -> Any:
    """Return ``omsm_msgs/CertificateSummary``; NaN for what the certificate does not state."""
    certificate = calibration.certificate
    shape, residual = certificate.structure, certificate.residual
    return messages.make(
        "CertificateSummary",
        id=calibration.id,
        verdict=certificate.verdict or "",
        valid_from=_known(certificate.validity.from_hz),
        valid_up_to=calibration.valid_up_to,
        poles=shape.poles if shape else 0,
        zeros=shape.zeros if shape else 0,
        static_gain=calibration.static_gain,
        static_gain_uncertainty=_known(certificate.static_gain.uncertainty),
        delay=calibration.dynamics.delay,
        lag=calibration.dynamics.low_frequency_delay,
        residual_rms=_known(residual.rms_m),
        noise=_known(residual.noise_m),
        edges=residual.edges or 0,
        reasons=[*map(str, certificate.reasons)],
        reservations=[*map(str, certificate.reservations)],
        warnings=[*map(str, certificate.warnings)],
    )


def account_message(
    messages: Messages,
    account: Account,
    outside: Mapping[str, Mapping[str, int]],
    clouds: int,
    stamp_ns: int,
) -> Any:
    """Return ``omsm_msgs/Account``.

    outside: samples that were not taken for correction: uncalibrated, refused -> stream -> number
    """
    streams = {
        name: messages.make(
            "StreamAccount",
            received=stream.received,
            corrected=stream.corrected,
            pending=stream.pending,
            reasons=[*stream.counted],
            samples=messages.sequence([*stream.counted.values()], np.uint64),
            missing=stream.missing,
            **{reason: counts[name] for reason, counts in outside.items()},
        )
        for name, stream in (("axes", account.axes), ("distance", account.distance))
    }
    return messages.make("Account", header=header(messages, stamp_ns, ""), clouds=clouds, **streams)


def verdict_message(
    messages: Messages,
    verdict: Mapping[str, Any],
    steps: Sequence[str],
    calibration: str,
    accuracy: float | None,
    stamp_ns: int,
) -> Any:
    """Return ``omsm_msgs/Verdict``; steps: what to do next;  accuracy: required [m]."""
    return messages.make(
        "Verdict",
        header=header(messages, stamp_ns, ""),
        code=verdict["code"],
        text=verdict["text"],
        uncertainty=_known(verdict["uncertainty"]),
        accuracy=_known(accuracy),
        calibration=calibration,
        next=[*steps],
    )


def probe_message(messages: Messages, settings: Mapping[str, object], stamp_ns: int) -> Any:
    """Return ``omsm_msgs/ProbeSettings`` of the settings that a probe reports, by name."""
    rest = {name.removeprefix(PROBE): value for name, value in settings.items()}
    fields: dict[str, Any] = {name: str(rest.pop(name, "")) for name in _PROBE_TEXTS}
    for name, (field, unit) in _PROBE_FIELDS.items():
        fields[field] = type(unit)(0) if name == "averaging" else float("nan")
        try:
            fields[field] = type(unit)(float(str(rest[name])) * unit)
        except (KeyError, ValueError, OverflowError):
            continue  # not reported, or in words
        del rest[name]
    other = json.dumps(rest, sort_keys=True)
    return messages.make(
        "ProbeSettings", header=header(messages, stamp_ns, ""), other=other, **fields
    )


def vibration_message(
    messages: Messages, levels: VibrationLevels, alarm: bool, limit: float, head: Any
) -> Any:
    """Return ``omsm_msgs/VibrationLevels``.

    limit: beyond which there is an alarm, rms [m];  head: header of the last block used
    """
    unknown = [float("nan")] * len(levels.bands)
    line = levels.height_line or (float("nan"), float("nan"))
    low, high = zip(*levels.bands, strict=True)
    columns = {"low": low, "high": high, "height": levels.height or unknown}
    columns |= {f"rms_{axis}": values for axis, values in levels.rms.items()}
    return messages.make(
        "VibrationLevels",
        header=head,
        height_total=_known(levels.height_total),
        height_noise=_known(levels.height_noise),
        line_axis=levels.line[0],
        line_frequency=levels.line[1],
        line_amplitude=levels.line[2],
        height_line_frequency=line[0],
        height_line_amplitude=line[1],
        windows=levels.windows,
        alarm=alarm,
        limit=limit,
        **{name: messages.sequence(values, np.float64) for name, values in columns.items()},
    )
