"""The files of one measurement agree: cloud, summary, form, page and map.

Read by Python's own library; the figures made again from the points by closed form and loops.
"""

import json
import math
import re
from base64 import b64decode
from hashlib import sha256
from itertools import islice

import numpy as np
import plain_readers
import pytest
from page_tables import PageTables, says

from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.io import bags
from omsm_ros.io.bag_writer import BagWriter
from omsm_ros.pipelines.form import RegistrationOptions
from omsm_ros.pipelines.measure import measure

FOCAL, AWAY = 0.0254, 0.0508


def mirror(x, y):
    """Height [m] of the parent's Z = R²/4f over the tangent plane at 45°, by substitution."""
    slope = AWAY / (2 * FOCAL)
    q, height = math.sqrt(1 + slope**2), np.zeros(len(x))
    for _ in range(30):
        height = (((x - slope * height) / q) ** 2 + y**2) / (4 * FOCAL * q)
    return height


@pytest.fixture(scope="module")
def result(tmp_path_factory, small_scan_blocks, true_calibration):
    folder = tmp_path_factory.mktemp("result")
    with BagWriter(folder / "scan.mcap", (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)) as bag:
        for axes, distance in islice(iter(small_scan_blocks), 100):
            bag.write_block(axes)
            bag.write_block(distance)
    out = folder / "out"
    measure(
        folder / "scan.mcap", true_calibration, out, nominal=PAPER_MIRROR, accuracy=1e-6,
        register=RegistrationOptions(("piston", "tip", "tilt"), tolerance=1e-6),
    )  # fmt: skip
    return out


def strict(path):
    """Parse JSON strictly by RFC 8259: no NaN, no repeated name."""

    def once(pairs):
        assert len(dict(pairs)) == len(pairs)
        return dict(pairs)

    text = path.read_text("utf-8")
    return json.loads(text, parse_constant=pytest.fail, object_pairs_hook=once)


@pytest.fixture(scope="module")
def summary(result):
    return strict(result / "summary.json")


@pytest.fixture(scope="module")
def cloud(result):
    raw = (result / "cloud.ply").read_bytes()
    return {name: np.array(v) for name, v in plain_readers.ply(result / "cloud.ply").items()} | {
        "header": raw[:512]
    }


@pytest.fixture(scope="module")
def page(result):
    return PageTables((result / "report.html").read_text("utf-8"))


def test_the_summary_names_the_files_that_there_are(result, summary):
    there = {path.name for path in result.iterdir()}
    assert set(summary["files"].values()) <= there
    assert there - set(summary["files"].values()) == {"curves.json", "systematic.npz"}
    for name in ("form.json", "curves.json"):
        strict(result / name)


def test_the_cloud_names_its_calibration_and_holds_what_the_account_says(cloud, summary):
    assert summary["calibration"].encode() in cloud["header"]
    points = summary["samples"]["distance"]["corrected"]
    assert len(cloud["x"]) == points
    for stream in summary["samples"].values():
        assert stream["received"] == 10_000
        lost = sum(stream["counted"].values())
        assert stream["received"] == stream["corrected"] + stream.get("pending", 0) + lost
    assert summary["deviation"]["corrected"]["points"] == points
    assert np.all(np.diff(cloud["sample"]) == 1)


def test_uncertainty_and_dynamic_error_are_those_of_the_points(cloud, summary):
    spread, error = cloud["uncertainty"], cloud["dynamic_error"]
    assert summary["uncertainty"]["median"] == pytest.approx(float(np.median(spread)), rel=1e-6)
    assert summary["uncertainty"]["largest"] == pytest.approx(max(spread), rel=1e-6)
    before = summary["dynamic_error_before"]
    assert before["peak_to_valley"] == pytest.approx(max(error) - min(error), rel=1e-5)
    assert abs(error).min() < before["rms"] < abs(error).max()


def test_the_deviation_is_that_of_the_points_from_the_mirror(cloud, summary):
    """In double precision of the height; x and y have single precision, 0.1 nm on these slopes."""
    away = cloud["height"] - mirror(cloud["x"], cloud["y"])
    for name, values in (("corrected", away), ("raw", away + cloud["dynamic_error"])):
        reported = summary["deviation"][name]
        assert reported["peak_to_valley"] == pytest.approx(np.ptp(values), abs=1e-9)
        # About a mean value, as piston is not form.
        assert reported["rms"] == pytest.approx(np.std(values), rel=0.02)


