"""The paper's measurement on the twin: which part, which seed, which motion."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.twin_motions import step_test_of
from omsm_ros.core.kinematics.trajectories import Chirp, plan_steps
from omsm_ros.twin.scenario import Scenario, on_a_flat, scan_of

SMALL = {"start_radius": 1e-3, "feed_per_turn": 5e-4}


def test_scans_of_one_part_have_their_own_noise():
    one, other = (scan_of(Scenario(seed=s, part_seed=7, **SMALL)) for s in (1, 2))
    np.testing.assert_array_equal(one.surface_height, other.surface_height)
    assert np.std(one.axes.z - other.axes.z) == pytest.approx(0.4e-9 * np.sqrt(2), rel=0.05)


def test_without_a_seed_of_its_own_the_part_has_that_of_all():
    assert Scenario(seed=3).part == Scenario(seed=1, part_seed=3).part
    assert Scenario(seed=3).part != Scenario(seed=1).part


def test_tool_marks_are_on_the_part():
    bare, marked = (scan_of(Scenario(tool_marks=t, **SMALL)) for t in (0.0, 8e-9))
    lifted = marked.surface_height - bare.surface_height
    assert 0 <= lifted.min() < lifted.max() <= 8e-9 * (1 + 1e-6)


@pytest.mark.parametrize("motion", [plan_steps(sample_period=1e-3, step=3e-6), Chirp()])
def test_any_motion_stays_in_range_before_the_flat(motion):
    made = on_a_flat(Scenario(), motion)
    assert np.all(made.distance.ok)
    assert np.nanmax(made.distance.distance) == pytest.approx(
        -np.nanmin(made.distance.distance), abs=0.3e-6
    )


def test_the_step_test_is_the_papers():
    made = step_test_of(Scenario())
    assert len(made.axes) == 10_500
    assert np.ptp(made.truth.slide) == pytest.approx(98e-6, rel=1e-4)
