"""The catalogue as any program of SQLite finds it: its tables, and what stands in them."""

from __future__ import annotations

import hashlib
import json
import sqlite3
from contextlib import closing
from dataclasses import replace
from datetime import datetime

import pytest
from certified import certified_by

from omsm_ros.errors import ConfigurationError
from omsm_ros.pipelines.history import (
    Catalogue,
    history,
    keep_calibration,
    keep_measurement,
    time_of,
)

pytest.importorskip("sqlalchemy", reason="the extra 'catalogue' is not installed")


@pytest.fixture
def address(tmp_path):
    return str(tmp_path / "c.sqlite")


def rows(address, table):
    with closing(sqlite3.connect(address)) as base:
        base.row_factory = sqlite3.Row
        return [dict(row) for row in base.execute(f"SELECT * FROM {table} ORDER BY rowid")]


def folder_with(path, **parts):
    path.mkdir()
    (path / "summary.json").write_text(json.dumps(parts))
    return path


def test_a_calibration_is_a_row_of_its_own_numbers(tmp_path, address, true_calibration):
    certificate = {"verdict": "accepted", "static_gain_uncertainty": 2e-6}
    made = replace(
        true_calibration, certificate=certified_by(certificate), settings={"machine": "ü 1", "n": 2}
    )
    assert keep_calibration(address, made, tmp_path / "cal.json", tmp_path / "gone.mcap")
    (row,) = rows(address, "calibrations")
    assert row["id"] == made.id
    assert (row["machine"], row["verdict"]) == ("ü 1", "accepted, valid up to 100 Hz")
    assert json.loads(row["settings"]) == {"machine": "ü 1", "n": 2}
    assert row["path"] == str(tmp_path / "cal.json")
    assert row["source"] == str(tmp_path / "gone.mcap")
    assert row["recorded_at"] is None
    for name in ("static_gain", "valid_up_to", "sample_period"):
        assert row[name] == getattr(made, name)
    assert row["static_gain_uncertainty"] == 2e-6
    # The lag of slow motion: minus the slope of the phase at zero, n1 - d1 and the dead time.
    numerator, denominator = made.dynamics.numerator, made.dynamics.denominator
    first = denominator[1] / denominator[0] - numerator[1] / numerator[0]
    assert row["delay"] == pytest.approx(first + made.dynamics.delay, rel=1e-12)


def test_a_measurement_is_a_row_of_its_summary(tmp_path, address):
    summary = {
        "bag": "scan.mcap", "calibration": "c" * 64, "settings": {"machine": "a"},
        "versions": {"omsm_ros": "1.2"}, "uncertainty": {"median": 1.5e-8},
        "samples": {"distance": {"received": 2**40, "corrected": 7}},
        "figures": {"rms": {"value": 1 / 3}, "peak_to_valley": {"value": 2e-9}},
        "dynamic_error_before": {"rms": 4e-7},
    }  # fmt: skip
    folder = folder_with(tmp_path / "r", **summary)
    assert keep_measurement(address, folder)
    (row,) = rows(address, "measurements")
    text = (folder / "summary.json").read_text()
    assert row["id"] == hashlib.sha256(f"{folder}\0{text}".encode()).hexdigest()
    assert (row["received"], row["corrected"]) == (2**40, 7)
    assert row["deviation_rms"] == 1 / 3
    figures = ("deviation_peak_to_valley", "dynamic_error_rms", "uncertainty_median")
    assert [row[name] for name in figures] == [2e-9, 4e-7, 1.5e-8]
    assert (row["version"], row["calibration"], row["machine"]) == ("1.2", "c" * 64, "a")
    assert row["folder"] == str(folder)


def test_a_catalogue_of_an_earlier_version_gets_the_columns_that_it_lacks(tmp_path, address):
    form = {"rms": {"value": 8e-9, "standard_uncertainty": 3e-9}}
    keep_measurement(address, folder_with(tmp_path / "a", figures=form))
    with closing(sqlite3.connect(address)) as base:
        base.execute("ALTER TABLE measurements DROP COLUMN deviation_rms_uncertainty")
        base.commit()
    keep_measurement(address, folder_with(tmp_path / "b", figures=form))
    (machine,) = history(address)[0]
    held = [(r["deviation_rms"], r["deviation_rms_uncertainty"]) for r in machine["measurements"]]
    assert sorted(held, key=str) == [(8e-9, 3e-9), (8e-9, None)]


