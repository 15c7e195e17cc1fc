"""The report of a comparison of two measurements: one self-contained HTML file."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from omsm_ros.core.comparison.agreement import COVERAGE_FACTOR, ComparedTerm
from omsm_ros.core.comparison.compare import Comparison
from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.messages import text_from
from omsm_ros.readable import NOTHING, count, percent, plain, probability, quantity
from omsm_ros.report import style
from omsm_ros.report.measurement.figures import PROFILES, UNITS_M, cuts, profile
from omsm_ros.report.measurement.surface_map import EmbeddedMap, Layer, embedded, policy_of, script
from omsm_ros.report.page_parts import Headline, fill, picture
from omsm_ros.report.tables import POSE_UNITS, Table, filled
from omsm_ros.report.verdict import PageVerdict

# Half width of a profile's band, and length of its segments, in grid spacings.
_HALF_WIDTH_CELLS, _SEGMENT_CELLS = 1.5, 1.5
# Numbers on an axis have at most four digits.
_LARGEST_NUMBER = 5000
_UNITS = ("nm", "µm", "mm")


def profiles(found: Comparison) -> dict[str, Figure]:
    """Draw the profiles along x and y through the centre, and the mean over rings, by name."""
    matched, agreement = found.matched, found.agreement
    side = matched.grid.dx
    x0, y0 = ((float(v.min()) + float(v.max())) / 2 for v in (matched.x, matched.y))
    a, b = matched.without_fit(np.stack([matched.a, matched.b]))
    shown = {"A": a, "B": b, "A − B": matched.difference}
    if agreement is not None:
        shown["u"] = agreement.uncertainty
    widths = _HALF_WIDTH_CELLS * side, _SEGMENT_CELLS * side, 2 * side
    made = {}
    for name, cut in cuts(matched.x - x0, matched.y - y0, shown, *widths).items():
        if name in CAPTIONS and len(cut["A"].position):
            above = {n: cut[n] for n in "AB"}
            largest = max(float(np.nanmax(np.abs(c.value), initial=0.0)) for c in above.values())
            units = (u for u in _UNITS if largest < _LARGEST_NUMBER * UNITS_M[u])
            title, position = PROFILES[name]
            made[name] = profile(
                above, cut["A − B"], title=title, position=position, unit=next(units, "mm"),
                height="height", lower=("A − B", style.TRUTH),
                band=None if name == "profile_radius" else cut.get("u"),
            )  # fmt: skip
    return made


def terms(numbers: Sequence[ComparedTerm]) -> Figure:
    """Draw E_n of the Zernike terms of the difference, the bounds at ±1."""
    made, (ax,) = style.figure(6.1, 3.6)
    values = np.array([term.e_n for term in numbers])
    colours = np.where(np.abs(values) > 1, style.BEFORE, style.AFTER)
    ax.bar(np.arange(len(values)), values, color=list(colours), width=0.75)
    for bound in (-1.0, 1.0):
        ax.axhline(bound, color=style.TRUTH, linewidth=0.9, linestyle=(0, (4, 2.5)))
    ax.axhline(0.0, color=style.MUTED, linewidth=0.6)
    names = [f"{term.n},{term.m}" for term in numbers]
    ax.set_xticks(np.arange(len(values)), names, rotation=90)
    reach = max(1.3, 1.1 * float(np.max(np.abs(values))))
    ax.set_ylim(-reach, reach)
    style.label(ax, y="E_n", title="Zernike terms (n, m) of the difference")
    return made


_VERDICTS = {
    "agree": ("good", "The two measurements agree"),
    "differ": ("bad", "The two measurements differ"),
    "cannot tell": ("unknown", "Agreement not decided"),
}
_MOST_IN_NANOMETRES_M = 5e-6
CAPTIONS = {
    "profile_x": "Through the centre: both measurements after removal of the fit, and A − B.",
    "profile_y": "Through the centre: both measurements after removal of the fit, and A − B.",
    "profile_radius": "Mean over each ring: symmetric form, and drift of spiral scans.",
    "terms": "Difference divided by its expanded uncertainty (95 % for all terms together); beyond "
    "±1 the measurements disagree.",
}


def render(title: str, date: str, facts: Mapping[str, Any], found: Comparison) -> str:
    """Return the page of ``difference.json`` (``facts``) as HTML; all text is escaped."""
    drawn = profiles(found)
    if found.agreement is not None:
        drawn["terms"] = terms(found.agreement.terms)
    drawing = script()
    level, word = _VERDICTS[facts["verdict"]]
    return fill(
        "difference.html",
        title=title,
        date=date,
        verdict=PageVerdict(level, word, tuple(facts["reasons"])),
        reservations=facts["reservations"],
        headlines=headlines(facts),
        map=map_of(found),
        figures={name: picture(style.png(figure)) for name, figure in drawn.items()},
        caption=CAPTIONS.__getitem__,
        records=[table for table in records(facts) if table.rows],
        script=drawing,
        script_policy=policy_of(drawing),
    )


def map_of(found: Comparison) -> EmbeddedMap:
    """Return maps of the difference, of E_n, and of both measurements after removal of the fit."""
    matched, agreement = found.matched, found.agreement
    a, b = matched.without_fit(np.stack([matched.a, matched.b]))

    def layer(name: str, heights: FloatArray, unit: str, symmetric: bool = True) -> Layer:
        return Layer(name, matched.x, matched.y, heights, unit, symmetric, matched.grid.dx)

    layers = [layer("A − B", matched.difference, "nm")]
    if agreement is not None:
        e_n = matched.difference / (COVERAGE_FACTOR * agreement.uncertainty)
        spread = layer("uncertainty, k = 1", agreement.uncertainty, "nm", symmetric=False)
        layers += [layer("E_n", e_n, "1"), spread]
    unit = "nm" if np.ptp(a) < _MOST_IN_NANOMETRES_M else "µm"
    return embedded([*layers, layer("A", a, unit), layer("B", b, unit)])


def headlines(facts: Mapping[str, Any]) -> list[Headline]:
    """Return the main results."""
    difference = facts["difference"]
    spread = difference["uncertainty"]
    extent = f"peak to valley {quantity(difference['peak_to_valley'], 'm')}"
    bound = "not evaluated" if spread is None else quantity(COVERAGE_FACTOR * spread, "m")
    found = [
        Headline("Difference, rms", quantity(difference["rms"], "m"), extent),
        Headline("Expanded uncertainty of a point", bound, "k = 2, rms over the area"),
    ]
    if facts["within"] is not None:
        text = f"probability of such a difference {probability(facts['probability'])}"
        found.append(Headline("|E_n| < 1", f"{percent(facts['within'])} of the area", text))
    text = f"{percent(difference['shared_area'])} of the smaller area"
    return [*found, Headline("Points compared", count(difference["places"]), text)]


def records(facts: Mapping[str, Any]) -> list[Table]:
    """Return E_n, Zernike terms, both measurements, and how they were matched."""
    return [_numbers(facts), _terms(facts), _sides(facts), _matching(facts)]


def _numbers(facts: Mapping[str, Any]) -> Table:
    numbers = [
        {**n, "name": name, "judged": "not evaluated" if n["e_n"] is None else plain(n["e_n"])}
        for name, n in facts["e_n"].items()
    ]
    columns = {"A": "{a:m/5}", "B": "{b:m/5}", "U of the difference": "{expanded:m}"}
    title = "Figures of both measurements; U: 95 % for all figures together"
    return filled(title, numbers, "{name:figure}", {**columns, "E_n": "{judged}"})


def _terms(facts: Mapping[str, Any]) -> Table:
    zernike = facts["zernike"] or {"terms": ()}
    columns = {"A − B": "{difference:m}", "U, all terms": "{expanded:m}", "E_n": "{e_n:plain}"}
    title = "Zernike terms of A − B, 1 at the rim"
    return filled(title, zernike["terms"], "Z({n}, {m})", columns)


_OF_A_SIDE = {
    "file": "{file}",
    "points": "{points:count}",
    "scatter of a point about its neighbours": "{scatter:m}",
    "largest interpolation error, rms": "{interpolation:m}",
    "cell size of the local fits": "{cell:m}",
}


def _sides(facts: Mapping[str, Any]) -> Table:
    a, b = facts["a"], facts["b"]
    rows = [(name, *(text_from(t, side) for side in (a, b))) for name, t in _OF_A_SIDE.items()]
    for source in dict.fromkeys([*(a["sources"] or {}), *(b["sources"] or {})]):
        sizes = ((side["sources"] or {}).get(source) for side in (a, b))
        name = f"{source.replace('_', ' ')}, common to all points, rms"
        rows.append((name, *(quantity(size, "m") for size in sizes)))
    rows.append(("basis of the drift", a["drift_from"], b["drift_from"]))
    notes = ("; ".join(side.get("notes") or ()) for side in (a, b))
    rows.append(("notes", *(note or NOTHING for note in notes)))
    return Table("Both measurements, uncertainties k = 1", ("A", "B"), rows)


def _matching(facts: Mapping[str, Any]) -> Table:
    moved = facts["registration"]["moved"]
    rows = [
        (
            f"B moved in {name}",
            f"{plain(value)} 1/m" if name == "power" else quantity(value, POSE_UNITS[name]),
        )
        for name, value in moved.items()
    ]
    refused = facts["registration"]["not_determined"]
    rows += [(f"not moved in {name}", str(why)) for name, why in refused.items()]
    rows += [
        ("resampling", facts["resampling"]["method"]),
        ("grid spacing", quantity(facts["resampling"]["spacing"], "m")),
        ("errors common to both", ", ".join(facts["common_errors"]).replace("_", " ") or "none"),
        ("correlation length, unknown form", quantity(facts["correlation_length"], "m")),
    ]
    return Table("Matching", (), rows)
