"""May the result be trusted? One word, and every reason against it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.calibration.certificate import REJECTED, Certificate
from omsm_ros.errors import text_of
from omsm_ros.readable import count, percent, quantity
from omsm_ros.report.tables import part

# A map with more holes than this hides something.
_LEAST_SHARE_CORRECTED = 0.95


@dataclass(frozen=True, slots=True)
class PageVerdict:
    """level: "good", "care", "bad" or "unknown";  word: for the reader;  reasons: all of them."""

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
    """Weigh the calibration's certificate, the account of samples, and the warnings.

    Warnings are those of the measurement (``summary["warnings"]``); the certificate's own
    are about the calibration and do not count once it is accepted.
    """
    certificate = calibration.certificate if calibration else Certificate()
    stated = certificate.verdict
    against = _accounting(summary)
    if stated == REJECTED:
        against += ["the calibration was rejected", *map(str, certificate.reasons)]
    if against:
        return PageVerdict("bad", "Not to be trusted", tuple(against))
    warnings = [*map(str, part(summary, "warnings") or ())]
    if light := part(summary, "light"):
        return _of_light(light, warnings)
    doubts = [*warnings, *_losses(summary), *_latency(calibration)]
    if calibration is None or not stated:
        missing = "the calibration has no certificate" if calibration else "no calibration is given"
        return PageVerdict("unknown", "Not judged", (missing, *doubts))
    if doubts:
        return PageVerdict("care", "Trusted with reservations", tuple(doubts))
    return PageVerdict(
        "good",
        "Trusted",
        (f"calibration {verdict_text(calibration)}", "every sample accounted for"),
    )


def _of_light(light: Mapping[str, Any], warnings: Sequence[str]) -> PageVerdict:
    """Return the light of the measurement, amber at best where there are warnings."""
    level = {"green": "good", "amber": "care", "red": "bad"}[light["level"]]
    if warnings and level == "good":
        level = "care"
    word = light["word"][:1].upper() + light["word"][1:]
    reasons = [
        f"{r['what']}: {r['remedy']}" if r["remedy"] else r["what"] for r in light["reasons"]
    ]
    return PageVerdict(level, word, (*warnings, *reasons) or ("every source was looked at",))


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
    """Return what to do about a lag of which nobody knows whether X and C share it."""
    if calibration is None or calibration.latency.resolved:
        return []
    lag = calibration.dynamics.low_frequency_delay
    return [
        f"of the lag of {quantity(lag, 's', 4)} any part may be latency of the probe, by "
        f"which X and C would have to be delayed (lateral_lag in the budget): {text_of('correction.latency_remedy', {})}"
    ]


def _losses(summary: Mapping[str, object]) -> list[str]:
    found = []
    for name, stream in _streams(summary).items():
        lost = stream["received"] - stream["corrected"]
        if lost > (1 - _LEAST_SHARE_CORRECTED) * stream["received"]:
            share = percent(lost / stream["received"])
            found.append(f"{name}: {count(lost)} samples ({share}) gave no point")
    return found
