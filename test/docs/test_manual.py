"""The manual's commands do what it says, and Sphinx makes it without a warning."""

import os
import re
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

import omsm_ros

ROOT = Path(omsm_ros.__file__).resolve().parent.parent
DOCS = ROOT / "docs"
PAGES = [DOCS / "tutorial.md", *sorted((DOCS / "howto").glob("*.md"))]
# What stands in a block of "sh" is run; what needs a machine, ROS or a network is "text".
COMMANDS = re.compile(r"^ *```sh\n(.*?)^ *```", re.MULTILINE | re.DOTALL)


def commands_of(page):
    """The blocks of a page that are to be run, one after the other."""
    return [textwrap.dedent(b) for b in COMMANDS.findall(page.read_text(encoding="utf-8"))]


# `make soak` runs all; the tutorial, which shows nearly every command, takes half a minute.
QUICK = ("first-calibration",)


@pytest.mark.timeout(180)
@pytest.mark.parametrize(
    "page",
    [
        pytest.param(p, id=p.stem, marks=() if p.stem in QUICK else pytest.mark.soak)
        for p in PAGES
        if commands_of(p)
    ],
)
def test_every_command_runs_as_it_stands(page, tmp_path):
    script = [
        "set -eu",
        f'omsm() {{ {sys.executable} -W error -m omsm_ros.cli "$@"; }}',
        *commands_of(page),
    ]
    done = subprocess.run(
        ["bash", "-c", "\n".join(script)],
        cwd=tmp_path, capture_output=True, text=True, check=False,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]


def test_what_the_tutorial_promises_is_there(tmp_path):
    named = set(re.findall(r"`(shop/[\w/.]+)`", (DOCS / "tutorial.md").read_text("utf-8")))
    assert {"shop/steps.mcap", "shop/scan.mcap", "shop/result/report.html"} <= named


def test_a_page_without_a_way_to_it_is_found_out():
    """Sphinx warns of a page outside of the contents, so this build shows that it looks."""
    pytest.importorskip("sphinx", reason="sphinx makes the manual")
    index = (DOCS / "index.md").read_text(encoding="utf-8")
    for page in DOCS.rglob("*.md"):
        name = page.relative_to(DOCS).with_suffix("").as_posix()
        assert name == "index" or name in re.findall(r"^[\w/-]+$", index, re.MULTILINE)


@pytest.mark.timeout(180)
def test_the_manual_is_made_without_a_warning(tmp_path):
    pytest.importorskip("sphinx", reason="sphinx makes the manual")
    pytest.importorskip("furo", reason="furo is its theme")
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", str(DOCS), str(tmp_path)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    told = (tmp_path / "reference" / "commands.html").read_text(encoding="utf-8")
    assert "omsm identify" in told
    assert "sample period" in (tmp_path / "reference" / "quantities.html").read_text("utf-8")
