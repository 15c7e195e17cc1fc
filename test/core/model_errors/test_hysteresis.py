"""Test backlash and friction against loops over single values, and their invariances."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from omsm_ros.core.model_errors.families import (
    backlash_lead,
    dahl_friction,
    through_backlash,
    without_noise,
)

few = settings(max_examples=40)
# Sixteenths are exact, so that shifted and turned motions are.
motions = st.lists(st.integers(-80, 80), min_size=1, max_size=40).map(
    lambda places: np.array(places) / 16.0
)
halves = st.integers(1, 60).map(lambda half: half / 16.0)


def played(motion, half):
    state, found = motion[0], []
    for value in motion:
        if value > state + half:
            state = value - half
        elif value < state - half:
            state = value + half
        found.append(state)
    return np.array(found)


def stepwise(motion, travel, force=0.0, pieces=400):
    """Integrate the differential equation of friction in small steps (Heun), from ``force``."""
    found = [force]
    for there, here in zip(motion[1:], motion[:-1], strict=True):
        direction, length = np.sign(there - here), abs(there - here) / pieces / travel
        for _ in range(pieces):
            slope = direction - force
            force += 0.5 * length * (slope + direction - (force + length * slope))
        found.append(force)
    return np.array(found)


class TestGap:
    @few
    @given(motions, halves)
    def test_it_is_the_play_operator(self, motion, half):
        np.testing.assert_array_equal(through_backlash(motion, half), played(motion, half))

    @few
    @given(motions, halves)
    def test_a_shift_shifts_it_and_a_motion_turned_about_turns_it(self, motion, half):
        found = through_backlash(motion, half)
        np.testing.assert_array_equal(through_backlash(motion + 7.5, half), found + 7.5)
        np.testing.assert_array_equal(through_backlash(-motion, half), -found)

    @few
    @given(motions, halves)
    def test_it_depends_on_reversals_only_and_not_on_how_fast_the_motion_goes(self, motion, half):
        slower = np.interp(np.arange(4 * len(motion) - 3) / 4, np.arange(len(motion)), motion)
        found = through_backlash(np.repeat(slower, 3), half)[::12]
        np.testing.assert_array_equal(found, through_backlash(motion, half))

    def test_a_motion_within_the_gap_moves_nothing(self):
        motion = 1.0 + 0.2 * np.sin(np.arange(50.0))
        motion[0] = 1.0
        assert np.ptp(through_backlash(motion, 0.25)) == 0

    def test_what_stands_still_stays_and_is_no_view_of_the_motion(self):
        motion = np.full(3, 2.0)
        found = through_backlash(motion, 0.5)
        found[0] = 9.0
        assert motion[0] == 2.0

    def test_the_lead_of_a_triangle(self):
        """The lead is half the backlash once crossed; after a reversal it takes all of it."""
        up = np.arange(0, 33) / 16.0
        motion = np.r_[up, up[-2::-1]]
        ahead, start = backlash_lead(motion, [1.0])
        np.testing.assert_allclose(ahead[:33], np.minimum(up / 0.5, 1.0))
        np.testing.assert_allclose(ahead[33:], np.maximum(1.0 - (2.0 - motion[33:]) / 0.5, -1.0))
        np.testing.assert_allclose(start[:33], np.maximum(1.0 - up, 0.0))
        assert not start[33:].any()

    @few
    @given(motions, halves)
    def test_the_lead_is_within_the_gap_and_what_it_began_with_only_fades(self, motion, half):
        ahead, start = backlash_lead(motion, [half])
        assert np.all(abs(ahead) <= 1)
        assert start[0] == 1
        assert np.all(np.diff(start) <= 0)
        assert np.all((start == 0) == (np.maximum.accumulate(motion)
                                       - np.minimum.accumulate(motion) >= half))  # fmt: skip


class TestNoise:
    def test_without_noise_the_motion_is_the_same(self):
        motion = np.array([0.0, 1.0, 0.5, 2.0])
        assert without_noise(motion, 0.0) is motion

    def test_reversals_of_noise_go_and_those_of_the_motion_stay(self):
        rng = np.random.default_rng(4)
        steps = np.repeat([0.0, 1.0, 2.0, 1.0, 0.0], 400)
        quiet = without_noise(steps + rng.normal(0, 1e-3, len(steps)), 1e-3)
        moves = np.diff(quiet)
        assert np.max(abs(quiet - steps)) < 5e-3
        # A normal value beyond 2 σ moves it a little, and further that way only.
        turned = np.count_nonzero(np.diff(np.sign(moves[abs(moves) > 2e-3])))
        assert turned == 1


class TestFriction:
    @pytest.mark.parametrize("travel", [0.3, 2.0])
    def test_it_is_the_differential_equation_in_small_steps(self, travel):
        motion = np.cumsum(np.random.default_rng(2).normal(size=12))
        force, decay = dahl_friction(motion, travel)
        np.testing.assert_allclose(force, stepwise(motion, travel), atol=2e-5)
        np.testing.assert_allclose(force - 0.4 * decay, stepwise(motion, travel, -0.4), atol=2e-5)

    @few
    @given(motions, halves)
    def test_it_depends_on_the_way_and_not_on_time(self, motion, travel):
        finer = np.interp(np.arange(4 * len(motion) - 3) / 4, np.arange(len(motion)), motion)
        for whole, slow in zip(
            dahl_friction(motion, travel), dahl_friction(np.repeat(finer, 2), travel), strict=True
        ):
            np.testing.assert_allclose(slow[::8], whole, atol=1e-12)

    @few
    @given(motions, halves)
    def test_it_never_exceeds_sliding_and_turns_with_the_motion(self, motion, travel):
        force, decay = dahl_friction(motion, travel)
        assert np.all(abs(force) <= 1)
        np.testing.assert_array_equal(dahl_friction(-motion, travel)[0], -force)
        way = np.sum(abs(np.diff(motion)))
        assert decay[-1] == pytest.approx(np.exp(-way / travel), abs=1e-12)

    def test_at_rest_it_keeps_what_it_had(self):
        motion = np.r_[np.linspace(0, 1, 5), np.ones(4), np.linspace(1, 0, 5)]
        force, decay = dahl_friction(motion, 1.0)
        np.testing.assert_allclose(force[4:9], 1 - np.exp(-1.0))
        np.testing.assert_allclose(decay[4:9], np.exp(-1.0))
        assert not dahl_friction(np.full(6, 3.0), 1.0)[0].any()
