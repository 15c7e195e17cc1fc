"""The report of a measurement: one self-contained HTML file."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.kinematics.limits import FASTEST
from omsm_ros.readable import (
    NOTHING,
    date_text_of_stamp,
    days,
    expanded,
    figure,
    measured,
    plain,
    quantity,
    rounded_down,
)
from omsm_ros.report import tables
from omsm_ros.report.measurement.surface_map import EmbeddedMap, policy_of, script
from omsm_ros.report.page_parts import Headline, fill, picture, title_block
from omsm_ros.report.tables import Table, part, unit_of_parameter
from omsm_ros.report.verdict import PageVerdict, covered, registered_figures, verdict_on_measurement
from omsm_ros.units import MILLIMETRE_M

_SLOPES = ("Sdq", "slope_rms", "slope_largest", "slope_rms_without_second_order")
_OTHER_UNITS = {"Ssk": "", "Sku": ""} | dict.fromkeys(_SLOPES, "rad")
_SIGNED = ("Ssk", "edge_roll_off")
_CONFORMITY = {
    "holds": ("good", "The part meets its tolerance"),
    "fails": ("bad", "The part exceeds its tolerance"),
    "cannot tell": ("care", "Conformity not decided: tolerance"),
}


def verdict_on_part(summary: Mapping[str, Any], form: Mapping[str, Any]) -> PageVerdict | None:
    """Return deviation and conformity of the part; None without a nominal surface.

    The figures are those of the summary, which its verdict holds for; of a form that has no
    summary, its own.
    """
    figures = part(summary, "figures") or registered_figures(form)
    if not figures:
        return None
    open_ = covered(form or part(summary, "form"))
    words = [
        f"{name} {expanded(found['value'], found['standard_uncertainty'], 'm')}{open_}"
        for name, found in (("PV", figures["peak_to_valley"]), ("rms", figures["rms"]))
    ]
    words.append(f"removed: {', '.join(figures['removed'])}")
    words += part(form, "removed", "notes") or ()
    held = part(summary, "conformity") or part(form, "conformity")
    if not held:
        words.append("no tolerance given (--tolerance): conformity not assessed")
        return PageVerdict("unknown", "Form deviation", tuple(words))
    level, word = _CONFORMITY[held["verdict"]]
    words = [*(held.get("reasons") or ()), *words]
    if level == "good" and part(summary, "verdict", "code") != "verified":
        level, word = "care", f"Not verified: {word[0].lower()}{word[1:]}"
    tolerance = quantity(held["tolerance"], "m")
    return PageVerdict(level, f"{word} of {tolerance} on the peak to valley", tuple(words))


def verdict_on_points(form: Mapping[str, Any]) -> PageVerdict:
    """Return the verdict on a form from points without a summary."""
    missing = tuple(part(form, "removed", "not_evaluated") or ())
    if missing:
        return PageVerdict(
            "unknown", "Uncertainty budget incomplete", (*(f"not evaluated: {m}" for m in missing),)
        )
    return PageVerdict(
        "care", "Valid with reservations", ("the measurement has no summary of its samples",)
    )


# Figures that a scan has from its adjustment.
_ADJUSTED = ("peak_to_valley", "robust_peak_to_valley", "rms", "peak_to_valley_best_fit",
             "rms_best_fit", "rms_before_fit")  # fmt: skip

_EXTENTS = ("rms", "iso10110_A", "iso10110_B", "iso10110_C")


def figure_rows(form: Mapping[str, Any], adjusted: object = None) -> list[tuple[str, str]]:
    """Return the figures of the deviation by name, with their expanded uncertainty.

    adjusted: figures of the adjusted scan, if there are any; PV and rms then are only those
    """
    entries = part(form, "deviation") or {}
    first = {name: entries[name] for name in ("peak_to_valley", "rms") if name in entries}
    return [
        (
            figure(name),
            expanded(
                entry["value"], entry["uncertainty"], _OTHER_UNITS.get(name, "m"), name in _SIGNED
            )
            + covered(form) * (name in _EXTENTS or "peak_to_valley" in name),
        )
        for name, entry in (first | entries).items()
        if not (adjusted and name in _ADJUSTED)
    ]


def form_table(
    form: Mapping[str, Any], curves: Mapping[str, Any], adjusted: object = None
) -> Table:
    """Return all figures of the part's form, and the rms of its spectral densities."""
    rows = figure_rows(form, adjusted)
    band, inside = (part(curves, "psd", name) for name in ("band", "mean_square_in_band"))
    if band:
        ends = " to ".join(plain(frequency * MILLIMETRE_M) for frequency in band)
        rows.append((f"rms in the band of the spectral density, {ends} 1/mm",
                     quantity(math.sqrt(inside), "m")))  # fmt: skip
        whole = math.sqrt(part(curves, "psd", "mean_square"))
        rows.append(("rms of the windowed points", quantity(whole, "m")))
    return Table("Figures of the form", (), [row for row in rows if row[1] != NOTHING])


