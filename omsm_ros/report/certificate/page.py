"""The certificate of a calibration as a page to file: HTML in one piece."""

from datetime import datetime, timezone
from typing import NamedTuple

import numpy as np

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.calibration.certificate import REJECTED, Certificate, to_json
from omsm_ros.core.identification.fitted_record import FittedRecord
from omsm_ros.core.lti.frequency_response import (
    COVERAGE_FACTOR,
    low_frequency_delay_uncertainty,
    response_band,
)
from omsm_ros.core.lti.modes import KnownMode, known_modes
from omsm_ros.core.model_errors.families import CREEP, MODE
from omsm_ros.readable import NOTHING, measured, percent, plain, quantity
from omsm_ros.report import style
from omsm_ros.report.certificate import figures as certificate_figures
from omsm_ros.report.certificate import tables
from omsm_ros.report.certificate.tables import known_rows
from omsm_ros.report.page_parts import Headline, Issue, Section, fill, picture, present, title_block
from omsm_ros.report.response_figures import step_response
from omsm_ros.report.tables import Table, latency_text, mapping_table
from omsm_ros.report.verdict import PageVerdict, verdict_text
from omsm_ros.units import DEGREE_RAD, MILLISECOND_S, NANOSECONDS_PER_S, PPM


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
    return (measured(mode.frequency, mode.frequency_uncertainty, "Hz"), *_oscillation(mode))


def _oscillation(mode: KnownMode) -> tuple[str, str]:
    if mode.residue is None or mode.residue_uncertainty is None:
        return "1, by definition", "none"
    residue, spread = (v * MILLISECOND_S**2 for v in (mode.residue, mode.residue_uncertainty))
    return measured(mode.damping, mode.damping_uncertainty), measured(residue, spread)


_MECHANICAL_UNITS = {"m1": "kg", "m2": "kg", "k1": "N/m", "k2": "N/m", "c1": "N·s/m", "c2": "N·s/m"}
_UNITS_PER_MASS = {
    "m2": "",
    "k1": "N/(m·kg)",
    "k2": "N/(m·kg)",
    "c1": "N·s/(m·kg)",
    "c2": "N·s/(m·kg)",
}
_PROBE_ON = {False: "second mass, not the driven one (Eq. 7)", True: "driven mass (collocated)"}


def two_mass_table(certificate: Certificate) -> Table:
    """Return masses, springs and dampers, or each per mass of the table where that is not known."""
    found, title = certificate.response.two_mass, "Two-mass model (Eq. 6, 7)"
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


def undetected_table(certificate: Certificate) -> Table:
    """Return the model errors that this test could not detect, and what they cost on a scan."""
    found = certificate.undetected
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
    rows += [(name, value, "", "") for name, value in known_rows(further, 1)]
    columns = ("largest undetected size", "its rms on the intended scan", "part of the band")
    return Table("Undetected model errors", columns, rows)


BAND = "band"
CAPTIONS = {
    BAND: (
        "Gain, phase, and the error of a sinusoidal motion before and after the correction. "
        "Grey: outside of the valid range."
    ),
    "step": "The steepest move: input, output, and the residual of the model.",
    "residual": (
        "The residual over the whole recording, at the edges on top of each other "
        "(downward ones turned over), and from sample to sample."
    ),
    "order": ("Each candidate is a structure that was fitted to the same samples."),
}
_CLOSING = (
    "On a fixed target the probe reads offset + drift ∓ static gain · G_m z, with G_m(0) = 1 and z "
    "from the encoder. The sign is − where the distance falls when Z rises, else +. "
    "After ± stands the standard uncertainty, k = 1; bands are 95 %."
)


def certificate_figures_of(calibration: Calibration, fitted: FittedRecord) -> dict[str, bytes]:
    """Return PNG files for the page."""
    certificate = calibration.certificate
    # Matplotlib leaves gaps at NaN, an edge's median does not.
    bridged = np.where(np.isfinite(fitted.output), fitted.output, fitted.modelled)
    made = {
        BAND: certificate_figures.response_with_band(calibration, fitted.measured),
        "step": step_response(fitted.time, fitted.input, bridged, fitted.modelled),
        "residual": certificate_figures.residual(fitted, certificate.residual.noise_m),
    }
    if certificate.candidates:
        made["order"] = certificate_figures.order(certificate.candidates, certificate.structure)
    return {name: style.png(figure) for name, figure in made.items()}


