"""``omsm plan scans``: sets of scans with what they reach, and programs that follow the part."""

import contextlib
import io
import json

import numpy as np
import pytest

from omsm_ros import cli
from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.pipelines.record_bags import write_nominal


@pytest.fixture
def nominal(tmp_path):
    write_nominal(tmp_path / "mirror.yaml")
    return tmp_path / "mirror.yaml"


def planned(capsys, *words):
    assert cli.main(["plan", "scans", "--json", *map(str, words)]) == 0
    return json.loads(capsys.readouterr().out)


def test_the_shortest_verifiable_set_that_reaches_is_chosen(capsys, nominal, tmp_path):
    words = ("--nominal", nominal, "--out", tmp_path, "--accuracy", 100e-9, "--radius", 8e-3)
    found = planned(capsys, *words)
    assert found["reaches"]
    chosen, *others = found["sets"]
    assert found["set"] == chosen["name"]
    assert len(chosen["scans"]) > 1
    reaching = [s for s in others if s["reaches"] and len(s["scans"]) > 1]
    assert reaching
    assert all(chosen["duration"] <= s["duration"] for s in reaching)
    assert len(found["sets"][-1]["scans"]) == 1
    reached = {s["name"]: s["expanded_uncertainty"] for s in found["sets"]}
    # Each is by 300 draws, from which a standard deviation is known to 4 %.
    assert reached["full"] < 1.1 * reached["quick"]
    assert reached["quick"] < 0.5 * reached["single"]
    assert reached["full_beyond"] < 0.7 * reached["full"]


@pytest.fixture(scope="module", params=[(0.0, 1e-10), (1e-3, 1e-6)], ids=["within", "beyond"])
def small(request, tmp_path_factory):
    """Plan scans of 3 mm for a travel of X beyond the axis and an accuracy [m]."""
    (travel, accuracy), folder = request.param, tmp_path_factory.mktemp("small")
    write_nominal(folder / "mirror.yaml")
    (folder / "limits.yaml").write_text(f"x_beyond: {travel}\n")
    words = [
        "plan",
        "scans",
        "--nominal",
        folder / "mirror.yaml",
        "--out",
        folder,
        "--radius",
        3e-3,
    ]
    words += ["--limits", folder / "limits.yaml", "--accuracy", accuracy, "--json"]
    with contextlib.redirect_stdout(io.StringIO()) as said:
        assert cli.main([str(w) for w in words]) == 0
    return travel, json.loads(said.getvalue()), folder


def test_where_no_set_reaches_the_accuracy_a_source_is_named(small):
    travel, found, _ = small
    assert found["reaches"] == (travel > 0)
    assert (found["largest"] is None) == found["reaches"]
    assert found["reaches"] or "the largest contribution is" in found["largest"]


def test_the_programs_follow_the_nominal_surface(small):
    _, found, folder = small
    table = np.genfromtxt(folder / "scan_2.csv", delimiter=",", names=True)
    x, z, c = (table[name] for name in ("x_m", "z_m", "c_rad"))
    height = PAPER_MIRROR.height(x * np.cos(c), -x * np.sin(c))
    np.testing.assert_allclose(z, height, atol=1e-10)
    speed = np.diff(c) / np.diff(table["time_s"]) * 30 / np.pi
    scan = found["sets"][0]["scans"][1]
    np.testing.assert_allclose(speed, scan["rpm"], rtol=1e-3)
    lines = (folder / "scan_2.nc").read_text().splitlines()
    moves = [line for line in lines if line.startswith("G1")]
    assert len(moves) == len(x) - 1
    last = {word[0]: float(word[1:]) for word in moves[-1].split()}
    assert last["Z"] == pytest.approx(z[-1] * 1e3, abs=1e-6)


def test_a_planned_motion_runs_at_its_speed_and_is_predicted(
    capsys, nominal, tmp_path, calibration
):
    words = ["plan", "motion", "--nominal", nominal, "--out", tmp_path, "--radius", 3e-3,
             "--line", 680.0, "--json"]  # fmt: skip
    assert cli.main([str(w) for w in words]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["paths"][0]["error"] <= found["path_error"]
    table = np.genfromtxt(tmp_path / "scan_1.csv", delimiter=",", names=True)
    speed = np.diff(table["c_rad"]) / np.diff(table["time_s"]) * 30 / np.pi
    np.testing.assert_allclose(speed, found["motion"][1]["rpm"], rtol=1e-5)
    motion, known = str(tmp_path / "scan_1.csv"), str(calibration)
    assert cli.main(["predict", motion, "--calibration", known, "--json"]) == 0
    # The third harmonic of a turn is the highest; the window of the spectrum widens it.
    content = json.loads(capsys.readouterr().out)["limits"][1]["value"]
    assert content == pytest.approx(3 * speed[0] / 60, abs=0.2)


def test_a_slide_that_ends_at_the_axis_is_not_sent_beyond(small):
    travel, found, _ = small
    starts = [scan["start"] for one in found["sets"] for scan in one["scans"]]
    assert (min(starts) < 0) == (travel > 0)


@pytest.mark.parametrize("what", ["scans", "motion"])
def test_a_scan_beyond_the_limits_is_refused_with_the_limit(what, capsys, nominal, tmp_path):
    limits = tmp_path / "limits.yaml"
    limits.write_text("spindle_speed_rpm: 20.0\n")
    words = ["plan", what, "--nominal", nominal, "--out", tmp_path, "--limits", limits]
    assert cli.main([str(w) for w in words]) == 2
    assert "--rpm" in capsys.readouterr().err


def test_a_missing_surface_is_named(capsys, tmp_path):
    assert cli.main(["plan", "scans", "--out", str(tmp_path)]) == 2
    assert "--nominal" in capsys.readouterr().err
