"""The HTML page of a comparison: verdict first, nothing fetched from anywhere."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from omsm_ros.core.comparison.agreement import COVERAGE_FACTOR
from omsm_ros.core.comparison.compare import Comparison
from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.readable import NOTHING, count, figure, percent, plain, probability, quantity
from omsm_ros.report.common import style
from omsm_ros.report.common.page_parts import Headline
from omsm_ros.report.common.tables import Table
from omsm_ros.report.common.template import fill, picture
from omsm_ros.report.common.verdict import Verdict
from omsm_ros.report.difference import figures
from omsm_ros.report.maps.surface_map import EmbeddedMap, Layer, embedded, policy_of, script

_VERDICTS = {
    "agree": ("good", "The two measurements agree"),
    "differ": ("bad", "The two measurements differ"),
    "cannot tell": ("unknown", "Nobody can tell whether they agree"),
}
_MOST_IN_NANOMETRES_M = 5e-6
CAPTIONS = {
    "profile_x": "Through the middle: both measurements less the fitted freedoms, and A − B.",
    "profile_y": "Through the middle: both measurements less the fitted freedoms, and A − B.",
    "profile_radius": "What is the same all around, such as rings; drift of a spiral scan is here.",
    "terms": "Difference over its expanded uncertainty, which holds for all terms together "
    "with 95 %; beyond ±1 they disagree.",
}


def render(title: str, date: str, facts: Mapping[str, Any], found: Comparison) -> str:
    """Return the page as HTML; all text from outside is escaped.

    facts: the content of ``difference.json``
    """
    drawn = figures.profiles(found)
    if found.agreement is not None:
        drawn["terms"] = figures.terms(found.agreement.terms)
    drawing = script()
    level, word = _VERDICTS[facts["verdict"]]
    return fill(
        "difference.html",
        title=title,
        date=date,
        verdict=Verdict(level, word, tuple(facts["reasons"])),
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
    """Return maps of the difference, of E_n and of both measurements less the fitted freedoms."""
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
    """Return the numbers that a reader looks for first."""
    difference = facts["difference"]
    spread = difference["uncertainty"]
    found = [
        Headline(
            "Difference, rms",
            quantity(difference["rms"], "m"),
            f"peak to valley {quantity(difference['peak_to_valley'], 'm')}",
        ),
        Headline(
            "Expanded uncertainty of a place",
            "not evaluated" if spread is None else quantity(COVERAGE_FACTOR * spread, "m"),
            "k = 2, rms over the area",
        ),
    ]
    if facts["within"] is not None:
        text = f"probability of such a difference {probability(facts['probability'])}"
        found.append(Headline("|E_n| < 1", f"{percent(facts['within'])} of the area", text))
    text = f"{percent(difference['shared_area'])} of the smaller area"
    return [*found, Headline("Places compared", count(difference["places"]), text)]


def records(facts: Mapping[str, Any]) -> list[Table]:
    """Return E_n, terms, what each brought, and how they were matched."""
    return [_numbers(facts), _terms(facts), _sides(facts), _matching(facts)]


def _numbers(facts: Mapping[str, Any]) -> Table:
    rows = [
        (
            figure(name),
            quantity(n["a"], "m", 5),
            quantity(n["b"], "m", 5),
            NOTHING if n["expanded"] is None else quantity(n["expanded"], "m"),
            "not evaluated" if n["e_n"] is None else plain(n["e_n"]),
        )
        for name, n in facts["e_n"].items()
    ]
    return Table(
        "Figures of both; U: 95 % for all together", ("A", "B", "U of the difference", "E_n"), rows
    )


def _terms(facts: Mapping[str, Any]) -> Table:
    zernike = facts["zernike"] or {"terms": ()}
    rows = [
        (
            f"Z({t['n']}, {t['m']})",
            quantity(t["difference"], "m"),
            quantity(t["expanded"], "m"),
            plain(t["e_n"]),
        )
        for t in zernike["terms"]
    ]
    return Table("Zernike terms of A − B, one at the rim", ("A − B", "U, all terms", "E_n"), rows)


def _sides(facts: Mapping[str, Any]) -> Table:
    a, b = facts["a"], facts["b"]
    rows = [("file", str(a["file"]), str(b["file"]))]
    rows.append(("points", count(a["points"]), count(b["points"])))
    for key, name in (
        ("scatter", "scatter of a point about its neighbours"),
        ("interpolation", "interpolation, rms, at most"),
        ("cell", "cell of the local fits"),
    ):
        rows.append((name, quantity(a[key], "m"), quantity(b[key], "m")))
    sources = dict.fromkeys([*(a["sources"] or {}), *(b["sources"] or {})])
    for source in sources:
        sizes = ((side["sources"] or {}).get(source) for side in (a, b))
        name = f"{source.replace('_', ' ')}, on all together, rms"
        rows.append((name, *(quantity(size, "m") for size in sizes)))
    rows.append(("drift known by", a["drift_from"], b["drift_from"]))
    notes = ("; ".join(side.get("notes") or ()) for side in (a, b))
    rows.append(("notes", *(note or NOTHING for note in notes)))
    return Table("What each brought, k = 1", ("A", "B"), rows)


_UNITS = {"piston": "m", "x": "m", "y": "m", "tip": "rad", "tilt": "rad", "clocking": "rad"}


def _matching(facts: Mapping[str, Any]) -> Table:
    moved = facts["registration"]["moved"]
    rows = [
        (
            f"B moved in {name}",
            quantity(value, _UNITS[name]) if name in _UNITS else f"{plain(value)} 1/m",
        )
        for name, value in moved.items()
    ]
    refused = facts["registration"]["not_determined"]
    rows += [(f"not moved in {name}", str(why)) for name, why in refused.items()]
    rows += [
        ("resampled by", facts["resampling"]["method"]),
        ("places", quantity(facts["resampling"]["spacing"], "m")),
        ("one and the same error in both", ", ".join(facts["common_errors"]) or "none"),
        ("errors of unknown form correlated over", quantity(facts["correlation_length"], "m")),
    ]
    return Table("Matching", (), rows)
