"""Areas of points against closed forms over disc and square, whatever path the scan took."""

from __future__ import annotations

import numpy as np
import pytest

from omsm_ros.core.surface.aperture import Aperture
from omsm_ros.core.surface.area_weights import area_weights

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


def test_within_its_outline_a_disc_is_weighed_as_it_is_where_turns_are_farther_apart() -> None:
    x, y = (v / RADIUS for v in feed_that_changes())
    weights = area_weights(RADIUS * x, RADIUS * y, outline=Aperture(RADIUS))
    assert np.average((x**2 - y**2) ** 2, weights=weights) == pytest.approx(1 / 6, rel=0.01)
    assert np.average(x**2, weights=weights) == pytest.approx(1 / 4, rel=0.01)


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


@pytest.mark.parametrize("outline", [None, Aperture(RADIUS)])
@pytest.mark.parametrize("path", [slower_on_one_side, lost_on_one_side])
def test_within_a_turn_each_part_of_it_counts_by_its_area(path, outline) -> None:
    x, y = path()
    weights = area_weights(x, y, outline=outline)
    assert abs(np.mean(x)) > 0.04 * RADIUS
    assert abs(np.average(x, weights=weights)) < 0.01 * RADIUS
    assert np.average(x**2, weights=weights) == pytest.approx(RADIUS**2 / 4, rel=0.01)


@pytest.mark.parametrize("clipped", [False, True])
@pytest.mark.parametrize("off", [(0.04, 0.0), (-0.02, 0.03)])
def test_off_the_axis_a_partly_covered_rim_counts_by_its_covered_part(off, clipped) -> None:
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
    # Evenly spaced points in the same region.
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


def turns(x, y) -> float:
    """Return the number of turns of the path about the origin."""
    angle = np.unwrap(np.arctan2(y, x))
    return float(abs(angle[-1] - angle[0]) / (2 * np.pi))


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


@pytest.mark.parametrize(
    ("lines", "slower"), [(8, 1), (8, 4), (12, 4), (16, 4), (17, 4), (31, 4), (100, 4)]
)
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


@pytest.mark.parametrize("lines", [40, 90])
def test_with_its_outline_lines_weigh_a_disc_to_its_rim(lines: int) -> None:
    """∫ r⁴ over the unit disc is 1/3 of its area; a strip at the rim lies between the lines."""
    line = np.linspace(-1.0, 1.0, 200)
    x, y = (v.ravel() for v in np.meshgrid(line, np.linspace(-1.0, 1.0, lines)))
    inside = np.hypot(x, y) <= 1
    x, y = RADIUS * x[inside], RADIUS * y[inside]
    fourth = (np.hypot(x, y) / RADIUS) ** 4
    outline = Aperture(RADIUS)
    with_rim = np.average(fourth, weights=area_weights(x, y, outline=outline))
    without = np.average(fourth, weights=area_weights(x, y))
    assert with_rim == pytest.approx(1 / 3, rel=0.4 / lines)
    assert abs(with_rim - 1 / 3) < abs(without - 1 / 3) / 2


def test_a_hole_that_nobody_scanned_has_no_area() -> None:
    x, y = raster()
    kept = np.hypot(x, y) > 0.5 * RADIUS
    weights = area_weights(x[kept], y[kept])
    square = np.average(x[kept] ** 2, weights=weights) / RADIUS**2
    # Mean square over (-1, 1)² without a disc of half its width: (4/3 - π/64) / (4 - π/4).
    assert square == pytest.approx((4 / 3 - np.pi / 64) / (4 - np.pi / 4), rel=0.01)


def test_they_have_mean_one_and_points_in_one_place_are_alike() -> None:
    assert np.mean(area_weights(*spiral())) == pytest.approx(1.0)
    assert np.mean(area_weights(*raster())) == pytest.approx(1.0)
    here = np.zeros(4)
    assert area_weights(here, here) == pytest.approx(1.0)
    assert area_weights(here[:1], here[:1]) == pytest.approx(1.0)


def test_repeated_points_and_dwells_take_no_area_from_the_others():
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


# Single lines.


@pytest.mark.parametrize("turn", [0.0, 0.6, np.pi / 2, 3.0])
def test_on_a_line_a_point_stands_for_half_the_way_to_each_neighbour(turn: float) -> None:
    """By hand, in any order and any direction; at its ends for half a step alone."""
    along = np.array([0.0, 1.0, 3.0, 4.0, 4.5, 8.0]) * 1e-3
    by_hand = np.array([0.5, 1.5, 1.5, 0.75, 2.0, 1.75])
    order = np.array([3, 0, 5, 1, 4, 2])
    x, y = np.cos(turn) * along[order] + 2e-3, np.sin(turn) * along[order] - 1e-3
    np.testing.assert_allclose(area_weights(x, y), (by_hand / by_hand.mean())[order], rtol=1e-9)


