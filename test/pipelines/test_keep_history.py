"""The catalogue: unique rows, several writers, failing databases, drift over months."""

import dataclasses
import json
import os
import sqlite3
import subprocess
import sys
from datetime import datetime

import pytest

from omsm_ros import cli
from omsm_ros.core.calibration.repeatability import LinearTrend
from omsm_ros.errors import ConfigurationError, FileError
from omsm_ros.io import bags, calibration_file
from omsm_ros.io.bag_writer import BagWriter
from omsm_ros.pipelines.history import Catalogue, history, keep, keep_calibration, keep_measurement

pytest.importorskip("sqlalchemy", reason="SQLAlchemy is an optional package")
DAY_NS = 86_400 * 10**9
FIRST_NS = 1_767_225_600 * 10**9  # 2026-01-01


@pytest.fixture
def address(tmp_path):
    """Return the address of an empty catalogue: SQLite, or the server of the environment."""
    return str(tmp_path / "catalogue.sqlite")


def result(folder, bag="scan.mcap", rms=17e-9):
    folder.mkdir(parents=True)
    summary = {
        "bag": bag,
        "calibration": "c" * 64,
        "settings": {"machine": "lathe 1"},
        "versions": {"omsm_ros": "0.1.0"},
        "samples": {"distance": {"received": 100, "corrected": 98, "counted": {"settling": 2}}},
        "figures": {"rms": {"value": rms}, "peak_to_valley": {"value": 5 * rms}},
        "uncertainty": {"median": 1e-8},
    }
    (folder / "summary.json").write_text(json.dumps(summary))
    return folder


def aged(calibration, delay):
    """Return a calibration of the same machine with another lag."""
    dynamics = dataclasses.replace(calibration.dynamics, delay=delay)
    return dataclasses.replace(calibration, dynamics=dynamics, settings={"machine": "lathe 1"})


def test_repeated_statements_are_listed_once(tmp_path, address, true_calibration):
    path = tmp_path / "cal.json"
    calibration_file.save_calibration(path, true_calibration)
    folder = result(tmp_path / "a")
    assert keep(address, path)
    assert keep(address, folder)
    assert not keep(address, path)
    assert not keep(address, folder)
    (twin, lathe) = sorted(history(address)[0], key=lambda m: len(m["measurements"]))
    assert [row["id"] for row in twin["calibrations"]] == [true_calibration.id]
    assert lathe["machine"] == "lathe 1"
    (row,) = lathe["measurements"]
    assert (row["received"], row["corrected"], row["deviation_rms"]) == (100, 98, 17e-9)
    assert row["dynamic_error_rms"] is None


def test_a_row_holds_what_its_calibration_says(tmp_path, address, true_calibration):
    keep_calibration(address, true_calibration, tmp_path / "cal.json")
    (machine,) = history(address)[0]
    (row,) = machine["calibrations"]
    assert row["delay"] == pytest.approx(true_calibration.dynamics.low_frequency_delay)
    assert row["static_gain"] == true_calibration.static_gain
    assert row["verdict"].startswith("accepted")
    assert json.loads(row["settings"]) == {"machine": "twin"}


def _bag(path, day, block):
    axes, distance = block
    with BagWriter(path, (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)) as bag:
        bag.write_block(dataclasses.replace(axes, stamp_ns=FIRST_NS + day * DAY_NS))
        bag.write_block(dataclasses.replace(distance, stamp_ns=FIRST_NS + day * DAY_NS))
    return path


def test_drift_of_a_machine_is_found_over_days(
    tmp_path, address, true_calibration, small_scan_blocks
):
    block = next(iter(small_scan_blocks))
    for day in range(8):
        bag = _bag(tmp_path / f"{day}.mcap", day, block)
        calibration = aged(true_calibration, 1e-6 * day)
        keep_calibration(address, calibration, tmp_path / f"{day}.json", bag)
    (machine,) = history(address, "lathe 1")[0]
    assert [row["recorded_at"] for row in machine["calibrations"]] == [
        datetime(2026, 1, day + 1) for day in range(8)
    ]
    assert machine["delay"]["slope"] * 86_400 == pytest.approx(1e-6, rel=1e-6)
    assert LinearTrend(**machine["delay"]).significant
    assert machine["deviation"] is None
    assert history(address, "lathe 2")[0] == []


