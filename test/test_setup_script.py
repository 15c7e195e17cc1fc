"""The script that colcon installs as a command: Ctrl-C while it loads gives no traceback."""

import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import omsm_ros

ROOT = Path(omsm_ros.__file__).resolve().parent.parent
SLOW = "import time\nprint('loading', flush=True)\ntime.sleep(100)\n"
QUICK = """
import signal, sys
from pathlib import Path

def main():
    heard = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    sys.exit(f"{Path(sys.argv[0]).stem} {sys.argv[1:]} {heard}")
"""


@pytest.fixture
def started(tmp_path):
    """A function that starts the script of a command; ``text`` stands for the module it loads."""
    setup = (ROOT / "setup.py").read_text(encoding="utf-8")
    template = re.search(r'^COMMAND = """\\\n(.*?)^"""', setup, re.DOTALL | re.MULTILINE)[1]

    def start(name, module, text):
        place = tmp_path / "omsm_ros" / module
        place.parent.mkdir(parents=True)
        for folder in {tmp_path / "omsm_ros", place.parent}:
            (folder / "__init__.py").touch()
        place.write_text(text, encoding="utf-8")
        script = tmp_path / name
        script.write_text(template % {"name": name}, encoding="utf-8")
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        return subprocess.Popen([sys.executable, script, "one"], **pipes)

    return start


def test_ctrl_c_while_a_node_loads_ends_it_silently(started):
    with started("corrector", "nodes/start.py", SLOW) as process:
        assert process.stdout.readline() == "loading\n"
        process.send_signal(signal.SIGINT)
        assert process.communicate(timeout=60) == ("", "")
    assert process.returncode == -signal.SIGINT


@pytest.mark.parametrize(
    ("name", "module"), [("corrector", "nodes/start.py"), ("omsm", "cli/__init__.py")]
)
def test_a_command_begins_with_its_name_and_the_usual_handler(started, name, module):
    with started(name, module, QUICK) as process:
        assert process.communicate(timeout=60) == ("", f"{name} ['one'] True\n")
