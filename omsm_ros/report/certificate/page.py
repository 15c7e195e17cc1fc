"""Pages to file, each HTML in one piece: certificate of a calibration, and a sampled model."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.calibration.certificate import REJECTED, to_json
from omsm_ros.core.estimation.sampled_model import SCHEMA, FreeRun, SampledModel
from omsm_ros.core.lti.frequency_response import COVERAGE_FACTOR, response_band
from omsm_ros.core.lti.transfer_function import Structure
from omsm_ros.readable import NOTHING, count, measured, percent, plain, probability, quantity
from omsm_ros.report.certificate import figures as drawn
from omsm_ros.report.certificate import tables
from omsm_ros.report.page_parts import Headline, Issue, Section, fill, picture, present, title_block
from omsm_ros.report.tables import Table, known_rows, latency_text, mapping_table, part
from omsm_ros.report.verdict import PageVerdict, verdict_text
from omsm_ros.units import DEGREE_RAD, PPM

_CLOSING = (
    "On a fixed target the probe reads offset + drift ∓ static gain · G_m z, with G_m(0) = 1 and z "
    "from the encoder. The sign is − where the distance falls when Z rises, else +. "
    "± states the standard uncertainty, k = 1; bands are 95 %."
)


def render(calibration: Calibration, issue: Issue) -> str:
    """Return the page as HTML; all text from outside is escaped."""
    origin = calibration.certificate.origin
    return _page(
        issue,
        calibration.id[:16],
        heading="Calibration certificate",
        closing=f"{_CLOSING} Calibration {calibration.id}.",
        verdict=verdict_on_calibration(calibration),
        headlines=headlines(calibration),
        sections=sections(calibration, issue),
        block=title_block(to_json(origin)),
        signer=origin.operator or "",
        caption=drawn.CAPTIONS.__getitem__,
    )


def _page(issue: Issue, identity: str = "", **content: object) -> str:
    return fill(
        "certificate.html",
        issued=issue.line(identity),
        figures=issue.figures,
        band=drawn.BAND,
        picture=lambda name: picture(issue.figures[name]),
        **content,
    )


def verdict_on_calibration(calibration: Calibration) -> PageVerdict:
    """Return the verdict of the certificate, and its reasons."""
    certificate = calibration.certificate
    reasons, kept = ([*map(str, n)] for n in (certificate.reasons, certificate.reservations))
    if certificate.verdict in (REJECTED, None):
        return _verdict(certificate.verdict, reasons, False, "calibration")
    grounds = [*reasons, *kept, *_verdict_reasons(calibration)]
    return _verdict(verdict_text(calibration), grounds, bool(kept), "calibration")


def _verdict(stated: str | None, grounds: Sequence[str], doubt: bool, what: str) -> PageVerdict:
    """Return a ``stated`` verdict for the page;  doubt: there are reservations."""
    if stated == REJECTED:
        return PageVerdict("bad", "Rejected", tuple(grounds) or ("no reason is given",))
    if not stated:
        return PageVerdict("unknown", "Not judged", (f"the {what} has no certificate",))
    return PageVerdict("care" if doubt else "good", stated[:1].upper() + stated[1:], tuple(grounds))


def _verdict_reasons(calibration: Calibration) -> list[str]:
    certificate, found = calibration.certificate, []
    if certificate.residual.chi_square is not None:
        found.append(
            "where the axis moves, only noise is left "
            f"(χ² = {plain(certificate.residual.chi_square)})"
        )
    if np.any(calibration.covariance):
        at = np.geomspace(1e-3, 1.0, 200) * calibration.valid_up_to
        band = response_band(calibration.dynamics, calibration.covariance, at)
        gain, phase = (COVERAGE_FACTOR * float(np.max(part)) for part in (band.gain, band.phase))
        found.append(
            f"up to {quantity(calibration.valid_up_to, 'Hz')} the 95 % band is within "
            f"±{percent(gain)} in gain and ±{plain(phase / DEGREE_RAD, 2)}° in phase"
        )
    delay_bound = certificate.response.inter_sample_delay_bound_s
    if delay_bound is not None:
        found.append(
            f"bias of the lag by motion between samples: at most {quantity(delay_bound, 's', 2)}"
            if delay_bound
            else "no bias of the lag by motion between samples"
        )
    return found


def headlines(calibration: Calibration) -> list[Headline]:
    """Return the numbers that a reader looks for first, those that are known."""
    certificate, dynamics = calibration.certificate, calibration.dynamics
    residual, spread = certificate.residual, certificate.static_gain.uncertainty
    structure = certificate.structure or Structure(
        len(dynamics.denominator) - 1, len(dynamics.numerator) - 1, dynamics.delay > 0
    )
    delay = measured(
        dynamics.low_frequency_delay, certificate.response.low_frequency_delay_uncertainty_s, "s"
    )
    found = [
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
        Headline("Structure", tables.structure_text(structure), ""),
    ]
    return [headline for headline in found if headline.value != NOTHING]


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


def _sample_table(calibration: Calibration) -> Table:
    samples = calibration.certificate.residual.samples
    return Table("Samples", (), [(k.replace("_", " "), count(n)) for k, n in samples.items()])


# Title, figures, tables and note of the sections between the statements and the records.
_SECTIONS: Sequence[tuple[str, tuple[str, ...], Sequence[Callable[[Calibration], Table]], str]] = (
    ("Fit to the recording", ("step", "residual"), (tables.residual_table, _sample_table), ""),
    (
        "Order",
        ("order",),
        (tables.order_table,),
        "The chosen structure has one parameter more than that of the lowest BIC, and at least "
        "three, unless an order was requested. The smallest structure that fits is biased by "
        "about its own uncertainty; one parameter more turns this bias into a wider band.",
    ),
    (
        "Dynamics",
        (),
        (tables.mode_table, tables.two_mass_table, tables.limit_table, tables.shape_table,
         tables.coefficient_table),
        "Uncertainties are standard, k = 1. Those of the coefficients are strongly "
        "correlated; the calibration file has the whole covariance.",
    ),
    ("Static gain and background", (), (tables.gain_table, tables.background_table), ""),
    (
        "Model errors, found and undetected",
        (),
        (tables.model_error_table, tables.consistency_table, tables.undetected_table),
        "An effect larger than the largest undetected size would have been detected with a "
        "probability of 95 %. The band contains what the test cannot exclude. The rms is that of "
        "heights on the intended scan; the report of a measurement has that of its own scan.",
    ),
)  # fmt: skip


def sections(calibration: Calibration, issue: Issue) -> list[Section]:
    """Return all parts below the first screen that have anything to show."""
    certificate = calibration.certificate
    warnings = [(str(warning),) for warning in certificate.warnings]
    further = dict(certificate.further)  # what has no other place on the page
    if certificate.self_calibration:
        further["self_calibration"] = certificate.self_calibration
    records = (
        tables.identity_table(calibration, issue.source, issue.version),
        mapping_table("Settings calibrated for", calibration.settings),
        mapping_table("Further entries", further),
    )
    every = [
        Section("Warnings", (), (Table("", (), warnings),)),
        *_laboratory(calibration),
        *(Section(title, shown, tuple(make(calibration) for make in made), note)
          for title, shown, made, note in _SECTIONS),
        Section("Records", (), records),
    ]  # fmt: skip
    return present(every, issue.figures)


def _laboratory(calibration: Calibration) -> list[Section]:
    """Return what a laboratory's certificate states: results, method, conditions, validity."""
    certificate = calibration.certificate
    origin, validity = certificate.origin, certificate.validity
    results = []
    for one in tables.dcc_quantities(calibration):
        unit = tables.DCC_UNITS[one.unit]
        value = measured(one.value, (one.expanded or 0.0) / 2, unit).partition(" ±")[0]
        expanded = quantity(one.expanded, unit, 2) if unit else plain(one.expanded, 2)
        results.append((one.name, value, tables.UNSTATED if one.expanded is None else expanded))
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