def test_the_budget_adds_up_to_the_uncertainty_of_the_points(cloud, summary):
    """The budget is the root of the sum of squares of the sources."""
    parts = [size for name, size in summary["uncertainty_budget"].items()]
    reported = math.sqrt(sum(part**2 for part in parts))
    found = math.sqrt(float(np.mean(cloud["uncertainty"] ** 2)))
    assert reported == pytest.approx(found, rel=1e-3)


def test_the_page_says_what_the_summary_says(page, summary):
    value, detail = page.headlines["Expanded uncertainty"]
    assert says(value, 2 * summary["uncertainty"]["median"])
    assert says(detail.partition("at most ")[2], 2 * summary["uncertainty"]["largest"])
    points = page.headlines["Surface points"][0]
    assert int(points.replace(" ", "")) == summary["samples"]["distance"]["corrected"]
    budget = {row["source"]: row for row in summary["budget"]["sources"]}
    (table,) = (t for t in page.tables if t["title"].startswith("Uncertainty of the heights"))
    *known, open_ones = table["rows"]
    assert open_ones[0] == "not evaluated"
    assert len(known) == sum(row["status"] != "not evaluated" for row in budget.values())
    largest = max(row["height"] or 0.0 for row in budget.values())
    for row in known:
        name = next(n for n in budget if row[0].endswith(f" ({n})"))
        assert says(row[2], budget[name]["height"], largest=largest), name
    provenance = page.table("Provenance")
    assert provenance["recording"] == [summary["bag"].replace("\u202f", " ")]
    assert provenance["calibration"] == [summary["calibration"]]


def test_the_form_is_one_in_its_file_in_the_summary_and_on_the_page(result, summary, page):
    form = strict(result / "form.json")
    for name in ("pose", "deviation", "removed", "points"):
        assert summary["form"][name] == form[name]
    rms = form["deviation"]["rms_form"]
    (reported,) = page.table("Figures of the form")["rms form"]
    found = re.fullmatch(r"([\d.]+) (nm|µm|pm) ± ([\d.]+) \2 \(k = 2\)", reported)
    assert found or reported.startswith("at most"), reported
    if found:
        unit = {"nm": 1e-9, "µm": 1e-6}[found[2]]
        assert float(found[1]) * unit == pytest.approx(rms["value"], rel=0.05)
        assert float(found[3]) * unit == pytest.approx(2 * rms["uncertainty"], rel=0.06)
    shown = {name.removeprefix("not ") for name in page.table("Removed pose")}
    assert set(form["removed"]["fitted"]) <= shown
    left = plain_readers.ply(result / "deviation.ply")
    assert len(left["z"]) == form["points"]["used"]
    assert form["deviation"]["peak_to_valley_of_points"]["value"] == pytest.approx(
        max(left["z"]) - min(left["z"]), rel=1e-9
    )


def test_the_map_of_the_page_is_that_of_the_deviation(result):
    """Each pixel is the mean of its points: none is beyond their range."""
    html = (result / "report.html").read_text("utf-8")
    (found,) = re.findall(r'<script type="application/json">(.*?)</script>', html, re.DOTALL)
    layers = json.loads(found, parse_constant=pytest.fail)["layers"]
    (layer,) = (one for one in layers if one["name"] == "registered deviation")
    left = plain_readers.ply(result / "deviation.ply")
    low, high = min(left["z"]) * 1e9, max(left["z"]) * 1e9
    assert low - 1e-6 <= layer["least"] <= layer["least"] + 65_534 * layer["step"] <= high + 1e-6
    assert layer["extent"][0] == pytest.approx(min(left["x"]) * 1e3)
    assert layer["extent"][2] == pytest.approx(min(left["y"]) * 1e3)
    assert layer["unit"] == "nm"
    assert b64decode(layer["png"]).startswith(b"\x89PNG")


@pytest.mark.soak
def test_the_same_bag_gives_the_same_bytes(result, summary, true_calibration, tmp_path):
    """Except for the page, which states the time of its creation."""
    measure(
        result.parent / "scan.mcap", true_calibration, tmp_path, nominal=PAPER_MIRROR,
        accuracy=1e-6, report=False,
        register=RegistrationOptions(("piston", "tip", "tilt"), tolerance=1e-6),
    )  # fmt: skip
    for name in ("cloud.ply", "deviation.ply", "form.json", "curves.json"):
        one, other = ((at / name).read_bytes() for at in (result, tmp_path))
        assert sha256(one).digest() == sha256(other).digest(), name
    again = strict(tmp_path / "summary.json")
    again["files"]["report"] = "report.html"
    assert again == summary
