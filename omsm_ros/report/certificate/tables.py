"""The numbers of a certificate: as rows of text with units and uncertainties, and as XML (DCC).

A row without a number is left out.
"""

from collections.abc import Mapping
from datetime import datetime, timezone
from typing import Any, NamedTuple

import numpy as np

from omsm_ros.core.calibration.calibration import SCHEMA, Calibration
from omsm_ros.core.lti.frequency_response import low_frequency_delay_uncertainty, response_band
from omsm_ros.core.lti.modes import KnownMode, known_modes
from omsm_ros.core.lti.transfer_function import Structure
from omsm_ros.core.model_errors.families import CREEP, MODE
from omsm_ros.readable import (
    NOTHING,
    count,
    date_text_of_stamp,
    measured,
    percent,
    plain,
    probability,
    quantity,
    superscript,
)
from omsm_ros.report.page_parts import fill
from omsm_ros.report.tables import Table, known_rows
from omsm_ros.report.verdict import verdict_text
from omsm_ros.units import MILLISECOND_S, NANOSECONDS_PER_S, PPM

# Where a p-value is called small.
_SIGNIFICANT = 0.01
# Coefficients are far more correlated than uncertain: to be of use they need their digits.
_ALL_DIGITS = 10


def texts(content: Mapping[str, Any], name: str) -> list[str]:
    """Return the texts of a list of a model's certificate."""
    entries = content.get(name)
    return [str(entry) for entry in entries] if isinstance(entries, list) else []


def structure_text(structure: Structure) -> str:
    """Return ``2 poles, 1 zero, no delay``."""
    counts = ((structure.poles, "pole"), (structure.zeros, "zero"))
    parts = [f"{n} {name}{'' if n == 1 else 's'}" for n, name in counts]
    return ", ".join([*parts, "delay" if structure.delay else "no delay"])


def residual_table(calibration: Calibration) -> Table:
    """Return the tests of the residual."""
    certificate = calibration.certificate
    found = certificate.residual
    rows = [
        ("χ² where the axis moves", plain(found.chi_square), "1 if only noise is left"),
        ("residual, rms", quantity(found.rms_m, "m"), "everywhere"),
        ("noise of one reading", quantity(found.noise_m, "m"), "where the axis rests"),
        (
            "whiteness, p",
            probability(found.whiteness_p),
            _in_words(found.whiteness_p, "white", "coloured; the uncertainties allow for it"),
        ),
        (
            "independence of the motion, p",
            probability(found.independence_p),
            _in_words(
                found.independence_p,
                "does not follow the motion",
                "follows the motion: dynamics missing",
            ),
        ),
        (
            "χ² against the estimate without a model",
            plain(found.response_agreement),
            "about 1 if the two agree",
        ),
        (
            "excited up to",
            quantity(certificate.validity.excited_up_to_hz, "Hz"),
            "beyond it the motion would show no deviation as large as the limits",
        ),
        ("edges", count(found.edges), ""),
    ]
    return Table("Tests of the residual", ("", "meaning"), known_rows(rows), prose="meaning")


def _in_words(p: float | None, good: str, bad: str) -> str:
    return "" if p is None else bad if p < _SIGNIFICANT else good


def order_table(calibration: Calibration) -> Table:
    """Return every structure that was tried."""
    certificate = calibration.certificate
    candidates = sorted(certificate.candidates, key=lambda c: structure_text(c.structure))
    least = min((c.bic for c in candidates), default=0.0)
    rows = []
    for one in candidates:
        remarks = ["lowest BIC"] * (one.bic == least)
        remarks += ["✓ chosen"] * (one.structure == certificate.structure)
        size = quantity(one.rms_m, "m", 5)
        text = structure_text(one.structure)
        rows.append((text, f"{one.bic - least:.1f}", size, ", ".join(remarks)))
    return Table("Candidates", ("BIC above lowest", "residual, rms", ""), rows)


