"""Offset of two counters from the motion, live: equal to the truth, or unknown."""

from __future__ import annotations

from dataclasses import replace

import pytest
from two_counters import blocks, motion, watched

from benchmarks.twin_motions import step_test_of
from omsm_ros.twin.cell import blocks_of
from omsm_ros.twin.plant import PAPER_STATIC_GAIN
from omsm_ros.twin.scenario import Scenario


@pytest.mark.parametrize("kind", ["chirp", "steps"])
@pytest.mark.parametrize("slip", [-40, -1, 0, 1, 3])
def test_a_motion_before_the_target_tells_the_offset(kind: str, slip: int) -> None:
    found = watched(blocks(motion(kind), slip)).established
    assert found is not None
    assert found.samples == slip
    assert abs(found.fraction) < 0.2


@pytest.mark.parametrize("slip", [0, -4])
def test_the_papers_step_test_tells_it(slip: int) -> None:
    came = [
        (
            replace(axes, first_sample=axes.first_sample + 4 + slip),
            replace(d, first_sample=d.first_sample + 4),
        )
        for axes, d in blocks_of(step_test_of(Scenario(seed=3)))
    ]
    found = watched(came).established
    assert found is not None
    assert found.samples == slip
    assert abs(found.fraction) < 0.02
    assert abs(found.gain / PAPER_STATIC_GAIN - 1) < 1e-3


def test_an_offset_that_is_stated_is_none_any_more() -> None:
    found = watched(blocks(motion("chirp"), 3), in_use=3).established
    assert found is not None
    assert found.samples == 0


@pytest.mark.parametrize(
    ("kind", "followed"),
    [("rest", 0.0), ("sine", 0.0), ("chirp", 0.97), ("steps", 1.3), ("steps", 0.1)],
)
def test_a_motion_that_does_not_tell_establishes_nothing(kind: str, followed: float) -> None:
    assert watched(blocks(motion(kind), 3, followed=followed)).established is None


def test_a_counter_that_begins_anew_has_to_be_established_anew() -> None:
    came = blocks(motion("chirp"), 0)
    watch = watched(came)
    assert watch.established is not None
    watch.add(came[0][1])
    assert watch.established is None


def test_the_slip_is_reported_within_two_seconds_of_motion() -> None:
    assert watched(blocks(motion("steps"), 1)[:42]).established is not None


def test_nothing_is_reported_of_counts_that_only_one_stream_has() -> None:
    """The probe starts late, in a gap of the axes, which have gone on since."""
    came = blocks(motion("chirp"), 0)
    counted = [axes.first_sample for axes, _ in came]
    watch = watched([])
    for axes, _ in came[: counted.index(4500)]:
        watch.add(axes)
    for _, distance in came[counted.index(5000) : counted.index(7500)]:
        watch.add(distance)
    watch.add(came[-1][0])
    watch.judge()
    assert watch.established is None


@pytest.mark.parametrize("period", [1e-7, 5.0, 10.0])
def test_samples_of_any_period_that_may_come_are_taken(period: float) -> None:
    """Blocks of ten seconds exceed the span that is kept, so that nothing is established."""
    came = [
        (replace(axes, sample_period=period), replace(distance, sample_period=period))
        for axes, distance in blocks(motion("chirp"), 0)[:5]
    ]
    assert watched(came).established is None
