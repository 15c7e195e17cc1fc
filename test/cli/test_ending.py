"""Commands end on signals of a batch system, a service, or a closed terminal."""

import signal
import subprocess
import sys

import pytest
from soaked import soaked

from omsm_ros import cli


@pytest.mark.parametrize("asked", ["SIGTERM", *soaked("SIGHUP")])
def test_a_command_that_is_asked_to_end_leaves_no_unfinished_file(tmp_path, asked):
    """The process ends by that signal, as its parent expects."""
    block = (
        "import os, signal, sys\n"
        f"signal.signal(signal.{asked}, signal.SIG_DFL)\n"  # also if the tests run under nohup
        "replaced = os.replace\n"
        "def asked(part, target):\n"
        f"    os.kill(os.getpid(), signal.{asked})\n"
        "    replaced(part, target)\n"
        "os.replace = asked\n"
        "from omsm_ros.cli import main\n"
        "sys.exit(main(['plan', 'steps', '--out', sys.argv[1]]))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", block, str(tmp_path / "plan")],
        capture_output=True, text=True, timeout=200,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (-getattr(signal, asked), "")
    assert done.stderr == "omsm: interrupted; no unfinished file was left\n"
    assert [path for path in tmp_path.rglob("*") if not path.is_dir()] == []


def test_what_is_ignored_stays_ignored(tmp_path):
    """SIGHUP is ignored under nohup."""
    block = (
        "import os, signal, sys\n"
        "signal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
        "replaced = os.replace\n"
        "def asked(part, target):\n"
        "    os.kill(os.getpid(), signal.SIGHUP)\n"
        "    replaced(part, target)\n"
        "os.replace = asked\n"
        "from omsm_ros.cli import main\n"
        "sys.exit(main(['plan', 'steps', '--out', sys.argv[1]]))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", block, str(tmp_path / "plan")], capture_output=True, timeout=200
    )
    assert done.returncode == 0
    assert any((tmp_path / "plan").iterdir())


def test_a_command_leaves_the_signals_as_they_were(tmp_path):
    before = signal.getsignal(signal.SIGTERM)
    assert cli.main(["plan", "steps", "--out", str(tmp_path / "plan")]) == 0
    assert signal.getsignal(signal.SIGTERM) is before
