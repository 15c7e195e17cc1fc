"""Test the detection of steps in a motion."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.step_test import StepTest
from omsm_ros.core.estimation.steps import extended, find_steps, sample_noise, segments
from omsm_ros.core.kinematics.trajectories import Chirp, s_curve
from omsm_ros.errors import StepTestError


def staircase(heights, period=1e-3, dwell=0.4, rise=0.02, noise=0.4e-9, seed=0):
    samples = round((len(heights) + 1) * dwell / period)
    time = np.arange(samples) * period
    z = np.zeros(samples)
    for k, height in enumerate(heights):
        z += height * s_curve((time - (k + 1) * dwell) / rise)
    return z + np.random.default_rng(seed).normal(0, noise, samples)


@settings(max_examples=25)
@given(
    heights=st.lists(
        st.floats(0.5e-6, 20e-6).flatmap(lambda h: st.sampled_from([h, -h])),
        min_size=2,
        max_size=12,
    ),
    rise=st.sampled_from([0.0005, 0.005, 0.02, 0.08]),
    period=st.sampled_from([1e-3, 2.5e-4]),
)
def test_every_step_is_found_whatever_its_size_and_direction(heights, rise, period):
    steps = find_steps(staircase(heights, period, rise=rise), period)
    assert len(steps.edges) == len(heights)
    # Rest is to a part of the travel, so a little of the slow end of a long edge counts to it.
    travel = np.ptp(np.cumsum([0, *heights]))
    found = [e.height for e in steps.edges]
    np.testing.assert_allclose(found, heights, atol=max(0.5e-9, 2e-5 * travel))


def test_an_edge_covers_the_whole_move():
    z = staircase([10e-6], noise=0)
    (edge,) = find_steps(z, 1e-3).edges
    assert edge.start <= 400
    assert edge.stop >= 420


def test_a_path_without_rest_has_no_plateaus_to_speak_of():
    time = np.arange(25_000) * 1e-3
    z = Chirp().positions(time).z
    steps = find_steps(z, 1e-3)
    assert np.mean(steps.moving) > 0.95


def test_noise_is_that_of_one_sample_even_with_steps():
    z = staircase([10e-6] * 5, noise=3e-9)
    assert sample_noise(z) == pytest.approx(3e-9, rel=0.1)


@pytest.mark.parametrize("frequency", [2.0, 15.0, 50.0])
def test_a_motion_that_never_rests_is_not_noise(frequency):
    time = np.arange(20_000) * 1e-3
    z = 20e-6 * np.sin(2 * np.pi * frequency * time) + np.random.default_rng(2).normal(
        0, 3e-9, 20_000
    )
    assert sample_noise(z) == pytest.approx(3e-9, rel=0.1)


def test_a_motion_at_rest_has_no_steps():
    rest = np.random.default_rng(3).normal(0, 0.4e-9, 20_000)
    with pytest.raises(StepTestError, match="no steps"):
        find_steps(rest, 1e-3)


def test_a_constant_has_no_steps():
    with pytest.raises(StepTestError, match="no steps"):
        find_steps(np.full(1000, 1e-3), 1e-3)


def test_micrometres_given_as_metres_are_noticed():
    with pytest.raises(StepTestError, match="must be in metres"):
        find_steps(staircase([9.8] * 4), 1e-3)


def test_two_samples_are_too_few():
    with pytest.raises(StepTestError, match="too few"):
        find_steps(np.array([0.0, 1e-5]), 1e-3)


def test_segments_hold_one_edge_each_and_cover_the_record():
    motion = StepTest()
    time = np.arange(round(motion.duration / 1e-3)) * 1e-3
    steps = find_steps(motion.positions(time).z, 1e-3)
    parts = segments(steps, len(time))
    assert parts[0][0] == 0
    assert parts[-1][1] == len(time)
    for (start, stop), edge in zip(parts, steps.edges, strict=True):
        assert start <= edge.start < edge.stop <= stop


def test_four_edges_are_cut_between_and_three_into_equal_parts():
    heights = [10e-6, 10e-6, -10e-6, -10e-6]
    steps = find_steps(staircase(heights), 1e-3)
    assert len(segments(steps, 2000)) == 4
    few = find_steps(staircase(heights[:3]), 1e-3)
    parts = segments(few, 1600)
    assert parts == [(start, start + 200) for start in range(0, 1600, 200)]


@pytest.mark.parametrize("cut", ["start", "end"])
def test_an_edge_cut_by_the_end_of_the_record_is_none(cut):
    """Its height is not known; the others keep theirs."""
    z = staircase([10e-6, 5e-6, -8e-6], noise=0.0)
    part = slice(410, None) if cut == "start" else slice(None, 1210)
    steps = find_steps(z[part], 1e-3)
    expected = [5e-6, -8e-6] if cut == "start" else [10e-6, 5e-6]
    np.testing.assert_allclose([edge.height for edge in steps.edges], expected, atol=1e-9)
    assert steps.moving[0 if cut == "start" else -1]
    assert not steps.moving[-1 if cut == "start" else 0]


@settings(max_examples=30)
@given(flags=st.lists(st.booleans(), max_size=40), samples=st.integers(0, 50))
def test_what_lasts_is_what_was_within_so_many_samples(flags, samples):
    expected = [any(flags[max(k - samples, 0) : k + 1]) for k in range(len(flags))]
    assert extended(np.array(flags, bool), samples).tolist() == expected
