"""Commands print one line per fact, whatever a file contains."""

import ast
import json
from pathlib import Path

import pytest

import omsm_ros
from omsm_ros import cli
from omsm_ros.cli.command import say, table

from .written import write

STEERING = "\x1b[2J\x9b31m\r\b\n  fault  none found\u2028\u202e\x00\ud800"


def test_what_would_steer_a_terminal_is_written_out(capsys):
    say(STEERING, "±1.0 µm · → 10⁻⁵")
    table([("name", STEERING)])
    said = capsys.readouterr().out
    assert said.count("\n") == 2
    assert said.startswith(
        r"\x1b[2J\x9b31m\r\x08\n  fault  none found\u2028\u202e\x00\ud800 ±1.0 µm"
    )
    assert all(c.isprintable() for c in said.replace("\n", ""))


@pytest.mark.parametrize("named", ["machine", "bag"])
def test_names_in_files_do_not_steer(capsys, tmp_path, named):
    pytest.importorskip("sqlalchemy", reason="SQLAlchemy is an optional package")
    name = STEERING.replace("\ud800", "").replace("\x00", "")
    settings = {"machine": name} if named == "machine" else {}
    summary = {"bag": name if named == "bag" else "scan.mcap", "settings": settings}
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    words = ["history", "--catalogue", str(tmp_path / "c.sqlite"), "--add", str(tmp_path)]
    assert cli.main(words) == 0
    lines = capsys.readouterr().out.splitlines()
    assert sum(r"\x1b[2J" in line for line in lines) == 1
    assert all(line.isprintable() for line in lines)


def test_commands_print_at_one_place():
    """Only JSON, which is ASCII, and error lines, which are cleaned, are printed directly."""
    calls = {}
    for path in Path(cli.__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Name) and node.id == "print":
                calls[path.name] = calls.get(path.name, 0) + 1
    assert calls == {"command.py": 2, "command_line.py": 1}


@pytest.mark.soak
def test_what_is_written_is_where_the_line_says(capsys, small_scan, calibration, tmp_path):
    """All commands state written files alike: names and their folder, or paths."""
    scan = write(tmp_path / "scan.mcap", small_scan)
    nominal = Path(omsm_ros.__file__).parent.parent / "config" / "paper_mirror.yaml"
    result, surface = tmp_path / "result", tmp_path / "look"
    for arguments, expected in (
        (["correct", scan, "--calibration", calibration, "--no-report",
          "--out", result], f"cloud.ply, summary.json in {result}"),
        (["report", result, "--calibration", calibration], f"{result}/report.html"),
        (["form", result, "--nominal", nominal, "--no-report", "--out", tmp_path / "form"],
         f"form.json, curves.json, deviation.ply in {tmp_path}/form"),
        (["surface", "show", nominal, "--radius", "0.002", "--out", surface],
         f"surface.png in {surface}"),
        (["plan", "steps", "--out", tmp_path], f"{tmp_path}/steps.csv, {tmp_path}/steps.nc"),
    ):  # fmt: skip
        assert cli.main([str(argument) for argument in arguments]) == 0
        text = capsys.readouterr().out
        (said,) = [line.split(None, 1)[1] for line in text.splitlines() if "written" in line]
        assert said == expected
        names, _, where = said.partition(" in ")
        assert all((tmp_path / where / name).is_file() for name in names.split(", "))
