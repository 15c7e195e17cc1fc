"""The background worker frees its resources."""

import os
import platform
import time
import weakref
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")

from omsm_ros.nodes.background_worker import BackgroundWorker


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