@pytest.mark.parametrize(
    ("part", "column"),
    [
        ({"uncertainty": {"median": None}}, "uncertainty_median"),
        ({"uncertainty": 3}, "uncertainty_median"),
        ({"uncertainty": {"median": "low"}}, "uncertainty_median"),
        ({"uncertainty": {"median": 1e300}}, "uncertainty_median"),
        ({"samples": {"distance": {"received": -1}}}, "received"),
        ({"samples": {"distance": {"received": 2.5}}}, "received"),
        ({"samples": []}, "corrected"),
        ({}, "deviation_rms"),
    ],
)
def test_what_a_summary_does_not_say_is_null(tmp_path, address, part, column):
    keep_measurement(address, folder_with(tmp_path / "r", **part))
    (row,) = rows(address, "measurements")
    assert row[column] is None
    assert row["settings"] == "{}"


def test_the_same_summary_in_another_folder_is_another_measurement(tmp_path, address):
    folders = [folder_with(tmp_path / name, bag="a.mcap") for name in ("one", "two")]
    assert [keep_measurement(address, folder) for folder in folders * 2] == [
        True,
        True,
        False,
        False,
    ]
    (folders[0] / "summary.json").write_text('{"bag": "b.mcap"}')
    assert keep_measurement(address, folders[0])
    assert len(rows(address, "measurements")) == 3


@pytest.mark.parametrize("machine", ["a' OR '1'='1", 'a"; DROP TABLE calibrations; --', "%", ""])
def test_a_name_is_a_name_and_no_statement(tmp_path, address, true_calibration, machine):
    for k, name in enumerate((machine, "other")):
        made = replace(true_calibration, settings={"machine": name, "k": k})
        keep_calibration(address, made, tmp_path / "cal.json")
    found = history(address, machine)[0]
    assert [m["machine"] for m in found] == ([machine] if machine else ["", "other"])
    assert len(rows(address, "calibrations")) == 2


def test_rows_come_the_oldest_first_whatever_their_order(tmp_path, address):
    with Catalogue(address) as catalogue:
        for k in (3, 1, 2):
            row = {"id": f"m{k}", "recorded_at": datetime(2026, 1, k), "machine": "a"}
            assert catalogue.add("measurements", row)
        assert not catalogue.add("measurements", {"id": "m1", "recorded_at": None, "machine": "b"})
        assert [row["id"] for row in catalogue.rows("measurements")] == ["m1", "m2", "m3"]
        assert catalogue.count("measurements", "a") == 3
        assert catalogue.count("measurements", "b") == catalogue.count("calibrations") == 0
    assert rows(address, "measurements")[0]["recorded_at"] == "2026-01-03 00:00:00.000000"


@pytest.mark.parametrize("stamp", [0, 1_790_000_000_123_456_789, -1, 2**31 * 10**9 - 1])
def test_a_stamp_is_its_instant_in_utc(stamp):
    found = time_of(stamp)
    assert found.tzinfo is None
    assert (found - datetime(1970, 1, 1)).total_seconds() == pytest.approx(stamp / 1e9, abs=2e-6)
    assert time_of(None) is None


@pytest.mark.parametrize(
    "address", ["mysql://a/b", "oracle://x", "postgresql+asyncpg://h/b", "http://h", "://x"]
)
def test_other_servers_are_refused_by_name(address):
    with pytest.raises(ConfigurationError, match="expected a file, sqlite:///FILE or postgresql"):
        Catalogue(address)


def test_a_file_is_one_by_its_path_and_by_its_address(tmp_path, address):
    for name in (address, f"sqlite:///{address}"):
        with Catalogue(name) as catalogue:
            catalogue.add("measurements", {"id": name, "recorded_at": None, "machine": ""})
    assert len(rows(address, "measurements")) == 2
