"""The image of a cloud is correct at points and empty without points."""

from __future__ import annotations

import numpy as np
import pytest

from omsm_ros.errors import DataError
from omsm_ros.report.measurement.surface_map import MAX_PIXELS, rasterise


def spiral(points, turns, radius=1e-2):
    share = np.arange(points) / points
    r, angle = radius * (1 - share), 2 * np.pi * turns * share
    return r * np.cos(angle), r * np.sin(angle)


def centres(raster):
    rows, columns = raster.image.shape
    left, right, bottom, top = raster.extent
    x = left + (np.arange(columns) + 0.5) * (right - left) / columns
    y = bottom + (np.arange(rows) + 0.5) * (top - bottom) / rows
    return np.meshgrid(x, y)


@pytest.mark.parametrize(("points", "turns"), [(254_000, 127), (20_000, 127), (300_000, 40)])
def test_shows_the_value_at_its_place_and_the_disk_without_holes(points, turns):
    x, y = spiral(points, turns)
    raster = rasterise(x, y, 3 * x - 2 * y)
    px, py = centres(raster)
    pitch = px[0, 1] - px[0, 0]
    track = max(1e-2 / turns, pitch)
    inside = np.hypot(px, py) < 1e-2 - track
    assert np.all(np.isfinite(raster.image[inside]))
    assert np.abs(raster.image - (3 * px - 2 * py))[inside].max() < 3.6 * track
    assert np.all(np.isnan(raster.image[np.hypot(px, py) > 1e-2 + 2 * track]))
    assert max(raster.image.shape) <= MAX_PIXELS


def test_rows_run_along_y_upwards():
    x, y = spiral(50_000, 100)
    image = rasterise(x, y, y).image
    assert np.nanmean(image[-20:]) > 0 > np.nanmean(image[:20])


def test_a_dropout_stays_a_hole():
    x, y = spiral(254_000, 127)
    seen = np.hypot(x - 3e-3, y) > 1e-3
    raster = rasterise(x[seen], y[seen], np.ones(seen.sum()))
    px, py = centres(raster)
    assert np.all(np.isnan(raster.image[np.hypot(px - 3e-3, py) < 0.8e-3]))
    assert np.all(raster.image[np.hypot(px + 3e-3, py) < 0.8e-3] == pytest.approx(1.0))


@pytest.mark.parametrize(("points", "turns"), [(120_000, 45), (254_000, 127), (300_000, 14)])
@pytest.mark.parametrize("inner", [0.5, 0.72, 0.93])
def test_a_ring_ends_where_its_tracks_end(points, turns, inner):
    share = np.arange(points) / points
    r, angle = 1e-2 * (1 - (1 - inner) * share), 2 * np.pi * turns * share
    raster = rasterise(r * np.cos(angle), r * np.sin(angle), r)
    radius = np.hypot(*centres(raster))
    pitch = (raster.extent[1] - raster.extent[0]) / raster.image.shape[1]
    track = max(1e-2 * (1 - inner) / turns, 1.5 * pitch)
    between = (radius > inner * 1e-2 + track) & (radius < 1e-2 - track)
    assert np.all(np.isfinite(raster.image[between]))
    outside = (radius < inner * 1e-2 - 2 * track) | (radius > 1e-2 + 2 * track)
    assert np.all(np.isnan(raster.image[outside]))


@pytest.mark.parametrize("turn", [0.0, 0.3, np.pi / 4, np.pi / 2])
def test_small_gaps_between_lines_are_closed_and_the_outside_is_not(turn):
    along, across = np.meshgrid(np.linspace(-1e-2, 1e-2, 10_000), np.linspace(2e-3, 9e-3, 24))
    u, v = along.ravel(), across.ravel()
    x, y = u * np.cos(turn) - v * np.sin(turn), u * np.sin(turn) + v * np.cos(turn)
    raster = rasterise(np.append(x, -x), np.append(y, -y), np.append(u, -u))
    px, py = centres(raster)
    v, u = py * np.cos(turn) - px * np.sin(turn), px * np.cos(turn) + py * np.sin(turn)
    track = 7e-3 / 23
    covered = (abs(v) > 2.2e-3) & (abs(v) < 8.8e-3) & (abs(u) < 9.8e-3)
    assert np.all(np.isfinite(raster.image[covered]))
    assert np.all(np.isnan(raster.image[abs(v) < 2e-3 - 1.5 * track]))


def test_a_pixel_is_the_mean_of_its_points():
    x = np.repeat(np.linspace(0, 1, 41), 100)
    y = np.tile(np.linspace(0, 1, 100), 41)
    noise = np.random.default_rng(1).normal(size=x.size)
    image = rasterise(x, y, noise).image
    assert np.nanmean(image) == pytest.approx(np.mean(noise), abs=0.02)


@pytest.mark.parametrize("points", [1, 2, 5])
def test_a_handful_of_points_is_drawn(points):
    x = np.linspace(0, 1e-3, points)
    image = rasterise(x, np.zeros(points), np.ones(points)).image
    assert np.nanmin(image) == np.nanmax(image) == pytest.approx(1.0)


def test_an_oblong_part_has_square_pixels():
    x, y = np.random.default_rng(1).uniform(size=(2, 50_000)) * [[40e-3], [10e-3]]
    raster = rasterise(x, y, x)
    rows, columns = raster.image.shape
    left, right, bottom, top = raster.extent
    assert (right - left) / columns == pytest.approx((top - bottom) / rows)
    assert columns == pytest.approx(4 * rows, rel=0.05)


@pytest.mark.parametrize("values", [np.empty(0), np.array([0.0, np.nan])])
def test_nothing_and_nan_are_refused(values):
    with pytest.raises(DataError, match="a map needs"):
        rasterise(np.zeros(len(values)), np.zeros(len(values)), values)
