"""The certificate of a calibration as a page to file: HTML in one piece, or Markdown."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from omsm_ros.core.calibration.calibration import REJECTED, Calibration, verdict_of
from omsm_ros.core.identification.fitted_record import FittedRecord
from omsm_ros.core.lti.frequency_response import COVERAGE_FACTOR, response_band
from omsm_ros.core.lti.modes import KnownMode, known_modes
from omsm_ros.core.model_errors.families import CREEP, MODE
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.readable import NOTHING, measured, number, percent, plain, quantity
from omsm_ros.report import style
from omsm_ros.report.certificate import figures as certificate_figures
from omsm_ros.report.certificate import tables as tables
from omsm_ros.report.certificate.tables import CertificateEntries, known_rows, listed, texts
from omsm_ros.report.page_parts import Headline, IssuedPage, Section, fill, picture, present
from omsm_ros.report.response_figures import step_response
from omsm_ros.report.tables import Table, latency_text, mapping_table, part
from omsm_ros.report.verdict import PageVerdict
from omsm_ros.units import DEGREE_RAD, MILLISECOND_S, PPM

# What the response says of the machine, and what could hide in it: modes, masses, shape.


def mode_table(calibration: Calibration) -> Table:
    """Return the poles as terms of Eq. 8, and whether the band reaches them."""
    modes = known_modes(calibration.dynamics, calibration.covariance)
    rows = [
        (
            f"mode {index}" if mode.residue is not None else f"real pole {index}",
            measured(mode.frequency, mode.frequency_uncertainty, "Hz"),
            *_oscillation(mode),
            "yes" if mode.frequency <= calibration.valid_up_to else "no",
        )
        for index, mode in enumerate(modes, start=1)
    ]
    columns = ("frequency", "damping ratio", "residue [1/ms²]", "within the trusted band")
    return Table("Modes (Eq. 8)", columns, rows)


def _oscillation(mode: KnownMode) -> tuple[str, str]:
    """Return the damping and residue."""
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


def two_mass_table(certificate: CertificateEntries) -> Table:
    """Return masses, springs and dampers, or each per mass of the table where that is not known."""
    model: Mapping[str, Any] = part(certificate, "two_mass", "model") or {}
    absolute = number(part(certificate, "two_mass", "table_mass_kg")) is not None
    rows = []
    for name, unit in (_MECHANICAL_UNITS if absolute else _UNITS_PER_MASS).items():
        value = number(part(model, name))
        relative = number(part(certificate, "two_mass", "relative_uncertainty", name))
        text = NOTHING if value is None else measured(value, (relative or 0.0) * value, unit)
        if name == "m1" and value is not None:
            text += ", as given"
        rows.append((name if absolute else f"{name} / m1", text))
    side = part(certificate, "two_mass", "collocated")
    rows += [
        ("probe on the", _PROBE_ON[side] if isinstance(side, bool) else NOTHING),
        ("misfit, over the stated uncertainty", plain(part(certificate, "two_mass", "misfit"))),
    ]
    title = "Two-mass model (Eq. 6, 7)"
    return Table(title if absolute else f"{title}, per mass of the table", (), known_rows(rows, 1))


_SHAPE_ROWS = (
    ("gain off 1 by 1 %", "bandwidth_1_percent", None),
    ("gain off 1 by 3 dB", "bandwidth_3db", None),
    ("highest peak of the gain", "resonance", "resonance_gain"),
    ("lowest dip of the gain", "minimum", "minimum_gain"),
)


def shape_table(calibration: Calibration) -> Table:
    """Return what stands out in the identified response, and whether the band reaches it."""
    certificate, trusted = calibration.certificate, calibration.valid_up_to
    rows = [
        (name, _point(certificate, place, gain), _response_up_to(certificate, place, trusted))
        for name, place, gain in _SHAPE_ROWS
    ]
    left = number(certificate.get("modal_remainder"))
    if left is not None:
        rows.append(("not in the terms of Eq. 8, of the greatest gain", percent(left), "yes"))
    columns = ("", "within the trusted band")
    return Table("Shape of the response", columns, known_rows(rows, 1))


def _response_up_to(certificate: CertificateEntries, place: str, trusted: float) -> str:
    at = number(part(certificate, "shape", place))
    return "" if at is None else "yes" if at <= trusted else "no"


def _point(certificate: CertificateEntries, place: str, gain: str | None) -> str:
    at = quantity(part(certificate, "shape", place), "Hz")
    if gain is None or at == NOTHING:
        return at
    return f"{plain(part(certificate, 'shape', gain), 4)} at {at}"


def _size(delay_bound: Mapping[str, Any]) -> str:
    """Return the largest size that was missed, in the unit of its family."""
    missed = number(delay_bound.get("missed"))
    if missed is None or delay_bound.get("family") not in (CREEP, MODE):
        return quantity(missed, "m")
    return f"{percent(missed)} of the motion"


def _family(entry: Mapping[str, Any]) -> str:
    """Return a way to depart from linear and steady, with its own time or frequency."""
    family, parameter = str(entry.get("family", NOTHING)), entry.get("parameter")
    if family == CREEP:
        return f"{family} over {quantity(parameter, 's', 2)}"
    return f"{family} at {quantity(parameter, 'Hz', 2)}" if family == MODE else family


def undetected_error_table(certificate: CertificateEntries) -> Table:
    """Return what this very test would have missed, and what that costs on a scan."""
    rows = [
        (
            _family(entry),
            _size(entry),
            quantity(entry.get("missed_effect_on_scan_m"), "m"),
            quantity(entry.get("effect_on_scan_m"), "m"),
        )
        for entry in listed(certificate, "could_hide")
    ]
    return Table(
        "What could hide",
        ("largest size missed", "its rms on the paper's scan", "carried in the band"),
        rows
        + known_rows(
            [
                (
                    "plateau that would tell the slowest",
                    quantity(certificate.get("plateau_that_would_tell_s"), "s"),
                    "",
                    "",
                )
            ],
            1,
        )
        + [(f"assumed: {text}", "", "", "") for text in texts(certificate, "assumed")],
    )


BAND = "band"
CAPTIONS = {
    BAND: (
        "Gain, phase, and the error of a sinusoidal motion before and after the correction. "
        "Grey: not trusted."
    ),
    "step": "The steepest move: input, output, and the residual of the model.",
    "residual": (
        "The residual over the whole recording, at the edges on top of each other "
        "(downward ones turned over), and from sample to sample."
    ),
    "order": ("Each candidate is a structure that was fitted to the same samples."),
}
_CLOSING = (
    "On a fixed target the probe reads offset + drift ∓ static gain · G_m z (− where the distance "
    "falls when Z rises, + where it rises), with G_m(0) = 1 and z "
    "from the encoder. After ± stands the standard uncertainty, k = 1; bands are 95 %."
)


@dataclass(frozen=True, kw_only=True)
class CertificatePage(IssuedPage):
    """Everything on the page; what is absent is left out."""

    captions = CAPTIONS
    calibration: Calibration

    @property
    def issue(self) -> str:
        """Recording, date and identity on one line."""
        return self.issued(self.calibration.id[:16])


def certificate_figures_of(calibration: Calibration, fitted: FittedRecord) -> dict[str, bytes]:
    """Return PNG files for the page."""
    certificate = calibration.certificate
    made = {
        BAND: certificate_figures.response_with_band(calibration, fitted.measured),
        "step": step_response(fitted.time, fitted.input, _bridged(fitted), fitted.modelled),
        "residual": certificate_figures.residual(fitted, number(certificate.get("noise_m"))),
    }
    candidates = [c for c in tables.listed(certificate, "candidates") if _comparable(c)]
    if candidates:
        chosen = [i for i, c in enumerate(candidates) if tables.is_chosen(c, certificate)]
        sized = [{**c, "parameters": c["poles"] + c["zeros"] + c["delay"]} for c in candidates]
        made["order"] = certificate_figures.order(sized, chosen[0] if chosen else None)
    return {name: style.png(figure) for name, figure in made.items()}


def _comparable(candidate: Mapping[str, object]) -> bool:
    counted = all(isinstance(candidate.get(key), int) for key in ("poles", "zeros", "delay"))
    return counted and all(number(candidate.get(key)) is not None for key in ("rms_m", "bic"))


def _bridged(fitted: FittedRecord) -> FloatArray:
    """Return ``values`` as they are: Matplotlib leaves gaps at NaN, an edge's median does not."""
    return np.asarray(np.where(np.isfinite(fitted.output), fitted.output, fitted.modelled))