def render(calibration: Calibration, issue: Issue) -> str:
    """Return the page as HTML; all text from outside is escaped."""
    origin = calibration.certificate.origin
    return fill(
        "certificate.html",
        heading="Calibration certificate",
        issued=issue.line(calibration.id[:16]),
        closing=f"{_CLOSING} Calibration {calibration.id}.",
        figures=issue.figures,
        verdict=verdict_on_calibration(calibration),
        headlines=headlines(calibration),
        sections=sections(calibration, issue),
        block=title_block(to_json(origin)),
        signer=origin.operator or "",
        band=BAND,
        picture=lambda name: picture(issue.figures[name]),
        caption=CAPTIONS.__getitem__,
    )


def verdict_on_calibration(calibration: Calibration) -> PageVerdict:
    """Return the verdict of the certificate, and its reasons."""
    certificate = calibration.certificate
    reasons = tuple(map(str, certificate.reasons))
    if certificate.verdict == REJECTED:
        return PageVerdict("bad", "Rejected", reasons or ("no reason is given",))
    if certificate.verdict is None:
        return PageVerdict("unknown", "Not judged", ("the calibration has no certificate",))
    kept = tuple(map(str, certificate.reservations))
    stated = verdict_text(calibration)
    grounds = (*reasons, *kept, *_verdict_reasons(calibration))
    return PageVerdict("care" if kept else "good", stated[:1].upper() + stated[1:], grounds)


def _verdict_reasons(calibration: Calibration) -> list[str]:
    certificate, found = calibration.certificate, []
    if certificate.residual.chi_square is not None:
        found.append(
            "where the axis moves, only noise is left "
            f"(χ² = {plain(certificate.residual.chi_square)})"
        )
    if np.any(calibration.covariance):
        top = quantity(calibration.valid_up_to, "Hz")
        found.append(f"up to {top} the 95 % band is within {_band_text(calibration)}")
    delay_bound = certificate.response.inter_sample_delay_bound_s
    if delay_bound is not None:
        found.append(
            f"bias of the lag by motion between samples: at most {quantity(delay_bound, 's', 2)}"
            if delay_bound
            else "no bias of the lag by motion between samples"
        )
    return found


def _band_text(calibration: Calibration) -> str:
    at = np.geomspace(1e-3, 1.0, 200) * calibration.valid_up_to
    band = response_band(calibration.dynamics, calibration.covariance, at)
    gain, phase = (COVERAGE_FACTOR * float(np.max(part)) for part in (band.gain, band.phase))
    return f"±{percent(gain)} in gain and ±{plain(phase / DEGREE_RAD, 2)}° in phase"


def headlines(calibration: Calibration) -> list[Headline]:
    """Return the numbers that a reader looks for first, those that are known."""
    return [h for h in _all_headlines(calibration) if h.value != NOTHING]


def _all_headlines(calibration: Calibration) -> list[Headline]:
    certificate, dynamics = calibration.certificate, calibration.dynamics
    residual, spread = certificate.residual, certificate.static_gain.uncertainty
    delay = measured(
        dynamics.low_frequency_delay, certificate.response.low_frequency_delay_uncertainty_s, "s"
    )
    return [
        Headline("Low-frequency delay", delay, _k1(delay, "by which the probe lags slow motion")),
        Headline(
            "Latency in it",
            latency_text(calibration),
            "X and C are not delayed"
            if calibration.latency.share is None
            else "by which X and C are delayed",
        ),
        _gain_headline(calibration.static_gain, spread),
        _range_headline(calibration),
        Headline(
            "χ², residual over noise",
            plain(residual.chi_square),
            "where the axis moves; 1 if only noise is left",
        ),
        Headline(
            "Noise of one reading",
            quantity(residual.noise_m, "m"),
            f"residual, rms: {quantity(residual.rms_m, 'm')}",
        ),
        Headline("Structure", tables.structure_text(tables.structure_of(calibration)), ""),
    ]


def _k1(text: str, detail: str) -> str:
    return f"{detail}; k = 1" if "±" in text else detail


def _gain_headline(gain: float, spread: float | None) -> Headline:
    value = measured(gain, spread, digits=6)
    off = measured((gain - 1) / PPM, None if spread is None else spread / PPM)
    return Headline("Static gain, probe per encoder", value, _k1(value, f"{off} ppm from 1"))


def _range_headline(calibration: Calibration) -> Headline:
    name, details = "Known within limits up to", ["rejected: not to be used"]
    if calibration.certificate.verdict != REJECTED:
        nyquist = 0.5 / calibration.sample_period
        shown = calibration.certificate.validity.excited_up_to_hz
        name, details = "Valid up to", [f"half the sampling rate is {quantity(nyquist, 'Hz')}"]
        if shown is not None and calibration.valid_up_to < nyquist:
            known = calibration.valid_up_to < shown
            ends = "the band exceeds its limits" if known else "the motion excites too little"
            details.insert(0, f"beyond it {ends}")
    return Headline(name, quantity(calibration.valid_up_to, "Hz"), "; ".join(details))


