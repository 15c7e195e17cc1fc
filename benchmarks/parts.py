"""The parts of the benchmarks, and how they share the machine."""

from __future__ import annotations

import importlib
import os
import time
import traceback
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from typing import NamedTuple

from benchmarks.row import Row, failed

# The longest parts first, so that all processors are busy to the end.
RESULTS = (
    *("other_plants", "identification", "disturbed", "honesty", "selfcal", "budget"),
    *("spectra", "comparison", "correction", "free_path", "adjustment"),
)
TIMES = ("speed", "form", "real_data", "offline", "live", "devices", "twin", "campaign", "viewer")
PARTS = (*RESULTS, *TIMES)


class Measured(NamedTuple):
    """The rows of a part, with its wall-clock and processor time [s]."""

    part: str
    rows: list[Row]
    wall: float
    processor: float


def _processor_time() -> float:
    """Return the processor time of this process and its ended children [s]."""
    took = os.times()
    return took.user + took.system + took.children_user + took.children_system


def measure(part: str, full: bool) -> Measured:
    """Return all rows of one part; if it fails, the rows so far and a failed one."""
    begin, used = time.monotonic(), _processor_time()
    rows: list[Row] = []
    try:
        for row in importlib.import_module(f"benchmarks.{part}").rows(full):
            rows.append(row)
    except Exception as err:  # the other parts continue
        traceback.print_exc()
        rows.append(failed(f"{part}, to its end", f"{type(err).__name__}: {err}"))
    return Measured(part, rows, time.monotonic() - begin, _processor_time() - used)


def measured(parts: list[str], full: bool) -> Iterator[Measured]:
    """Yield every part as it is done."""
    together = [part for part in RESULTS if part in parts]
    with _processes(len(os.sched_getaffinity(0))) as pool:
        for done in as_completed([pool.submit(measure, part, full) for part in together]):
            yield done.result()
    for part in [part for part in TIMES if part in parts]:
        # In a process of its own, because a child's peak memory is never below its parent's.
        with _processes(1) as alone:
            yield alone.submit(measure, part, full).result()


def _processes(number: int) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(number, get_context("spawn"))