def render(certificate: CertificatePage) -> str:
    """Return the page as HTML; all text from outside is escaped."""
    return fill(
        "certificate.html",
        heading="Calibration certificate",
        issued=certificate.issue,
        closing=f"{_CLOSING} Calibration {certificate.calibration.id}.",
        figures=certificate.figures,
        verdict=verdict_on_calibration(certificate.calibration),
        headlines=headlines(certificate.calibration),
        sections=sections(certificate),
        band=BAND,
        picture=lambda name: picture(certificate.figures[name]),
        caption=CAPTIONS.__getitem__,
    )


def verdict_on_calibration(calibration: Calibration) -> PageVerdict:
    """Return the certificate's own verdict, and why."""
    stated, reasons = verdict_of(calibration)
    if stated == REJECTED:
        return PageVerdict("bad", "Rejected", tuple(reasons) or ("no reason is given",))
    if not stated:
        return PageVerdict("unknown", "Not judged", ("the calibration has no certificate",))
    kept = tables.texts(calibration.certificate, "reservations")
    level = "good" if stated.startswith("accepted") else "unknown"
    grounds = (*reasons, *kept, *_verdict_reasons(calibration))
    return PageVerdict("care" if kept else level, stated[:1].upper() + stated[1:], grounds)


def _verdict_reasons(calibration: Calibration) -> list[str]:
    certificate, found = calibration.certificate, []
    if number(certificate.get("chi_square")) is not None:
        found.append(
            f"where the axis moves, only noise is left (χ² = {plain(certificate['chi_square'])})"
        )
    if np.any(calibration.covariance):
        top = quantity(calibration.valid_up_to, "Hz")
        found.append(f"up to {top} the 95 % band is within {_band_text(calibration)}")
    delay_bound = number(certificate.get("inter_sample_delay_bound_s"))
    if delay_bound is not None:
        found.append(
            f"motion between samples hides a lag of {quantity(delay_bound, 's', 2)} at most"
            if delay_bound
            else "no motion is hidden between samples"
        )
    return found


