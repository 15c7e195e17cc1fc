"""On a signal the benchmarks end with all processes that they started."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# A worker, its child in a session of its own, and an orphaned grandchild.
FAMILY = """
import subprocess, sys, tempfile, time
from benchmarks.ending import nothing_left
with nothing_left():
    tempfile.NamedTemporaryFile(delete=False).close()
    tree = "sleep 100 & setsid sh -c 'echo $$; sleep 100' & (sleep 100 & echo $!) ; echo $!; wait"
    subprocess.Popen(["sh", "-c", "trap '' TERM; " + tree])
    print(tempfile.gettempdir(), flush=True)
    time.sleep(100)
"""


def alive(process):
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


def gone(processes, seconds=10.0):
    end = time.monotonic() + seconds
    while any(map(alive, processes)) and time.monotonic() < end:
        time.sleep(0.01)
    return [process for process in processes if alive(process)]


def started(command):
    return subprocess.Popen(
        [sys.executable, *command], cwd=ROOT, stdout=subprocess.PIPE, text=True,
        start_new_session=True,
    )  # fmt: skip


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_nothing_is_left_of_processes_and_files(number):
    with started(["-c", FAMILY]) as running:
        said = [running.stdout.readline().strip() for _ in range(4)]
        processes = [int(word) for word in said if word.isdigit()]
        (folder,) = (Path(word) for word in said if not word.isdigit())
        assert len(processes) == 3
        assert len(list(folder.iterdir())) == 1
        running.send_signal(number)
        assert running.wait(20) == 128 + number
        assert gone(processes) == []
        assert not folder.exists()


def children(process):
    found = Path(f"/proc/{process}/task/{process}/children").read_text()
    return [int(word) for word in found.split()]


def test_the_workers_of_a_part_end_too(tmp_path):
    command = ["-m", "benchmarks", "free_path", "--out", str(tmp_path / "b.json")]
    with started(command) as running:
        assert running.stdout.readline(), "the head of the table"
        end = time.monotonic() + 30
        # The tracker of resources, and a worker at least.
        while len(workers := children(running.pid)) < 2 and time.monotonic() < end:
            time.sleep(0.02)
        assert len(workers) >= 2
        os.kill(running.pid, signal.SIGTERM)
        assert running.wait(20) == 128 + signal.SIGTERM
        assert gone(workers) == []
    assert not (tmp_path / "b.json").exists()
