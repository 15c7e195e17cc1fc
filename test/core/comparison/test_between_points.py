"""Cells, trends and local fits of points: plain loops, polynomials, and what changes nothing."""

from __future__ import annotations

import numpy as np
import pytest

from omsm_ros.core.comparison.matching import MATCHING_PARAMETERS, SEATED, match, ordered_dofs
from omsm_ros.core.comparison.resampling import (
    TREND_DEGREE,
    LocalQuadratic,
    averaged,
    cell_side,
    on_grid,
    portions,
    surface_trend,
)
from omsm_ros.core.surface.height_grid import HeightGrid
from omsm_ros.core.surface.measured_points import MeasuredPoints
from omsm_ros.errors import ConfigurationError, DataError

RNG = np.random.default_rng(15)
RADIUS = 5e-3
# Even but for a third of their distance.
ACROSS = 45
STEP = 2 * RADIUS / (ACROSS - 1)
X, Y = (v.ravel() for v in np.meshgrid(*[np.linspace(-RADIUS, RADIUS, ACROSS)] * 2))
X, Y = np.stack([X, Y]) + STEP / 3 * RNG.uniform(-1, 1, (2, ACROSS**2))
COUNT = len(X)
POWERS = [(i, j) for i in range(TREND_DEGREE + 1) for j in range(TREND_DEGREE + 1 - i)]
SIZES = 1e-7 * RNG.normal(size=len(POWERS))
AT_X, AT_Y = 0.85 * RADIUS * RNG.uniform(-1, 1, (2, 100))
SIDE = 3e-4


def polynomial(x, y):
    """Return a polynomial of sixth degree over the radius."""
    u, v = x / RADIUS, y / RADIUS
    return sum(c * u**i * v**j for c, (i, j) in zip(SIZES, POWERS, strict=True))


def points(height, x=X, y=Y, **more):
    return MeasuredPoints(x=x, y=y, height=height, **more)


def wavy(x, y):
    return polynomial(x, y) + 5e-9 * np.sin(2 * np.pi * x / 2e-3) * np.cos(2 * np.pi * y / 3e-3)


# Trends and cells.


def test_a_trend_is_the_polynomial_and_its_slopes_are_its_derivatives():
    trend = surface_trend(points(polynomial(X, Y)))
    np.testing.assert_allclose(trend.height(AT_X, AT_Y), polynomial(AT_X, AT_Y), atol=1e-15)
    step = 1e-6
    along_x, along_y = trend.gradient(AT_X, AT_Y)
    by_x = (polynomial(AT_X + step, AT_Y) - polynomial(AT_X - step, AT_Y)) / (2 * step)
    by_y = (polynomial(AT_X, AT_Y + step) - polynomial(AT_X, AT_Y - step)) / (2 * step)
    np.testing.assert_allclose(along_x, by_x, atol=1e-9)
    np.testing.assert_allclose(along_y, by_y, atol=1e-9)


def test_of_few_points_the_trend_is_their_plane():
    few = points(3e-6 + 2e-3 * X[:200] - 1e-3 * Y[:200], X[:200], Y[:200])
    plane = 3e-6 + 2e-3 * AT_X - 1e-3 * AT_Y
    np.testing.assert_allclose(surface_trend(few).height(AT_X, AT_Y), plane, atol=1e-15)
    bowl = surface_trend(points(X[:200] ** 2, X[:200], Y[:200]))
    assert np.ptp(bowl.gradient(AT_X, AT_Y)[0]) < 1e-9


def test_portions_cover_all_and_none_twice():
    for count in (0, 1, 20_000, 20_001, 65_000):
        parts = [range(count)[p] for p in portions(count)]
        assert [k for part in parts for k in part] == list(range(count))


