"""Areas of points against closed forms over disc and square, whatever path the scan took."""

from __future__ import annotations

import numpy as np
import pytest

from omsm_ros.core.surface.area_weights import area_weights, turns

RADIUS = 12.7e-3
Path = tuple[np.ndarray, np.ndarray]


def polar(radius: np.ndarray, angle: np.ndarray) -> Path:
    return radius * np.cos(angle), radius * np.sin(angle)


def spiral(points: int = 100_000, count: float = 127.0) -> Path:
    share = np.arange(points) / points
    return polar(RADIUS * (1 - share), 2 * np.pi * count * share)


def constant_surface_speed() -> Path:
    share = np.arange(100_000) / 100_000
    return polar(RADIUS * np.sqrt(1 - share), 2 * np.pi * 254 * (1 - np.sqrt(1 - share)))


def feed_that_changes() -> Path:
    # Three times as fast over the inner half, and a dwell of 300 rad at the rim.
    radius = RADIUS * np.concatenate(
        [np.ones(60_000), np.linspace(1.0, 0.5, 60_000), np.linspace(0.5, 0.0, 20_000)]
    )
    return polar(radius, np.linspace(0.0, 900.0, len(radius)))


@pytest.mark.parametrize(
    "path", [spiral, constant_surface_speed, feed_that_changes, lambda: spiral(9000, 30.0)]
)
@pytest.mark.parametrize(
    ("form", "rms"),
    [
        # Over the unit disc: x² - y² has a mean square of 1/6, x of 1/4, r⁴ a variance of 4/45.
        (lambda x, y: x**2 - y**2, np.sqrt(1 / 6)),
        (lambda x, y: x, 0.5),
        (lambda x, y: (x**2 + y**2) ** 2, np.sqrt(1 / 5 - 1 / 9)),
    ],
)
def test_a_turning_scan_weighs_the_disc_as_it_is(path, form, rms) -> None:
    x, y = path()
    weights = area_weights(x, y)
    value = form(x / RADIUS, y / RADIUS)
    mean = np.average(value, weights=weights)
    assert np.average((value - mean) ** 2, weights=weights) == pytest.approx(rms**2, rel=4e-3)


def slower_on_one_side() -> Path:
    """The spindle lingers where x is positive, three times as long as opposite."""
    share = np.arange(100_000) / 100_000
    angle = 2 * np.pi * 127 * share
    return polar(RADIUS * (1 - share), angle - 0.5 * np.sin(angle))


def lost_on_one_side() -> Path:
    """Three points in four are lost where the surface is steep."""
    x, y = spiral()
    kept = (x < 0.3 * RADIUS) | (np.arange(len(x)) % 4 == 0)
    return x[kept], y[kept]


@pytest.mark.parametrize("path", [slower_on_one_side, lost_on_one_side])
def test_within_a_turn_each_part_of_it_counts_by_its_area(path) -> None:
    x, y = path()
    weights = area_weights(x, y)
    assert abs(np.mean(x)) > 0.04 * RADIUS
    assert abs(np.average(x, weights=weights)) < 0.01 * RADIUS
    assert np.average(x**2, weights=weights) == pytest.approx(RADIUS**2 / 4, rel=0.01)


@pytest.mark.parametrize("clipped", [False, True])
@pytest.mark.parametrize("off", [(0.04, 0.0), (-0.02, 0.03)])
def test_beside_the_axis_a_rim_seen_in_part_counts_by_that_part(off, clipped) -> None:
    """The part's centre is half a millimetre off: of its rim the scan sees a crescent."""
    dx, dy = (RADIUS * share for share in off)
    x, y = (v - d for v, d in zip(spiral(254_000), (dx, dy), strict=True))
    seen = np.hypot(x, y) <= (RADIUS if clipped else np.inf)
    x, y = x[seen], y[seen]
    weights = area_weights(x, y)
    # No point stands for a hundred others.
    assert weights.max() < 20
    assert weights[weights > 5].sum() < 1e-3 * weights.sum()
    assert np.mean(weights) ** 2 / np.mean(weights**2) > 0.7
    # What evenly laid places say of the same region.
    line = np.linspace(-1.1 * RADIUS, 1.1 * RADIUS, 1500)
    u, v = (axis.ravel() for axis in np.meshgrid(line, line))
    inside = np.hypot(u + dx, v + dy) <= RADIUS
    inside &= np.hypot(u, v) <= (RADIUS if clipped else np.inf)
    for form in (lambda x, y: x, lambda x, y: y, lambda x, y: x * x + y * y):
        truth = np.mean(form(u[inside] / RADIUS, v[inside] / RADIUS))
        found = np.average(form(x / RADIUS, y / RADIUS), weights=weights)
        assert found == pytest.approx(truth, abs=0.02)


def test_speed_and_feed_would_mislead_by_a_tenth() -> None:
    x, y = constant_surface_speed()
    assumed = np.hypot(x, y)
    value = (x**2 - y**2) / RADIUS**2
    assert np.sqrt(np.average(value**2, weights=assumed)) > 1.1 * np.sqrt(1 / 6)