def gain_table(calibration: Calibration) -> Table:
    """Return the static gains of probe, encoder and reference, and their deviation from 1."""
    found = calibration.certificate.static_gain
    rows = [_gain_row("probe per encoder, fitted", calibration.static_gain, found.uncertainty)]
    for name, gain in (
        ("probe per encoder, plateaus", found.probe_per_encoder),
        ("probe per reference, plateaus", found.probe_per_reference),
        ("reference per encoder, plateaus", found.reference_per_encoder),
    ):
        if gain is not None:
            rows.append(_gain_row(name, gain.value, gain.uncertainty))
    return Table("Static gain", ("travel per travel", "from 1 [ppm]"), rows)


def _gain_row(name: str, value: float, spread: float | None) -> tuple[str, ...]:
    off = measured((value - 1) / PPM, None if spread is None else spread / PPM)
    return (name, measured(value, spread, digits=6), off)


_POLARITIES = {1: "falls when Z rises", -1: "rises when Z rises"}


def background_table(calibration: Calibration) -> Table:
    """Return what the readings contain besides the motion."""
    certificate = calibration.certificate
    errors, response = certificate.model_errors, certificate.response
    polarity = certificate.static_gain.polarity
    rows = [
        ("drift", quantity(errors.drift_m_s, "m/s")),
        ("backlash", _or_none(errors.backlash_m, "m")),
        (
            "greatest bias of the lag by motion between samples",
            _or_none(response.inter_sample_delay_bound_s, "s"),
        ),
        ("lag of the reference sensor", quantity(response.reference_lag_s, "s")),
        ("distance", NOTHING if polarity is None else _POLARITIES.get(polarity, NOTHING)),
    ]
    return Table("Drift, backlash and direction", (), known_rows(rows))


def _or_none(value: float | None, unit: str) -> str:
    return "none found" if value == 0 else quantity(value, unit)


def model_error_table(calibration: Calibration) -> Table:
    """Return the deviations from a linear, steady response that were modelled."""
    found = calibration.certificate.model_errors
    rows = [
        (
            error.family,
            quantity(error.size_m, "m"),
            quantity(error.uncertainty_m, "m"),
            "in the response" if error.size_m is None else "as a nuisance term",
        )
        for error in found.modelled
    ]
    if rows:
        rows.append(("together, on a height", quantity(found.motion_error_m, "m"), "", ""))
    return Table("Found in addition to a linear, steady response", ("size", "u", "modelled"), rows)


def consistency_table(calibration: Calibration) -> Table:
    """Return the differences between the parts of the test, the first less the second."""
    rows = [
        (
            part.parts,
            measured(part.lag_difference_s, part.lag_difference_uncertainty_s, "s"),
            measured(_ppm(part.gain_difference), _ppm(part.gain_difference_uncertainty)),
            probability(part.p),
        )
        for part in calibration.certificate.consistency
    ]
    columns = ("lag differs by", "gain differs by [ppm]", "p, by chance")
    return Table("Agreement of the parts of the test", columns, rows)


def _ppm(value: float | None) -> float | None:
    return None if value is None else value / PPM


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


_LIMITS = (
    ("95 % band of the gain, half-width, at most", "gain", ""),
    ("95 % band of the phase, half-width, at most", "phase_rad", "rad"),
    ("χ² where the axis moves, at least", "chi_square_least", ""),
    ("χ² where the axis moves, at most", "chi_square_greatest", ""),
    ("valid range, to at least", "valid_up_to_least_hz", "Hz"),
    ("delay that is harmless on the intended scan", "harmless_delay_s", "s"),
    ("share of hidden parts accounted for, at least", "predicted_least", ""),
)


