"""`make matrix` runs a goal on each Python that is installed, and says which it skipped."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

import omsm_ros

SCRIPT = Path(omsm_ros.__file__).resolve().parent.parent / "bootstrap" / "matrix.sh"

pytestmark = pytest.mark.skipif(
    not (SCRIPT.exists() and shutil.which("git") and shutil.which("make")),
    reason="needs git, make and the source tree",
)


@pytest.fixture
def tree(tmp_path):
    """A tree whose tests fail on 3.12; 3.11 is a version manager's stub, 3.13 is broken."""
    (tmp_path / "bootstrap").mkdir()
    shutil.copy(SCRIPT, tmp_path / "bootstrap")
    (tmp_path / "Makefile").write_text(
        "test:\n\t@echo tested with $(PYTHON)\n\t@case $(PYTHON) in *3.12) false;; esac\n"
    )
    subprocess.run(["git", "init", "-q"], cwd=tmp_path, check=True)
    subprocess.run(["git", "add", "."], cwd=tmp_path, check=True)
    (tmp_path / "bin").mkdir()
    for version, status in (("3.10", 0), ("3.11", 127), ("3.12", 0), ("3.13", 1)):
        stub = tmp_path / "bin" / f"python{version}"
        stub.write_text(f"#!/bin/sh\nexit {status}\n")
        stub.chmod(0o755)
    return tmp_path


def test_what_is_not_there_is_skipped_and_what_fails_is_named(tree):
    path = f"{tree / 'bin'}:{os.environ['PATH']}"
    done = subprocess.run(
        ["sh", tree / "bootstrap" / "matrix.sh"],
        env={**os.environ, "PATH": path}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert "Python 3.11 is not installed: skipped" in done.stdout
    assert f"tested with {tree}/bin/python3.10" in done.stdout
    assert "passed: 3.10; failed: 3.12" in done.stdout
    assert (tree / "out/matrix/3.10/Makefile").is_file()
