"""Python on the pages runs from top to bottom, and its numbers are those of the twin."""

import re
from functools import lru_cache

import numpy as np
import pytest

from omsm_ros import api
from omsm_ros.twin.plant import PAPER_DYNAMICS

from .pages import ROOT

LAG = PAPER_DYNAMICS.low_frequency_delay


def blocks(page, fence="python"):
    """Return the blocks of a page, without the commands of a notebook."""
    text = re.sub(r"^%.*$", "", (ROOT / page).read_text("utf-8"), flags=re.MULTILINE)
    return re.findall(rf"^```{re.escape(fence)}\n(.*?)^```", text, re.M | re.S)


def run(page, fence="python"):
    """Return the names after all blocks of a page."""
    names = {}
    for block in blocks(page, fence):
        exec(block, names)
    return names


@pytest.fixture(autouse=True, scope="module")
def same_recordings_once():
    """Compute a result that several pages ask for once: recordings of the twin are repeatable."""
    with pytest.MonkeyPatch.context() as patch:
        identified, computed = {}, api.identify

        def identify(recording, *arrays):
            name = getattr(recording, "name", None)
            if name is None or name not in identified:
                identified[name] = computed(recording, *arrays)
            return identified[name]

        patch.setattr(api, "identify", identify)
        patch.setattr(api, "simulate", lru_cache(api.simulate))
        yield


def is_right(calibration):
    return abs(calibration.lag - LAG) < 3 * calibration.lag_uncertainty


def test_ten_lines_of_the_readme_draw_a_figure(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (block,) = blocks("README.md")
    assert len(block.strip().splitlines()) <= 10
    names = run("README.md")
    assert is_right(names["calibration"])
    assert (tmp_path / "mirror.png").stat().st_size > 10_000
    assert "accepted" in capsys.readouterr().out


def test_the_page_runs_from_top_to_bottom(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = run("docs/python.md")
    assert is_right(names["calibration"])
    assert names["again"].lag == pytest.approx(names["calibration"].lag, rel=0.05)
    assert names["figure"].axes


@pytest.mark.soak
def test_twelve_tasks_are_done_in_ten_lines_each(tmp_path, monkeypatch, capsys):
    pytest.importorskip("pandas", reason="one task makes a table")
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "docs/howto/tasks.md").read_text("utf-8")
    assert re.findall(r"^## (\d+)\.", text, re.M) == [str(k + 1) for k in range(12)]
    assert all(len(b.strip().splitlines()) <= 10 for b in blocks("docs/howto/tasks.md"))
    names = run("docs/howto/tasks.md")
    said = capsys.readouterr().out
    assert is_right(names["mine"])
    assert names["log"].distance[1] == pytest.approx(-1.5e-6, abs=1e-15)
    assert "agrees" in said
    slow, fast = (names["costs"][rpm].error for rpm in (30, 60))
    # The lag's error is proportional to the speed of Z.
    assert np.ptp(fast) == pytest.approx(2 * np.ptp(slow), rel=0.02)
    assert np.ptp(slow) == pytest.approx(1.23e-6, rel=0.02)
    assert 0 < names["rms"] < 10e-9
    # The probe's noise and resolution, 10.5 nm, white over 500 Hz of path frequency.
    ring, low, high = names["psd"].rms(), 5e3, 5e4
    share = (high - low) / names["psd"].frequency[-1]
    assert names["psd"].rms(low, high) == pytest.approx(ring * share**0.5, rel=0.3)
    assert len(names["table"]) == len(names["points"])
    # The paraboloid moves Z twice a turn: 1 Hz at 30 rpm.
    lines = names["lines"]
    assert lines.rms(0.75, 1.25) > 5 * max(lines.rms(0.1, 0.75), lines.rms(1.25, 50))


# "make docs" runs them all in kernels.
QUICK = ("python-control",)
NOTEBOOKS = sorted(path.stem for path in (ROOT / "docs/notebooks").glob("*.md"))


@pytest.mark.parametrize(
    "name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.soak) for n in NOTEBOOKS]
)
def test_a_notebook_runs(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names = run(f"docs/notebooks/{name}.md", "{code-cell}")
    said = capsys.readouterr().out
    if "calibration" in names:
        assert is_right(names["calibration"])
    if name == "textures-and-vibration":  # the marks' image and the aliased vibration
        assert "371.7 Hz" in said
        assert "320.0 Hz" in said
    if name == "own-csv":  # the digits of the text cost less than the noise
        assert abs(names["calibration"].lag - names["direct"].lag) < 0.1 * 3e-6
    if name == "python-control":
        assert names["given"].lag == pytest.approx(LAG, rel=1e-6)
        assert names["phase_margin"] == pytest.approx(90 - 360 * 20 * LAG, abs=0.5)
    if name == "choosing-speed":
        assert names["found"][120].residual > names["found"][15].residual
