"""The certificate of a calibration as a page to file: HTML in one piece, or Markdown."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from omsm_ros.core.dynamics.calibration import REJECTED, Calibration, verdict_of
from omsm_ros.core.dynamics.response_band import COVERAGE_FACTOR, response_band
from omsm_ros.core.identification.fitted_record import FittedRecord
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.readable import NOTHING, measured, number, percent, plain, quantity
from omsm_ros.report.certificate import figures as certificate_figures
from omsm_ros.report.certificate import reading as reading
from omsm_ros.report.certificate import tables as tables
from omsm_ros.report.common import style
from omsm_ros.report.common.page_parts import Headline, IssuedPage, Section, present
from omsm_ros.report.common.response_figures import step_response
from omsm_ros.report.common.tables import Table, latency_text, mapping_table
from omsm_ros.report.common.template import fill, picture
from omsm_ros.report.common.verdict import Verdict
from omsm_ros.units import DEGREE_RAD, PPM

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


def verdict_on_calibration(calibration: Calibration) -> Verdict:
    """Return the certificate's own verdict, and why."""
    stated, reasons = verdict_of(calibration)
    if stated == REJECTED:
        return Verdict("bad", "Rejected", tuple(reasons) or ("no reason is given",))
    if not stated:
        return Verdict("unknown", "Not judged", ("the calibration has no certificate",))
    kept = tables.texts(calibration.certificate, "reservations")
    level = "good" if stated.startswith("accepted") else "unknown"
    grounds = (*reasons, *kept, *_grounds(calibration))
    return Verdict("care" if kept else level, stated[:1].upper() + stated[1:], grounds)


def _grounds(calibration: Calibration) -> list[str]:
    certificate, found = calibration.certificate, []
    if number(certificate.get("chi_square")) is not None:
        found.append(
            f"where the axis moves, only noise is left (χ² = {plain(certificate['chi_square'])})"
        )
    if np.any(calibration.covariance):
        top = quantity(calibration.valid_up_to, "Hz")
        found.append(f"up to {top} the 95 % band is within {_band_text(calibration)}")
    hidden = number(certificate.get("inter_sample_delay_bound_s"))
    if hidden is not None:
        found.append(
            f"motion between samples hides a lag of {quantity(hidden, 's', 2)} at most"
            if hidden
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


def _departures(entries: tables.CertificateEntries) -> Section:
    return Section(
        "What departs, and what could hide",
        (),
        (
            tables.departure_table(entries),
            tables.consistency_table(entries),
            reading.hidden_table(entries),
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
                reading.mode_table(calibration),
                reading.two_mass_table(entries),
                tables.limit_table(entries),
                reading.shape_table(calibration),
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
        _departures(entries),
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
