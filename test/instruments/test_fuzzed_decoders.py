"""Every decoder under fuzzing that is guided by what it executes, where atheris is installed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from .test_decoders_at_length import CASES

pytestmark = pytest.mark.soak


@pytest.mark.parametrize("name", CASES)
def test_no_input_that_reaches_new_code_raises(name: str, tmp_path: Path) -> None:
    pytest.importorskip("atheris", reason="pip install atheris")  # no part of the set-up
    _, good, _ = CASES[name]
    (tmp_path / "good").write_bytes(good()[:4000])
    script = Path(__file__).with_name("fuzzed_decoder.py")
    limits = ("-runs=50000", "-max_total_time=60", "-max_len=4096", f"-artifact_prefix={tmp_path}/")
    done = subprocess.run(
        [sys.executable, str(script), name, *limits, str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert "DONE" in done.stderr
