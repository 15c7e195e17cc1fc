"""The live page in a real browser, where there is one: points drawn, counts true, reconnection."""

import os
import shutil
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("websockets", reason="websockets is an optional package")
pytest.importorskip("playwright", reason="playwright is not installed")
from playwright.sync_api import sync_playwright

from omsm_ros.core.correction.surface_points import POINT_DTYPE
from omsm_ros.core.streams.blocks import AccelerationBlock
from omsm_ros.live_page.live_view import LiveView
from omsm_ros.live_page.server import LiveServer, render

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this computer")
MINUTES = float(os.environ.get("OMSM_SOAK_MINUTES", "60"))
# Half an hour at 1 kHz kept at four bytes a point would be seven times as much.
MOST_GROWTH_BYTES = 2**20
HEAP = "(gc(), performance.memory.usedJSHeapSize)"
OPTIONS = [
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--enable-precise-memory-info", "--js-flags=--expose-gc",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
]  # fmt: skip


def spiral(count):
    turn, radius = np.linspace(0, 2 * np.pi * 127, count), np.linspace(12.7e-3, 0, count)
    points = np.zeros(count, POINT_DTYPE)
    points["x"], points["y"] = radius * np.cos(turn), radius * np.sin(turn)
    points["height"] = 50e-9 * (radius / 12.7e-3) ** 2 * np.cos(2 * turn)
    return points


def wait_for(page, condition):
    """Until a condition holds; the page's own policy forbids Playwright's way, which evaluates."""
    deadline = time.monotonic() + 30
    while not page.evaluate(condition):
        assert time.monotonic() < deadline, condition
        page.wait_for_timeout(50)


@pytest.fixture
def page():
    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=CHROMIUM, args=OPTIONS)
        opened = browser.new_page()
        opened.troubles = []
        opened.on("pageerror", lambda err: opened.troubles.append(str(err)))
        opened.on(
            "console", lambda m: opened.troubles.append(m.text) if m.type == "error" else None
        )
        yield opened
        browser.close()


def test_points_are_drawn_counted_and_reported_again_after_a_restart(page):
    view = LiveView()
    first = LiveServer(view, render("Cell 1"), "127.0.0.1", 0)
    first.start()
    port = int(first.address.rsplit(":", 1)[1].strip("/"))
    view.add_points(spiral(254_000))
    page.goto(first.address)
    wait_for(page, "livePage.frames > 0 && livePage.latest.points === 254000")
    assert "254 000" in page.inner_text("#numbers")
    drawn = page.evaluate("livePage.layers[0].reduce((n, v) => n + !Number.isNaN(v), 0)")
    place, _ = view._map.since(0)
    assert drawn == len(place) > 40_000
    # Astigmatism: high at the ends of x, low at the ends of y.
    middle = page.evaluate("livePage.cells / 2")
    at = "livePage.layers[0][{row} * livePage.cells + {column}]"
    assert page.evaluate(at.format(row=f"{middle:.0f}", column=f"{2 * middle - 12:.0f}")) > 40
    assert page.evaluate(at.format(row=f"{2 * middle - 12:.0f}", column=f"{middle:.0f}")) < -40
    assert page.troubles == []

    first.stop()
    wait_for(page, "document.getElementById('link').textContent.includes('has ended')")
    assert "Nothing" not in page.inner_text("#light")
    again = LiveServer(view, render("Cell 1"), "127.0.0.1", port)
    again.start()
    frames = page.evaluate("livePage.frames")
    wait_for(page, f"livePage.frames > {frames}")
    assert page.inner_text("#link") == "live"
    again.stop()


def held_bytes():
    """Memory of this process, which has the server in it."""
    status = Path("/proc/self/status").read_text()
    return 1024 * int(status.split("RssAnon:")[1].split()[0])


@pytest.mark.soak
@pytest.mark.timeout(0)
def test_an_hour_without_growing(page):
    """A cell at 1 kHz with an accelerometer, scan after scan, watched by one page all the time.

    Its trace of the error is half an hour long, so the second half of the hour is looked at.
    """
    view = LiveView()
    server = LiveServer(view, render("Cell 1"), "127.0.0.1", 0)
    server.start()
    page.goto(server.address)
    scan, random = spiral(254_000), np.random.default_rng(0)
    seconds, held = round(60 * MINUTES), []
    begin = time.monotonic()
    for second in range(seconds):
        view.add_points(np.take(scan, range(1000 * second, 1000 * second + 1000), mode="wrap"))
        for node in ("driver", "corrector", "calibrator", "recorder", "vibration_monitor"):
            view.add_state(node, "OK", f"second {second}", {"received": str(1000 * second)})
        stamp = 10**9 * second
        view.add_acceleration(
            AccelerationBlock(
                stamp_ns=stamp, first_sample=2000 * second, sample_period=5e-4,
                **dict(zip("xyz", random.normal(0, 0.01, (3, 2000)), strict=True)),
            )
        )  # fmt: skip
        page.wait_for_timeout(max(0.0, 1e3 * (begin + second + 1 - time.monotonic())))
        if second % 60 == 59 and second > seconds / 2:
            held.append((held_bytes(), page.evaluate(HEAP)))
            print(second + 1, held[-1], flush=True)
    wait_for(page, f"livePage.latest.points === {1000 * seconds}")
    assert page.troubles == []
    server.stop()
    # Messages on their way come and go: the least is what is kept.
    early, late = (np.min(part, axis=0) for part in np.array_split(np.array(held), 2))
    assert np.all(late - early < MOST_GROWTH_BYTES), late - early