def _model_errors(certificate: Certificate) -> Section:
    return Section(
        "Model errors, found and undetected",
        (),
        (
            tables.model_error_table(certificate),
            tables.consistency_table(certificate),
            undetected_table(certificate),
        ),
        "An effect larger than the largest undetected size would have been detected with a "
        "probability of 95 %. The band contains what the test cannot exclude. The rms is that of "
        "heights on the intended scan; the report of a measurement has that of its own scan.",
    )


def _order(certificate: Certificate) -> Section:
    return Section(
        "Order",
        ("order",),
        (tables.order_table(certificate),),
        "The chosen structure has one parameter more than that of the lowest BIC, and at least "
        "three, unless an order was requested. The smallest structure that fits is biased by "
        "about its own uncertainty; one parameter more turns this bias into a wider band.",
    )


def sections(calibration: Calibration, issue: Issue) -> list[Section]:
    """Return all parts below the first screen that have anything to show."""
    certificate = calibration.certificate
    warnings = [(str(warning),) for warning in certificate.warnings]
    identity = tables.identity_table(calibration, issue.source, issue.version)
    every = [
        Section("Warnings", (), (Table("", (), warnings),)),
        *_laboratory(calibration),
        Section(
            "Fit to the recording",
            ("step", "residual"),
            (tables.residual_table(certificate), tables.sample_account(certificate)),
        ),
        _order(certificate),
        Section(
            "Dynamics",
            (),
            (
                mode_table(calibration),
                two_mass_table(certificate),
                tables.limit_table(certificate),
                shape_table(calibration),
                tables.coefficient_table(calibration),
            ),
            "Uncertainties are standard, k = 1. Those of the coefficients are strongly "
            "correlated; the calibration file has the whole covariance.",
        ),
        Section(
            "Static gain and background",
            (),
            (tables.gain_table(calibration), tables.background_table(certificate)),
        ),
        _model_errors(certificate),
        Section(
            "Records",
            (),
            (
                identity,
                mapping_table("Settings calibrated for", calibration.settings),
                tables.further_table(certificate),
            ),
        ),
    ]
    return present(every, issue.figures)


def _laboratory(calibration: Calibration) -> list[Section]:
    """Return what a laboratory's certificate states: results, method, conditions, validity."""
    certificate = calibration.certificate
    origin, validity = certificate.origin, certificate.validity
    results = []
    for one in dcc_quantities(calibration):
        unit = _UNITS[one.unit]
        value = measured(one.value, (one.expanded or 0.0) / 2, unit).partition(" ±")[0]
        expanded = quantity(one.expanded, unit, 2) if unit else plain(one.expanded, 2)
        results.append((one.name, value, _UNSTATED if one.expanded is None else expanded))
    start = quantity(validity.from_hz or 0.0, "Hz", 2)
    stated = (
        ("method", origin.method or "step test on a fixed target; transfer function from encoder "
         "to probe, doi 10.37188/lam.2025.078"),
        ("conditions", "; ".join(filter(None, (
            f"{quantity(origin.temperature_c, '°C', 4)}" if origin.temperature_c else
            "temperature not stated",
            f"sample period {quantity(calibration.sample_period, 's', 4)}",
            "settings as listed under Records" if calibration.settings else "",
        )))),
        ("uncertainty", "expanded, k = 2, about 95 %: noise, undetected model errors, motion "
         "between samples"),
        ("traceability", origin.traceability or "not stated: lengths are those of the encoder"),
        ("validity", f"{verdict_text(calibration) or 'no verdict'}; for the settings of the "
         f"recording, motion from {start} to {quantity(calibration.valid_up_to, 'Hz')}, until "
         "machine, probe or settings change"),
    )  # fmt: skip
    return [
        Section("Results", (), (Table("", ("value", "U (k = 2)"), results),)),
        Section("Statements", (), (Table("", ("statement",), stated, prose="statement"),)),
    ]


_UNITS = {r"\second": "s", r"\one": "", r"\hertz": "Hz", r"\radian": "rad"}
# Shares of the valid band at which gain and phase are stated.
_DCC_SHARES = (0.01, 0.1, 0.25, 0.5, 0.75, 1.0)
_UNSTATED = "not stated"
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
    return " ".join((value or "").split()) or _UNSTATED
