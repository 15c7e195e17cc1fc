"""Motions against integrals of their jerk, plain loops and the surface that they follow."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.free_path import Multisine
from benchmarks.step_test import StepTest
from omsm_ros.core.kinematics.kinematics import Geometry, workpiece_points
from omsm_ros.core.kinematics.trajectories import (
    Chirp,
    Circle,
    Spiral,
    StepPlan,
    plan_csv,
    plan_steps,
    s_curve,
)
from omsm_ros.core.surface.aspheres import Sphere, Toroid
from omsm_ros.core.surface.nominal import PAPER_MIRROR, Flat
from omsm_ros.errors import ConfigurationError
from omsm_ros.io.gcode_file import steps_gcode


def integrated(phase: Fraction) -> Fraction:
    """Jerk of ±32 over four quarters, integrated three times in fractions."""
    place = speed = acceleration = Fraction(0)
    for quarter, jerk in enumerate((32, -32, -32, 32)):
        span = min(max(phase - Fraction(quarter, 4), Fraction(0)), Fraction(1, 4))
        place += speed * span + acceleration * span**2 / 2 + jerk * span**3 / 6
        speed += acceleration * span + jerk * span**2 / 2
        acceleration += jerk * span
    return place


def test_an_s_curve_is_its_jerk_integrated_three_times():
    for k in range(0, 129):
        phase = Fraction(k, 128)
        found = s_curve(np.array([float(phase)]))[0]
        assert found == pytest.approx(float(integrated(phase)), abs=1e-15)


@given(st.floats(-2, 3), st.floats(-2, 3))
@settings(max_examples=30)
def test_an_s_curve_rises_and_looks_alike_from_both_ends(one, other):
    low, high = s_curve(np.array(sorted((one, other))))
    assert 0 <= low <= high <= 1
    assert s_curve(np.array([one, 1 - one])).sum() == pytest.approx(1.0)


# Step tests.


def by_steps(motion, time):
    """The commanded height at one time, edge by edge."""
    z = 0.0
    for edge in range(1, 2 * motion.count + 1):
        since = time - edge * motion.dwell
        if since < 0:
            break
        way = 1.0 if motion.rise == 0 else float(s_curve(np.array([since / motion.rise]))[0])
        z += way * motion.step * (1 if edge <= motion.count else -1)
    return z


@pytest.mark.parametrize("motion", [StepTest(), StepTest(3e-6, 4, 0.3, 0.0), StepTest(rise=0.4)])
def test_a_step_test_is_the_sum_of_its_edges(motion):
    time = np.sort(np.random.default_rng(1).uniform(-1, motion.duration + 1, 80))
    found = motion.positions(time)
    np.testing.assert_allclose(found.z, [by_steps(motion, t) for t in time], atol=1e-18)
    for name in "xybc":
        assert not np.any(getattr(found, name))


def test_a_sharp_edge_is_there_from_its_first_moment_on():
    motion = StepTest(step=1e-6, count=1, dwell=0.5, rise=0.0)
    z = motion.positions(np.array([0.5 - 1e-12, 0.5, 1.0 - 1e-12, 1.0])).z
    np.testing.assert_array_equal(z, [0.0, 1e-6, 1e-6, 0.0])


# Over a surface.


@pytest.mark.parametrize("speed", [30.0, -45.0])
@pytest.mark.parametrize("surface", [PAPER_MIRROR, Toroid(0.05, -0.04)])
@pytest.mark.parametrize(
    "make",
    [
        lambda s, v: Spiral(s, 5e-3, 1e-3, v),
        lambda s, v: Spiral(s, 5e-3, 1e-3, v, outward=True, beyond=2e-3),
        lambda s, v: Circle(s, 4e-3, v, turns=2.5),
    ],
)
def test_a_probe_on_the_axis_of_its_spindle_sees_the_surface_all_the_way(make, surface, speed):
    """Through the kinematics that turn positions of axes into points."""
    motion = make(surface, speed)
    axes = motion.positions(np.linspace(-0.5, motion.duration, 400))
    seen = workpiece_points(
        Geometry(), (axes.x, axes.y, axes.z), axes.b, axes.c, np.zeros(len(axes.z))
    )
    np.testing.assert_allclose(seen.height, surface.height(seen.x, seen.y), atol=1e-18)


@pytest.mark.parametrize("speed", [30.0, -90.0])
def test_each_turn_of_a_spiral_is_a_feed_nearer(speed):
    spiral = Spiral(Flat(), 8e-3, 5e-4, speed)
    turn = 60 / abs(speed)
    axes = spiral.positions(np.arange(17) * turn)
    np.testing.assert_allclose(-np.diff(axes.x), np.full(16, 5e-4), rtol=1e-9)
    np.testing.assert_allclose(np.diff(axes.c), np.full(16, np.copysign(2 * np.pi, speed)))
    assert spiral.duration == pytest.approx(16 * turn)


@pytest.mark.parametrize(("outward", "ends"), [(False, (8e-3, -2e-3)), (True, (-2e-3, 8e-3))])
def test_a_spiral_goes_on_beyond_the_centre(outward, ends):
    spiral = Spiral(Flat(), 8e-3, 5e-4, 60.0, outward, beyond=2e-3)
    assert spiral.duration == pytest.approx(20.0)
    assert spiral.positions(np.array([0.0, 20.0])).x == pytest.approx(ends)


def test_a_spindle_that_turns_backwards_sees_the_mirror_image():
    """A surface with mirror symmetry has the same heights in both directions."""
    time = np.linspace(0, 3, 200)
    there, back = (Spiral(Toroid(0.05, 0.08), 5e-3, 1e-3, v).positions(time) for v in (40.0, -40.0))
    np.testing.assert_allclose(back.z, there.z, atol=1e-18)
    np.testing.assert_array_equal(back.c, -there.c)


def test_a_circle_comes_back_to_where_it_was():
    circle = Circle(PAPER_MIRROR, 6e-3, -120.0, turns=3)
    axes = circle.positions(np.array([0.0, circle.duration / 3, circle.duration]))
    np.testing.assert_allclose(axes.z, np.full(3, axes.z[0]), rtol=1e-12)
    assert axes.c[-1] == pytest.approx(-6 * np.pi)


def test_over_a_sphere_a_circle_needs_no_z():
    z = Circle(Sphere(0.05), 3e-3, 30.0).positions(np.linspace(0, 2, 50)).z
    np.testing.assert_allclose(z, np.full(50, z[0]), rtol=1e-12)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"start_radius": -1e-3}, "start_radius -0.001 m"),
        ({"feed_per_turn": 0.0}, "feed_per_turn 0.0 m"),
        ({"spindle_speed": 0.0}, "spindle_speed 0.0 rpm not zero"),
    ],
)
def test_a_spiral_that_never_ends_is_refused_by_what_is_wrong(options, named):
    usual = {"surface": Flat(), "start_radius": 1e-3, "feed_per_turn": 1e-4, "spindle_speed": 30.0}
    with pytest.raises(ConfigurationError, match=named):
        Spiral(**usual | options)


# Swings.


def test_a_chirp_is_at_each_moment_at_its_own_frequency():
    """Its phase by the arccosine, differentiated; away from its turning points."""
    chirp = Chirp(peak_to_peak=2.0, start_frequency=2.0, end_frequency=8.0, duration=6.0)
    time = np.linspace(0.5, 5.5, 4001)
    step = 1e-5
    z, before, after = (chirp.positions(time + d).z for d in (0, -step, step))
    steep = np.abs(z) < 0.9
    rate = np.abs((after - before) / (2 * step))[steep] / np.sqrt(1 - z[steep] ** 2)
    np.testing.assert_allclose(rate / (2 * np.pi), 2 + time[steep], rtol=1e-5)


def test_before_its_start_a_chirp_rests_where_it_begins():
    chirp = Chirp(peak_to_peak=3e-6)
    np.testing.assert_array_equal(chirp.positions(np.array([-9.0, -1e-3, 0.0])).z, [1.5e-6] * 3)


def test_a_multisine_swings_before_its_start_and_repeats_after_a_common_period():
    motion = Multisine(frequencies=(0.5, 1.5, 4.0), amplitude=1e-6)
    time = np.linspace(-3, 3, 301)
    np.testing.assert_allclose(motion.positions(time + 2.0).z, motion.positions(time).z, atol=1e-18)
    assert np.ptp(motion.positions(time[time < 0]).z) > 1e-6


def test_schroeders_phases_keep_the_peak_below_that_of_equal_phases():
    """Sixteen lines in phase have a peak of sixteen amplitudes, white noise of four."""
    motion = Multisine(frequencies=tuple(0.5 * np.arange(1, 17)), amplitude=1.0)
    z = motion.positions(np.linspace(0, 2, 20_001)).z
    assert np.std(z) == pytest.approx(np.sqrt(8), rel=1e-3)
    assert np.abs(z).max() < 2 * np.std(z)


# Plans.


def planned(plan, time):
    """The height of a plan at one time, edge by edge."""
    return sum(
        height * float(s_curve(np.array([(time - start) / plan.rise]))[0])
        for start, height in zip(plan.starts, plan.heights, strict=True)
    )


@pytest.mark.parametrize("options", [{}, {"second_step": 2e-6}, {"count": 3, "dwell": 0.1}])
def test_a_plan_is_the_sum_of_its_edges(options):
    plan = plan_steps(sample_period=1e-3, **options)
    time = np.sort(np.random.default_rng(2).uniform(-0.2, plan.duration + 0.2, 60))
    np.testing.assert_allclose(plan.z(time), [planned(plan, t) for t in time], atol=1e-18)
    axes = plan.positions(time)
    np.testing.assert_array_equal(axes.z, plan.z(time))
    assert not any(np.any(getattr(axes, name)) for name in "xybc")


@given(st.integers(1, 12), st.floats(1e-6, 4e-6), st.floats(1e-6, 4e-6))
@settings(max_examples=30)
def test_a_plan_of_any_steps_comes_home_and_travels_what_its_steps_add_up_to(count, one, other):
    plan = plan_steps(sample_period=1e-3, step=one, second_step=other, count=count)
    assert len(plan.starts) == len(plan.heights) == 2 * count
    assert abs(sum(plan.heights)) < 1e-18
    ups = [other if k % 2 else one for k in range(count)]
    assert plan.travel == pytest.approx(sum(ups))
    every = np.concatenate([[0.0], np.cumsum(plan.heights)])
    # As far to one side as to the other, but for a step.
    assert abs(every.max() + every.min()) <= 2 * max(one, other)


def test_plans_at_their_limits_are_made():
    """Ten samples of rise, three rises of dwell, all of the range."""
    plan = plan_steps(sample_period=2e-3, rise=20e-3, dwell=60e-3, count=10, step=10e-6)
    assert plan.travel == pytest.approx(100e-6)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"sample_period": 2.01e-3}, r"rise 0.02 s is too short for samples every 0.00201 s"),
        ({"dwell": 0.0599}, "'dwell' 0.06 s or longer"),
        ({"step": 10.1e-6}, r"10 steps travel 101 µm.*range of ±50.0 µm; use fewer or smaller"),
    ],
)
def test_plans_beyond_them_are_refused_with_what_would_do(options, named):
    with pytest.raises(ConfigurationError, match=named):
        plan_steps(**{"sample_period": 1e-3} | options)


def test_edges_that_overlap_are_no_plan():
    StepPlan((0.25, 0.375), (1e-6, -1e-6), 0.125, 1.0)
    with pytest.raises(ConfigurationError, match=r"within the rise of 0.125 s.*leave a rest"):
        StepPlan((0.25, 0.374), (1e-6, -1e-6), 0.125, 1.0)


def test_a_table_of_more_lines_than_a_controller_takes_is_refused_by_their_number():
    plan = plan_steps(sample_period=1e-3)
    with pytest.raises(
        ConfigurationError, match=r"10.5 s every 10.0 µs are 1 050 000 lines, at most 1 000 000"
    ):
        plan_csv(plan, 1e-5)


def test_gcode_ends_each_edge_where_the_plan_does():
    """Its relative moves added up, its rests and feeds run through: the plateaus of the plan."""
    plan = plan_steps(sample_period=1e-3, second_step=3e-6, count=4)
    now = z = 0.0
    for line in steps_gcode(plan).splitlines():
        words = line.split(";")[0].split()
        if words[:1] == ["G4"]:
            now += float(words[1][1:])
            assert z == pytest.approx(plan.z(np.array([now]))[0], abs=1e-12)
        elif words[:1] == ["G1"]:
            move, feed = float(words[1][1:]) * 1e-3, float(words[2][1:]) * 1e-3 / 60
            z, now = z + move, now + abs(move) / feed
    assert now == pytest.approx(plan.duration, abs=1e-4)
    assert z == pytest.approx(0.0, abs=1e-12)
