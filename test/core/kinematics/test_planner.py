"""Segments of a path, against a planner that is written here from its description."""

import numpy as np
import pytest

from omsm_ros.core.kinematics.planner import averaged, plan_path, planned_at
from omsm_ros.core.surface.nominal import PAPER_MIRROR


def spiral(rpm, radius=12.7e-3, feed=2e-4):
    def path(t):
        c = 2 * np.pi * rpm / 60 * t
        x = radius - feed * rpm / 60 * t
        return x, PAPER_MIRROR.height(x * np.cos(c), -x * np.sin(c)), c

    return path


def executed(path, period):
    """Return z and c of each cycle: segments ramp up, run, ramp down, overlap; then cubics."""
    cycles, ramp = round(path.segment / period), 2 * round(path.cycle / period)
    fine = 64
    n, r = cycles * fine, ramp * fine
    speed = np.convolve(np.full(n, 1.0 / n), np.full(r, 1.0 / r))  # trapezoid of one segment
    total = np.zeros(n * (len(path.z) - 1) + r)
    z, c = total.copy(), total.copy()
    for k, (dz, dc) in enumerate(zip(np.diff(path.z), np.diff(path.c), strict=True)):
        z[k * n : k * n + len(speed)] += dz * speed
        c[k * n : k * n + len(speed)] += dc * speed
    at = slice(r // 2 + fine - 1, -r, fine)
    kernel = np.array([1.0, 4.0, 1.0]) / 6
    z, c = (np.convolve(np.cumsum(v)[at], kernel, "valid") for v in (z, c))
    return path.z[0] + z, path.c[0] + c


@pytest.mark.parametrize(("rpm", "bound"), [(30, 100e-9), (60, 100e-9), (120, 300e-9)])
def test_the_executed_path_keeps_its_bound(rpm, bound):
    path = plan_path(spiral(rpm), 2.0, 1e-3, bound)
    z, c = executed(path, 1e-3)
    x = np.interp(c, path.c, path.x)
    off = z - PAPER_MIRROR.height(x * np.cos(c), -x * np.sin(c))
    inner = slice(50, -50)
    assert np.max(np.abs(off[inner])) < path.error <= bound
    # Half a degree in a cycle, and no ripple: the ramps of neighbours add up.
    np.testing.assert_allclose(np.diff(c)[inner], 2 * np.pi * rpm / 60 * 1e-3, rtol=1e-6)


def test_segments_are_whole_cycles_and_c_reaches_its_speed_in_one():
    path = plan_path(spiral(30), 2.0, 1e-3, 1e-7)
    assert path.segment / 1e-3 == pytest.approx(round(path.segment / 1e-3), abs=1e-9)
    assert path.c_acceleration == pytest.approx(np.pi / 1e-3, rel=2e-3)


def test_vertices_lie_outside_so_that_the_path_is_on_the_surface():
    """A polygon through points of a circle is T² z''/12 inside on average; the vertices make up."""
    plain = planned_at(spiral(60), 2.0, 0.02, 1e-3)
    time = np.linspace(0.2, 1.8, 100_001)
    wanted = spiral(60)(time)[1]
    through = averaged(time, plain.time, spiral(60)(plain.time)[1], 1e-3)
    assert np.std(plain.motion(time)[1] - wanted) < 0.6 * np.std(through - wanted)


def test_a_bound_that_no_segment_keeps_leaves_what_can_be_had():
    path = plan_path(spiral(120), 2.0, 1e-3, 1e-9)
    assert path.segment == pytest.approx(4e-3)
    assert 50e-9 < path.error < 500e-9


@pytest.mark.parametrize("values", [np.ones(9), np.arange(9.0)])
def test_the_average_of_a_straight_line_is_the_line(values):
    at = np.linspace(1.0, 7.0, 31)
    line = np.interp(at, np.arange(9.0), values)
    np.testing.assert_allclose(averaged(at, np.arange(9.0), values, 0.7), line, atol=1e-12)