def _band_text(calibration: Calibration) -> str:
    """Return the greatest half-width of the 95 % band below ``valid_up_to``."""
    at = np.geomspace(1e-3, 1.0, 200) * calibration.valid_up_to
    band = response_band(calibration.dynamics, calibration.covariance, at)
    gain, phase = (COVERAGE_FACTOR * float(np.max(part)) for part in (band.gain, band.phase))
    return f"±{percent(gain)} in gain and ±{plain(phase / DEGREE_RAD, 2)}° in phase"


def headlines(calibration: Calibration) -> list[Headline]:
    """Return the numbers that a reader looks for first, those that are known."""
    return [h for h in _all_headlines(calibration) if h.value != NOTHING]


def _all_headlines(calibration: Calibration) -> list[Headline]:
    certificate, dynamics = calibration.certificate, calibration.dynamics
    delay = measured(
        dynamics.low_frequency_delay, certificate.get("low_frequency_delay_uncertainty_s"), "s"
    )
    spread = number(certificate.get("static_gain_uncertainty"))
    return [
        Headline("Low-frequency delay", delay, _k1(delay, "by which the probe lags slow motion")),
        Headline("Of it latency", latency_text(calibration), "by which X and C are delayed"),
        _gain_headline(calibration.static_gain, spread),
        _range_headline(calibration),
        Headline(
            "χ², residual over noise",
            plain(certificate.get("chi_square")),
            "where the axis moves; 1 if only noise is left",
        ),
        Headline(
            "Noise of one reading",
            quantity(certificate.get("noise_m"), "m"),
            f"residual, rms: {quantity(certificate.get('residual_rms_m'), 'm')}",
        ),
        _order_headline(calibration),
    ]


