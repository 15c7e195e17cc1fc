"""The colours and helpers that all figures share."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
from itertools import pairwise

import matplotlib
import numpy as np
import pytest
from matplotlib.colors import to_rgb

from omsm_ros.report import style

# Machado, Oliveira and Fernandes (2009), severity 1, on linear RGB.
DEUTERANOPIA = np.array(
    [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]]
)
PROTANOPIA = np.array(
    [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ]
)
SIGHTS = {"normal": np.eye(3), "deuteranopia": DEUTERANOPIA, "protanopia": PROTANOPIA}


def lab(rgb, sight):
    """CIELAB (…, 3) of sRGB under D65, as seen by ``sight``."""
    rgb = np.asarray(rgb)
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    linear = np.clip(linear @ sight.T, 0, 1)
    to_xyz = np.array(
        [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    )
    ratio = linear @ to_xyz.T / [0.9505, 1.0, 1.089]
    f = np.where(ratio > (6 / 29) ** 3, np.cbrt(ratio), ratio * (29 / 6) ** 2 / 3 + 4 / 29)
    x, y, z = np.moveaxis(f, -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


@pytest.mark.parametrize("sight", SIGHTS.values(), ids=SIGHTS)
def test_the_map_is_lightest_at_zero_and_its_ends_differ(sight):
    """A diverging scale: darker all the way to both ends, which differ for every sight."""
    colours = lab(matplotlib.colormaps[style.MAP_COLOURS](np.linspace(0, 1, 64))[:, :3], sight)
    lightness = colours[:, 0]
    middle = int(np.argmax(lightness))
    assert abs(middle - 31.5) < 2
    assert np.all(np.diff(lightness[: middle + 1]) > 0)
    assert np.all(np.diff(lightness[middle:]) < 0)
    assert min(lightness[middle] - lightness[0], lightness[middle] - lightness[-1]) > 50
    assert np.linalg.norm(colours[0] - colours[-1]) > 50


@pytest.mark.parametrize("sight", SIGHTS.values(), ids=SIGHTS)
def test_before_after_and_truth_are_distinguished(sight):
    colours = lab([to_rgb(c) for c in (style.BEFORE, style.AFTER, style.TRUTH)], sight)
    for one in range(3):
        for other in range(one):
            assert np.linalg.norm(colours[one] - colours[other]) > 25


def test_text_is_legible_on_white():
    for colour in (style.INK, style.MUTED):
        assert lab(to_rgb(colour), np.eye(3))[0] < 50


def test_an_envelope_loses_no_spike():
    value = np.zeros(254_000)
    value[[17, 100_003, 253_999]] = 1.0, -2.0, 3.0
    time, low, high = style.envelope(np.arange(254_000.0), value)
    assert len(time) == len(low) == len(high) == 900
    assert (low.min(), high.max()) == (-2.0, 3.0)
    assert np.sum(high > 0) == 2


def test_an_envelope_of_few_values_is_the_values():
    value = np.array([3.0, 1.0, 2.0])
    _, low, high = style.envelope(np.arange(3.0), value)
    assert np.array_equal(low, value)
    assert np.array_equal(high, value)


def test_a_png_has_the_size_asked_for_and_is_repeatable():
    first, second = (style.png(style.figure(4.0, 3.0)[0], dpi=100) for _ in range(2))
    assert first == second
    assert first.startswith(b"\x89PNG\r\n\x1a\n")
    assert struct.unpack(">II", first[16:24]) == (400, 300)


def test_drawing_leaves_the_settings_of_matplotlib_alone():
    before = dict(matplotlib.rcParams)
    style.png(style.figure(2.0, 2.0)[0])
    assert dict(matplotlib.rcParams) == before


@pytest.mark.parametrize("rows", [1, 2, 3])
def test_no_axes_write_over_others_or_beyond_the_figure(rows):
    """Every figure has a title, and numbers and labels on both axes."""
    made, axes = style.figure(4.6, 2.6 * rows, rows)
    for one in axes:
        one.plot([0, 100], [0, 100])
        one.set(title="What is shown", xlabel="along [mm]", ylabel="across [nm]")
    renderer = made.canvas.get_renderer()
    boxes = [one.get_tightbbox(renderer) for one in axes]
    for k, box in enumerate(boxes):
        assert box.xmin >= 0
        assert box.ymin >= 0
        assert box.xmax <= made.bbox.xmax
        assert box.ymax <= made.bbox.ymax
        assert not any(box.overlaps(other) for other in boxes[:k])


def test_axes_are_as_far_apart_as_their_texts_need_however_many_there_are():
    """A taller figure has taller axes, and no wider gaps."""
    gaps = []
    for rows, height in ((2, 4.0), (2, 9.0), (4, 9.0)):
        axes = style.figure(5.0, height, rows)[1]
        places = [one.get_position() for one in axes]
        gaps += [height * (upper.y0 - lower.y1) for upper, lower in pairwise(places)]
    np.testing.assert_allclose(gaps, gaps[0], rtol=1e-9)


@pytest.mark.parametrize(
    "around", [{"HOME": "/nonexistent"}, {"MPLBACKEND": "of_another_program"}], ids=str
)
def test_what_surrounds_a_command_costs_no_figure_and_no_line_on_stderr(around):
    """A service has no home, and a notebook sets a backend in the shells that it opens."""
    kept = {k: v for k, v in os.environ.items() if k not in ("MPLCONFIGDIR", "XDG_CONFIG_HOME")}
    drawn = "from omsm_ros.report import style; style.png(style.figure(4, 3)[0])"
    done = subprocess.run(
        [sys.executable, "-c", drawn], env=kept | around, capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (0, "")
