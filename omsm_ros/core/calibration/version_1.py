"""Certificates of schema "omsm-calibration/1": flat names, findings as sentences."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from omsm_ros.core.calibration.certificate import ACCEPTED, REJECTED, RESERVED, Certificate
from omsm_ros.core.calibration.finding import REJECTS, RESERVATION, TEXT, WARNING
from omsm_ros.core.calibration.typed_json import from_json
from omsm_ros.errors import CalibrationError

# Where an entry of version 1 stands now; a path of two names is a group and its field.
_PLACES = {
    "input": ("origin", "input"),
    "recorded_ns": ("origin", "recorded_ns"),
    "structure": ("structure",),
    "noise_covariance": ("noise_covariance",),
    "consistency": ("consistency",),
    "latency": ("latency",),
    "self_calibration": ("self_calibration",),
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
        name: ("residual", name)
        for name in (
            "noise_m", "chi_square", "edges", "whiteness_p", "independence_p", "timing_scatter_s",
            "axis_timing_scatter_s", "encoder_noise_m", "samples",
        )
    },
    **{
        name: ("response", name)
        for name in (
            "low_frequency_delay_s", "low_frequency_delay_uncertainty_s",
            "inter_sample_delay_bound_s", "reference_lag_s", "reference_lag_uncertainty_s",
            "shape", "modes", "modal_remainder", "two_mass",
        )
    },
    **{name: ("model_errors", name) for name in ("motion_error_m", "backlash_m", "drift_m_s")},
}  # fmt: skip
# The calibration itself has the gain, the structure has the order, and the terms that may be
# undetected tell which is the largest.
_REDUNDANT = {"static_gain", "order", "hidden_mostly"}
_LATENCY_NAMES = {"beside_z_s": "unshared_s"}
_LISTS = {"reasons": REJECTS, "reservations": RESERVATION, "warnings": WARNING}
_READ_APART = {"verdict", "limits", "candidates", "static_gains", *_LISTS}


def certificate_of_version_1(entries: Mapping[str, Any]) -> Certificate:
    """Return the certificate of a file of version 1; raise CalibrationError if it is malformed."""
    content: dict[str, Any] = {"findings": _findings(entries), "further": {}}
    if entries.get("verdict") is not None:
        content["verdict"] = _verdict(entries["verdict"])
    for name, value in entries.items():
        if name in _READ_APART or name in _REDUNDANT or value is None:
            continue
        if name not in _PLACES:
            content["further"][name] = value
            continue
        *group, field = _PLACES[name]
        (content.setdefault(group[0], {}) if group else content)[field] = value
    _add_limits(content, entries.get("limits"))
    _add_candidates(content, entries.get("candidates"))
    for name, gain in (entries.get("static_gains") or {}).items():
        content.setdefault("static_gain", {})[name] = gain
    latency = content.get("latency")
    if isinstance(latency, Mapping):
        content["latency"] = {_LATENCY_NAMES.get(k, k): v for k, v in latency.items()}
    for error in content.get("model_errors", {}).get("modelled", ()):
        error.pop("modelled", None)
    return from_json(Certificate, content, "certificate")


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
    for name, severity in _LISTS.items():
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


def _add_limits(content: dict[str, Any], limits: object) -> None:
    if isinstance(limits, Mapping):
        content["limits"] = dict(limits)
        band = {name: limits[name] for name in ("gain", "phase_rad") if name in limits}
        content["validity"] = content.get("validity", {}) | band


def _add_candidates(content: dict[str, Any], candidates: object) -> None:
    """Add the structures that were tried; one without its numbers is left out."""
    known = (
        [c for c in candidates if isinstance(c, Mapping)] if isinstance(candidates, list) else []
    )
    names = ("poles", "zeros", "delay")
    content["candidates"] = [
        {"structure": {n: c[n] for n in names}, "bic": c["bic"], "rms_m": c["rms_m"]}
        for c in known
        if {*names, "bic", "rms_m"} <= c.keys()
    ]
