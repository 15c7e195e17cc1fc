"""The numbers of a certificate as rows of text, with units and uncertainties.

Certificates of older versions lack entries; a row that would have no number is left out.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from omsm_ros.core.calibration.calibration import RECORDED, SCHEMA, Calibration
from omsm_ros.readable import (
    NOTHING,
    count,
    date_text_of_stamp,
    measured,
    number,
    plain,
    probability,
    quantity,
    superscript,
)
from omsm_ros.report.tables import Table, mapping_table, part
from omsm_ros.units import PPM

# Where a p-value is called small.
_SIGNIFICANT = 0.01
# Coefficients are far more correlated than uncertain: to be of use they need their digits.
_ALL_DIGITS = 10
_SHOWN = {
    "order", "structure", "candidates", "chi_square",
    "residual_rms_m", "noise_m", "edges", "whiteness_p", "independence_p",
    "low_frequency_delay_s", "low_frequency_delay_uncertainty_s", "inter_sample_delay_bound_s",
    "modes", "static_gain", "static_gain_uncertainty", "polarity", "drift_m_s", "backlash_m",
    "shape", "modal_remainder", "two_mass", "static_gains", "nonparametric_agreement", "samples",
    "warnings", "reasons", "verdict", "limits", "input", "shown_up_to_hz",
    "valid_from", "departures", "could_hide", "hidden_mostly", "plateau_s", "assumed",
    "motion_error_m", "reservations", "timing_scatter_s", "axis_timing_scatter_s",
    "encoder_noise_m",
    "noise_covariance", "gain_above_rest_u", "plateau_that_would_tell_s", "reference_lag_s",
    "reference_lag_uncertainty_s", "latency", "consistency", RECORDED,
}  # fmt: skip

CertificateEntries = Mapping[str, Any]


def listed(certificate: CertificateEntries, name: str) -> list[Mapping[str, Any]]:
    """Return the mappings in a list of the certificate; none if there is no such list."""
    entries = certificate.get(name)
    return [e for e in entries if isinstance(e, Mapping)] if isinstance(entries, list) else []


def texts(certificate: CertificateEntries, name: str) -> list[str]:
    """Return the texts of a list of the certificate."""
    entries = certificate.get(name)
    return [str(entry) for entry in entries] if isinstance(entries, list) else []


def structure_text(structure: Mapping[str, Any]) -> str:
    """Return ``2 poles, 1 zero, no delay``."""
    counts = [(structure.get("poles"), "pole"), (structure.get("zeros"), "zero")]
    parts = [f"{n} {name}{'' if n == 1 else 's'}" for n, name in counts if isinstance(n, int)]
    if isinstance(structure.get("delay"), bool):
        parts.append("delay" if structure["delay"] else "no delay")
    return ", ".join(parts) or NOTHING


def own_structure(calibration: Calibration) -> dict[str, object]:
    """Return the structure of the coefficients themselves, whatever the certificate says of it."""
    dynamics = calibration.dynamics
    return {
        "poles": len(dynamics.denominator) - 1,
        "zeros": len(dynamics.numerator) - 1,
        "delay": dynamics.delay > 0,
    }


def residual_table(certificate: CertificateEntries) -> Table:
    """Return what the model leaves that it should have explained, if anything."""
    white, free = (number(certificate.get(f"{n}_p")) for n in ("whiteness", "independence"))
    rows = [
        (
            "χ² where the axis moves",
            plain(certificate.get("chi_square")),
            "1 if only noise is left",
        ),
        ("residual, rms", quantity(certificate.get("residual_rms_m"), "m"), "everywhere"),
        ("noise of one reading", quantity(certificate.get("noise_m"), "m"), "where the axis rests"),
        (
            "whiteness, p",
            probability(white),
            _in_words(white, "white", "coloured; the uncertainties allow for it"),
        ),
        (
            "independence of the motion, p",
            probability(free),
            _in_words(free, "does not follow the motion", "follows the motion: dynamics missing"),
        ),
        (
            "χ² against the estimate without a model",
            plain(certificate.get("nonparametric_agreement")),
            "about 1 if the two agree",
        ),
        (
            "shown up to",
            quantity(certificate.get("shown_up_to_hz"), "Hz"),
            "beyond it the motion would show no deviation as large as the limits",
        ),
        ("edges", count(certificate.get("edges")), ""),
    ]
    return Table("Tests of the residual", ("", "in words"), known_rows(rows, 1))


def _in_words(p: float | None, good: str, bad: str) -> str:
    return "" if p is None else bad if p < _SIGNIFICANT else good


def order_table(certificate: CertificateEntries) -> Table:
    """Return every structure that was tried."""
    candidates = sorted(listed(certificate, "candidates"), key=structure_text)
    scores = [number(c.get("bic")) for c in candidates]
    least = min((s for s in scores if s is not None), default=0.0)
    rows = [
        (
            structure_text(candidate),
            NOTHING if score is None else f"{score - least:.1f}",
            quantity(candidate.get("rms_m"), "m", 5),
            _remark(candidate, score == least, certificate),
        )
        for candidate, score in zip(candidates, scores, strict=True)
    ]
    columns = ("BIC above lowest", "residual, rms", "")
    return Table("Candidates", columns, rows)


def _remark(candidate: Mapping[str, Any], lowest: bool, certificate: CertificateEntries) -> str:
    remarks = ["lowest BIC"] if lowest else []
    if is_chosen(candidate, certificate):
        remarks.append("✓ chosen")
    return ", ".join(remarks)


def is_chosen(candidate: Mapping[str, Any], certificate: CertificateEntries) -> bool:
    """Return True for the candidate whose structure the certificate gives as its own."""
    structure = certificate.get("structure")
    return isinstance(structure, Mapping) and all(
        candidate.get(key) == structure.get(key) for key in ("poles", "zeros", "delay")
    )


_GAINS = {
    "probe_per_encoder": "probe per encoder, at rest",
    "probe_per_reference": "probe per reference, at rest",
    "reference_per_encoder": "reference per encoder, at rest",
}


def gain_table(calibration: Calibration) -> Table:
    """Return the static gains: the probe's scale, or the encoder's? And how far each is from 1."""
    certificate = calibration.certificate
    spread = certificate.get("static_gain_uncertainty")
    rows = [_gain_row("probe per encoder, fitted", calibration.static_gain, spread)]
    for key, name in _GAINS.items():
        gain = part(certificate, "static_gains", key) or {}
        value, spread = part(gain, "value"), part(gain, "uncertainty")
        rows.append(_gain_row(name, value, spread))
    return Table("Static gain", ("travel per travel", "from 1 [ppm]"), known_rows(rows, 1))


def _gain_row(name: str, value: object, uncertainty: object) -> tuple[str, ...]:
    known, spread = number(value), number(uncertainty)
    if known is None:
        return (name, NOTHING, NOTHING)
    off = measured((known - 1) / PPM, None if spread is None else spread / PPM)
    return (name, measured(known, spread, digits=6), off)


_POLARITIES = {1: "falls when Z rises", -1: "rises when Z rises"}


def background_table(certificate: CertificateEntries) -> Table:
    """Return what the probe saw besides the motion."""
    polarity = certificate.get("polarity")
    rows = [
        ("drift", quantity(certificate.get("drift_m_s"), "m/s")),
        ("backlash", _or_none(certificate.get("backlash_m"), "m")),
        (
            "lag that motion between samples may hide, at most",
            _or_none(certificate.get("inter_sample_delay_bound_s"), "s"),
        ),
        ("lag of the reference sensor", quantity(certificate.get("reference_lag_s"), "s")),
        ("distance", _POLARITIES.get(polarity, NOTHING) if isinstance(polarity, int) else NOTHING),
    ]
    return Table("Besides the motion", (), known_rows(rows, 1))


def _or_none(value: object, unit: str) -> str:
    return "none found" if number(value) == 0 else quantity(value, unit)


def model_error_table(certificate: CertificateEntries) -> Table:
    """Return what departs from a linear, steady response, and was modelled."""
    rows = [
        (
            str(entry.get("family", NOTHING)),
            quantity(entry.get("size_m"), "m"),
            quantity(entry.get("uncertainty_m"), "m"),
            str(entry.get("modelled", NOTHING)),
        )
        for entry in listed(certificate, "departures")
    ]
    if rows:
        together = quantity(certificate.get("motion_error_m"), "m")
        rows.append(("together, on a height", together, "", ""))
    return Table("Found beside a steady linear response", ("size", "u", "modelled"), rows)


def consistency_table(certificate: CertificateEntries) -> Table:
    """Return what differs between the parts of the test, the first less the second."""
    rows = [
        (
            str(entry.get("parts", NOTHING)),
            measured(entry.get("lag_difference_s"), entry.get("lag_difference_uncertainty_s"), "s"),
            measured(
                _ppm(entry.get("gain_difference")), _ppm(entry.get("gain_difference_uncertainty"))
            ),
            probability(entry.get("p")),
        )
        for entry in listed(certificate, "consistency")
    ]
    columns = ("lag differs by", "gain differs by [ppm]", "p, by chance")
    return Table("Do the parts of the test agree?", columns, rows)


def _ppm(value: object) -> float | None:
    known = number(value)
    return None if known is None else known / PPM


def coefficient_table(calibration: Calibration) -> Table:
    """Return G_m itself (Eq. 11), with standard uncertainties from the covariance's diagonal."""
    dynamics = calibration.dynamics
    spread = np.sqrt(np.diag(calibration.covariance))
    names = [_power("n", k) for k in range(len(dynamics.numerator))]
    names += [_power("d", k) for k in range(1, len(dynamics.denominator))]
    values = [*dynamics.numerator, *dynamics.denominator[1:]]
    values.append(dynamics.delay)
    rows = [
        (name, plain(float(value), _ALL_DIGITS), plain(float(u), 2))
        if u
        else (name, f"{float(value):.{_ALL_DIGITS}g}", "fixed")
        for name, value, u in zip([*names, "delay [s]"], values, spread, strict=True)
    ]
    columns = ("value", "standard uncertainty")
    return Table("Coefficients of Eq. 11, ascending powers of s", columns, rows)


