"""The background worker frees its resources."""

import os
import platform
import signal
import subprocess
import sys
import time
import weakref
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

from omsm_ros.errors import OmsmError
from omsm_ros.io.child_process import in_child
from omsm_ros.nodes.background_worker import BackgroundWorker
from omsm_ros.nodes.running import settings_of


def outcome(awaited):
    """Return the result of a coroutine without an executor."""
    while True:
        try:
            awaited.send(None)
        except StopIteration as end:
            return end.value
        time.sleep(0.01)


@pytest.fixture
def worker():
    with ExitStack() as undo:
        yield BackgroundWorker(SimpleNamespace(executor=None), undo)


def soon(true):
    end = time.monotonic() + 30.0
    while not true() and time.monotonic() < end:
        time.sleep(0.05)
    return true()


def test_what_was_found_is_kept_by_nobody_but_who_asked(worker):
    class Found:
        pass

    found = outcome(worker.do(Found))
    kept = weakref.ref(found)
    del found
    assert soon(lambda: kept() is None)


def resident_bytes():
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc can be asked for it")
def test_memory_of_the_work_goes_back_to_the_system(worker):
    parts = []

    def work():
        parts.extend(np.ones(10_000) for _ in range(2000))
        del parts[:-1]  # what stays lies above all that is free

    before = resident_bytes()
    outcome(worker.do(work))
    assert resident_bytes() > before + 100e6
    assert soon(lambda: resident_bytes() < before + 30e6)


def test_work_on_a_bag_from_outside_has_a_process_with_limits():
    assert in_child(partial(int, "3")) == 3
    with pytest.raises(OmsmError, match="settings"):
        in_child(partial(settings_of, "["))
    with pytest.raises(OmsmError, match="more than 1 GB"):
        in_child(partial(bytearray, 4 << 30), most_bytes=1 << 30)
    began = time.monotonic()
    with pytest.raises(OmsmError, match=r"in 0\.5 s"):
        in_child(partial(time.sleep, 60.0), seconds=0.5)
    assert time.monotonic() - began < 20.0


@pytest.mark.skipif(sys.platform != "linux", reason="Linux ends a process with its parent")
@pytest.mark.parametrize("method", ["spawn", "fork"])
def test_the_process_of_a_killed_caller_ends(tmp_path, method):
    script = tmp_path / "caller.py"
    script.write_text(
        "import functools, os, pathlib, time\n"
        "from omsm_ros.io.child_process import in_child\n"
        "def work(file):\n"
        "    part = file.with_suffix('.part')\n"
        "    part.write_text(str(os.getpid()))\n"
        "    part.rename(file)\n"
        "    time.sleep(600)\n"
        "if __name__ == '__main__':\n"
        f"    file = pathlib.Path({str(tmp_path / 'pid')!r})\n"
        f"    in_child(functools.partial(work, file), method={method!r})\n"
    )
    caller = subprocess.Popen([sys.executable, str(script)])
    try:
        assert soon((tmp_path / "pid").exists)
        child = int((tmp_path / "pid").read_text())
    finally:
        caller.kill()
        caller.wait()
    try:
        assert soon(lambda: not runs(child))
    finally:
        if runs(child):
            os.kill(child, signal.SIGKILL)


def runs(pid):
    """Whether a process is there and is not only waited for."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
