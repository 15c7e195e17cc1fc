"""Run a campaign on two Dask workers: equal to one process, faster, also with killed workers."""

from __future__ import annotations

import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from benchmarks.offline import save_paper_calibration, write_spiral
from benchmarks.row import Row, at_least, at_most, shown
from omsm_ros.cli.campaign import DONE, Entry, load_campaign, run_campaign

POINTS = 29_000
_BAGS, _ALL_BAGS = 30, 100
_OPTIONS = ("--no-report",)
_WORKERS = 2
_HALVES = "first", "second"


@contextmanager
def _cluster() -> Iterator[Any]:
    """Start two workers on this host, configured as in docs/campaigns.md."""
    import dask
    from distributed import LocalCluster

    with (
        dask.config.set({"distributed.worker.profile.enabled": False}),
        LocalCluster(
            n_workers=_WORKERS,
            threads_per_worker=1,
            dashboard_address=None,
            host="127.0.0.1",
            silence_logs=50,
        ) as cluster,
    ):
        yield cluster


def _clouds(out: Path) -> dict[str, str]:
    """Return digests of the clouds by bag.

    Folders ``*.part``, which the process of a killed worker may still write, are left out.
    """
    return {
        str(path.parent.relative_to(out)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(out.rglob("cloud.ply"))
        if path.parent.suffix != ".part"
    }


def _timed(work: Callable[[], list[Entry]]) -> float:
    begin = time.perf_counter()
    entries = work()
    took = time.perf_counter() - begin
    undone = [entry for entry in entries if entry.state != DONE]
    if undone:
        raise RuntimeError(f"{len(undone)} bags gave no result: {undone[0].said}")
    return took


def _rate_alone(folder: Path, half: str) -> float:
    """Correct half of the bags in one process after the other; return the time [s]."""
    places = folder / "bags" / half, folder / "cal.json", folder / "alone" / half
    return _timed(lambda: run_campaign(*places, _OPTIONS, jobs=1))


def _killed_now_and_then(folder: Path, out: Path, bags: int) -> int:
    """Correct all bags while workers are killed at random; return the number of kills."""
    chance = random.Random(1)
    at = set(chance.sample(range(1, bags - 1), max(2, bags // 10)))
    killed = 0
    with _cluster() as cluster:

        def perhaps_kill(done: int, total: int) -> None:
            nonlocal killed
            processes = [nanny.process.process for nanny in cluster.workers.values()]
            alive = [process for process in processes if process is not None]
            if done in at and alive:
                os.kill(chance.choice(alive).pid, signal.SIGKILL)
                killed += 1

        _timed(
            lambda: run_campaign(
                folder / "bags", folder / "cal.json", out, _OPTIONS,
                scheduler=cluster.scheduler_address, progress=perhaps_kill,
            )
        )  # fmt: skip
    return killed


def _continued(folder: Path, out: Path, bags: int) -> int:
    """Kill the campaign halfway and start it again; return how many bags were corrected twice."""
    command = [sys.executable, "-m", "omsm_ros.cli", "batch", str(folder / "bags"), "--out", out]
    command += ["--calibration", folder / "cal.json", "--jobs", "2", "--json", "--", *_OPTIONS]
    running = subprocess.Popen(command, stdout=subprocess.DEVNULL, start_new_session=True)
    while len(load_campaign(out)) < bags // 2:
        if running.poll() is not None:
            raise RuntimeError("the campaign ended before it was killed")
        time.sleep(0.01)
    os.killpg(running.pid, signal.SIGKILL)
    running.wait()
    begun = {e.bag: (out / e.folder / "cloud.ply").stat().st_mtime_ns for e in load_campaign(out)}
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    entries = json.loads(done.stdout)["entries"]
    now = {e["bag"]: (out / e["folder"] / "cloud.ply").stat().st_mtime_ns for e in entries}
    return sum(now[bag] != when for bag, when in begun.items())


def rows(full: bool) -> Iterator[Row]:
    """Yield figures of one process, of two workers, of killed workers, and of a restart."""
    bags = _ALL_BAGS if full else _BAGS
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        save_paper_calibration(folder / "cal.json")
        for number in range(bags):
            half = folder / "bags" / _HALVES[2 * number // bags]
            half.mkdir(parents=True, exist_ok=True)
            write_spiral(half / f"{number:03d}.mcap", POINTS, seed=number)
        # One process does half of the bags before the two workers and half after them, so that a
        # host that slows down meanwhile affects both alike.
        alone = _rate_alone(folder, _HALVES[0])
        with _cluster() as cluster:
            shared = _timed(
                lambda: run_campaign(
                    folder / "bags", folder / "cal.json", folder / "shared", _OPTIONS,
                    scheduler=cluster.scheduler_address,
                )
            )  # fmt: skip
        alone += _rate_alone(folder, _HALVES[1])
        expected = _clouds(folder / "alone")
        text = f"{bags} bags of {POINTS} points: "
        yield shown(f"{text}one process after the other", alone, "s")
        yield at_least(
            f"{text}two local Dask workers, times as fast", alone / shared, "1", 1.7,
            f"{os.cpu_count()} cores",
        )  # fmt: skip
        yield _others("  clouds that differ from those of one process", folder / "shared", expected)
        killed = _killed_now_and_then(folder, folder / "killed", bags)
        yield _others(f"  the same, {killed} workers killed", folder / "killed", expected)
        twice = _continued(folder, folder / "begun", bags)
        yield at_most("  killed as a whole halfway: bags corrected twice", twice, "1", 0)
        yield _others("  its clouds that differ", folder / "begun", expected)


def _others(name: str, out: Path, expected: dict[str, str]) -> Row:
    found = _clouds(out)
    differ = sum(found.get(bag) != digest for bag, digest in expected.items())
    return at_most(name, differ + len(set(found) - set(expected)), "1", 0)
