"""No result overwrites a recording or an input."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest

from omsm_ros.cli import main
from omsm_ros.cli.command_line import check_outputs
from omsm_ros.errors import ConfigurationError


@pytest.fixture
def shop(tmp_path, monkeypatch):
    """Create empty files; no test reads them."""
    monkeypatch.chdir(tmp_path)
    for name in ("steps.mcap", "older.mcap", "run.csv", "cal.json", "geo.yaml", "points.xyz"):
        Path(name).write_text(name)
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "metadata.yaml").write_text("")
    Path("link.mcap").symlink_to("steps.mcap")
    return tmp_path


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("identify steps.mcap --out steps.mcap", "is an input"),
        ("identify steps.mcap --out ./link.mcap", "is an input"),
        ("identify steps.mcap --out older.mcap", "is a recording"),
        ("identify run.csv --input u --output y --period 1 --out run.csv", "is an input"),
        ("validate cal.json run.csv --input u --output y --out run.csv", "is an input"),
        ("validate cal.json run.csv --input u --output y --out cal.json", "is an input"),
        ("export points.xyz --out points.xyz", "is an input"),
        ("selfcal steps.mcap older.mcap --out older.mcap", "is an input"),
        ("calset cal.json@x=0 cal.json@x=1 --out cal.json", "is an input"),
        ("align steps.mcap --calibration cal.json --radius 1 --out cal.json", "is an input"),
        ("history --catalogue h.sqlite --add cal.json --plot cal.json", "is an input"),
        ("correct bag --calibration cal.json --out bag", "is an input"),
        ("form points.xyz --nominal geo.yaml --out points.xyz", "is an input"),
    ],
)
def test_what_is_read_is_not_written(shop, capsys, words, said):
    before = {path: path.read_text() for path in shop.iterdir() if path.is_file()}
    assert main(words.split()) == 2
    err = capsys.readouterr().err
    assert said in err
    assert "give another name" in err
    assert err.count("\n") == 1
    assert {path: path.read_text() for path in shop.iterdir() if path.is_file()} == before


@pytest.mark.parametrize(
    ("command", "given"),
    [
        ("latency", {"calibration": "cal.json", "out": "cal.json"}),
        ("align", {"bag": "steps.mcap", "geometry": "geo.yaml", "out": "geo.yaml"}),
        ("identify", {"recording": "steps.mcap", "out": "cal.json"}),
        ("form", {"measured": "folder", "out": "folder"}),
        ("identify", {"recording": "steps.mcap", "out": "new.json", "settings": "x" * 5000}),
    ],
)
def test_a_result_may_take_the_place_of_its_like(shop, command, given):
    (shop / "folder").mkdir()
    check_outputs(argparse.Namespace(command=command, **{n: Path(v) for n, v in given.items()}))


def test_a_bag_in_a_pipe_or_a_name_too_long_is_left_to_whoever_opens_it(shop):
    check_outputs(argparse.Namespace(command="identify", out=Path("x" * 300), bag=Path("y" * 300)))
    with pytest.raises(ConfigurationError):
        check_outputs(argparse.Namespace(command="x", out=Path("run.csv"), bag=[("run.csv", 1.0)]))
