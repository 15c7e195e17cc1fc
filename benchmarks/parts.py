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

# The long ones first: the processors are then busy to the end.
RESULTS = (
    *("other_plants", "identification", "disturbed", "honesty", "selfcal", "budget"),
    *("spectra", "comparison", "correction", "free_path", "adjustment"),
)
TIMES = ("speed", "form", "real_data", "offline", "live", "devices", "twin", "campaign", "viewer")
PARTS = (*RESULTS, *TIMES)


class Measured(NamedTuple):
    """The rows of a part, and the seconds that it took: of the clock, of the processor."""

    part: str
    rows: list[Row]
    wall: float
    processor: float


def _processor_time() -> float:
    """Seconds that this process and those it waited for have taken."""
    took = os.times()
    return took.user + took.system + took.children_user + took.children_system


def measure(part: str, full: bool) -> Measured:
    """All rows of one part; where it fails, a bar that is not cleared, after those before it."""
    begin, used = time.monotonic(), _processor_time()
    rows: list[Row] = []
    try:
        for row in importlib.import_module(f"benchmarks.{part}").rows(full):
            rows.append(row)
    except Exception as err:  # of many parts, the others are still worth having
        traceback.print_exc()
        rows.append(failed(f"{part}, to its end", f"{type(err).__name__}: {err}"))
    return Measured(part, rows, time.monotonic() - begin, _processor_time() - used)


def measured(parts: list[str], full: bool) -> Iterator[Measured]:
    """Every part, as it gets done."""
    together = [part for part in RESULTS if part in parts]
    with _processes(len(os.sched_getaffinity(0))) as pool:
        for done in as_completed([pool.submit(measure, part, full) for part in together]):
            yield done.result()
    for part in [part for part in TIMES if part in parts]:
        # By itself, for the peak memory that a child reports is never below its parent's.
        with _processes(1) as alone:
            yield alone.submit(measure, part, full).result()


def _processes(number: int) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(number, get_context("spawn"))
