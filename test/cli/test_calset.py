"""``omsm calset``, a scan corrected with its set, and a budget stated in a file."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from omsm_ros import cli
from omsm_ros.io.bag_writer import BagWriter
from omsm_ros.io.bags import AXES_TOPIC, DISTANCE_TOPIC
from omsm_ros.io.calibration_file import save_calibration
from omsm_ros.twin.cell import blocks_of

SOURCES = """\
schema: omsm-sources/1
sources:
  - {source: tilt, value: 1.0e-5, unit: rad, how: declared, reason: dial gauge}
  - {source: clocking, value: 0.0, unit: rad, how: declared, reason: no mark to clock it by}
"""
MIRROR = "shape: off_axis_paraboloid\nparent_focal_length: 25.4e-3\noff_axis_distance: 50.8e-3\n"


def facts(capsys, *arguments):
    assert cli.main([*map(str, arguments), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.fixture
def scan(tmp_path, small_scan):
    path = tmp_path / "scan.mcap"
    with BagWriter(path, (AXES_TOPIC, DISTANCE_TOPIC)) as bag:
        for axes, distance in blocks_of(small_scan, 1000)[:10]:
            bag.write_block(axes)
            bag.write_block(distance)
    return path


@pytest.fixture
def calibrations(tmp_path, true_calibration):
    paths = []
    for number in range(2):
        path = tmp_path / f"cal{number}.json"
        save_calibration(path, replace(true_calibration, settings={"machine": "twin"}))
        paths.append(path)
    return paths


def test_a_set_is_made_and_corrected_with(capsys, tmp_path, scan, calibrations):
    out = tmp_path / "set.json"
    placed = [f"{path}@x={x}" for path, x in zip(calibrations, (0.0, 1.9e-3), strict=True)]
    made = facts(capsys, "calset", *placed, "--out", out)
    assert made["positions"] == [0.0, 1.9e-3]
    assert made["verdict"].startswith("accepted")
    summary = facts(
        capsys, "correct", scan, "--calibration", out, "--out", tmp_path / "result",
        "--no-report", "--settings", '{"machine": "twin"}',
    )  # fmt: skip
    assert summary["calibration_set"] == {"along": "x", "positions": [0.0, 1.9e-3]}
    account = summary["samples"]["axes"]
    assert account["counted"]["beyond"] > 0
    assert account["received"] == account["corrected"] + sum(account["counted"].values())
    assert any("beyond the range" in reason["text"] for reason in summary["verdict"]["reasons"])
    assert cli.main(["calset", *placed, "--out", str(out)]) == 0
    assert "at x = 1.90 mm" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("places", "says"),
    [
        (("", ""), "states no position"),
        (("@x=0", "@z=1e-3"), "along x and z, expected one axis"),
        (("@x=0", "@x=here"), "position is 'here'"),
        (("@x=0", "@x=0"), "at the same x"),
    ],
)
def test_what_makes_no_set_is_refused_on_one_line(capsys, tmp_path, calibrations, places, says):
    placed = [f"{path}{place}" for path, place in zip(calibrations, places, strict=True)]
    assert cli.main(["calset", *placed, "--out", str(tmp_path / "set.json")]) == 2
    said = capsys.readouterr().err.strip()
    assert says in said
    assert "\n" not in said


def test_sources_of_no_name_are_refused(capsys, tmp_path, scan, calibrations):
    """An unset shell variable as sources is refused, as the budget would omit them."""
    words = ["correct", scan, "--calibration", calibrations[0], "--out", tmp_path / "r"]
    assert cli.main([*map(str, words), "--sources", ""]) == 2
    assert capsys.readouterr().err == "omsm: no sources at ''; check the path\n"
    assert not (tmp_path / "r").exists()


def test_sources_in_a_file_reach_points_budget_and_verdict(capsys, tmp_path, scan, calibrations):
    files = {"machine.yaml": SOURCES, "mirror.yaml": MIRROR}
    for name, text in files.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    arguments = [
        "correct", scan, "--calibration", calibrations[0], "--nominal", tmp_path / "mirror.yaml",
        "--out", tmp_path / "result", "--no-report", "--settings", '{"machine": "twin"}',
    ]  # fmt: skip
    silent = facts(capsys, *arguments)
    reported = facts(
        capsys, *arguments, "--sources", tmp_path / "machine.yaml", "--accuracy", "1e-9"
    )
    rows = {row["source"]: row for row in reported["budget"]["sources"]}
    assert rows["tilt"]["reason"] == "dial gauge"
    # 10 µrad over a ring of 2 mm: 20 nm at the rim, 14 nm rms.
    assert rows["tilt"]["height"] == pytest.approx(1e-5 * 2e-3, rel=0.2)
    assert (rows["clocking"]["status"], rows["clocking"]["height"]) == ("declared", 0.0)
    assert rows["drift"]["status"] == "not evaluated"
    assert rows["discretisation"]["status"] == "evaluated"
    before, after = (s["uncertainty"]["median"] for s in (silent, reported))
    assert after == pytest.approx(np.hypot(before, 1e-5 * 1.75e-3), rel=0.03)
    said = [
        [reason["code"] for reason in found["verdict"]["reasons"]] for found in (silent, reported)
    ]
    assert ["uncertainty" in codes for codes in said] == [False, True]
    assert (tmp_path / "result" / "systematic.npz").is_file()
