"""Offsets of the next cut, and the way of the tool: planes, waves and spirals in closed form."""

from __future__ import annotations

import re

import numpy as np
import pytest

from omsm_ros.core.form.compensation import Compensation, compensation, path_gcode, spiral_offsets
from omsm_ros.core.form.deviation_map import DeviationMap
from omsm_ros.core.kinematics.trajectories import Spiral
from omsm_ros.core.surface.nominal import Flat, Sphere
from omsm_ros.core.surface.posed import Pose, PosedSurface
from omsm_ros.errors import ConfigurationError, DataError

RADIUS = 6e-3
LINE = np.linspace(-RADIUS, RADIUS, 161)
ALL_X, ALL_Y = (v.ravel() for v in np.meshgrid(LINE, LINE))
INSIDE = np.hypot(ALL_X, ALL_Y) <= RADIUS
X, Y = ALL_X[INSIDE], ALL_Y[INSIDE]


def map_of(deviation, noise=0.0, effects=()):
    return DeviationMap(
        x=X, y=Y, deviation=deviation, area=np.ones(len(X)),
        effects=np.array(effects).reshape(len(effects), len(X)), noise=noise,
    )  # fmt: skip


def plane(slope=(2e-6, -3e-6), level=50e-9, side=21):
    """Offsets that are linear over a grid of 0.5 mm."""
    x = y = 5e-4 * (np.arange(side) - side // 2)
    offset = level + slope[0] * x[np.newaxis] + slope[1] * y[:, np.newaxis]
    return Compensation(
        x=x, y=y, offset=offset, uncertainty=0 * offset, low_pass=1e-3, before=0.0, after=0.0
    )


# Between the cells.


def test_between_its_cells_a_plane_is_a_plane():
    found = plane()
    x, y = np.random.default_rng(1).uniform(-4.9e-3, 4.9e-3, (2, 300))
    np.testing.assert_allclose(found.between(x, y), 50e-9 + 2e-6 * x - 3e-6 * y, atol=1e-21)


def test_half_a_cell_beyond_the_last_its_offset_goes_on_and_no_farther():
    found = plane(slope=(0.0, 0.0))
    edge = found.x[-1]
    for x, y in ((edge, 0.0), (-edge, 0.0), (0.0, edge), (0.0, -edge)):
        out = np.sign([x, y])
        near, far = (np.array([x, y]) + out * d for d in (2e-4, 6e-4))
        assert found.between(near[:1], near[1:]) == pytest.approx([50e-9])
        assert np.isnan(found.between(far[:1], far[1:]))[0]


def test_next_to_a_missing_cell_the_present_ones_count():
    found = plane(slope=(0.0, 0.0))
    found.offset[9:12, 9:12] = np.nan
    there = np.array([7e-4, 5.1e-4, 1e-4])
    np.testing.assert_allclose(found.between(there[:2], 0 * there[:2]), [50e-9, 50e-9])
    assert np.isnan(found.between(there[2:], 0 * there[2:]))[0]


def test_at_a_cell_its_own_offset_is_the_answer():
    found = plane()
    found.offset[:] = np.random.default_rng(2).normal(size=found.offset.shape)
    x, y = np.meshgrid(found.x, found.y)
    between = found.between(x.ravel(), y.ravel())
    np.testing.assert_allclose(between.reshape(x.shape), found.offset, atol=1e-12)


# Offsets of the next cut.


def wave(length):
    return 20e-9 * np.sin(2 * np.pi * X / length)


@pytest.mark.parametrize("length", [2e-3, 4e-3])
def test_of_a_wave_at_the_low_pass_half_is_compensated(length):
    """Amid the part; what stays is the other half, and the cells take a little of their own."""
    found = compensation(map_of(wave(length)), Flat(), length)
    amid = np.abs(X) < 2e-3
    cut = found.between(X, Y)
    share = -(cut[amid] @ wave(length)[amid]) / (wave(length)[amid] @ wave(length)[amid])
    assert share == pytest.approx(0.5, abs=0.05)


def test_what_is_long_goes_and_what_is_fine_stays():
    ridge = wave(0.5e-3)
    level = 100e-9 + 0 * X
    found = compensation(map_of(level + ridge), Flat(), 4e-3)
    assert found.before == pytest.approx(np.sqrt(1e-14 + 2e-16), rel=0.01)
    assert found.after == pytest.approx(20e-9 / np.sqrt(2), rel=0.05)
    np.testing.assert_allclose(found.offset[np.isfinite(found.offset)], -100e-9, rtol=0.03)


def test_the_next_cut_is_the_opposite_of_the_deviation_and_scales_with_it():
    rng = np.random.default_rng(3)
    one, other = rng.normal(0, 1e-8, (2, len(X)))
    both, first, second = (
        compensation(map_of(d), Flat(), 2e-3).offset for d in (one - 2 * other, one, other)
    )
    np.testing.assert_allclose(both, first - 2 * second, atol=1e-20)


def test_on_a_steep_part_the_tool_goes_deeper_along_z():
    """A part that is high by d along its normal: d over the cosine of its slope."""
    part = PosedSurface(Flat(), Pose(tilt=0.5))
    found = compensation(map_of(np.full(len(X), 30e-9)), part, 2e-3)
    known = np.isfinite(found.offset)
    np.testing.assert_allclose(found.offset[known], -30e-9 / np.cos(0.5), rtol=1e-9)
    # After the cut the points lie on the nominal surface.
    assert found.after < 1e-15


def test_on_a_sphere_the_depth_is_by_the_radius_of_each_cell():
    found = compensation(map_of(np.full(len(X), 30e-9)), Sphere(0.01), 2e-3)
    x, y = np.meshgrid(found.x, found.y)
    known = np.isfinite(found.offset)
    cosine = np.sqrt(1 - (x[known] ** 2 + y[known] ** 2) / 0.01**2)
    np.testing.assert_allclose(found.offset[known], -30e-9 / cosine, rtol=1e-6)


def test_an_effect_of_the_whole_part_is_its_uncertainty_and_noise_averages_out():
    shift = np.full(len(X), 5e-9)
    found = compensation(map_of(0 * X, effects=[shift, 2 * shift]), Flat(), 2e-3)
    known = np.isfinite(found.offset)
    np.testing.assert_allclose(found.uncertainty[known], np.sqrt(5) * 5e-9, rtol=1e-9)
    noisy = [compensation(map_of(0 * X, noise=1e-8), Flat(), w) for w in (2e-3, 4e-3)]
    centre = tuple(size // 2 for size in noisy[0].offset.shape)
    # Twice the width averages four times as many points: half the noise.
    one, half = (float(f.uncertainty[centre]) for f in noisy)
    assert one / half == pytest.approx(2.0, rel=0.06)
    # A Gaussian of cutoff c over points of spacing s leaves σ s √(π / 2 ln 2) / c of white noise.
    spacing = LINE[1] - LINE[0]
    expected = 1e-8 * spacing * np.sqrt(np.pi / (2 * np.log(2))) / 2e-3
    assert one == pytest.approx(expected, rel=0.05)


def test_stated_noise_of_the_offsets_is_their_scatter():
    rng = np.random.default_rng(4)
    runs = [
        compensation(map_of(rng.normal(0, 1e-8, len(X)), 1e-8), Flat(), 2e-3) for _ in range(12)
    ]
    scatter = np.sqrt(np.nanmean([run.offset**2 for run in runs]))
    assert scatter == pytest.approx(np.sqrt(np.nanmean(runs[0].uncertainty ** 2)), rel=0.1)


def test_four_cells_of_the_points_are_the_finest_wave_that_is_compensated():
    """Eight points a cell: cells of √8 distances of the points, which fill their square."""
    area = map_of(0 * X)
    pitch = np.sqrt(8 * np.ptp(X) * np.ptp(Y) / len(X))
    compensation(area, Flat(), 4.01 * pitch)
    with pytest.raises(DataError, match="finer than the points resolve"):
        compensation(area, Flat(), 3.99 * pitch)


def test_a_low_pass_finer_than_the_points_and_a_single_row_are_refused():
    with pytest.raises(DataError, match=r"low-pass of 0.0001 m is finer .* measure more points"):
        compensation(map_of(0 * X), Flat(), 1e-4)
    row = DeviationMap(
        x=LINE, y=0 * LINE, deviation=0 * LINE, area=np.ones(161),
        effects=np.empty((0, 161)), noise=0.0,
    )  # fmt: skip
    with pytest.raises(DataError, match=r"one row of cells .* measure more tracks"):
        compensation(row, Flat(), 5e-3)


# The way of the tool.


@pytest.mark.parametrize("per_turn", [12, 90])
def test_a_tool_path_is_a_spiral_from_the_rim_inwards(per_turn):
    path = spiral_offsets(plane(), 2e-4, per_turn)
    rim = np.hypot(5e-3, 5e-3)
    assert path.radius[0] <= rim
    np.testing.assert_allclose(path.radius, rim - 2e-4 * path.angle / (2 * np.pi), rtol=1e-9)
    steps = path.angle * per_turn / (2 * np.pi)
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    assert path.radius[-1] == pytest.approx(0.0, abs=2e-4)
    assert np.all(np.diff(path.angle) > 0)
    # The spiral leaves the measured square beyond its sides.
    assert path.left_out > 0
    assert path.left_out + len(path.radius) == int(rim / 2e-4 * per_turn) + 1


def test_the_place_under_the_tool_is_that_of_a_scan_of_the_same_spiral():
    """A scan of a tilted plane has in Z what the offsets of that plane have at the same X and C."""
    path = spiral_offsets(plane(), 5e-4, 36)
    tilted = PosedSurface(Flat(50e-9), Pose(tip=-3e-6, tilt=-2e-6))
    axes = Spiral(tilted, float(np.hypot(5e-3, 5e-3)), 5e-4, 60.0).positions(
        path.angle / (2 * np.pi)
    )
    np.testing.assert_allclose(axes.x, path.radius, atol=1e-12)
    over = path.radius < 5e-3  # beyond it the corners alone were measured
    np.testing.assert_allclose(path.offset[over], axes.z[over], atol=1e-15)


def test_a_table_for_the_controller_is_in_millimetres_and_degrees():
    path = spiral_offsets(plane(), 1e-3, 24)
    text = path_gcode(path)
    rows = np.array(re.findall(r"^X(\S+) C(\S+) Z(\S+)$", text, re.M), float)
    assert rows.shape == (len(path.radius), 3)
    np.testing.assert_allclose(rows[:, 0], 1e3 * path.radius, atol=1e-6)
    np.testing.assert_allclose(rows[:, 1], np.degrees(path.angle), atol=1e-5)
    np.testing.assert_allclose(rows[:, 2], 1e3 * path.offset, atol=1e-8)
    assert "\nG21\nG90\n" in text


def test_more_places_than_a_controller_takes_are_refused_by_their_number():
    with pytest.raises(ConfigurationError, match=r"1.00 µm a turn with 720 places .* wider feed"):
        spiral_offsets(plane(), 1e-6, 720)


def test_a_feed_in_a_wrong_unit_makes_no_turn_and_is_refused():
    with pytest.raises(ConfigurationError, match=r"100 mm a turn .* makes less than one turn"):
        spiral_offsets(plane(), 0.1, 360)