def _power(letter: str, k: int) -> str:
    unit = f"s{superscript(k)}" if k > 1 else "s" if k else "1"
    return f"{letter}{k} [{unit}]"


def sample_account(certificate: CertificateEntries) -> Table:
    """Return what became of every sample."""
    account = certificate.get("samples")
    rows = [
        (str(reason).replace("_", " "), count(value))
        for reason, value in (account.items() if isinstance(account, Mapping) else ())
    ]
    return Table("Samples", (), rows)


_LIMITS = (
    ("95 % band of the gain, half-width, at most", "gain", ""),
    ("95 % band of the phase, half-width, at most", "phase_rad", "rad"),
    ("χ² where the axis moves, at least", "chi_square_least", ""),
    ("χ² where the axis moves, at most", "chi_square_greatest", ""),
    ("trusted band, to at least", "valid_up_to_least_hz", "Hz"),
)


def limit_table(certificate: CertificateEntries) -> Table:
    """Return what the verdict was measured against."""
    rows = [
        (
            name,
            plain(part(certificate, "limits", key))
            if not unit
            else quantity(part(certificate, "limits", key), unit),
        )
        for name, key, unit in _LIMITS
    ]
    source = certificate.get("input")
    rows.append(("motion taken from", source if isinstance(source, str) else NOTHING))
    return Table("Limits of the verdict", (), known_rows(rows, 1))


def identity_table(calibration: Calibration, source: str, version: str) -> Table:
    """Return what the certificate is about."""
    rows = [
        ("identity", calibration.id),
        ("schema", SCHEMA),
        ("recording", source or NOTHING),
        ("recorded", date_text_of_stamp(calibration.certificate.get(RECORDED))),
        ("sample period", quantity(calibration.sample_period, "s", 4)),
        ("half the sampling rate", quantity(0.5 / calibration.sample_period, "Hz", 4)),
        ("omsm_ros", version or NOTHING),
    ]
    return Table("Identity", (), known_rows(rows, 1))


def further_table(certificate: CertificateEntries) -> Table:
    """Return the entries that have no other place on the page."""
    rest = {str(key): value for key, value in certificate.items() if key not in _SHOWN}
    return mapping_table("Further entries", rest)


def known_rows(rows: Iterable[tuple[str, ...]], column: int) -> Sequence[tuple[str, ...]]:
    """Return the rows that have something in ``column``."""
    return [row for row in rows if row[column] != NOTHING]