def removed_table(form: Mapping[str, Any]) -> Table:
    """Return the removed pose, and the degrees of freedom that were not fitted."""
    title, columns = "Removed pose", ("value", "standard uncertainty")
    if not form:
        return Table(title, columns, [])
    fitted = []
    for name in part(form, "removed", "fitted") or ():
        pose = part(form, "pose", name) or part(form, "shape", name) or {}
        unit = unit_of_parameter(name)
        # Without a prefix, which 1/m would not take.
        bare, tail = ("", f" {unit}") if unit == "1/m" else (unit, "")
        stated = measured(pose.get("value"), settled(form, name), bare).split(" ± ")
        value, spread = stated if len(stated) == 2 else (stated[0], NOTHING)
        fitted.append((name, value + tail, spread + tail))
    held: Mapping[str, str] = part(form, "removed", "held") or {}
    refused: Mapping[str, str] = part(form, "removed", "not_determined") or {}
    reasons = {name: f"held: {why}" for name, why in held.items()}
    reasons |= {name: f"{why}{correlated_moves(form, name)}" for name, why in refused.items()}
    if not reasons:
        return Table(title, columns, fitted)
    rows = [(*row, "") for row in fitted]
    rows += [(f"{name}, not fitted", NOTHING, NOTHING, why) for name, why in reasons.items()]
    return Table(title, (*columns, "reason"), rows, prose="reason")


def settled(form: Mapping[str, Any], name: str) -> float | None:
    """Return the standard uncertainty of a degree of freedom with the undetermined ones held.

    Correlated moves of the undetermined ones, see :func:`correlated_moves`, do not change the form.
    """
    shares: Mapping[str, Mapping[str, float]] = part(form, "removed", "pose_uncertainty") or {}
    refused = part(form, "removed", "not_determined") or ()
    if not shares:
        return None
    return math.hypot(*(share[name] for source, share in shares.items() if source not in refused))


def correlated_moves(form: Mapping[str, Any], name: str) -> str:
    """Return the moves that correlate with an undetermined degree of freedom, at equal form."""
    shares: Mapping[str, float] = part(form, "removed", "pose_uncertainty", name) or {}
    if not shares:
        return ""
    sizes = {name: part(form, "pose", name, "uncertainty"), **shares}
    moves = {n: v for n, v in sizes.items() if n in form["pose"]}
    spans = {n: quantity(v, unit_of_parameter(n), 2) for n, v in moves.items()}
    # A move without effect is zero, or rounding only.
    stated = [f"{n} ± {span}" for n, span in spans.items() if moves[n] and span[0] != "<"]
    if len(stated) < 2:
        return ""
    own, *others = stated
    return f"; {own} correlates with {', '.join(others)}, at equal form"


def _size(value: Any, unit: str) -> str:
    if value is None:
        return NOTHING
    return f"{plain(value)} {unit}".rstrip() if unit in ("", "1/m") else quantity(value, unit)


def limits_table(summary: Mapping[str, Any]) -> Table:
    """Return the limits of the speed of this motion, the tightest first."""
    limits = sorted(
        part(summary, "prediction", "limits") or (), key=lambda limit: limit["speed_factor"]
    )
    rows = [
        (
            str(limit["name"]),
            _size(limit["value"], limit["unit"]),
            _size(limit["allowed"], limit["unit"]),
            "≥ " * (limit["speed_factor"] >= FASTEST)
            + f"{plain(rounded_down(limit['speed_factor']))} ×",
        )
        for limit in limits
    ]
    missing = part(summary, "prediction", "not_evaluated") or ()
    rows += [(str(name), "not evaluated", NOTHING, NOTHING) for name in missing]
    return Table("Limits of the motion", ("on this scan", "allowed", "maximum speed"), rows)


def provenance_table(summary: Mapping[str, Any]) -> Table:
    """Return recording, calibration and files of a result."""
    admission, warm = part(summary, "admission"), part(summary, "conditions", "temperature")
    change = quantity((warm or {}).get("change"), "K", 2, True)
    temperature = f"{quantity((warm or {}).get('mean'), '°C', 4)}, {change} from start to end"
    rows = [
        ("recording", str(part(summary, "bag") or NOTHING)),
        ("recorded", date_text_of_stamp(part(summary, "conditions", "recorded_ns"))),
        ("temperature", temperature if warm else NOTHING),
        ("calibration", str(part(summary, "calibration") or NOTHING)),
        ("age of the calibration", days(part(summary, "conditions", "calibration_age"))),
        ("overridden", "yes" if part(admission or {}, "overridden") else "no"),
        ("files", ", ".join(map(str, (part(summary, "files") or {}).values())) or NOTHING),
    ]
    known = [row for row in rows if row[1] != NOTHING]
    return Table("Provenance", (), known if part(summary, "bag") else [])


