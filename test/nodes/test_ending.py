"""A signal to end is heard whenever it comes."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

# The signal comes as soon as somebody minds it: between two lines that set up who hears it.
EAGER = """
import os, signal, sys
from omsm_ros.nodes import running
number, set_handler = int(sys.argv[1]), signal.signal
set_handler(number, signal.SIG_DFL)  # below nohup a SIGHUP is ignored, and is to be

def signal_at_once(which, handler):
    set_handler(which, handler)
    if which == number:
        os.kill(os.getpid(), number)

signal.signal = signal_at_once
ending = running._SignalEnd()
sys.exit(0 if ending.asked.wait(5) else 3)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_while_its_hearing_is_set_up_is_not_lost(number: signal.Signals) -> None:
    done = subprocess.run(
        [sys.executable, "-c", EAGER, str(int(number))], capture_output=True, text=True, timeout=200
    )
    assert done.returncode == 0, done.stderr
