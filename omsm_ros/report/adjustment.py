"""The page of an adjustment: verdict and figures, the map, sources declared and found."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from omsm_ros.core.adjustment import Adjustment
from omsm_ros.core.adjustment.sources import WITH_CALIBRATION
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.readable import NOTHING, count, expanded, measured, plain, quantity
from omsm_ros.report import style
from omsm_ros.report.page_parts import Section, fill_study, title_block
from omsm_ros.report.tables import Table, sized
from omsm_ros.report.verdict import headline, page_verdict
from omsm_ros.units import MILLIMETRE_M, NANOMETRE_M

_PV = "peak_to_valley"
CAPTIONS = {
    "map": "Form deviation from the nominal surface, pose removed; mean of each cell.",
    "uncertainty": "Standard uncertainty (k = 1) of the map, all sources together.",
    "profiles": "Sections through the map along x, y and 45°, with the band of k = 2.",
    "agreement": "E_n of each scan against the others: above 1 they disagree.",
}


def render(title: str, facts: Mapping[str, Any], found: Adjustment, date: str) -> str:
    """Return the page as HTML.

    facts: the content of ``adjustment.json``;  found: from which it was made;  date: as printed
    """
    origin, verdict = facts.get("origin") or {}, page_verdict(facts["verdict"])
    place = (form := found.form).x, form.y
    figures = {
        "map": height_map(*place, form.height, "form deviation"),
        "uncertainty": height_map(*place, form.uncertainty, "standard uncertainty", "viridis"),
        "profiles": profiles(found),
    }
    if found.agreement:
        figures["agreement"] = agreement(found)
    reasons = [(reason,) for reason in verdict.reasons]
    subtitle = [*map(_scan_text, facts["scans"])]
    if (truth := facts.get("truth")) is not None:
        subtitle.append(f"truth of the twin: PV {quantity(truth[_PV], 'm')}")
    return fill_study(
        title=f"{origin.get('title') or title}: {headline(facts)}",
        block=title_block(origin),
        subtitle="; ".join(subtitle),
        verdict=replace(verdict, reasons=verdict.reasons[:1]),
        sections=(
            Section("Form", ("map",)),
            Section("Reasons for the verdict", (), (Table("", (), reasons),)),
            Section(
                "Uncertainty and sections",
                ("uncertainty", "profiles"),
                (_truth(facts), _figures(facts)),
            ),
            Section("Sources: declared and found", (), (source_table(facts),), tested_text(facts)),
            Section("Agreement of the scans", ("agreement",), (_scans(facts),)),
        ),
        captions=CAPTIONS,
        figures={name: style.png(made) for name, made in figures.items()},
        footer=f"issued {date} · calibration {facts['calibration']}",
    )


def _scan_text(scan: Mapping[str, Any]) -> str:
    way = "outward" if scan["outward"] else "inward"
    return f"{plain(scan['speed_rpm'])} rpm {way}, {count(scan['points'])} points"


def _truth(facts: Mapping[str, Any]) -> Table:
    """Return what only the twin knows; a table without rows for a real part."""
    truth = facts.get("truth")
    names = (("true PV", _PV), ("true rms", "rms"), ("rms error of the map", "map_error_rms"))
    rows = [] if truth is None else [(name, quantity(truth[key], "m")) for name, key in names]
    return Table("Truth of the twin", ("value",), rows)


def _figures(facts: Mapping[str, Any]) -> Table:
    figures = facts["figures"]
    shown = [("PV", figures[_PV], False), ("rms", figures["rms"], False)]
    shown += [(f"Z({t['n']}, {t['m']})", t, True) for t in figures["terms"]]
    rows = [
        (name, expanded(found["value"], found["standard_uncertainty"], "m", signed=signed))
        for name, found, signed in shown
    ]
    return Table("Figures, pose removed", ("value and U (k = 2)",), rows)


def source_table(facts: Mapping[str, Any]) -> Table:
    """Return each source that was declared or is significant: declared against found."""
    shown = [s for s in facts["sources"] if s["declared"] is not None or s["refuted"]]
    shown.sort(key=lambda s: -(s["effect"] or 0.0))
    heads = ("declared (k = 1)", "found (k = 1)", "effect on the heights, rms (k = 1)", "")
    status = ["significant" if s["declared"] is None else "refuted" * s["refuted"] for s in shown]
    rows = zip(shown, status, strict=True)
    return Table("", heads, [(s["text"], _declared(s), *_found(s), said) for s, said in rows])


def tested_text(facts: Mapping[str, Any]) -> str:
    """Return how many further effects were tested without a significant result."""
    others = sum(s["declared"] is None and not s["refuted"] for s in facts["sources"])
    return f"{count(others)} further effects were tested; none is significant"


def _declared(source: Mapping[str, Any]) -> str:
    """Return the declared standard uncertainty, or that there is none."""
    if source["declared"] is None:
        return "not declared"
    added = ", that of the calibration included" * (source["name"] in WITH_CALIBRATION)
    return f"{sized(source['declared'], source['unit'], 2)}{added}"


def _found(source: Mapping[str, Any]) -> tuple[str, str]:
    """Return the found value and its effect on the heights, or that these scans do not show it."""
    if not source["identifiable"]:
        return "not identifiable from these scans", NOTHING
    # A declaration holds for one component, so the mean square over the components is compared.
    size, spread = (float(np.sqrt(np.mean(np.square(source[k])))) for k in ("found", "uncertainty"))
    return (
        measured(size, spread, "" if source["unit"] == "1" else source["unit"]),
        measured(source["effect"], source["effect_uncertainty"], "m"),
    )


def _scans(facts: Mapping[str, Any]) -> Table:
    rows = []
    for k, scan in enumerate(facts["scans"]):
        e_n = next((a for a in facts["agreement"] if a["scan"] == k), None)
        largest = (
            "–" if e_n is None else plain(max(e_n["peak_to_valley"], e_n["rms"], *e_n["terms"]), 2)
        )
        rows.append((f"scan {k + 1}", scan["bag"], _scan_text(scan), largest))
    return Table("", ("recording", "motion", "largest E_n"), rows)


def height_map(
    x: FloatArray, y: FloatArray, heights: FloatArray, name: str, colours: str = style.MAP_COLOURS
) -> Figure:
    """Draw heights at x, y (n,) [m], colours symmetric about zero if some are below it."""
    values, (made, (ax,)) = heights / NANOMETRE_M, style.figure(6.1, 5.0)
    high = float(np.max(np.abs(values)))
    drawn = ax.tripcolor(
        x / MILLIMETRE_M, y / MILLIMETRE_M, values, cmap=colours,
        vmin=-high if np.min(values) < 0 else 0.0, vmax=high, shading="gouraud",
    )  # fmt: skip
    ax.set_aspect("equal")
    bar = made.colorbar(drawn, ax=ax)
    style.quiet(bar.ax)
    style.label(bar.ax, y=f"{name} [nm]")
    style.label(ax, x="x [mm]", y="y [mm]", title=name)
    return made


def profiles(found: Adjustment) -> Figure:
    """Draw sections along x, y and 45° with their band."""
    form = found.form
    made, axes = style.figure(9.2, 5.5, 3, sharex=True)
    radius = np.hypot(form.x, form.y)
    width = 0.06 * float(np.max(radius))
    for ax, (name, angle) in zip(
        axes, (("x", 0.0), ("y", np.pi / 2), ("45°", np.pi / 4)), strict=True
    ):
        along = form.x * np.cos(angle) + form.y * np.sin(angle)
        across = form.y * np.cos(angle) - form.x * np.sin(angle)
        near = np.abs(across) < width
        order = np.argsort(along[near])
        position = along[near][order] / MILLIMETRE_M
        height = form.height[near][order] / NANOMETRE_M
        band = 2 * form.uncertainty[near][order] / NANOMETRE_M
        ax.fill_between(position, height - band, height + band, color=style.AFTER, alpha=0.2,
                        linewidth=0)  # fmt: skip
        ax.plot(position, height, ".-", color=style.AFTER, linewidth=0.9, markersize=3)
        style.label(ax, y="deviation [nm]", title=f"along {name}")
    style.label(axes[-1], x="position [mm]")
    return made


def agreement(found: Adjustment) -> Figure:
    """Draw E_n of PV, rms and terms of each scan against the others."""
    made, (ax,) = style.figure(9.2, 3.4)
    names = ["PV", "rms", *(f"Z({t.n},{t.m})" for t in found.form.terms)]
    width = 0.8 / max(len(found.agreement), 1)
    for k, one in enumerate(found.agreement):
        values = np.array([one.pv, one.rms, *one.terms])
        ax.bar(np.arange(len(values)) + k * width, values, width, label=f"scan {one.scan + 1}")
    ax.axhline(1.0, color=style.TRUTH, linewidth=0.9, linestyle=(0, (4, 2.5)))
    ax.set_xticks(np.arange(len(names)) + 0.4 - width / 2, names, rotation=60)
    style.legend_above(ax)
    style.label(ax, y="E_n")
    return made
