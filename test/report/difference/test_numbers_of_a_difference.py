"""Page, JSON and CSV of a comparison agree with its arrays."""

from __future__ import annotations

import csv
import json
import math

import numpy as np
import pytest
from page_tables import PageTables, says

from omsm_ros.core.comparison.compare import compare_measurements_of_part
from omsm_ros.core.comparison.stated_errors import ComparedMeasurement
from omsm_ros.core.surface.measured_points import MeasuredPoints
from omsm_ros.pipelines.difference import facts_of, write_difference
from omsm_ros.readable import figure

RADIUS = 5e-3


def one(name, seed, astigmatism, common=2e-9):
    at = np.linspace(-RADIUS, RADIUS, 45)
    x, y = (part.ravel() for part in np.meshgrid(at, at))
    inside = np.hypot(x, y) < RADIUS
    x, y = x[inside], y[inside]
    height = astigmatism * (x**2 - y**2) / RADIUS**2
    height += np.random.default_rng(seed).normal(0, 1e-9, len(x))
    return ComparedMeasurement(
        name=name, points=MeasuredPoints(x=x, y=y, height=height, notes=("as <it> is",)),
        common=common,
    )  # fmt: skip


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    out = tmp_path_factory.mktemp("difference")
    found = compare_measurements_of_part(one("/a/one.xyz", 0, 80e-9), one("/b/two.xyz", 1, 110e-9))
    facts = facts_of(found)
    for key in "ab":
        facts[key]["notes"] = ["as <it> is"]
    write_difference(out, found, facts)
    return out, found, json.loads((out / "difference.json").read_text(), parse_constant=pytest.fail)


@pytest.fixture(scope="module")
def page(written):
    return PageTables((written[0] / "report.html").read_text())


def test_the_table_of_places_is_the_difference(written):
    """The CSV file holds points, difference and uncertainty to the last bit."""
    out, found, facts = written
    with open(out / "difference.csv", newline="") as stream:
        rows = [{k: float(v) for k, v in row.items()} for row in csv.DictReader(stream)]
    assert len(rows) == facts["difference"]["places"]
    for name, values in (
        ("x_m", found.matched.x), ("y_m", found.matched.y),
        ("difference_m", found.matched.difference), ("uncertainty_m", found.agreement.uncertainty),
    ):  # fmt: skip
        assert [row[name] for row in rows] == values.tolist()
    left = [row["difference_m"] for row in rows]
    mean = math.fsum(v**2 for v in left) / len(left)
    assert facts["difference"]["rms"] == pytest.approx(math.sqrt(mean), rel=1e-12)
    assert facts["difference"]["peak_to_valley"] == pytest.approx(max(left) - min(left), rel=1e-12)
    spread = math.fsum(row["uncertainty_m"] ** 2 for row in rows) / len(rows)
    assert facts["difference"]["uncertainty"] == pytest.approx(math.sqrt(spread), rel=1e-12)


def test_within_is_the_share_of_places_whose_e_n_is_below_one(written):
    _, found, facts = written
    e_n = np.abs(found.matched.difference / (2 * found.agreement.uncertainty))
    assert facts["coverage_factor"] == 2
    assert facts["within"] == pytest.approx(float(np.mean(e_n < 1)), abs=0.02)


def test_each_e_n_is_the_difference_over_its_expanded_uncertainty(written):
    assert written[2]["e_n"]
    assert written[2]["zernike"]["terms"]
    for name, number in written[2]["e_n"].items():
        quotient = (number["a"] - number["b"]) / number["expanded"]
        # Each figure less what noise adds to it, of both nearly the same.
        assert number["e_n"] == pytest.approx(quotient, rel=0.1), name
    for term in written[2]["zernike"]["terms"]:
        assert term["e_n"] == pytest.approx(term["difference"] / term["expanded"], rel=1e-9)
        assert term["expanded"] >= 2 * term["uncertainty"] * (1 - 1e-9)


def test_the_headlines_are_the_numbers_of_the_file(written, page):
    facts = written[2]
    difference = facts["difference"]
    value, detail = page.headlines["Difference, rms"]
    assert says(value, difference["rms"])
    assert says(detail.removeprefix("peak to valley "), difference["peak_to_valley"])
    spread = page.headlines["Expanded uncertainty of a point"][0]
    assert says(spread, 2 * difference["uncertainty"])
    assert int(page.headlines["Points compared"][0].replace(" ", "")) == difference["places"]
    share = page.headlines["|E_n| < 1"][0].removesuffix(" of the area")
    assert says(share, facts["within"], 2)


def test_the_tables_are_the_numbers_of_the_file(written, page):
    facts = written[2]
    rows = page.table("Figures of both measurements; U: 95 % for all figures together")
    assert set(rows) == {figure(name) for name in facts["e_n"]}
    for name, number in facts["e_n"].items():
        a, b, expanded, e_n = rows[figure(name)]
        assert says(a, number["a"], 5), name
        assert says(b, number["b"], 5), name
        assert says(expanded, number["expanded"]), name
        assert says(e_n, number["e_n"]), name
    rows = page.table("Zernike terms of A − B, 1 at the rim")
    assert len(rows) == len(facts["zernike"]["terms"])
    for term in facts["zernike"]["terms"]:
        left, expanded, e_n = rows[f"Z({term['n']}, {term['m']})".replace("-", "−")]
        assert says(left, term["difference"])
        assert says(expanded, term["expanded"])
        assert says(e_n, term["e_n"])


def test_each_measurement_is_reported_with_file_points_and_notes(written, page):
    rows = page.table("Both measurements, uncertainties k = 1")
    assert rows["file"] == ["/a/one.xyz", "/b/two.xyz"]
    facts = written[2]
    for k, side in enumerate("ab"):
        assert int(rows["points"][k].replace(" ", "")) == facts[side]["points"]
        assert says(rows["scatter of a point about its neighbours"][k], facts[side]["scatter"])
        assert says(rows["cell size of the local fits"][k], facts[side]["cell"])
        assert rows["notes"][k] == "as <it> is"


def test_the_matching_is_reported_in_units(written, page):
    rows = page.table("Matching")
    facts = written[2]
    for name, value in facts["registration"]["moved"].items():
        (cell,) = rows[f"B moved in {name}"]
        assert says(cell, value), name
    assert says(rows["grid spacing"][0], facts["resampling"]["spacing"])


def test_thirty_nanometres_of_astigmatism_are_thirty_nanometres(written):
    """The true difference is known; the aperture is a little smaller than the part."""
    terms = {(t["n"], t["m"]): t for t in written[2]["zernike"]["terms"]}
    edge = (RADIUS / written[2]["zernike"]["aperture"]["radius"]) ** 2
    assert terms[2, 2]["difference"] * edge == pytest.approx(-30e-9, abs=1e-9)
    assert abs(terms[2, -2]["difference"]) < 1e-9
    assert written[2]["verdict"] == "differ"