def limit_rows(limits: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return names and values of the limits of a calibration or model."""
    return [
        (name, quantity(limits.get(key), unit) if unit else plain(limits.get(key)))
        for name, key, unit in _LIMITS
    ]


def limit_table(calibration: Calibration) -> Table:
    """Return what the verdict was measured against."""
    certificate = calibration.certificate
    rows, use = limit_rows(certificate.limits), certificate.validity.use
    rows.append(("motion taken from", certificate.origin.input or NOTHING))
    if use is not None:
        highest = quantity(use.highest_hz, "Hz")
        rows.append(("intended scan", f"{quantity(use.speed_m_s, 'm/s')} rms, up to {highest}"))
        rows.append(("accuracy asked for, k = 2", quantity(use.accuracy_m, "m")))
    return Table("Limits of the verdict", (), known_rows(rows))


def identity_table(calibration: Calibration, source: str, version: str) -> Table:
    """Return identity and recording; the title block has machine, instruments and people."""
    origin = calibration.certificate.origin
    rows = [
        ("identity", calibration.id),
        ("schema", SCHEMA),
        ("recording", source or NOTHING),
        ("recorded", date_text_of_stamp(origin.recorded_ns)),
        ("sample period", quantity(calibration.sample_period, "s", 4)),
        ("half the sampling rate", quantity(0.5 / calibration.sample_period, "Hz", 4)),
        ("software", origin.software or NOTHING),
        ("made from", origin.made_from or NOTHING),
        ("omsm_ros", version or NOTHING),
    ]
    return Table("Identity", (), known_rows(rows))


def mode_table(calibration: Calibration) -> Table:
    """Return the poles as terms of Eq. 8, and whether the band reaches them."""
    modes = known_modes(calibration.dynamics, calibration.covariance)
    rows = [
        (
            f"mode {index}" if mode.residue is not None else f"real pole {index}",
            *_resolved(mode, calibration),
            "yes" if mode.frequency <= calibration.valid_up_to else "no",
        )
        for index, mode in enumerate(modes, start=1)
    ]
    columns = ("frequency", "damping ratio", "residue [1/ms²]", "within the valid range")
    return Table("Modes (Eq. 8)", columns, rows)


def _resolved(mode: KnownMode, calibration: Calibration) -> tuple[str, str, str]:
    """Return frequency, damping and residue; a pole beyond the sampling rate is not resolved."""
    known, fastest = calibration.valid_up_to, 1 / calibration.sample_period
    if mode.frequency > known and mode.frequency_uncertainty >= mode.frequency:
        fastest = known
    if mode.frequency > fastest:
        return f"not resolved (faster than {quantity(fastest, 'Hz')})", "unknown", "unknown"
    frequency = measured(mode.frequency, mode.frequency_uncertainty, "Hz")
    if mode.residue is None or mode.residue_uncertainty is None:
        return frequency, "1, by definition", "none"
    residue, spread = (v * MILLISECOND_S**2 for v in (mode.residue, mode.residue_uncertainty))
    damping = measured(mode.damping, mode.damping_uncertainty)
    return frequency, damping, measured(residue, spread)


_MECHANICAL_UNITS = {"m1": "kg", "m2": "kg", "k1": "N/m", "k2": "N/m", "c1": "N·s/m", "c2": "N·s/m"}
_UNITS_PER_MASS = {
    "m2": "",
    "k1": "N/(m·kg)",
    "k2": "N/(m·kg)",
    "c1": "N·s/(m·kg)",
    "c2": "N·s/(m·kg)",
}
_PROBE_ON = {False: "second mass, not the driven one (Eq. 7)", True: "driven mass (collocated)"}


def two_mass_table(calibration: Calibration) -> Table:
    """Return masses, springs and dampers, or each per mass of the table where that is not known."""
    title, found = "Two-mass model (Eq. 6, 7)", calibration.certificate.response.two_mass
    if found is None:
        return Table(title, (), [])
    absolute = found.table_mass_kg is not None
    rows = []
    for name, unit in (_MECHANICAL_UNITS if absolute else _UNITS_PER_MASS).items():
        value = found.model[name]
        text = measured(value, found.relative_uncertainty.get(name, 0.0) * value, unit)
        rows.append((name if absolute else f"{name} / m1", text + ", as given" * (name == "m1")))
    rows += [
        ("probe on the", _PROBE_ON[found.collocated]),
        ("misfit, over the stated uncertainty", plain(found.misfit)),
    ]
    return Table(title if absolute else f"{title}, per mass of the table", (), rows)


_SHAPE_ROWS = (
    ("gain differs from 1 by 1 %", "bandwidth_1_percent", None),
    ("gain differs from 1 by 3 dB", "bandwidth_3db", None),
    ("highest peak of the gain", "resonance", "resonance_gain"),
    ("lowest dip of the gain", "minimum", "minimum_gain"),
)


def shape_table(calibration: Calibration) -> Table:
    """Return the salient points of the identified response, and whether the band reaches them."""
    found, trusted = calibration.certificate.response, calibration.valid_up_to
    rows = []
    for name, place, gain in _SHAPE_ROWS:
        at = found.shape.get(place)
        if at is not None:
            size = "" if gain is None else f"{plain(found.shape.get(gain), 4)} at "
            rows.append((name, size + quantity(at, "Hz"), "yes" if at <= trusted else "no"))
    if found.modal_remainder is not None:
        remainder = percent(found.modal_remainder)
        rows.append(("share of the greatest gain that Eq. 8 lacks", remainder, "yes"))
    return Table("Shape of the response", ("", "within the valid range"), rows)


def undetected_table(calibration: Calibration) -> Table:
    """Return the model errors that this test could not detect, and what they cost on a scan."""
    found = calibration.certificate.undetected
    rows = []
    for term in found.terms:
        family, size = term.family, quantity(term.missed, "m")
        if term.missed is not None and family in (CREEP, MODE):
            size = f"{percent(term.missed)} of the motion"
        if family == CREEP:
            family += f" over {quantity(term.parameter, 's', 2)}"
        elif family == MODE:
            family += f" at {quantity(term.parameter, 'Hz', 2)}"
        effects = (quantity(v, "m") for v in (term.missed_effect_on_scan_m, term.effect_on_scan_m))
        rows.append((family, size, *effects))
    further = (
        ("dwell that would show the slowest creep", quantity(found.plateau_needed_s, "s")),
        ("assumed: no relaxation slower than", quantity(found.slowest_creep_s, "s")),
        ("assumed: no mode below", quantity(found.lowest_mode_hz, "Hz", 2)),
    )
    rows += [(name, value, "", "") for name, value in known_rows(further)]
    columns = ("largest undetected size", "its rms on the intended scan", "part of the band")
    return Table("Undetected model errors", columns, rows)


DCC_UNITS = {r"\second": "s", r"\one": "", r"\hertz": "Hz", r"\radian": "rad"}
# Shares of the valid band at which gain and phase are stated.
_DCC_SHARES = (0.01, 0.1, 0.25, 0.5, 0.75, 1.0)
UNSTATED = "not stated"
_ENCODER = (
    "Lengths are those of the encoder of Z. Its traceability is not part of this certificate."
)


class Quantity(NamedTuple):
    """A result in SI units; ``expanded``: k = 2, None if not evaluated."""

    kind: str
    name: str
    value: float
    unit: str
    expanded: float | None = None


def dcc_quantities(calibration: Calibration) -> list[Quantity]:
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
    at = np.array(_DCC_SHARES) * calibration.valid_up_to
    band, response = response_band(dynamics, calibration.covariance, at), dynamics.response(at)
    for k, frequency in enumerate(at.tolist()):
        gain, phase = float(abs(response[k])), float(np.angle(response[k]))
        expanded, turned = 2 * float(band.gain[k]), 2 * float(band.phase[k])
        place = f"at {frequency:.6g} Hz"
        found.append(Quantity("omsm_response", f"gain {place}", gain, r"\one", gain * expanded))
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
        customer=_word(origin.customer),
        operator=_word(origin.operator),
        traceability=_word(origin.traceability or _ENCODER),
        method=_word(origin.method or "step test on a fixed target"),
        verdict=_word(verdict_text(calibration) or "no certificate"),
        temperature=None if warm is None else Quantity(
            "basic_temperature", "temperature", warm, r"\degreeCelsius"),
        quantities=dcc_quantities(calibration),
    ).lstrip()  # fmt: skip


def _word(value: str | None) -> str:
    """Return a text without spaces at its ends, which the schema forbids."""
    return " ".join((value or "").split()) or UNSTATED
