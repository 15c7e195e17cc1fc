"""The certificate as a Digital Calibration Certificate (PTB, DCC 3.2.1 with D-SI 2.1 units)."""

from __future__ import annotations

from datetime import datetime, timezone
from typing import NamedTuple

import numpy as np

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.lti.frequency_response import low_frequency_delay_uncertainty, response_band
from omsm_ros.report.page_parts import fill
from omsm_ros.report.verdict import verdict_text
from omsm_ros.units import NANOSECONDS_PER_S

# Shares of the valid band at which gain and phase are stated.
_SHARES = (0.01, 0.1, 0.25, 0.5, 0.75, 1.0)
_UNSTATED = "not stated"


class Quantity(NamedTuple):
    """A result in SI units; ``expanded``: k = 2, None if not evaluated."""

    kind: str
    name: str
    value: float
    unit: str
    expanded: float | None = None


def quantities(calibration: Calibration) -> list[Quantity]:
    """Return lag, static gain, valid range, and gain and phase within it."""
    dynamics, certificate = calibration.dynamics, calibration.certificate
    lag = 2 * low_frequency_delay_uncertainty(dynamics, calibration.covariance)
    spread = certificate.static_gain.uncertainty
    found = [
        Quantity("omsm_lag", "lag at low frequency", dynamics.low_frequency_delay, r"\second", lag),
        Quantity("omsm_gain", "static gain, probe per encoder", calibration.static_gain, r"\one",
                 None if spread is None else 2 * spread),
        Quantity("omsm_valid", "valid up to", calibration.valid_up_to, r"\hertz"),
    ]  # fmt: skip
    at = np.array(_SHARES) * calibration.valid_up_to
    band, response = response_band(dynamics, calibration.covariance, at), dynamics.response(at)
    for k, frequency in enumerate(at.tolist()):
        gain, phase = float(abs(response[k])), float(np.angle(response[k]))
        wide, turned = 2 * float(band.gain[k]), 2 * float(band.phase[k])
        place = f"at {frequency:.6g} Hz"
        found.append(Quantity("omsm_response", f"gain {place}", gain, r"\one", gain * wide))
        found.append(Quantity("omsm_response", f"phase {place}", phase, r"\radian", turned))
    return found


def render_dcc(calibration: Calibration, version: str) -> str:
    """Return the certificate as XML; all text from outside is escaped."""
    origin = calibration.certificate.origin
    now, recorded = datetime.now(timezone.utc), origin.recorded_ns
    when = datetime.fromtimestamp(recorded / NANOSECONDS_PER_S, timezone.utc) if recorded else now
    warm = origin.temperature_c
    return fill(
        "certificate_dcc.xml",
        version=version,
        identity=calibration.id,
        day=when.date().isoformat(),
        machine=_word(origin.machine or str(calibration.settings.get("machine", ""))),
        probe=_word(origin.probe),
        serial=_word(origin.probe_serial_number),
        laboratory=_word(origin.laboratory),
        operator=_word(origin.operator),
        method=_word(origin.method or "step test on a fixed target"),
        verdict=_word(verdict_text(calibration) or "no certificate"),
        temperature=None if warm is None else Quantity(
            "basic_temperature", "temperature", warm, r"\degreeCelsius"),
        quantities=quantities(calibration),
    ).lstrip()  # fmt: skip


def _word(value: str | None) -> str:
    """Return a text without spaces at its ends, which the schema forbids."""
    return " ".join((value or "").split()) or _UNSTATED