def test_means_of_cells_are_those_of_a_loop():
    uncertainty = RNG.uniform(1e-9, 3e-9, COUNT)
    some = points(wavy(X, Y), uncertainty=uncertainty, sample=np.arange(COUNT) * 3)
    cells, own = averaged(some, some.height, 5e-4)
    held = {}
    for k, place in enumerate(zip(
        np.floor((X - X.min()) / 5e-4), np.floor((Y - Y.min()) / 5e-4), strict=True
    )):  # fmt: skip
        held.setdefault(place, []).append(k)
    assert len(cells.x) == len(held)
    for numbers in held.values():
        cell = own[numbers[0]]
        assert np.all(own[numbers] == cell)
        dx, dy = X[numbers] - X[numbers].mean(), Y[numbers] - Y[numbers].mean()
        assert cells.points[cell] == len(numbers)
        assert cells.height[cell] == pytest.approx(some.height[numbers].mean(), rel=1e-9, abs=0)
        assert cells.xx[cell] == pytest.approx(np.mean(dx * dx), abs=1e-20)
        assert cells.xy[cell] == pytest.approx(np.mean(dx * dy), abs=1e-20)
        assert cells.yy[cell] == pytest.approx(np.mean(dy * dy), abs=1e-20)
        assert cells.variance[cell] == pytest.approx(
            np.mean(uncertainty[numbers] ** 2), rel=1e-9, abs=0
        )
        assert cells.order[cell] == pytest.approx(np.mean(numbers) / (COUNT - 1))


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_the_side_of_a_cell_scales_with_the_part(scale):
    usual = cell_side(X, Y, 200)
    assert cell_side(scale * X, scale * Y, 200) == pytest.approx(scale * usual)
    assert cell_side(X + 0.3, Y - 0.2, 200) == pytest.approx(usual, rel=0.5)
    # A point or two a cell, where they fill the part at random.
    assert 1 < usual / np.sqrt(4 * RADIUS**2 / COUNT) < 3


def test_no_more_cells_lie_across_than_are_asked_for():
    for most in (10, 30):
        assert np.ptp(X) / cell_side(X, Y, most) <= most * (1 + 1e-9)


# Local fits.


def test_a_polynomial_is_met_with_its_slopes_everywhere():
    found = LocalQuadratic(points(polynomial(X, Y)), SIDE).at(AT_X, AT_Y)
    np.testing.assert_allclose(found.value, polynomial(AT_X, AT_Y), atol=1e-14)
    assert np.all(np.isnan(found.order))
    assert np.all(np.isnan(found.stated))


def test_heights_between_points_are_linear_in_those_of_the_points():
    one, other = wavy(X, Y), 1e-8 * RNG.normal(size=COUNT)
    both, first, second = (
        LocalQuadratic(points(h), SIDE).at(AT_X, AT_Y) for h in (one - 3 * other, one, other)
    )
    np.testing.assert_allclose(both.value, first.value - 3 * second.value, atol=1e-18)
    np.testing.assert_allclose(both.slope_x, first.slope_x - 3 * second.slope_x, atol=1e-11)
    np.testing.assert_array_equal(both.gain, first.gain)


def test_points_in_another_order_are_the_same_surface():
    order = RNG.permutation(COUNT)
    usual = LocalQuadratic(points(wavy(X, Y)), SIDE)
    mixed = LocalQuadratic(points(wavy(X, Y)[order], X[order], Y[order]), SIDE)
    np.testing.assert_allclose(mixed.at(AT_X, AT_Y).value, usual.at(AT_X, AT_Y).value, atol=1e-17)
    assert mixed.scatter == pytest.approx(usual.scatter, rel=0.2)


def test_errors_are_carried_as_heights_are():
    """Interpolate errors of points: equal to the change of the fit by these errors."""
    error = 1e-8 * np.stack([np.ones(COUNT), np.sin(X / 1e-3), RNG.normal(size=COUNT)])
    surface = LocalQuadratic(points(wavy(X, Y)), SIDE)
    carried = surface.carried(lambda first, count: error[:, first : first + count], AT_X, AT_Y)
    np.testing.assert_allclose(carried[0], np.full(100, 1e-8), rtol=1e-9)
    for row, own in zip(carried[1:], error[1:], strict=True):
        # Their trend is taken off, and added, in heights alone: of noise it is next to nothing.
        spoiled = LocalQuadratic(points(wavy(X, Y) + own), SIDE).at(AT_X, AT_Y).value
        change = spoiled - surface.at(AT_X, AT_Y).value
        np.testing.assert_allclose(row, change, atol=0.05 * 1e-8)


def test_the_order_of_a_scan_is_that_of_the_points_around():
    """Scanned from left to right: the place along x."""
    order = np.argsort(X)
    scan = points(wavy(X, Y)[order], X[order], Y[order], sample=np.arange(COUNT) + 7)
    found = LocalQuadratic(scan, SIDE).at(AT_X, AT_Y).order
    np.testing.assert_allclose(found, (AT_X / RADIUS + 1) / 2, atol=0.03)


