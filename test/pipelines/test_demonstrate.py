"""Plan of the demonstration, and its comparison with the true values."""

from __future__ import annotations

from pathlib import Path

import pytest
from written_disturbances import write_disturbances

from benchmarks.disturbance_catalogue import CATALOGUE
from benchmarks.twin_motions import step_test_of
from omsm_ros.errors import FileError, OmsmError
from omsm_ros.pipelines.demonstrate import Demonstration, response_errors, sample_rows
from omsm_ros.twin.disturbances import NOTHING


def test_without_a_file_nothing_is_wrong_with_the_machine(tmp_path):
    plan = Demonstration(tmp_path)
    assert plan.disturbances == NOTHING
    assert plan.emulator_parameters()["disturbances"] == ""


def test_the_emulator_is_given_the_file_by_its_whole_path(tmp_path, monkeypatch):
    latency = CATALOGUE["latency"][2]
    write_disturbances(tmp_path / "d.yaml", latency)
    monkeypatch.chdir(tmp_path)
    plan = Demonstration(tmp_path / "out", disturbance_file=(tmp_path / "d.yaml").relative_to("/"))
    assert Demonstration(tmp_path, disturbance_file=tmp_path / "d.yaml").disturbances == latency
    assert str(plan.emulator_parameters()["disturbances"]).startswith("/")


@pytest.mark.parametrize(
    ("live", "equal", "said"),
    [
        (1000, True, "to the last bit"),
        (900, False, "NO: 100 points are missing live"),
        (1000, False, "NO"),
    ],
)
def test_a_live_cloud_that_differs_says_why(live, equal, said):
    summary = {"live_equals_offline": equal, "live_points": live}
    summary["samples"] = {"distance": {"received": 1010, "corrected": 1000, "counted": {}}}
    (reported,) = [text for name, text in sample_rows(summary) if name.startswith("live cloud")]
    assert reported.startswith(said)
    assert ("--time-lapse" in reported) == (live < 1000)


def test_a_file_that_cannot_be_read_is_reported_before_anything_is_cleared(tmp_path):
    kept = tmp_path / "calibration.json"
    kept.write_text("{}")
    with pytest.raises(FileError, match="nowhere"):
        Demonstration(tmp_path, disturbance_file=tmp_path / "nowhere.yaml").prepare()
    assert kept.exists()


@pytest.mark.parametrize("name", ["scan.mcap", "calibration.json", "log/driver.log", "notes.txt"])
def test_a_folder_with_files_of_a_machine_is_refused_and_stays(tmp_path, name):
    kept = tmp_path / "cell" / name
    kept.parent.mkdir(parents=True)
    kept.write_text("precious")
    with pytest.raises(OmsmError, match="holds files that are not from a demonstration"):
        Demonstration(tmp_path / "cell").prepare()
    assert kept.read_text() == "precious"
    assert [p for p in (tmp_path / "cell").rglob("*") if p.is_file()] == [kept]


def test_the_folder_of_an_earlier_demonstration_is_cleared(tmp_path):
    plan = Demonstration(tmp_path / "demo")
    plan.prepare()
    plan.bag.write_bytes(b"old")
    plan.prepare()
    assert not plan.bag.exists()


def test_the_truth_holds_the_latency(true_calibration):
    """Compared with a latency of 0.34 ms, the plant's dynamics lead by ω · 0.34 ms."""
    step = step_test_of(Demonstration(Path()).scenario, CATALOGUE["latency"][2])
    rows = response_errors(true_calibration, step.truth.response)
    assert len(rows) > 1
    for row in rows:
        assert row["gain_error"] == pytest.approx(0.0, abs=1e-9)
        expected = 360 * row["frequency"] * 0.34e-3
        assert row["phase_error_deg"] == pytest.approx(expected, rel=1e-6)
