"""Two participants of this computer pass a message, as ``omsm doctor`` asks."""

import subprocess
import sys


def test_two_participants_find_each_other():
    done = subprocess.run(
        [sys.executable, "-m", "omsm_ros.nodes.discovery_check"],
        capture_output=True, text=True, timeout=200, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "a message between two participants" in done.stdout