def raster(lines: int = 200, zigzag: bool = False, centre: float = 0.0) -> Path:
    line = np.linspace(-RADIUS, RADIUS, 600)
    turned = [line[:: -1 if zigzag and k % 2 else 1] for k in range(lines)]
    rows = np.repeat(np.linspace(-RADIUS, RADIUS, lines), len(line))
    return np.concatenate(turned) + centre, rows


@pytest.mark.parametrize("options", [{}, {"zigzag": True}, {"centre": 0.1}])
def test_a_raster_weighs_the_square_as_it_is(options) -> None:
    x, y = raster(**options)
    assert turns(x, y) < 2
    value = (x - options.get("centre", 0.0)) / RADIUS
    weights = area_weights(x, y)
    assert np.average(value**2, weights=weights) == pytest.approx(1 / 3, rel=0.02)


def test_lines_scanned_at_other_speeds_count_by_their_area() -> None:
    x, y = raster()
    # The upper half four times as slowly.
    x, y = (np.concatenate([v[y <= 0], np.repeat(v[y > 0], 4)]) for v in (x, y))
    weights = area_weights(x, y)
    assert np.average(y > 0, weights=weights) == pytest.approx(0.5, abs=0.01)
    assert np.mean(y > 0) > 0.75


@pytest.mark.parametrize("lines", [8, 12, 16, 17, 31, 100])
@pytest.mark.parametrize("slower", [1, 4])
def test_of_few_lines_each_stands_for_the_way_to_the_next(lines: int, slower: int) -> None:
    """The mean square over a square by the trapezoidal rule, whatever the lines' speed was."""
    rows = np.linspace(-1.0, 1.0, lines)
    along = [np.linspace(-1.0, 1.0, 500 * (slower if row > 0 else 1)) for row in rows]
    x, y = np.concatenate(along), np.repeat(rows, [len(line) for line in along])
    weights = area_weights(RADIUS * x, RADIUS * y)
    assert np.average(np.sign(y), weights=weights) == pytest.approx(0.0, abs=0.02)
    trapezoid = np.trapezoid(rows**2, rows) / 2
    assert np.average(y**2, weights=weights) == pytest.approx(trapezoid, rel=0.03)
    # Between the ends of two lines the rim of what was scanned is a bay.
    assert np.average(x**2, weights=weights) == pytest.approx(1 / 3, rel=0.8 / lines)


@pytest.mark.parametrize("lines", [21, 50, 127])
def test_lines_over_a_disc_weigh_it_as_it_is(lines: int) -> None:
    rows = np.linspace(-1.0, 1.0, lines)
    half = np.sqrt(np.maximum(1 - rows**2, 0.0))
    along = [np.linspace(-h, h, int(2000 * h) + 1) for h in half]
    x, y = np.concatenate(along), np.repeat(rows, [len(line) for line in along])
    weights = area_weights(RADIUS * x, RADIUS * y)
    # At the rim a line stands for half of the way.
    assert np.average(x**2 + y**2, weights=weights) == pytest.approx(0.5, rel=1 / lines)


def test_a_hole_that_nobody_scanned_has_no_area() -> None:
    x, y = raster()
    kept = np.hypot(x, y) > 0.5 * RADIUS
    weights = area_weights(x[kept], y[kept])
    square = np.average(x[kept] ** 2, weights=weights) / RADIUS**2
    # Of the square (-1, 1)² without a disc of half its width: (4/3 - π/64) / (4 - π/4).
    assert square == pytest.approx((4 / 3 - np.pi / 64) / (4 - np.pi / 4), rel=0.01)


def test_they_have_mean_one_and_points_in_one_place_are_alike() -> None:
    assert np.mean(area_weights(*spiral())) == pytest.approx(1.0)
    assert np.mean(area_weights(*raster())) == pytest.approx(1.0)
    here = np.zeros(4)
    assert area_weights(here, here) == pytest.approx(1.0)
    assert area_weights(here[:1], here[:1]) == pytest.approx(1.0)


def test_turns_are_those_about_the_origin() -> None:
    assert turns(*spiral()) == pytest.approx(127, abs=0.01)
    x, y = spiral()
    assert turns(x + 0.1, y) < 1


def test_points_told_again_or_a_rest_take_no_area_from_the_others():
    x, y = spiral(9000, 30.0)
    once = area_weights(x, y)
    thrice = area_weights(np.repeat(x, 3), np.repeat(y, 3))
    # The ends of the path have a step on one side only.
    together = thrice.reshape(-1, 3).mean(axis=1)[1:-1]
    np.testing.assert_allclose(together, once[1:-1], rtol=2e-2, atol=1e-2)
    rested = area_weights(
        np.append(x, np.full(20_000, x[-1])), np.append(y, np.full(20_000, y[-1]))
    )
    share = rested[:9000] / rested[:9000].mean()
    assert np.all(np.isfinite(rested))
    np.testing.assert_allclose(share[:8000], once[:8000], rtol=2e-2)


def test_places_that_are_one_but_for_their_last_bits_weigh_alike() -> None:
    rng = np.random.default_rng(1)
    x, y = rng.integers(0, 9, (2, 500)) * 5e-324
    assert np.mean(area_weights(x, y)) == pytest.approx(1.0)