_CLOSING_OF_MODEL = (
    "The model is of deviations from the working point. The file has its coefficients and their "
    "covariance."
)


def render_model(model: SampledModel, run: FreeRun, issue: Issue) -> str:
    """Return the page of a model and its ``run`` as HTML; all text from outside is escaped."""
    return _page(
        issue,
        heading="Model",
        closing=_CLOSING_OF_MODEL,
        verdict=verdict_on_model(model),
        headlines=_model_headlines(model, run),
        sections=_model_sections(model, issue),
        caption=drawn.CAPTIONS_OF_MODEL.__getitem__,
    )


def verdict_on_model(model: SampledModel) -> PageVerdict:
    """Return the model's own verdict, and why."""
    stated = str(model.certificate.get("verdict", ""))
    grounds = tables.texts(model.certificate, "reasons" if stated == REJECTED else "warnings")
    return _verdict(stated, grounds, bool(grounds), "model")


def _model_headlines(model: SampledModel, run: FreeRun) -> list[Headline]:
    certificate = model.certificate
    valid = "; ".join(" to ".join(quantity(end, "Hz") for end in ends) for ends in model.valid)
    half = quantity(0.5 / model.sections.period, "Hz")
    predicted = percent(certificate.get("predicted"), 4)
    return [
        Headline("Free run accounts for", percent(run.explained, 4), "of this record"),
        Headline("Residual, rms", plain(run.rms, 4), "in the units of the output"),
        Headline("Hidden parts accounted for", predicted, "when the model was identified"),
        Headline("Valid", valid, f"half the sampling rate is {half}"),
        Headline("Poles", str(certificate.get("order", NOTHING)), f"input: {model.sections.hold}"),
    ]


