"""Check that Sphinx builds the manual without a warning; test_run_pages runs its commands."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import omsm_ros

ROOT = Path(omsm_ros.__file__).resolve().parent.parent
DOCS = ROOT / "docs"


def test_what_the_tutorial_promises_is_there(tmp_path):
    named = set(re.findall(r"`(shop/[\w/.]+)`", (DOCS / "tutorial.md").read_text("utf-8")))
    assert {"shop/steps.mcap", "shop/scan.mcap", "shop/result/report.html"} <= named


def test_a_page_without_a_way_to_it_is_found_out():
    """Fail for a page that the index does not list."""
    pytest.importorskip("sphinx", reason="sphinx makes the manual")
    index = (DOCS / "index.md").read_text(encoding="utf-8")
    pages = list(DOCS.rglob("*.md"))
    assert len(pages) > 10
    for page in pages:
        name = page.relative_to(DOCS).with_suffix("").as_posix()
        assert name == "index" or name in re.findall(r"^[\w/-]+$", index, re.MULTILINE)


@pytest.mark.soak
def test_the_manual_is_made_without_a_warning(tmp_path):
    pytest.importorskip("sphinx", reason="sphinx makes the manual")
    pytest.importorskip("furo", reason="furo is its theme")
    pytest.importorskip("myst_nb", reason="myst_nb reads the notebooks")
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-D", "nb_execution_mode=off",
         str(DOCS), str(tmp_path)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    reported = (tmp_path / "reference" / "commands.html").read_text(encoding="utf-8")
    assert "omsm identify" in reported
    assert "omsm_ros.api.identify" in (tmp_path / "python.html").read_text(encoding="utf-8")
    assert "sample period" in (tmp_path / "reference" / "quantities.html").read_text("utf-8")
