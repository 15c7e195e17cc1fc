"""Names of files and machines in figures: drawn as they are written, whatever they say."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
from hostile.judge import Case, ask, judge
from soaked import soaked

from omsm_ros.io.bag_writer import BagWriter
from omsm_ros.io.calibration_file import save_calibration
from omsm_ros.report import style

NAMES = [r"$\frac$", "a$b$c^", "$$", "旋盤 7", "a\x1b[31m", "100 %_{"]


@pytest.mark.parametrize("name", NAMES)
def test_a_name_is_no_mathematics(name):
    made, (axes,) = style.figure(2.0, 2.0)
    axes.plot([], [], label=style.named(name))
    style.label(axes, y="nm", title=style.named(name))
    axes.legend()
    assert style.png(made).startswith(b"\x89PNG")


@pytest.mark.parametrize("name", [NAMES[0], *soaked(*NAMES[3:5])])
def test_a_machine_may_have_any_name(tmp_path: Path, true_calibration, name):
    pytest.importorskip("sqlalchemy", reason="SQLAlchemy is an optional package")
    named = dataclasses.replace(true_calibration, settings={"machine": name})
    save_calibration(tmp_path / "cal.json", named)
    words = ("history", "--catalogue", "c.sqlite", "--add", "cal.json", "--plot", "p.png", "--json")
    answer = ask(Case(words), tmp_path)
    assert (answer.status, answer.err) == (0, "")
    judge(Case(words), answer, tmp_path)


@pytest.mark.parametrize("name", [NAMES[0], *soaked(NAMES[1])])
def test_a_scan_may_have_any_name(tmp_path: Path, small_scan_blocks, name):
    with BagWriter(tmp_path / f"{name}.mcap", ("/omsm/axes", "/omsm/confocal")) as bag:
        for axes, distance in small_scan_blocks[:30]:
            bag.write_block(axes)
            bag.write_block(distance)
    answer = ask(Case(("spectrum", f"{name}.mcap", "--out", "out", "--json")), tmp_path)
    assert (answer.status, answer.err) == (0, "")
    assert (tmp_path / "out" / "report.html").exists()