# Captions of the figures; maps fill a third of a row, others half.
MAPS = {
    "raw_map": "Before the correction: encoder plus probe.",
    "corrected_map_same_scale": "After it, on the scale of the map before.",
    "corrected_map": "After it, enlarged.",
    "height_map": "Corrected height; no nominal surface was given.",
    "error_map": "Dynamic error that was removed.",
}
PROFILES = {
    "profile_x": "Through the centre, mean over 1/200 of the aperture.",
    "profile_y": "Through the centre, mean over 1/200 of the aperture.",
    "profile_diagonal": "A lag's error is largest here if the part is tilted along x.",
    "profile_radius": "Mean of each ring: rotationally symmetric error.",
}
FORM = {
    "form_map": "Pose removed. ×: left out as dust. Hatched: aperture without points.",
    "form_lines": "Along the normal, pose removed, mean over 1/50 of the radius; k = 2.",
    "form_rings": "Mean of each ring, and around the outer third of the radius; k = 2.",
    "zernike_terms": "Terms, 1 at the rim, k = 2. Grey: within the uncertainty.",
    "psd_radial": "Two-sided, with noise; the sum of 2πf S Δf is the mean square; k = 2.",
    "psd_direction": "Over the direction of the waves; half a turn is the mean square.",
    "psd_areal": "Its sum times the area of a block is the mean square.",
}
GROUPS = {
    "Surface": MAPS,
    "Profiles": PROFILES,
    "Form of the registered part": FORM,
    "Dynamic error": {"dynamic_error": "Before and after: mind the different scales."},
    "Dynamics of the probe": {
        "bode": "Grey: above the frequency up to which the calibration is valid."
    },
}
CAPTIONS = {name: text for group in GROUPS.values() for name, text in group.items()}


@dataclass(frozen=True, slots=True)
class Report:
    """Contents of the page; absent parts are left out.

    title: of the page;  date: as printed
    summary: the content of ``summary.json``: optional ``samples`` (an account as its
        ``as_dict`` gives it), ``dynamic_error_before``, ``dynamic_error_after``,
        ``deviation`` (``raw``, ``corrected``), ``uncertainty`` (``median``, ``largest``),
        ``warnings``, ``settings``, ``versions``; lengths in metres
    calibration: of the correction, if any
    figures: PNG files by the names in :data:`CAPTIONS`
    form: the content of ``form.json``, if the part was registered;  curves: of ``curves.json``
    map: zoomable map;  origin: entries of the title block, as ``--origin`` gives them
    """

    title: str
    date: str
    summary: Mapping[str, Any]
    calibration: Calibration | None = None
    figures: Mapping[str, bytes] = field(default_factory=dict)
    form: Mapping[str, Any] = field(default_factory=dict)
    curves: Mapping[str, Any] = field(default_factory=dict)
    map: EmbeddedMap | None = None
    origin: Mapping[str, Any] = field(default_factory=dict)


def render(report: Report) -> str:
    """Return the page as HTML; all text from outside is escaped."""
    drawing = script() if report.map else ""
    return fill(
        "report.html",
        report=report,
        heading=str(report.origin.get("title") or report.title),
        block=title_block(report.origin),
        on_part=verdict_on_part(report.summary, report.form),
        verdict=verdict_on_points(report.form)
        if report.form and not report.summary
        else verdict_on_measurement(report.summary),
        removed=removed_table(report.form),
        script=drawing,
        script_policy=policy_of(drawing),
        headlines=headlines(report.summary),
        sections=[
            (title, names)
            for title, group in GROUPS.items()
            if (names := [name for name in group if name in report.figures])
        ],
        records=_records(report),
        picture=lambda name: picture(report.figures[name]),
        caption=CAPTIONS.__getitem__,
        maps=MAPS,
    )


def headlines(summary: Mapping[str, Any]) -> list[Headline]:
    """Return the main results that are known."""
    found = []
    before = part(summary, "dynamic_error_before")
    if before:
        after = part(summary, "dynamic_error_after")
        sides = [before, after] if after else [before]
        value, extent = (" → ".join(quantity(s[k], "m") for s in sides)
                         for k in ("rms", "peak_to_valley"))  # fmt: skip
        name = "Dynamic error, rms" if after else "Dynamic error removed, rms"
        found.append(Headline(name, value, f"peak to valley {extent}"))
    median = part(summary, "uncertainty", "median")
    if median is not None:
        most = quantity(2 * part(summary, "uncertainty", "largest"), "m")
        text = f"of one point's height, k = 2, median; at most {most}"
        found.append(Headline("Expanded uncertainty", quantity(2 * median, "m"), text))
    stream = part(summary, "samples", "distance")
    if stream:
        text = f"of {tables.count(stream['received'])} samples received"
        found.append(Headline("Surface points", tables.count(stream["corrected"]), text))
    return found


def _records(report: Report) -> list[tables.Table]:
    summary = report.summary
    found = [
        form_table(report.form, report.curves, part(summary, "figures")),
        tables.budget_table(summary), limits_table(summary), tables.sample_table(summary),
    ]  # fmt: skip
    if report.calibration is not None:
        found.append(tables.calibration_table(report.calibration))
    found.append(tables.mapping_table("Settings", part(summary, "settings") or {}))
    found.append(provenance_table(summary))
    found.append(tables.mapping_table("Versions", part(summary, "versions") or {}))
    return [table for table in found if table.rows]
