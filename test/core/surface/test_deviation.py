"""Deviation, levelling, statistics and profiles against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from omsm_ros.core.surface import deviation as form
from omsm_ros.core.surface.area_weights import area_weights
from omsm_ros.core.surface.aspheres import Sphere
from omsm_ros.core.surface.nominal import PAPER_MIRROR, PAPER_MIRROR_RADIUS_M, Flat
from omsm_ros.errors import DataError

RADIUS = 12.7e-3
AMPLITUDE = 40e-9


@pytest.fixture(scope="module")
def spiral():
    """x, y of a spiral to the centre: uniform in radius and angle."""
    share = (np.arange(200_000) + 0.5) / 200_000
    radius, angle = RADIUS * (1 - share), 2 * np.pi * 127 * share
    return radius * np.cos(angle), radius * np.sin(angle)


@pytest.fixture(scope="module")
def grid():
    """x, y of a square grid inside the disk: uniform in area."""
    line = np.linspace(-RADIUS, RADIUS, 601)
    x, y = (axis.ravel() for axis in np.meshgrid(line, line))
    inside = np.hypot(x, y) <= RADIUS
    return x[inside], y[inside]


def zernike(x, y, order, amplitude=AMPLITUDE):
    """amplitude · ρ^n cos nθ"""
    return amplitude * (np.hypot(x, y) / RADIUS) ** order * np.cos(order * np.arctan2(y, x))


def disk_rms(order, amplitude=AMPLITUDE):
    """∫ρ^2n cos²(nθ) ρ dρ dθ / π = 1 / (2 (n + 1))"""
    return amplitude / np.sqrt(2 * (order + 1))


def statistics(x, y, deviation):
    running = form.RunningStatistics()
    running.add(x, y, deviation)
    return running.statistics()


class TestDeviation:
    def test_of_the_nominal_surface_itself_is_zero(self, spiral):
        x, y = spiral
        assert not np.any(form.deviation(x, y, PAPER_MIRROR.height(x, y), PAPER_MIRROR))

    def test_is_positive_where_material_is_left(self, spiral):
        x, y = spiral
        found = form.deviation(x, y, np.full_like(x, 3e-9), Flat(1e-9))
        np.testing.assert_allclose(found, np.full_like(x, 2e-9), rtol=1e-6)

    def test_points_beyond_the_nominal_surface_are_refused_and_counted(self):
        x = np.array([0.0, 1e-3, 3e-3, 4e-3])
        with pytest.raises(DataError, match=r"2 of 4 points .*Sphere\(radius=0.002\)"):
            form.deviation(x, np.zeros(4), np.zeros(4), Sphere(2e-3))

    def test_a_height_that_is_not_finite_is_refused(self):
        with pytest.raises(DataError, match="1 of 3 values of height are not finite"):
            form.deviation(np.zeros(3), np.zeros(3), np.array([0.0, np.nan, 0.0]), Flat())

    def test_rows_of_other_lengths_are_refused(self):
        with pytest.raises(DataError, match=r"'height': \(2,\)"):
            form.deviation(np.zeros(3), np.zeros(3), np.zeros(2), Flat())


class TestLevel:
    def test_a_plane_leaves_nothing(self, spiral):
        x, y = spiral
        plane = 1e-6 + 3e-5 * x - 2e-5 * y
        assert np.abs(form.level(x, y, plane, tilt=True)).max() < 1e-18

    def test_piston_alone_leaves_the_tilt(self, grid):
        x, y = grid
        left = form.level(x, y, 5e-6 + 1e-5 * x)
        np.testing.assert_allclose(left, 1e-5 * x, rtol=1e-6, atol=1e-15)

    def test_weighted_piston_is_the_mean_over_the_area(self, spiral):
        x, y = spiral
        # The mean of ρ² over a disk is 1/2; over a spiral's points it is 1/3.
        bowl = AMPLITUDE * (x**2 + y**2) / RADIUS**2
        weighted = form.level(x, y, bowl, weights=area_weights(x, y))
        assert np.mean(bowl - weighted) == pytest.approx(AMPLITUDE / 2, rel=1e-4)
        assert np.mean(bowl - form.level(x, y, bowl)) == pytest.approx(AMPLITUDE / 3, rel=1e-4)

    @pytest.mark.parametrize("order", [2, 3])
    def test_does_not_touch_astigmatism_and_trefoil(self, grid, order):
        x, y = grid
        error = zernike(x, y, order)
        left = form.level(x, y, error, tilt=True)
        np.testing.assert_allclose(left, error, rtol=1e-6, atol=1e-3 * AMPLITUDE)

    @given(st.floats(-1e-3, 1e-3), st.floats(-1e-2, 1e-2), st.floats(-1e-2, 1e-2))
    def test_adding_a_plane_changes_nothing(self, piston, tilt_x, tilt_y):
        x, y = np.random.default_rng(1).uniform(-RADIUS, RADIUS, (2, 300))
        error = zernike(x, y, 2)
        plane = piston + tilt_x * x + tilt_y * y
        expected = form.level(x, y, error, tilt=True)
        left = form.level(x, y, error + plane, tilt=True)
        # A plane of a millimetre is rounded to a ten-millionth of a nanometre, and so is each of
        # the sums over 300 points: together no more than one rounding a point.
        size = float(np.max(np.abs(plane)) + np.max(np.abs(error)))
        allowed = len(x) * float(np.finfo(np.float64).eps) * size
        assert np.max(np.abs(left - expected)) <= allowed


class TestStatistics:
    @pytest.mark.parametrize("order", [2, 3])
    def test_of_a_zernike_term_on_a_spiral(self, spiral, order):
        x, y = spiral
        found = statistics(x, y, zernike(x, y, order))
        assert found.points == 200_000
        assert found.peak_to_valley == pytest.approx(2 * AMPLITUDE, rel=2e-2)
        assert found.rms_area_weighted == pytest.approx(disk_rms(order), rel=1e-3)
        # Without the area the centre, where the term is small, counts too much.
        assert found.rms == pytest.approx(AMPLITUDE / np.sqrt(2 * (2 * order + 1)), rel=1e-3)

    def test_of_astigmatism_on_a_grid(self, grid):
        x, y = grid
        found = statistics(x, y, zernike(x, y, 2))
        assert found.rms == pytest.approx(AMPLITUDE / np.sqrt(6), rel=1e-2)
        assert found.rms_area_weighted == pytest.approx(disk_rms(2), rel=1e-2)

    def test_one_outlier_among_many_is_seen(self, spiral):
        error = np.zeros_like(spiral[0])
        error[1234] = 1e-6
        assert statistics(*spiral, error).peak_to_valley == 1e-6


class TestProfiles:
    @pytest.mark.parametrize("angle", [0.0, np.pi / 2, np.pi / 4])
    def test_a_line_follows_astigmatism(self, grid, angle):
        x, y = grid
        cut = form.line_profile(
            x, y, zernike(x, y, 2), angle=angle, half_width=0.1e-3, spacing=0.2e-3
        )
        expected = AMPLITUDE * (cut.position / RADIUS) ** 2 * np.cos(2 * angle)
        assert cut.value == pytest.approx(expected, abs=0.01 * AMPLITUDE)
        assert cut.position[[0, -1]] == pytest.approx([-RADIUS, RADIUS], abs=0.2e-3)

    def test_counts_the_points_of_the_band(self, grid):
        x, y = grid
        cut = form.line_profile(x, y, x, half_width=1e-3, spacing=1e-3)
        assert np.sum(cut.points) == np.sum(np.abs(y) <= 1e-3)

    def test_a_gap_is_left_out_and_not_bridged(self):
        x = np.r_[np.linspace(-5e-3, -2e-3, 100), np.linspace(2e-3, 5e-3, 100)]
        cut = form.line_profile(x, np.zeros(200), x, half_width=1e-4, spacing=1e-4)
        assert np.all(np.abs(cut.position) >= 2e-3)
        assert np.all(np.diff(cut.position) > 0)

    def test_a_line_next_to_the_cloud_is_empty(self):
        ones = np.ones(5)
        assert len(form.line_profile(ones, ones, ones, half_width=0.1, spacing=0.1).position) == 0

    def test_rings_keep_what_is_round(self, spiral):
        x, y = spiral
        ripple = AMPLITUDE * np.cos(2 * np.pi * np.hypot(x, y) / 3.2e-3)
        cut = form.radial_profile(x, y, ripple, spacing=0.2e-3)
        expected = AMPLITUDE * np.cos(2 * np.pi * cut.position / 3.2e-3)
        assert cut.value == pytest.approx(expected, abs=0.02 * AMPLITUDE)

    @pytest.mark.parametrize("order", [2, 3])
    def test_rings_average_the_rest_away(self, spiral, order):
        x, y = spiral
        cut = form.radial_profile(x, y, zernike(x, y, order), spacing=0.2e-3)
        assert np.abs(cut.value).max() < 0.01 * AMPLITUDE

    def test_half_a_disk_has_no_rings(self, grid):
        x, y = grid
        upper = y > 0
        assert len(form.radial_profile(x[upper], y[upper], x[upper], spacing=1e-3).position) == 0

    @pytest.mark.parametrize("spacing", [0.0, -1e-3, np.nan])
    def test_a_spacing_that_is_none_is_refused(self, grid, spacing):
        with pytest.raises(DataError, match="spacing of a profile"):
            form.radial_profile(*grid, grid[0], spacing=spacing)

    def test_a_spacing_in_the_wrong_unit_is_refused(self, grid):
        with pytest.raises(DataError, match="widen it"):
            form.radial_profile(*grid, grid[0], spacing=1e-12)


def test_a_gain_on_the_travel_shows_as_its_share_of_the_sag(spiral):
    """The paper's static gain of 1.26/1.27 on the mirror's travel: 8.9 µm peak to valley."""
    x, y = spiral
    sag = PAPER_MIRROR.height(x, y)
    assert RADIUS == PAPER_MIRROR_RADIUS_M
    error = form.deviation(x, y, sag * 1.26 / 1.27, PAPER_MIRROR)
    found = statistics(x, y, error)
    assert found.peak_to_valley == pytest.approx(np.ptp(sag) / 127)
    assert found.peak_to_valley == pytest.approx(8.9e-6, rel=0.01)


class TestRunningStatistics:
    @pytest.mark.parametrize("portion", [1, 7, 1000])
    @pytest.mark.parametrize("stand_off", [0.0, 3e-3])
    def test_agrees_with_the_whole(self, portion, stand_off):
        random = np.random.default_rng(5)
        x, y = random.uniform(-0.01, 0.01, (2, 1000))
        deviation = 50e-9 * random.standard_normal(1000) + 2e-6 * x + stand_off
        running = form.RunningStatistics()
        for start in range(0, 1000, portion):
            part = slice(start, start + portion)
            running.add(x[part], y[part], deviation[part])
        weights = area_weights(x, y)
        whole = form.level(x, y, deviation, weights=weights)
        found = running.statistics()
        assert found.points == 1000
        assert found.peak_to_valley == pytest.approx(np.ptp(whole), rel=1e-9)
        assert found.rms == pytest.approx(np.sqrt(np.mean(whole**2)), rel=1e-9)
        by_area = np.sqrt(np.average(whole**2, weights=weights))
        assert found.rms_area_weighted == pytest.approx(by_area, rel=1e-9)

    def test_nothing_is_no_cloud(self):
        with pytest.raises(DataError, match="0 points"):
            form.RunningStatistics().statistics()


def seated(x, y):
    """A part that is tilted and lies 3 mm off: neither is said to be another surface."""
    return 3e-3 + 0.01 * x - 0.02 * y


@pytest.mark.parametrize("shape", [PAPER_MIRROR, Sphere(radius=0.2), Flat(level=1e-3)])
def test_points_of_the_surface_with_errors_of_form_are_not_called_others(spiral, shape):
    x, y = spiral
    height = shape.height(x, y) + seated(x, y) + zernike(x, y, 2, 1e-6)
    assert form.mismatch(x, y, height, shape) == []


@pytest.mark.parametrize("radius", [-0.2, 0.13, 0.4, 200.0])
def test_a_wrong_radius_sign_or_unit_is_reported_with_both_sizes(spiral, radius):
    x, y = spiral
    (said,) = form.mismatch(x, y, Sphere(radius=0.2).height(x, y), Sphere(radius=radius))
    left = form.level(x, y, x**2 + y**2, tilt=True) * (1 / 0.4 - 0.5 / radius)
    number, unit = str(said).split(" by ")[1].split()[:2]
    assert unit == "µm"
    assert float(number) == pytest.approx(1e6 * np.sqrt(np.mean(left**2)), rel=0.01)


def test_a_handful_of_points_says_nothing():
    nothing = np.zeros(2)
    assert form.mismatch(nothing, nothing, nothing + 1.0, PAPER_MIRROR) == []