def test_across_a_gap_of_a_line_nobody_has_looked() -> None:
    """A gap counts no more than ten of the usual steps."""
    along = np.r_[np.arange(20.0), np.arange(20.0) + 1000.0] * 1e-4
    weights = area_weights(along, np.zeros(40))
    ways = np.ones(40)
    ways[[0, -1]], ways[[19, 20]] = 0.5, 0.5 + 10 / 2
    np.testing.assert_allclose(weights, ways / ways.mean(), rtol=1e-9)


def test_two_points_share_their_line() -> None:
    np.testing.assert_allclose(area_weights(np.array([0.0, 1e-3]), np.zeros(2)), [1.0, 1.0])


def test_a_line_scanned_to_and_fro_has_the_integral_of_one_way() -> None:
    there = np.linspace(-1.0, 1.0, 501)
    along = np.concatenate([there, there[::-1][1:] + 1e-4])
    weights = area_weights(RADIUS * along, 0 * along)
    assert np.average(along**2, weights=weights) == pytest.approx(1 / 3, rel=1e-2)


@pytest.mark.parametrize("path", [lambda: spiral(9000, 30.0), raster])
@pytest.mark.parametrize("scale", [1e-3, 50.0])
def test_weights_do_not_depend_on_the_size_of_the_part(path, scale: float) -> None:
    x, y = path()
    np.testing.assert_allclose(area_weights(scale * x, scale * y), area_weights(x, y), rtol=1e-6)


@pytest.mark.parametrize("turn", [0.2, 1.0, -2.5])
def test_a_turned_or_mirrored_spiral_weighs_as_before(turn: float) -> None:
    x, y = spiral(9000, 30.0)
    c, s = np.cos(turn), np.sin(turn)
    np.testing.assert_allclose(
        area_weights(c * x - s * y, s * x + c * y), area_weights(x, y), rtol=1e-6
    )
    np.testing.assert_allclose(area_weights(x, -y), area_weights(x, y), rtol=1e-6)


def test_scanned_outwards_each_point_weighs_what_it_does_inwards() -> None:
    x, y = spiral(9000, 30.0)
    np.testing.assert_allclose(area_weights(x[::-1], y[::-1])[::-1], area_weights(x, y), rtol=1e-6)


@pytest.mark.parametrize("centre", [0.0, 0.5 * RADIUS, 0.9 * RADIUS])
def test_a_raster_in_no_order_weighs_the_square_all_the_same(centre: float) -> None:
    """By chance its points get around the axis some dozen times."""
    x, y = raster(40, centre=centre)
    order = np.random.default_rng(2).permutation(len(x))
    assert turns(x[order], y[order]) > 2
    np.testing.assert_allclose(area_weights(x[order], y[order]), area_weights(x, y)[order])


@pytest.mark.parametrize("seed", range(3))
def test_points_dense_on_one_side_and_in_no_order_weigh_the_disc_as_it_is(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, y = polar(RADIUS * np.sqrt(rng.random(30_000)), rng.uniform(-np.pi, np.pi, 30_000))
    kept = (x < 0) | (rng.random(30_000) < 0.3)
    x, y = x[kept], y[kept]
    weights = area_weights(x, y)
    assert np.mean(x) < -0.2 * RADIUS
    assert abs(np.average(x, weights=weights)) < 0.05 * RADIUS


@pytest.mark.parametrize("per_turn", [5.3, 8.1, 20.7])
@pytest.mark.parametrize("way", [1, -1])
def test_a_spiral_of_few_points_a_turn_turns_all_the_same(per_turn: float, way: int) -> None:
    x, y = spiral(4000, 4000 / per_turn)
    weights = area_weights(x, way * y)
    assert np.average(x**2, weights=weights) == pytest.approx(RADIUS**2 / 4, rel=0.04)


def test_points_of_an_even_grid_weigh_alike_whatever_their_order_says() -> None:
    x, y = spiral(500, 5.0)
    np.testing.assert_array_equal(area_weights(x, y, even=True), np.ones(500))


def test_points_on_a_circle_have_equal_weights_except_next_to_a_gap() -> None:
    angle = np.linspace(0, 6 * np.pi, 3001)
    weights = area_weights(*polar(np.full(3001, RADIUS), angle))
    np.testing.assert_allclose(weights, np.ones(3001), rtol=1e-6)
