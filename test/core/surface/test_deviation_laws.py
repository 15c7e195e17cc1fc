"""Levelling, figures and profiles against plain loops, repeated points, and any order of points."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from omsm_ros.core.surface import deviation as form
from omsm_ros.core.surface.aspheres import Sphere
from omsm_ros.core.surface.nominal import Flat
from omsm_ros.core.surface.posed import Pose, PosedSurface
from omsm_ros.errors import DataError

RNG = np.random.default_rng(9)
X, Y = RNG.uniform(-5e-3, 5e-3, (2, 400))
ERROR = RNG.normal(0, 30e-9, 400)
WHOLE = RNG.integers(1, 5, 400)


@pytest.mark.parametrize("tilt", [False, True])
def test_a_point_of_weight_three_is_three_points(tilt):
    """Weights are repetitions, by least squares of numpy."""
    left = form.level(X, Y, ERROR, tilt=tilt, weights=WHOLE.astype(float))
    x, y, error = (np.repeat(v, WHOLE) for v in (X, Y, ERROR))
    design = np.column_stack([np.ones_like(x), x * 1e3, y * 1e3])[:, : 3 if tilt else 1]
    fitted = np.linalg.lstsq(design, error, rcond=None)[0]
    np.testing.assert_allclose(np.repeat(left, WHOLE), error - design @ fitted, atol=1e-20)


@pytest.mark.parametrize("tilt", [False, True])
def test_what_is_left_has_no_piston_and_no_tilt_over_the_weights(tilt):
    weights = RNG.uniform(0, 3, 400)
    left = form.level(X, Y, ERROR + 2e-6 + 1e-3 * X, tilt=tilt, weights=weights)
    size = weights @ np.abs(left)
    assert abs(weights @ left) < 1e-9 * size
    for along in (X, Y):
        assert (abs(weights @ (along * left)) < 1e-9 * size * 5e-3) == tilt
    again = form.level(X, Y, left, tilt=tilt, weights=weights)
    np.testing.assert_allclose(again, left, atol=1e-20)


def test_levelling_does_not_care_for_the_order_or_the_unit():
    order = RNG.permutation(400)
    left = form.level(X, Y, ERROR, tilt=True)
    mixed = form.level(X[order], Y[order], ERROR[order], tilt=True)
    np.testing.assert_allclose(mixed, left[order], atol=1e-21)
    np.testing.assert_allclose(
        form.level(1e3 * X, 1e3 * Y, 1e9 * ERROR, tilt=True), 1e9 * left, atol=1e-9
    )


@pytest.mark.parametrize("turn", [0.5, -2.2])
def test_a_turned_cloud_is_levelled_like_the_cloud(turn):
    c, s = np.cos(turn), np.sin(turn)
    np.testing.assert_allclose(
        form.level(c * X - s * Y, s * X + c * Y, ERROR, tilt=True),
        form.level(X, Y, ERROR, tilt=True),
        atol=1e-20,
    )


def test_weights_of_nothing_take_a_point_out_of_the_fit_but_not_out_of_the_answer():
    spike = ERROR.copy()
    spike[7] = 1e-3
    weights = np.ones(400)
    weights[7] = 0.0
    left = form.level(X, Y, spike, weights=weights)
    others = np.delete(np.arange(400), 7)
    np.testing.assert_allclose(left[others], ERROR[others] - ERROR[others].mean(), atol=1e-20)
    assert left[7] == pytest.approx(1e-3, rel=1e-4)


@given(st.lists(st.integers(-1_000_000, 1_000_000), min_size=1, max_size=30))
@settings(max_examples=30)
def test_no_rms_exceeds_peak_to_valley(picometres):
    error = np.array([1e-12 * v for v in picometres])
    running = form.RunningStatistics()
    running.add(X[: len(error)], Y[: len(error)], error)
    found = running.statistics()
    assert found.peak_to_valley == pytest.approx(np.ptp(error), abs=1e-20)
    for rms in (found.rms, found.rms_area_weighted):
        assert rms <= found.peak_to_valley * (1 + 1e-6) + 1e-20


def test_the_deviation_is_that_in_height_whatever_the_pose():
    part = PosedSurface(Sphere(0.05), Pose(x=1e-3, tip=0.02))
    found = form.deviation(X, Y, part.height(X, Y) + ERROR, part)
    np.testing.assert_allclose(found, ERROR, atol=1e-18)
    np.testing.assert_array_equal(form.deviation(X, Y, ERROR, Flat()), ERROR)


@pytest.mark.parametrize(
    ("columns", "reported"),
    [
        ((np.zeros((2, 2)),) * 3, r"\(2, 2\).*one row"),
        ((np.empty(0),) * 3, "x is empty"),
        ((np.array([0.0, np.inf]), np.zeros(2), np.zeros(2)), "1 of 2 values of x are not finite"),
        ((np.zeros(2), np.full(2, np.nan), np.zeros(2)), "2 of 2 values of y.*drop and count"),
    ],
)
def test_clouds_that_are_none_are_refused_with_what_is_wrong(columns, reported):
    with pytest.raises(DataError, match=reported):
        form.deviation(*columns, Flat())
    with pytest.raises(DataError):
        form.radial_profile(*columns, spacing=1e-3)
    with pytest.raises(DataError):
        form.RunningStatistics().add(*columns)


# Portions.


def test_figures_of_portions_do_not_care_for_their_order():
    one, other = form.RunningStatistics(), form.RunningStatistics()
    for start in range(0, 400, 50):
        one.add(*(v[start : start + 50] for v in (X, Y, ERROR)))
        back = 350 - start
        other.add(*(v[back : back + 50] for v in (X, Y, ERROR)))
    for name in ("peak_to_valley", "rms", "rms_area_weighted"):
        assert getattr(one.statistics(), name) == pytest.approx(
            getattr(other.statistics(), name), rel=1e-6
        )


def test_a_single_point_has_no_deviation_from_its_own_piston():
    running = form.RunningStatistics()
    running.add(np.array([1e-3]), np.zeros(1), np.array([5e-6]))
    found = running.statistics()
    assert (found.peak_to_valley, found.rms, found.rms_area_weighted) == (0.0, 0.0, 0.0)
    assert found.points == 1


def test_figures_may_be_asked_for_after_each_portion():
    running = form.RunningStatistics()
    for stop in (100, 250, 400):
        start = running.statistics().points if stop > 100 else 0
        running.add(X[start:stop], Y[start:stop], ERROR[start:stop])
        found = running.statistics()
        assert found.points == stop
        assert found.peak_to_valley == pytest.approx(np.ptp(ERROR[:stop]))


def test_a_piston_of_a_metre_costs_no_picometre():
    """Sums are taken about the first value, or squares of metres would drown nanometres."""
    near, far = form.RunningStatistics(), form.RunningStatistics()
    near.add(X, Y, ERROR)
    far.add(X, Y, ERROR + 1.0)
    for name in ("peak_to_valley", "rms", "rms_area_weighted"):
        found = getattr(far.statistics(), name)
        assert found == pytest.approx(getattr(near.statistics(), name), abs=1e-14)


# Profiles.


def by_loop(position, value, spacing):
    """Mean place and value of each filled stretch, one point after the other."""
    stretches = {}
    for p, v in zip(position, value, strict=True):
        stretches.setdefault(int(np.floor(p / spacing)), []).append((p, v))
    return [(*np.mean(s, axis=0), len(s)) for _, s in sorted(stretches.items())]


@pytest.mark.parametrize("angle", [0.0, 0.7, -2.0])
def test_a_line_is_the_mean_of_its_stretches(angle):
    found = form.line_profile(X, Y, ERROR, angle=angle, half_width=1e-3, spacing=7e-4)
    along = X * np.cos(angle) + Y * np.sin(angle)
    near = np.abs(Y * np.cos(angle) - X * np.sin(angle)) <= 1e-3
    expected = np.array(by_loop(along[near], ERROR[near], 7e-4))
    np.testing.assert_allclose(found.position, expected[:, 0], rtol=1e-12)
    np.testing.assert_allclose(found.value, expected[:, 1], atol=1e-21)
    np.testing.assert_array_equal(found.points, expected[:, 2])


def test_from_the_other_side_a_line_runs_backwards():
    there = form.line_profile(X, Y, ERROR, angle=0.4, half_width=2e-3, spacing=1e-3)
    back = form.line_profile(X, Y, ERROR, angle=0.4 - np.pi, half_width=2e-3, spacing=1e-3)
    np.testing.assert_allclose(back.position, -there.position[::-1], rtol=1e-9)
    np.testing.assert_allclose(back.value, there.value[::-1], atol=1e-20)


def test_a_turned_cloud_has_the_turned_profile():
    c, s = np.cos(0.9), np.sin(0.9)
    here = form.line_profile(X, Y, ERROR, angle=0.2, half_width=1e-3, spacing=1e-3)
    turned = form.line_profile(
        c * X - s * Y, s * X + c * Y, ERROR, angle=1.1, half_width=1e-3, spacing=1e-3
    )
    np.testing.assert_allclose(turned.position, here.position, rtol=1e-9)
    np.testing.assert_allclose(turned.value, here.value, atol=1e-20)


def test_a_point_at_the_edge_of_the_band_counts():
    x, y = np.zeros(4), np.array([-1e-3, 1e-3, 1.001e-3, -1.001e-3])
    found = form.line_profile(x, y, np.array([1.0, 3.0, 50.0, 70.0]), half_width=1e-3, spacing=1.0)
    assert (found.value.tolist(), found.points.tolist()) == ([2.0], [2])


def ring_cloud(rings, per_ring, heavy=1):
    """Rings of points even in angle; those with x > 0 stand there ``heavy`` times."""
    radius, angle = np.meshgrid(rings, 2 * np.pi * (np.arange(per_ring) + 0.5) / per_ring)
    x, y = (radius * np.cos(angle)).ravel(), (radius * np.sin(angle)).ravel()
    times = np.where(x > 0, heavy, 1)
    return np.repeat(x, times), np.repeat(y, times)


@pytest.mark.parametrize("heavy", [1, 9])
def test_in_a_ring_each_direction_counts_alike_however_many_points_it_has(heavy):
    x, y = ring_cloud([1.2e-3, 2.3e-3, 3.4e-3], 48, heavy)
    found = form.radial_profile(x, y, 5e-6 * x + 1e-9 * np.hypot(x, y), spacing=1e-3)
    np.testing.assert_allclose(found.position, [1.2e-3, 2.3e-3, 3.4e-3])
    np.testing.assert_allclose(found.value, 1e-9 * found.position, atol=1e-22)
    assert found.points.sum() == len(x)


def test_a_ring_with_a_direction_that_nobody_saw_is_left_out_and_no_other():
    x, y = ring_cloud([1.5e-3, 2.5e-3], 48)
    angle, radius = np.arctan2(y, x), np.hypot(x, y)
    # A twelfth of the outer ring is missing.
    kept = ~((radius > 2e-3) & (angle > 0) & (angle < np.pi / 6))
    found = form.radial_profile(x[kept], y[kept], radius[kept], spacing=1e-3)
    np.testing.assert_allclose(found.position, [1.5e-3])
    half = ~((radius > 2e-3) & (angle > 0) & (angle < np.pi / 12))
    found = form.radial_profile(x[half], y[half], radius[half], spacing=1e-3)
    np.testing.assert_allclose(found.position, [1.5e-3, 2.5e-3])


@pytest.mark.parametrize("spacing", [np.inf, -np.inf, -1.0])
def test_a_line_of_a_spacing_that_is_none_is_refused(spacing):
    with pytest.raises(DataError, match="expected a positive number"):
        form.line_profile(X, Y, ERROR, half_width=1e-3, spacing=spacing)


def test_too_many_stretches_are_refused_by_their_number():
    with pytest.raises(DataError, match=r"1e-15 m divides the profile into .* intervals; widen it"):
        form.line_profile(X, Y, ERROR, half_width=1e-3, spacing=1e-15)
