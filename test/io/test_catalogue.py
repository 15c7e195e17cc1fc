"""A catalogue that was changed by hand is reported in one line and not used."""

import sqlite3
from contextlib import closing

import pytest

pytest.importorskip("sqlalchemy", reason="the extra 'catalogue' is not installed")

from omsm_ros import cli
from omsm_ros.errors import ConfigurationError, FileError
from omsm_ros.pipelines.history import Catalogue, history, keep_calibration


@pytest.fixture
def address(tmp_path, true_calibration):
    found = str(tmp_path / "catalogue.sqlite")
    keep_calibration(found, true_calibration, tmp_path / "cal.json")
    return found


@pytest.mark.parametrize(
    ("change", "reported"),
    [
        ("recorded_at = 'yesterday'", "yesterday"),
        ("added_at = '2026-13-45'", "month must be in 1..12"),
        ("static_gain = 'x'", "static_gain of one of the calibrations is 'x', expected a number"),
        ("delay = 9e999", "delay of one of the calibrations is inf"),
        ("delay = x'00ff'", r"delay of one of the calibrations is b'\x00\xff'"),
        ("machine = x'ff'", r"machine of one of the calibrations is b'\xff', expected str"),
    ],
)
def test_a_row_that_cannot_be_is_named(address, change, reported):
    with closing(sqlite3.connect(address)) as base, base:
        base.execute(f"UPDATE calibrations SET {change}")
    with pytest.raises(FileError, match=r"catalogue .*catalogue.sqlite") as refusal:
        history(address)
    assert reported in str(refusal.value)


def test_a_view_without_end_is_given_up(address, monkeypatch):
    monkeypatch.setattr("omsm_ros.pipelines.history.WAIT_S", 0.2)
    with closing(sqlite3.connect(address)) as base, base:
        columns = [row[1] for row in base.execute("PRAGMA table_info(calibrations)")]
        base.execute("DROP TABLE calibrations")
        base.execute(
            "CREATE VIEW calibrations AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL "
            f"SELECT i + 1 FROM n) SELECT i AS id, {', '.join(f'NULL AS {c}' for c in columns[1:])}"
            " FROM n"
        )
    with pytest.raises(FileError, match="interrupted"):
        history(address)


def test_an_address_that_is_no_text_is_refused():
    with pytest.raises(ConfigurationError, match="in UTF-8"):
        Catalogue("a\udcff.sqlite")


def test_a_part_of_an_address_that_says_nothing_is_refused():
    with pytest.raises(ConfigurationError, match=r"mode=ro', expected a file, sqlite:///FILE"):
        Catalogue("sqlite:///a.sqlite?mode=ro")


@pytest.mark.parametrize("address", ["a\0b", "postgresql://u:secret@[::1"])
def test_an_address_that_is_none_is_named_without_its_password(address):
    with pytest.raises(FileError, match="check that it is there") as refusal, Catalogue(address):
        pass
    assert "secret" not in str(refusal.value)


def test_of_more_rows_than_are_listed_the_newest_are_and_the_others_counted(
    capsys, address, true_calibration, monkeypatch
):
    monkeypatch.setattr("omsm_ros.pipelines.history.MOST_ROWS", 3)
    monkeypatch.setattr("omsm_ros.pipelines.history.MOST_ROWS", 3)
    with closing(sqlite3.connect(address)) as base, base:
        base.execute("UPDATE calibrations SET added_at = '2026-01-01 00:00:00.000000'")
        columns = [row[1] for row in base.execute("PRAGMA table_info(calibrations)")]
        rest = ", ".join(c for c in columns if c not in ("id", "recorded_at", "machine"))
        # Added in another order than they were recorded; the one of no date is the oldest.
        for k in (4, 2, 5, 3):
            base.execute(
                f"INSERT INTO calibrations (id, recorded_at, machine, {rest}) SELECT 'c{k}', "
                f"'2026-0{k}-01 00:00:00.000000', 'm{k % 2}', {rest} FROM calibrations LIMIT 1"
            )
    found = history(address)
    listed = [row["id"] for machine in found[0] for row in machine["calibrations"]]
    assert (listed, found[1]) == (["c4", "c3", "c5"], 2)
    assert history(address, "m0")[1] == 0
    assert cli.main(["history", "--catalogue", address]) == 0
    assert "2 older calibrations and measurements are neither listed" in capsys.readouterr().out


def test_a_figure_of_too_many_machines_is_refused(capsys, address, tmp_path):
    with closing(sqlite3.connect(address)) as base, base:
        columns = [row[1] for row in base.execute("PRAGMA table_info(calibrations)")]
        rest = ", ".join(c for c in columns if c not in ("id", "machine"))
        for k in range(30):
            base.execute(
                f"INSERT INTO calibrations (id, machine, {rest}) "
                f"SELECT 'c{k}', 'm{k}', {rest} FROM calibrations LIMIT 1"
            )
    words = ["history", "--catalogue", address, "--plot", str(tmp_path / "h.png")]
    assert cli.main(words) == 2
    assert "choose one with --machine" in capsys.readouterr().err
    assert cli.main([*words, "--machine", "m3"]) == 0
