"""The page of a model between any two sampled quantities, with a record that it is run over."""

from collections.abc import Mapping
from typing import Any

from omsm_ros.core.calibration.certificate import REJECTED
from omsm_ros.core.estimation.sampled_model import SCHEMA, FreeRun, SampledModel
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.readable import NOTHING, count, percent, plain, probability, quantity
from omsm_ros.report import style
from omsm_ros.report.certificate import figures as drawn
from omsm_ros.report.certificate.tables import known_rows, limit_rows, texts
from omsm_ros.report.page_parts import Headline, Issue, Section, fill, picture, present
from omsm_ros.report.tables import Table, part
from omsm_ros.report.verdict import PageVerdict

BAND, RECORD, CORRELATION = "band", "record", "correlation"
CAPTIONS = {
    BAND: "Gain and phase with their 95 % band. Grey: not known within the limits.",
    RECORD: (
        "The record, and what the model makes of its input alone; the state that it starts in "
        "is fitted."
    ),
    CORRELATION: "From sample to sample: outside the shade the residual is not white.",
}
_NOTE = (
    "The model is of deviations from the working point. The file has its coefficients and their "
    "covariance."
)


def model_figures_of(
    model: SampledModel, inputs: FloatArray, output: FloatArray, run: FreeRun
) -> dict[str, bytes]:
    """Return PNG files for the page."""
    made = {
        BAND: drawn.response(model),
        RECORD: drawn.record(model, inputs, output, run),
        CORRELATION: drawn.correlation(run),
    }
    return {name: style.png(figure) for name, figure in made.items()}


def render_model(model: SampledModel, run: FreeRun, issue: Issue) -> str:
    """Return the page of a model and its ``run`` as HTML; all text from outside is escaped."""
    return fill(
        "certificate.html",
        heading="Model",
        issued=issue.line(),
        closing=_NOTE,
        figures=issue.figures,
        verdict=verdict_on_model(model),
        headlines=_headlines(model, run),
        sections=_sections(model, issue),
        band=BAND,
        picture=lambda name: picture(issue.figures[name]),
        caption=CAPTIONS.__getitem__,
    )


def verdict_on_model(model: SampledModel) -> PageVerdict:
    """Return the model's own verdict, and why."""
    stated = str(model.certificate.get("verdict", ""))
    reasons, warnings = (texts(model.certificate, name) for name in ("reasons", "warnings"))
    if stated == REJECTED:
        return PageVerdict("bad", "Rejected", tuple(reasons) or ("no reason is given",))
    if not stated:
        return PageVerdict("unknown", "Not judged", ("the model has no certificate",))
    level = "care" if warnings else "good"
    return PageVerdict(level, stated[:1].upper() + stated[1:], tuple(warnings))


def _headlines(model: SampledModel, run: FreeRun) -> list[Headline]:
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


def _sections(model: SampledModel, issue: Issue) -> list[Section]:
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
    limits = limit_rows(stated if isinstance(stated, Mapping) else {})
    every = [
        Section("Record", (RECORD, CORRELATION), (Table("", (), known_rows(tests, 1)),)),
        Section("Poles", (), (_poles(certificate),)),
        Section(
            "Records",
            (),
            (_identity(model, issue), Table("Limits of the verdict", (), known_rows(limits, 1))),
        ),
    ]
    return present(every, issue.figures)


def _poles(certificate: Mapping[str, Any]) -> Table:
    rows = []
    for pole in certificate.get("poles", ()):
        if "frequency_hz" in pole:
            rows.append((quantity(pole["frequency_hz"], "Hz"), plain(pole["damping"], 3)))
        else:
            word = "faster" if "faster_than_hz" in pole else "slower"
            bound = quantity(pole[f"{word}_than_hz"], "Hz")
            rows.append((f"not resolved ({word} than {bound})", NOTHING))
    return Table("", ("damping ratio",), rows)


def _identity(model: SampledModel, issue: Issue) -> Table:
    rows = [
        ("schema", SCHEMA),
        ("record", issue.source or NOTHING),
        ("sample period", quantity(model.sections.period, "s", 4)),
        ("working point, inputs", ", ".join(plain(x, 6) for x in model.working_point[:-1])),
        ("working point, output", plain(model.working_point[-1], 6)),
        ("omsm_ros", issue.version or NOTHING),
    ]
    return Table("Identity", (), known_rows(rows, 1))
