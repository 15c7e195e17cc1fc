"""Make the pictures of the manual anew: ``python docs/pictures.py``, two minutes, needs chromium.

overview.png is drawn; the others are screenshots of pages that the commands of the tutorial and
``omsm demo --view`` make.
"""

from __future__ import annotations

import io
import json
import re
import subprocess
import sys
import tempfile
import time
import urllib.request
from base64 import b64decode
from pathlib import Path

import numpy as np
from matplotlib.image import imread, imsave
from websockets.sync.client import connect

from omsm_ros.core.surface.nominal import PAPER_MIRROR
from omsm_ros.io.calibration_file import load_calibration
from omsm_ros.io.results import CloudFile
from omsm_ros.pipelines.correct import MOST_DRAWN
from omsm_ros.pipelines.publish import view_of
from omsm_ros.report import style
from omsm_ros.report.measurement.figures import surface_figures
from omsm_ros.report.response_figures import draw_response
from omsm_ros.twin.plant import Plant

IMAGES = Path(__file__).parent / "images"
OMSM = (sys.executable, "-m", "omsm_ros.cli")


def omsm(words: str) -> None:
    subprocess.run([*OMSM, *words.split()], check=True)


def shot(page: str, name: str, width: int, height: int) -> None:
    """Write a screenshot of the first screen of a page."""
    subprocess.run(
        ["chromium", "--headless=new", "--no-sandbox", "--hide-scrollbars", "--timeout=5000",
         f"--window-size={width},{height}", f"--screenshot={IMAGES / name}", page],
        check=True, capture_output=True,
    )  # fmt: skip


def overview(folder: Path) -> None:
    """Draw the paper's scan before and after the correction, and the response of the probe."""
    omsm(f"twin --out {folder} --radius 0.0127")
    omsm(f"identify {folder}/steps.mcap --out {folder}/cal.json --report {folder}/certificate")
    omsm(f"correct {folder}/scan.mcap --calibration {folder}/cal.json --out {folder}/whole")
    calibration = load_calibration(folder / "cal.json")
    cloud = view_of(CloudFile(folder / "whole" / "cloud.ply").read(MOST_DRAWN), 1e-3)
    maps = surface_figures(cloud, PAPER_MIRROR)
    made, (gain, phase) = style.figure(4.0, 3.35, rows=2, sharex=True)
    frequency = np.geomspace(0.1, 0.5 / calibration.sample_period, 600)
    draw_response(gain, phase, frequency, calibration, Plant().dynamics)
    style.label(phase, x="frequency [Hz]")
    drawn = (maps["raw_map"], maps["corrected_map"], style.png(made))
    parts = [imread(io.BytesIO(one))[..., :3] for one in drawn]
    imsave(IMAGES / "overview.png", np.hstack(parts))


def pages(folder: Path) -> None:
    """Run the tutorial, and show the first screens of its certificate and reports."""
    tutorial = (IMAGES.parent / "tutorial.md").read_text("utf-8")
    script = "set -e\n" + "".join(re.findall(r"```sh\n(.*?)```", tutorial, re.DOTALL))
    subprocess.run(["bash", "-c", script], check=True, cwd=folder)
    shop = f"file://{folder}/shop"
    shot(f"{shop}/certificate/certificate.html", "certificate.png", 1100, 790)
    shot(f"{shop}/result/report.html", "report.png", 1200, 800)
    shot(f"{shop}/adjusted/report.html", "verified.png", 1200, 800)


def live(folder: Path) -> None:
    """Show the live page of the demonstration, which without a terminal ends by itself."""
    page, port = "http://127.0.0.1:8080/", 9333
    with subprocess.Popen([*OMSM, "demo", "--view", "--out", str(folder / "demo")]) as demo:
        while not _answers(page):
            time.sleep(1.0)
        browser = subprocess.Popen(
            ["chromium", "--headless=new", "--no-sandbox", "--hide-scrollbars",
             "--window-size=1380,1060", f"--remote-debugging-port={port}",
             f"--user-data-dir={folder / 'browser'}", page],
            stderr=subprocess.DEVNULL,
        )  # fmt: skip
        time.sleep(5.0)
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as tabs:
            (place,) = (t["webSocketDebuggerUrl"] for t in json.load(tabs) if t["url"] == page)
        with connect(place, max_size=None) as tab:
            # The last one while the page answers shows the end of the second scan.
            while demo.poll() is None and _answers(page):
                tab.send(json.dumps({"id": 1, "method": "Page.captureScreenshot"}))
                content = json.loads(tab.recv())["result"]["data"]
                (IMAGES / "live.png").write_bytes(b64decode(content))
                time.sleep(2.0)
        browser.terminate()


def _answers(page: str) -> bool:
    try:
        urllib.request.urlopen(page, timeout=1.0).close()
    except OSError:
        return False
    return True


if __name__ == "__main__":
    # The browser may still write into its profile when it has been told to end.
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as place:
        for make in (overview, pages, live):
            make(Path(place))