def test_a_dense_patch_counts_by_its_area():
    """A thousand points given at each of four places do not drag the fit to their error."""
    x, y = (np.concatenate([v, np.repeat(v[:4], 500)]) for v in (X, Y))
    height = polynomial(x, y)
    found = LocalQuadratic(points(height, x, y), SIDE).at(AT_X, AT_Y)
    np.testing.assert_allclose(found.value, polynomial(AT_X, AT_Y), atol=1e-13)


def test_a_map_of_points_is_as_fine_as_was_asked_for():
    made, _ = on_grid(points(polynomial(X, Y)), 200, spacing=2.5e-4)
    assert (made.dx, made.dy) == (2.5e-4, 2.5e-4)
    assert made.height.shape == (41, 41)
    x, y = np.meshgrid(made.x, made.y)
    known = np.isfinite(made.height)
    assert known.mean() > 0.8
    np.testing.assert_allclose(made.height[known], polynomial(x, y)[known], atol=1e-13)
    # It lies amid what was measured.
    assert made.x[0] + made.x[-1] == pytest.approx(X.min() + X.max(), abs=1e-9)


# Matching.


def two(second, **first):
    a = LocalQuadratic(points(wavy(X, Y), **first), SIDE)
    line = np.linspace(-0.8 * RADIUS, 0.8 * RADIUS, 25)
    step = line[1] - line[0]
    grid = HeightGrid(height=np.zeros((25, 25)), x0=line[0], y0=line[0], dx=step, dy=step)
    return a, LocalQuadratic(second, SIDE), grid


def seat(x, y):
    """Return the heights of piston, tip, tilt and power, with the signs of a pose."""
    return 2e-6 + 3e-6 * y - (-4e-6) * x + 5e-3 * (x**2 + y**2) / 2


@pytest.mark.parametrize("dofs", [(*SEATED, "power"), ("power", "tilt", "tip", "piston")])
def test_what_a_seat_makes_is_taken_off_with_its_signs(dofs):
    found = match(*two(points(wavy(X, Y) - seat(X, Y))), dofs)
    assert found.dofs == (*SEATED, "power")
    assert found.moved == pytest.approx(
        {"piston": 2e-6, "tip": 3e-6, "tilt": -4e-6, "power": 5e-3}, rel=1e-4
    )
    np.testing.assert_allclose(found.difference, np.zeros(len(found.x)), atol=1e-12)
    np.testing.assert_allclose(found.a, wavy(found.x, found.y), atol=1e-9)
    held = found.grid.height.ravel()[found.filled]
    np.testing.assert_allclose(held, found.difference, atol=1e-20)


def test_what_is_not_fitted_stays_in_the_difference():
    found = match(*two(points(wavy(X, Y) - seat(X, Y))), ("piston",))
    left = seat(found.x, found.y)
    np.testing.assert_allclose(found.difference, left - left.mean(), atol=1e-11)


def test_less_the_fit_nothing_is_left_of_its_columns_and_once_is_enough():
    found = match(*two(points(wavy(X, Y))), (*SEATED, "power"))
    np.testing.assert_allclose(found.without_fit(found.columns), 0, atol=1e-12)
    rows = RNG.normal(size=(3, len(found.x)))
    once = found.without_fit(rows)
    np.testing.assert_allclose(found.without_fit(once), once, atol=1e-12)
    unit = found.columns / np.linalg.norm(found.columns, axis=1, keepdims=True)
    np.testing.assert_allclose(once @ unit.T, 0, atol=1e-10)
    design = found.columns.T / np.linalg.norm(found.columns, axis=1)
    expected = rows - (design @ np.linalg.lstsq(design, rows.T, rcond=None)[0]).T
    np.testing.assert_allclose(once, expected, atol=1e-12)


def test_freedoms_come_in_one_order_and_each_once():
    assert ordered_dofs(MATCHING_PARAMETERS[::-1]) == MATCHING_PARAMETERS
    assert ordered_dofs(("tilt", "piston", "tilt")) == ("piston", "tilt")
    assert ordered_dofs(()) == ()
    with pytest.raises(ConfigurationError, match=r"'roll' is unknown, expected one of \['piston'"):
        ordered_dofs(("piston", "roll"))


def test_a_surface_that_is_not_there_is_reported_with_the_number_of_places():
    adjacent = points(wavy(X, Y), X + 1.7 * RADIUS, Y)
    with pytest.raises(DataError, match=r"share \d+ places of 333 µm, expected 100 or more"):
        match(*two(adjacent), SEATED)
