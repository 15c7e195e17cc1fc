"""The verdict on a measurement, with every reason against it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.calibration.certificate import REJECTED, Certificate
from omsm_ros.errors import text_of
from omsm_ros.readable import count, percent, quantity
from omsm_ros.report.tables import part

# With a smaller share of corrected samples the map may miss defects of the surface.
_LEAST_SHARE_CORRECTED = 0.95


@dataclass(frozen=True, slots=True)
class PageVerdict:
    """level: "good", "care", "bad" or "unknown";  word: the verdict as text;  reasons: for it."""

    level: str
    word: str
    reasons: tuple[str, ...]


def verdict_text(calibration: Calibration) -> str:
    """Return the verdict of the certificate and the band that it holds for; empty without one."""
    certificate = calibration.certificate
    if not certificate.accepted:
        return certificate.verdict or ""
    low, high = certificate.validity.from_hz, quantity(calibration.valid_up_to, "Hz")
    start = f"from {quantity(low, 'Hz', 2)} to" if low else "up to"
    return f"{certificate.verdict}, valid {start} {high}"


def verdict_on_measurement(
    summary: Mapping[str, object], calibration: Calibration | None
) -> PageVerdict:
    """Return the verdict from certificate, account of samples, traffic light and warnings.

    Only warnings of the measurement (``summary["warnings"]``) count; those of an accepted
    certificate do not.
    """
    certificate = calibration.certificate if calibration else Certificate()
    stated = certificate.verdict
    against = _accounting(summary)
    if stated == REJECTED:
        against += ["the calibration was rejected", *map(str, certificate.reasons)]
    if against:
        return PageVerdict("bad", "Measurement not valid", tuple(against))
    warnings = [*map(str, part(summary, "warnings") or ())]
    if light := part(summary, "light"):
        return _of_light(light, warnings)
    doubts = [*warnings, *_losses(summary), *_latency(calibration)]
    if calibration is None or not stated:
        missing = "the calibration has no certificate" if calibration else "no calibration is given"
        return PageVerdict("unknown", "Validity not assessed", (missing, *doubts))
    if doubts:
        return PageVerdict("care", "Valid with reservations", tuple(doubts))
    return PageVerdict(
        "good",
        "Valid",
        (f"calibration {verdict_text(calibration)}", "every sample accounted for"),
    )


def _of_light(light: Mapping[str, Any], warnings: Sequence[str]) -> PageVerdict:
    """Return the verdict by the traffic light; with warnings at most amber."""
    level = {"green": "good", "amber": "care", "red": "bad"}[light["level"]]
    if warnings and level == "good":
        level = "care"
    word = light["word"][:1].upper() + light["word"][1:]
    reasons = [
        f"{r['what']}: {r['remedy']}" if r["remedy"] else r["what"] for r in light["reasons"]
    ]
    return PageVerdict(level, word, (*warnings, *reasons) or ("every source was evaluated",))


def _streams(summary: Mapping[str, object]) -> Mapping[str, Any]:
    return part(summary, "samples") or {}


def _accounting(summary: Mapping[str, object]) -> list[str]:
    found = []
    for name, stream in _streams(summary).items():
        seen = stream["corrected"] + stream.get("pending", 0) + sum(stream["counted"].values())
        if seen != stream["received"]:
            found.append(f"{name}: {count(abs(stream['received'] - seen))} samples unaccounted for")
    return found


def _latency(calibration: Calibration | None) -> list[str]:
    """Return the remedy for a lag of unknown origin, mechanical or latency."""
    if calibration is None or calibration.latency.resolved:
        return []
    lag = calibration.dynamics.low_frequency_delay
    remedy = text_of("correction.latency_remedy", {})
    return [
        f"the share of probe latency in the lag of {quantity(lag, 's', 4)} is unknown; X and C "
        f"must be delayed by it (probe_latency in the budget): {remedy}"
    ]


def _losses(summary: Mapping[str, object]) -> list[str]:
    found = []
    for name, stream in _streams(summary).items():
        lost = stream["received"] - stream["corrected"]
        if lost > (1 - _LEAST_SHARE_CORRECTED) * stream["received"]:
            share = percent(lost / stream["received"])
            found.append(f"{name}: {count(lost)} samples ({share}) gave no point")
    return found
