"""The live page: eight hours of points in bounded memory, and how smoothly a map is moved."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.row import Row, at_least, at_most, not_compared, shown
from omsm_ros.core.correction.surface_points import POINT_DTYPE
from omsm_ros.live_page.live_view import LiveView
from omsm_ros.live_page.server import render

_CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
_HOURS, _RATE = 8.0, 1000
_PAPER_POINTS = 254_000
_BLOCK = 100_000
_RADIUS, _FEED = 12.7e-3, 1e-4
_TURNS_S = 2.0
_OPTIONS = [
    "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run",
    "--enable-precise-memory-info", "--js-flags=--expose-gc",
]  # fmt: skip


def spiral(first: int, count: int) -> NDArray[np.void]:
    """Points of spirals inwards, one after the other, each as long as the paper's."""
    second = (first + np.arange(count)) % _PAPER_POINTS / _RATE
    angle, radius = 2 * np.pi * second / _TURNS_S, _RADIUS - _FEED * second / _TURNS_S
    points = np.zeros(count, POINT_DTYPE)
    points["x"], points["y"] = radius * np.cos(angle), radius * np.sin(angle)
    noise = np.random.default_rng(first).normal(0, 10e-9, count)
    points["height"] = 50e-9 * (radius / _RADIUS) ** 2 * np.cos(2 * angle) + noise
    points["uncertainty"] = 10e-9
    return points


def _resident() -> float:
    """Memory of this process [MiB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 2**20


@contextmanager
def _page(view: LiveView) -> Iterator[Any]:
    from playwright.sync_api import sync_playwright

    from omsm_ros.live_page.server import LiveServer

    server = LiveServer(view, render("Benchmark"), "127.0.0.1", 0)
    server.start()
    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=_CHROMIUM, args=_OPTIONS)
        page = browser.new_page(viewport={"width": 1380, "height": 900})
        page.goto(server.address)
        yield page
        browser.close()
    server.stop()


def _wait(page: Any, condition: str) -> None:
    deadline = time.monotonic() + 120
    while not page.evaluate(condition):
        if time.monotonic() > deadline:
            raise RuntimeError(f"waited in vain for {condition}")
        page.wait_for_timeout(100)


_HEAP_MIB = "(gc(), performance.memory.usedJSHeapSize / 2 ** 20)"
# Drawn between two looks at the screen, as a finger moves it; on a processor, without a GPU.
_PAN = """new Promise((done) => {
  const map = livePage.map, times = [];
  map.zoomAt(400, 300, 4);
  const step = (n) => {
    const begin = performance.now();
    map.shift(n % 40 < 20 ? 2 : -2, 0);
    map.canvas.getContext("2d").getImageData(0, 0, 1, 1);
    times.push(performance.now() - begin);
    n < 200 ? requestAnimationFrame(() => step(n + 1)) : done(times);
  };
  const begin = performance.now();
  step(0);
})"""
_FRAMES = """new Promise((done) => {
  const map = livePage.map, begin = performance.now();
  const step = (n) => {
    map.shift(n % 40 < 20 ? 2 : -2, 0);
    n < 200 ? requestAnimationFrame(() => step(n + 1))
            : done(200e3 / (performance.now() - begin));
  };
  step(0);
})"""


def rows(full: bool) -> Iterator[Row]:
    """A tenth of eight hours, all of it with ``--full``."""
    if _CHROMIUM is None:
        yield not_compared("live page", "1", "", "needs a Chromium on this computer")
        return
    try:
        yield from _measured(round(_HOURS * 3600 * _RATE / (1 if full else 10)))
    except ImportError as err:
        yield not_compared("live page", "1", "", f"needs websockets and playwright: {err}")


def _measured(total: int) -> Iterator[Row]:
    view = LiveView()
    with _page(view) as page:
        _add(view, 0, _PAPER_POINTS)
        _wait(page, f"livePage.frames > 0 && livePage.latest.points === {_PAPER_POINTS}")
        drawing = np.array(page.evaluate(_PAN))
        name = f"live page, {_PAPER_POINTS} points moved by hand"
        yield at_least(f"{name}: frames a second", page.evaluate(_FRAMES), "1/s", 20.0)
        yield shown(f"{name}: one drawing, median", float(np.median(drawing)), "ms")
        before = _resident(), page.evaluate(_HEAP_MIB)
        begin = time.process_time()
        _add(view, _PAPER_POINTS, total)
        took = time.process_time() - begin
        _wait(page, f"livePage.latest.points === {total}")
        after = _resident(), page.evaluate(_HEAP_MIB)
        text = f"live page, {total} points: "
        yield at_most(f"{text}memory grown, server", after[0] - before[0], "MiB", 30.0)
        yield at_most(f"{text}memory grown, page", after[1] - before[1], "MiB", 30.0)
        rate = (total - _PAPER_POINTS) / took / 1e6
        yield shown(f"{text}taken in, a second of a core", rate, "10⁶/s")
        said = page.inner_text("#reduction")
        yield at_least("  the page says that it is a reduction", "A reduction" in said, "1", 1)


def _add(view: LiveView, first: int, end: int) -> None:
    for start in range(first, end, _BLOCK):
        view.add_points(spiral(start, min(_BLOCK, end - start)))
