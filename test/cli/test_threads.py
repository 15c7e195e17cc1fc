"""A command uses one core, as BLAS threads on small matrices cost more than they gain."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from soaked import soaked

_WORK = """
import os
from omsm_ros import cli
assert cli.main(["correct", "no.mcap", "--calibration", "none.json", "--out", "nowhere"]) == 2
import numpy as np
import scipy.linalg
np.vdot(np.ones(1_000_000), np.ones(1_000_000))
print(len(os.listdir("/proc/self/task")), os.environ["OMP_NUM_THREADS"])
"""


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="threads are counted by Linux")
@pytest.mark.parametrize("asked", [None, *soaked("2")])
def test_a_command_has_one_thread_unless_more_are_asked_for(tmp_path, asked):
    threads = {"OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"}
    environment = {name: value for name, value in os.environ.items() if name not in threads}
    environment |= {"OMP_NUM_THREADS": asked} if asked else {}
    done = subprocess.run(
        [sys.executable, "-c", _WORK],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    running, stated = done.stdout.split()
    assert stated == (asked or "1")
    if asked is None:
        assert running == "1"