def _model_sections(model: SampledModel, issue: Issue) -> list[Section]:
    certificate = model.certificate
    tests = [
        ("whiteness, p", probability(certificate.get("whiteness_p"))),
        ("independence of the input, p", probability(certificate.get("independence_p"))),
        ("residual when identified, rms", plain(certificate.get("residual_rms"))),
        ("poles of the free choice", str(certificate.get("free_order", NOTHING))),
        ("samples received", count(part(certificate, "samples", "received"))),
        ("samples compared", count(part(certificate, "samples", "compared"))),
    ]
    stated = part(certificate, "limits")
    limits = tables.limit_rows(stated if isinstance(stated, Mapping) else {})
    judged_by = Table("Limits of the verdict", (), known_rows(limits))
    shown = (drawn.RECORD, drawn.CORRELATION)
    every = [
        Section("Record", shown, (Table("", (), known_rows(tests)),)),
        Section("Poles", (), (_model_poles(certificate),)),
        Section("Records", (), (_model_identity(model, issue), judged_by)),
    ]
    return present(every, issue.figures)


def _model_poles(certificate: Mapping[str, Any]) -> Table:
    rows = []
    for pole in certificate.get("poles", ()):
        if "frequency_hz" in pole:
            rows.append((quantity(pole["frequency_hz"], "Hz"), plain(pole["damping"], 3)))
        else:
            word = "faster" if "faster_than_hz" in pole else "slower"
            bound = quantity(pole[f"{word}_than_hz"], "Hz")
            rows.append((f"not resolved ({word} than {bound})", NOTHING))
    return Table("", ("damping ratio",), rows)


def _model_identity(model: SampledModel, issue: Issue) -> Table:
    rows = [
        ("schema", SCHEMA),
        ("record", issue.source or NOTHING),
        ("sample period", quantity(model.sections.period, "s", 4)),
        ("working point, inputs", ", ".join(plain(x, 6) for x in model.working_point[:-1])),
        ("working point, output", plain(model.working_point[-1], 6)),
        ("omsm_ros", issue.version or NOTHING),
    ]
    return Table("Identity", (), known_rows(rows))
