"""End the benchmarks on a signal, with all processes and files that they created."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_PR_SET_CHILD_SUBREAPER = 36  # of <linux/prctl.h>
_PATIENCE_S = 5.0
# It cleans up and ends by itself when the processes that it serves have ended.
_TRACKER = b"multiprocessing.resource_tracker"


@contextmanager
def nothing_left() -> Iterator[None]:
    """On a signal, end every descendant process and exit with 128 + its number.

    Workers start clusters, nodes and commands, some in sessions of their own. An orphan becomes a
    child of this process, so none is missed. Temporary folders are removed at the end.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1)
    for number in _ENDING:
        signal.signal(number, _end)
    with tempfile.TemporaryDirectory(prefix="omsm-bench-") as folder:
        os.environ["TMPDIR"] = tempfile.tempdir = folder
        yield


def _end(number: int, _: object) -> NoReturn:
    for each in _ENDING:
        signal.signal(each, signal.SIG_IGN)
    last = time.monotonic() + _PATIENCE_S
    while (found := _below(os.getpid())) and time.monotonic() < last:
        for process in found:
            try:
                os.kill(process, signal.SIGKILL)
            except ProcessLookupError:
                continue
        time.sleep(0.02)
    sys.exit(128 + number)


def _below(ancestor: int) -> list[int]:
    """Return the running descendants of a process."""
    children: dict[int, list[int]] = {}
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            # Behind the name, which may hold anything: state, parent.
            state, parent = entry.read_text().rpartition(")")[2].split()[:2]
            tracks = _TRACKER in entry.with_name("cmdline").read_bytes()
        except OSError:
            continue  # it has ended meanwhile
        if state != "Z" and not tracks:
            children.setdefault(int(parent), []).append(int(entry.parent.name))
    found, waiting = [], [ancestor]
    while waiting:
        waiting += (below := children.get(waiting.pop(), []))
        found += below
    return found