def _k1(text: str, detail: str) -> str:
    return f"{detail}; k = 1" if "±" in text else detail


def _gain_headline(gain: float, spread: float | None) -> Headline:
    value = measured(gain, spread, digits=6)
    off = measured((gain - 1) / PPM, None if spread is None else spread / PPM)
    return Headline("Static gain, probe per encoder", value, _k1(value, f"{off} ppm from 1"))


def _range_headline(calibration: Calibration) -> Headline:
    verdict, _ = verdict_of(calibration)
    name, details = "Known within limits up to", ["rejected: not to be used"]
    if verdict != REJECTED:
        nyquist = 0.5 / calibration.sample_period
        shown = number(calibration.certificate.get("shown_up_to_hz"))
        name, details = "Valid up to", [f"half the sampling rate is {quantity(nyquist, 'Hz')}"]
        if shown is not None and calibration.valid_up_to < nyquist:
            known = calibration.valid_up_to < shown
            ends = "the band exceeds its limits" if known else "the motion excites too little"
            details.insert(0, f"beyond it {ends}")
    return Headline(name, quantity(calibration.valid_up_to, "Hz"), "; ".join(details))


def _order_headline(calibration: Calibration) -> Headline:
    structure = calibration.certificate.get("structure")
    known = structure if isinstance(structure, Mapping) else tables.own_structure(calibration)
    return Headline("Structure", tables.structure_text(known), "")


def _model_error_texts(entries: tables.CertificateEntries) -> Section:
    return Section(
        "What departs, and what could hide",
        (),
        (
            tables.model_error_table(entries),
            tables.consistency_table(entries),
            undetected_error_table(entries),
        ),
        "Anything larger than the largest size missed, this very test would have shown with a "
        "probability of 95 %; the band carries what it cannot exclude. The rms is that of heights "
        "on one well-known scan, the paper's mirror at 30 rpm; a report has that of its own scan.",
    )


def _order(entries: tables.CertificateEntries) -> Section:
    return Section(
        "Order",
        ("order",),
        (tables.order_table(entries),),
        "Unless an order was asked for, the structure chosen has one parameter more than that "
        "of the lowest BIC, and three at least: the smallest that fits is biased by about its "
        "own uncertainty, and one parameter more trades that for a wider band.",
    )


def sections(certificate: CertificatePage) -> list[Section]:
    """Return all parts below the first screen that have anything to show."""
    calibration = certificate.calibration
    entries = calibration.certificate
    warnings = [(text,) for text in tables.texts(entries, "warnings")]
    identity = tables.identity_table(calibration, certificate.source, certificate.version)
    every = [
        Section("Warnings", (), (Table("", (), warnings),)),
        Section(
            "Fit to the recording",
            ("step", "residual"),
            (tables.residual_table(entries), tables.sample_account(entries)),
        ),
        _order(entries),
        Section(
            "Dynamics",
            (),
            (
                mode_table(calibration),
                two_mass_table(entries),
                tables.limit_table(entries),
                shape_table(calibration),
                tables.coefficient_table(calibration),
            ),
            "Uncertainties are standard, k = 1. Those of the coefficients are strongly "
            "correlated; the calibration file has the whole covariance.",
        ),
        Section(
            "Static gain and background",
            (),
            (tables.gain_table(calibration), tables.background_table(entries)),
        ),
        _model_error_texts(entries),
        Section(
            "Records",
            (),
            (
                identity,
                mapping_table("Settings calibrated for", calibration.settings),
                tables.further_table(entries),
            ),
        ),
    ]
    return present(every, certificate.figures)
