import json
import subprocess
import sys

import pytest
from soaked import soaked

from omsm_ros import cli
from omsm_ros.cli import doctor
from omsm_ros.cli.doctor import HostCheck


def test_omsm_alone_tells_what_to_do_next(capsys):
    assert cli.main([]) == 0
    reported = capsys.readouterr().out
    words = [
        line.split("omsm ")[1].split()[0] for line in reported.splitlines() if "  omsm " in line
    ]
    before = ["doctor", "demo", "twin", "plan", "import", "inspect"]
    assert words == [*before, "identify", "predict", "correct", "form", "batch"]


def test_doctor_ends_with_a_refusal_where_something_must_be_mended(capsys, monkeypatch, tmp_path):
    checks = [
        HostCheck("disk", "fine", "room"),
        HostCheck("ROS 2", "faulty", "rclpy without omsm_msgs", "build it"),
    ]
    monkeypatch.setattr(doctor, "examine_host", lambda folder, port: checks)
    assert cli.main(["doctor", "--folder", str(tmp_path)]) == 2
    out, err = capsys.readouterr()
    assert "NO  ROS 2" in out
    assert "→ build it" in out
    assert err.strip() == "omsm: not ready: ROS 2; see the remedies above"
    assert cli.main(["doctor", "--json"]) == 2
    reported = json.loads(capsys.readouterr().out)
    assert [check["state"] for check in reported["checks"]] == ["fine", "faulty"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("doctor", "the folder in which this command runs was deleted"),
        ("plan steps --out p", "cannot write 'p/steps.csv'"),
        ("identify a.mcap --out c.json", "no bag at 'a.mcap'"),
    ],
)
def test_a_deleted_working_folder_is_one_line_of_error(capsys, monkeypatch, tmp_path, words, said):
    monkeypatch.setattr(doctor, "examine_host", lambda folder, port: [doctor._disk(folder)])
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert cli.main(words.split()) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(f"omsm: {said}")
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("option", "says"),
    [("--radius=2", "that of the twin's mirror"), ("--feed=1e-7", "40 000 000 samples")],
)
def test_a_scan_of_the_twin_that_no_memory_holds_is_refused(capsys, tmp_path, option, says):
    assert cli.main(["twin", "--out", str(tmp_path / "shop"), option]) == 2
    assert says in capsys.readouterr().err
    assert not list(tmp_path.rglob("*.mcap"))


def test_bags_of_the_twin_are_what_the_other_commands_take(capsys, tmp_path):
    command = ["twin", "--out", str(tmp_path), "--radius", "5e-4", "--rpm", "60", "--json"]
    assert cli.main(command) == 0
    facts = json.loads(capsys.readouterr().out)
    # Five turns of 0.1 mm at 60 rpm and 1 kHz.
    assert facts["scan_samples"] == 5000
    assert cli.main(["identify", facts["steps"], "--out", str(tmp_path / "cal.json")]) == 0
    arguments = ["--calibration", str(tmp_path / "cal.json"), "--nominal", facts["nominal"]]
    arguments += ["--out", str(tmp_path / "r"), "--no-report", "--json"]
    capsys.readouterr()
    assert cli.main(["correct", facts["scan"], *arguments]) == 0
    summary = json.loads(capsys.readouterr().out)
    # Form error and probe noise: tens of nanometres instead of micrometres.
    assert summary["deviation"]["corrected"]["rms_area_weighted"] < 40e-9
    assert cli.main(command) == 2
    assert "exists" in capsys.readouterr().err


@pytest.mark.soak
def test_the_twin_without_faults_is_safe_to_scan(capsys, tmp_path):
    """Its step test is the planned one, so that the undetected model error is small."""
    assert cli.main(["twin", "--out", str(tmp_path), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    calibration = str(tmp_path / "cal.json")
    assert cli.main(["identify", facts["steps"], "--out", calibration]) == 0
    capsys.readouterr()
    assert cli.main(["predict", facts["scan"], "--calibration", calibration, "--json"]) == 0
    prediction = json.loads(capsys.readouterr().out)
    assert prediction["safe"]
    # The paper's twenty steps leave 1.0 nm, as they do not detect a slow relaxation.
    assert prediction["residual"] < 0.7e-9


@pytest.mark.parametrize("redirected", ["2>/dev/full", *soaked(">&- 2>&-", "2>&-")])
def test_the_exit_status_is_right_without_a_readable_stderr(redirected, tmp_path):
    command = f"{sys.executable} -m omsm_ros.cli inspect none.mcap {redirected}"
    done = subprocess.run(command, shell=True, cwd=tmp_path, capture_output=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (2, b"", b"")


@pytest.mark.parametrize("options", ["--json", *soaked("")])
def test_a_standard_output_that_is_full_is_named(options, tmp_path):
    """Standard output is a full disk."""
    command = f"{sys.executable} -m omsm_ros.cli plan steps --out p {options} >/dev/full"
    done = subprocess.run(
        command, shell=True, cwd=tmp_path, capture_output=True, check=False, text=True
    )
    assert done.returncode == 2
    assert done.stderr.startswith("omsm: cannot write to standard output: No space left on device;")
    assert done.stderr.count("\n") == 1
    assert (tmp_path / "p" / "steps.csv").exists()
