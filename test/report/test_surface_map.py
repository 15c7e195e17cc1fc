"""The zoomable map: its data are the heights, and its script fetches nothing."""

from __future__ import annotations

import io
import json
import re
import shutil
import subprocess
from base64 import b64decode, b64encode
from hashlib import sha256

import numpy as np
import pytest
from matplotlib import colormaps
from matplotlib.image import imread

from omsm_ros.report.measurement.page import Report, render
from omsm_ros.report.measurement.surface_map import Layer, embedded, policy_of, script
from omsm_ros.report.style import MAP_COLOURS


def layer(count=20_000, unit="nm", symmetric=True, seed=0):
    random = np.random.default_rng(seed)
    radius, angle = 5e-3 * np.sqrt(random.random(count)), 2 * np.pi * random.random(count)
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    return Layer("deviation", x, y, 40e-9 * (x / 5e-3) + 10e-9 * (y / 5e-3), unit, symmetric)


def decoded(entry):
    """Decode heights as the script does: two bytes per pixel, least y first."""
    pixels = np.round(255 * imread(io.BytesIO(b64decode(entry["png"])))).astype(int)
    codes = 256 * pixels[..., 0] + pixels[..., 1]
    return np.where(codes, entry["least"] + (codes - 1) * entry["step"], np.nan)


def test_the_heights_come_back_with_their_place_and_unit():
    entry = json.loads(embedded([layer()]).data)["layers"][0]
    heights = decoded(entry)
    rows, columns = heights.shape
    left, right, bottom, top = entry["extent"]
    x = left + (np.arange(columns) + 0.5) / columns * (right - left)
    y = bottom + (np.arange(rows) + 0.5) / rows * (top - bottom)
    expected = 40 * x[np.newaxis] / 5 + 10 * y[:, np.newaxis] / 5
    known = np.isfinite(heights)
    assert 0.7 < known.mean() < 0.9
    assert np.sqrt(np.mean((heights - expected)[known] ** 2)) < 0.6
    assert not known[0, 0]
    assert entry["step"] < 0.002


def test_colours_leave_out_the_few_and_may_show_all():
    one = layer()
    one.heights[7] = 5e-6
    entry = json.loads(embedded([one]).data)["layers"][0]
    assert entry["robust"][1] == -entry["robust"][0] < 60
    assert entry["full"][1] > 1000
    plain = json.loads(embedded([layer(symmetric=False, unit="µm")]).data)["layers"][0]
    assert plain["full"][0] == pytest.approx(-0.041, abs=2e-3)


def test_a_flat_map_has_a_range():
    flat = Layer("flat", *np.random.default_rng(0).random((2, 50)), np.zeros(50), "nm")
    entry = json.loads(embedded([flat]).data)["layers"][0]
    assert entry["full"][1] > entry["full"][0]
    assert np.nanmax(np.abs(decoded(entry))) == 0


def test_a_map_of_any_cloud_is_small():
    noisy = layer(400_000)
    noisy = Layer("n", noisy.x, noisy.y, np.random.default_rng(1).normal(0, 1e-8, 400_000), "nm")
    assert len(embedded([noisy]).data) < 0.5e6


def page(layers=None):
    layers = layers or [layer(), layer(seed=1)]
    return render(Report("Mirror", "today", {}, map=embedded(layers)))


def test_the_page_allows_this_script_and_no_other():
    html = page()
    inline = re.findall(r"<script>(.*?)</script>", html, re.DOTALL)
    assert len(inline) == 1
    digest = b64encode(sha256(inline[0].encode()).digest()).decode()
    policy = re.search(r'Content-Security-Policy" content="([^"]+)"', html)[1]
    assert f"script-src 'sha256-{digest}'" in policy.replace("&#39;", "'")
    assert policy_of(script()) == f"'sha256-{digest}'"
    assert not re.search(r"https?://|fetch\(|XMLHttpRequest|import\(|eval\(", inline[0])


def test_without_a_map_there_is_no_script():
    html = render(Report("Mirror", "today", {}))
    assert "<script" not in html
    assert "script-src" not in html


@pytest.mark.skipif(not shutil.which("chromium"), reason="no chromium on this machine")
def test_a_browser_draws_it_from_a_file(tmp_path):
    (tmp_path / "page.html").write_text(page(), encoding="utf-8")
    found = subprocess.run(
        [
            "chromium", "--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=3000",
            f"--user-data-dir={tmp_path / 'profile'}", "--window-size=900,1200",
            f"--screenshot={tmp_path / 'page.png'}", (tmp_path / "page.html").as_uri(),
        ],
        capture_output=True, timeout=200, check=False,
    )  # fmt: skip
    picture = imread(tmp_path / "page.png")[..., :3]
    # The ends of the palette are on the map and on its bar.
    for colour in (255 * np.array(colormaps[MAP_COLOURS](end)[:3]) for end in (0.0, 1.0)):
        near = np.all(np.abs(255 * picture - colour) < 12, axis=2)
        assert near.sum() > 300, found.stderr[-500:]


@pytest.mark.skipif(not shutil.which("chromium"), reason="no chromium on this machine")
def test_a_page_that_is_printed_as_soon_as_it_has_loaded_has_its_map(tmp_path):
    """Four maps take a while to decode; drawn, one is a picture of hundreds of places each way."""
    noise = np.random.default_rng(2).normal(0, 1e-8, 400_000)
    large = layer(400_000)
    layers = [Layer(f"map {n}", large.x, large.y, noise, "nm", True) for n in range(4)]
    (tmp_path / "page.html").write_text(page(layers), encoding="utf-8")
    found = subprocess.run(
        [
            "chromium", "--headless", "--no-sandbox", "--disable-gpu",
            f"--user-data-dir={tmp_path / 'profile'}", "--no-pdf-header-footer",
            f"--print-to-pdf={tmp_path / 'page.pdf'}", (tmp_path / "page.html").as_uri(),
        ],
        capture_output=True, timeout=200, check=False,
    )  # fmt: skip
    printed = (tmp_path / "page.pdf").read_bytes()
    widths = [int(width) for width in re.findall(rb"/Width (\d+)", printed)]
    assert widths, found.stderr[-500:]
    assert max(widths) > 300