def test_a_clock_that_was_never_set_tells_no_time(tmp_path, small_scan_blocks):
    """Stamps of the twin count from zero, which is no date."""
    block = next(iter(small_scan_blocks))
    for day, known in ((-FIRST_NS // DAY_NS, None), (0, FIRST_NS)):
        with bags.BagReader(_bag(tmp_path / f"{day}.mcap", day, block)) as bag:
            assert bag.recorded_ns == known


WRITER = """
import sys
from pathlib import Path
from omsm_ros.pipelines.history import keep_measurement
print("begins", flush=True)
for i in range(10):
    assert keep_measurement(sys.argv[1], Path(sys.argv[2]) / str(i))
"""


def test_two_writers_at_once_lose_nothing(tmp_path, address):
    for writer in "ab":
        for i in range(10):
            result(tmp_path / writer / str(i))
    command = [sys.executable, "-c", WRITER, address, str(tmp_path / "a")]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as other:
        assert other.stdout.readline() == b"begins\n"
        for i in range(10):
            assert keep_measurement(address, tmp_path / "b" / str(i))
    assert other.returncode == 0
    (machine,) = history(address)[0]
    assert len({row["folder"] for row in machine["measurements"]}) == 20


# Databases that fail.


def test_a_correction_does_not_fail_with_its_catalogue(
    capsys, tmp_path, small_scan_blocks, true_calibration
):
    bag = _bag(tmp_path / "scan.mcap", 1, next(iter(small_scan_blocks)))
    calibration_file.save_calibration(tmp_path / "cal.json", true_calibration)
    (tmp_path / "broken.sqlite").write_text("this is no database, " * 100)
    arguments = ["correct", bag, "--calibration", tmp_path / "cal.json", "--no-report", "--json"]
    arguments += ["--out", tmp_path / "out", "--catalogue", tmp_path / "broken.sqlite"]
    assert cli.main([str(a) for a in arguments]) == 0
    reported = json.loads(capsys.readouterr().out)
    assert any("not written into the catalogue" in w for w in reported["warnings"])
    assert (tmp_path / "out" / "cloud.ply").exists()
    assert (
        cli.main(["history", "--catalogue", str(tmp_path / "b"), "--add", str(tmp_path / "out")])
        == 0
    )
    assert "scan.mcap" in capsys.readouterr().out


def test_a_locked_file_is_waited_for_three_seconds_and_named(tmp_path, address, monkeypatch):
    monkeypatch.setattr("omsm_ros.pipelines.history.WAIT_S", 0.2)
    folder = result(tmp_path / "a")
    with Catalogue(address):
        pass
    other = sqlite3.connect(address)
    other.execute("BEGIN EXCLUSIVE")
    try:
        with pytest.raises(FileError, match="locked"):
            keep_measurement(address, folder)
    finally:
        other.close()
    assert keep_measurement(address, folder)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_read_only_disk_is_named(tmp_path, address):
    with Catalogue(address):
        pass
    os.chmod(address, 0o400)
    with pytest.raises(FileError, match="readonly"):
        keep_measurement(address, result(tmp_path / "a"))


@pytest.mark.parametrize("name", ["http://shop/base", "mysql://shop/base", "oracle://x"])
def test_other_databases_are_refused(name):
    with pytest.raises(ConfigurationError, match="expected a file"):
        Catalogue(name)


def test_a_password_is_never_shown(monkeypatch):
    monkeypatch.setattr("omsm_ros.pipelines.history.WAIT_S", 1)
    pytest.importorskip("psycopg", reason="psycopg is an optional package")
    with pytest.raises(FileError) as refused, Catalogue("postgresql://me:sesame@127.0.0.1:1/base"):
        pass
    assert "sesame" not in str(refused.value)
    assert "127.0.0.1" in str(refused.value)


def test_history_is_listed_drawn_and_reported_as_json(capsys, tmp_path, address, true_calibration):
    path = tmp_path / "cal.json"
    calibration_file.save_calibration(path, true_calibration)
    folder = result(tmp_path / "a")
    arguments = ["history", "--catalogue", address, "--add", str(path), str(folder)]
    assert cli.main([*arguments, "--plot", str(tmp_path / "h.png")]) == 0
    reported = capsys.readouterr().out
    assert true_calibration.id[:8] in reported
    assert "form 17.0 nm rms" in reported
    assert "not evaluated: fewer than five" in reported
    assert (tmp_path / "h.png").read_bytes().startswith(b"\x89PNG")
    assert cli.main(["history", "--catalogue", address, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["machines"][0]["machine"] == "lathe 1"


def test_a_question_begins_no_catalogue(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("OMSM_CATALOGUE", raising=False)
    assert cli.main(["history"]) == 2
    assert "set OMSM_CATALOGUE, or create one with --add" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_catalogue_that_is_not_there_is_named_and_not_begun(capsys, tmp_path):
    path = tmp_path / "catalgoue.sqlite"
    assert cli.main(["history", "--catalogue", str(path)]) == 2
    assert "create one with --add" in capsys.readouterr().err
    assert not path.exists()
