"""The page of a comparison states the verdict first, and shows the given data."""

from __future__ import annotations

import json
import re
from functools import cache
from html import unescape

import numpy as np
import pytest

from omsm_ros.core.comparison.compare import compare_measurements_of_part
from omsm_ros.core.comparison.stated_errors import ComparedMeasurement
from omsm_ros.core.surface.measured_points import MeasuredPoints
from omsm_ros.pipelines.difference import facts_of
from omsm_ros.report.difference import CAPTIONS, headlines, map_of, records, render

ATTACK = "<script>alert('x')</script>\"><img src=x onerror=alert(1)>"
RADIUS = 5e-3


def measurement(name, seed, added=0.0, common=2e-9):
    at = np.linspace(-RADIUS, RADIUS, 51)
    x, y = (part.ravel() for part in np.meshgrid(at, at))
    inside = np.hypot(x, y) < RADIUS
    x, y = x[inside], y[inside]
    height = (80e-9 + added) * (x**2 - y**2) / RADIUS**2
    height += np.random.default_rng(seed).normal(0, 1e-9, len(x))
    points = MeasuredPoints(x=x, y=y, height=height)
    return ComparedMeasurement(name=name, points=points, common=common)


def page(added=0.0, common=2e-9, name="b.xyz"):
    return _page(added, common, name)  # one key of the cache, however they are given


@cache
def _page(added, common, name):
    found = compare_measurements_of_part(
        measurement("a.xyz", 0, 0.0, common), measurement(name, 1, added, common)
    )
    facts = facts_of(found)
    for key in "ab":
        facts[key]["notes"] = [ATTACK] if name == ATTACK else []
    return render("A and B", "today", facts, found), facts, found


def _letters(text):
    return re.sub(r"[^a-z]", "", text.lower())


@pytest.mark.parametrize(
    ("added", "common", "level", "word"),
    [
        (0.0, 2e-9, "good", "The two measurements agree"),
        (40e-9, 2e-9, "bad", "The two measurements differ"),
        (0.0, None, "unknown", "Agreement not decided"),
    ],
)
def test_the_verdict_comes_first(added, common, level, word):
    html, facts, _ = page(added, common)
    assert re.search(rf'class="verdict {level}"', html)
    assert html.index(word) < html.index("<h2>Map</h2>")
    for reason in facts["reasons"]:
        assert _letters(reason)[:30] in _letters(unescape(html))


def test_it_fetches_nothing_and_has_every_figure():
    html, _, _ = page()
    addresses = re.findall(r'(?:src|href)="([^"]+)"', html)
    assert len(addresses) == len(CAPTIONS)
    assert all(address.startswith("data:image/png;base64,") for address in addresses)
    assert "https://" not in html


def test_names_from_outside_are_escaped():
    html, _, _ = page(name=ATTACK)
    assert "<script>alert" not in html
    assert "<img src=x" not in html
    assert "&lt;script&gt;alert" in html


def test_the_map_is_the_difference_place_by_place():
    _, _, found = page(40e-9)
    layers = {entry["name"]: entry for entry in json.loads(map_of(found).data)["layers"]}
    assert set(layers) == {"A − B", "E_n", "uncertainty, k = 1", "A", "B"}
    entry = layers["A − B"]
    expected = found.matched.difference * 1e9
    assert entry["least"] == pytest.approx(expected.min(), abs=0.01)
    assert entry["least"] + 65_534 * entry["step"] == pytest.approx(expected.max(), abs=0.01)
    left, right, _, _ = entry["extent"]
    assert right - left == pytest.approx(
        (np.ptp(found.matched.x) + found.matched.grid.dx) * 1e3, rel=1e-9
    )


def test_what_is_not_evaluated_is_not_a_number():
    _, facts, _ = page(common=None)
    assert [h.value for h in headlines(facts)][1] == "not evaluated"
    tables = {table.title: table.rows for table in records(facts)}
    assert all(
        row[-1] == "not evaluated"
        for row in tables["Figures of both measurements; U: 95 % for all figures together"]
    )
    assert not tables["Zernike terms of A − B, 1 at the rim"]


def test_the_page_is_small():
    html, _, _ = page()
    assert len(html) < 1e6
