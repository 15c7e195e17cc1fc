"""The HTML page of a measurement: one file, nothing fetched from anywhere."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from omsm_ros.core.dynamics.calibration import Calibration
from omsm_ros.readable import quantity
from omsm_ros.report.common import tables
from omsm_ros.report.common.page_parts import Headline
from omsm_ros.report.common.tables import part
from omsm_ros.report.common.template import check_places, fill, picture
from omsm_ros.report.common.verdict import Verdict, verdict_on_measurement
from omsm_ros.report.maps.surface_map import EmbeddedMap, policy_of, script
from omsm_ros.report.measurement.part import (
    form_table,
    limits_table,
    provenance_table,
    removed_table,
    verdict_on_part,
    verdict_on_points,
)


@dataclass(frozen=True, slots=True)
class Caption:
    """What stands below a figure; ``wide`` figures fill half of a line, others a third."""

    text: str
    wide: bool = True


MAPS = {
    "raw_map": Caption("Before the correction: encoder plus probe. Scale in micrometres.", False),
    "corrected_map_same_scale": Caption(
        "After it, in the colours of the map before: what is gone was dynamic error.", False
    ),
    "corrected_map": Caption("After it, enlarged. Scale in nanometres.", False),
    "height_map": Caption("Corrected height; no nominal surface was given.", False),
    "error_map": Caption("What the correction took away at each point.", False),
}
PROFILES = {
    "profile_x": Caption("Through the centre, mean over a band of 1/200 of the aperture."),
    "profile_y": Caption("Through the centre, mean over a band of 1/200 of the aperture."),
    "profile_diagonal": Caption("On this line the lag of a part that swings along x shows most."),
    "profile_radius": Caption("What is the same all around, such as rings left by turning."),
}
ERRORS = {
    "dynamic_error": Caption("Before in micrometres, after in nanometres: different scales."),
    "error_histogram": Caption("Before and after on one logarithmic axis."),
}
DYNAMICS = {
    "bode": Caption(
        "Gain, phase, and the error that a sinusoidal motion would leave. Grey: beyond the "
        "frequency up to which the identified response is trusted."
    ),
    "step_response": Caption("One edge of the step test, and the residual of the model."),
}
FORM = {
    "form_lines": Caption(
        "Deviation along the normal after the pose was taken out, mean over a band of 1/50 of the "
        "radius. Shaded: expanded uncertainty (k = 2), with that of the pose."
    ),
    "form_rings": Caption("The mean of each ring, and of the outer third around. Shaded: k = 2."),
    "zernike_terms": Caption(
        "Terms of the deviation, each one at the rim, with their expanded uncertainty (k = 2). "
        "Grey: no larger than it."
    ),
    "psd_radial": Caption(
        "Two-sided, of the points under a tapered window; the sum of 2πf S Δf is their mean square "
        "in this band. Noise is in it, and in the shaded uncertainty (k = 2)."
    ),
    "psd_direction": Caption(
        "Of waves that run this way, all frequencies; the integral over half a turn is the mean "
        "square. Shaded: k = 2."
    ),
    "psd_areal": Caption(
        "The same over both frequencies; its sum times the area of a block is the mean square."
    ),
}
CAPTIONS = {**MAPS, **PROFILES, **FORM, **ERRORS, **DYNAMICS}


@dataclass(frozen=True, slots=True)
class Report:
    """Everything on the page; what is absent is left out.

    title: of the page;  date: as it is to be printed
    summary: the content of ``summary.json``: optional ``samples`` (an account as its
        ``as_dict`` gives it), ``dynamic_error_before``, ``dynamic_error_after``,
        ``deviation`` (``raw``, ``corrected``), ``uncertainty`` (``median``, ``largest``),
        ``warnings``, ``settings``, ``versions``; lengths in metres
    calibration: that was applied, if any
    figures: PNG files by the names in :data:`CAPTIONS`
    form: the content of ``form.json``, if the part was registered;  curves: of ``curves.json``
    map: that a reader can enlarge

    Raises ConfigurationError for a figure of another name.
    """

    title: str
    date: str
    summary: Mapping[str, Any]
    calibration: Calibration | None = None
    figures: Mapping[str, bytes] = field(default_factory=dict)
    form: Mapping[str, Any] = field(default_factory=dict)
    curves: Mapping[str, Any] = field(default_factory=dict)
    map: EmbeddedMap | None = None

    def __post_init__(self) -> None:
        check_places(self.figures, CAPTIONS)


def render(report: Report) -> str:
    """Return the page as HTML; all text from outside is escaped."""
    drawing = script() if report.map else ""
    return fill(
        "report.html",
        report=report,
        on_part=verdict_on_part(report.summary, report.form),
        verdict=_trust(report),
        removed=removed_table(report.summary, report.form),
        script=drawing,
        script_policy=policy_of(drawing),
        headlines=headlines(report.summary),
        sections=_sections(report),
        records=_records(report),
        picture=lambda name: picture(report.figures[name]),
        caption=CAPTIONS.__getitem__,
    )


def _trust(report: Report) -> Verdict:
    if report.form and not report.summary:
        return verdict_on_points(report.form)
    return verdict_on_measurement(report.summary, report.calibration)


def headlines(summary: Mapping[str, Any]) -> list[Headline]:
    """Return the numbers that a reader looks for first, those that are known."""
    found = []
    form = part(summary, "deviation", "corrected")
    if form:
        value = quantity(form["rms_area_weighted"], "m")
        detail = f"peak to valley {quantity(form['peak_to_valley'], 'm')}"
        found.append(Headline("Deviation from nominal, rms by area", value, detail))
    before = part(summary, "dynamic_error_before")
    if before:
        found.append(_dynamic_headline(before, part(summary, "dynamic_error_after")))
    median = part(summary, "uncertainty", "median")
    if median is not None:
        text = "of a single height, median, k = 2"
        found.append(Headline("Expanded uncertainty", quantity(2 * median, "m"), text))
    stream = part(summary, "samples", "distance")
    if stream:
        text = f"of {tables.count(stream['received'])} samples received"
        found.append(Headline("Surface points", tables.count(stream["corrected"]), text))
    return found


def _dynamic_headline(before: Mapping[str, Any], after: Mapping[str, Any] | None) -> Headline:
    value = quantity(before["rms"], "m")
    detail = f"peak to valley {quantity(before['peak_to_valley'], 'm')}"
    if not after:
        return Headline("Dynamic error removed, rms", value, detail)
    return Headline(
        "Dynamic error, rms",
        f"{value} → {quantity(after['rms'], 'm')}",
        f"{detail} → {quantity(after['peak_to_valley'], 'm')}",
    )


def _sections(report: Report) -> list[tuple[str, list[str]]]:
    groups = {
        "Surface": MAPS,
        "Profiles": PROFILES,
        "Form of the registered part": FORM,
        "Dynamic error": ERRORS,
        "Dynamics of the probe": DYNAMICS,
    }
    present = {title: [n for n in names if n in report.figures] for title, names in groups.items()}
    return [(title, names) for title, names in present.items() if names]


def _records(report: Report) -> list[tables.Table]:
    summary = report.summary
    verdict = _trust(report)
    found = [
        form_table(report.form, report.curves),
        tables.error_table(summary),
        tables.budget_table(summary),
        tables.Table("What stands against trust", (), [(reason,) for reason in verdict.reasons]),
        tables.motion_table(summary),
        limits_table(summary),
        tables.sample_table(summary),
    ]
    if report.calibration is not None:
        found.append(tables.calibration_table(report.calibration))
        found.append(tables.remarks_table(report.calibration))
        found.append(tables.mapping_table("Settings calibrated for", report.calibration.settings))
    settings = part(summary, "settings") or {}
    if report.calibration is None or settings != dict(report.calibration.settings):
        found.append(tables.mapping_table("Settings", settings))
    found.append(provenance_table(summary))
    found.append(tables.mapping_table("Versions", part(summary, "versions") or {}))
    return [table for table in found if table.rows]
