"""Lately, as against ever: figures worked out by hand on a clock of the test's own."""

from __future__ import annotations

import pytest

from omsm_ros.core.streams.monitoring import RecentIncrease, SampleFlow


def test_a_fault_is_recent_for_the_window_and_history_after() -> None:
    recent = RecentIncrease()
    assert recent.update({"lost": 0}, 0.0) == {}
    assert recent.update({"lost": 3}, 5.0) == {"lost": 3}
    assert recent.update({"lost": 5}, 12.0) == {"lost": 5}
    assert recent.update({"lost": 5}, 14.9) == {"lost": 5}
    assert recent.update({"lost": 5}, 15.1) == {"lost": 2}
    assert recent.update({"lost": 5}, 22.1) == {}


def test_what_was_counted_before_the_first_look_is_new_then() -> None:
    recent = RecentIncrease()
    assert recent.update({"lost": 7}, 100.0) == {"lost": 7}
    assert recent.update({"lost": 7}, 110.5) == {}


def test_a_count_that_began_anew_counts_from_zero() -> None:
    recent = RecentIncrease()
    recent.update({"lost": 100}, 0.0)
    recent.update({"lost": 100}, 10.0)
    assert recent.update({"lost": 4}, 11.0) == {"lost": 4}


def test_names_are_distinguished() -> None:
    recent = RecentIncrease()
    recent.update({"a": 0, "b": 0}, 0.0)
    assert recent.update({"a": 1, "b": 0}, 1.0) == {"a": 1}


def test_a_flow_that_never_began_is_not_one_that_ended() -> None:
    flow = SampleFlow()
    flow.update(0, 0.0)
    flow.update(0, 50.0)
    assert flow.silent(50.0) is None
    assert flow.rate == 0


def test_silence_counts_from_the_last_look_that_saw_samples() -> None:
    flow = SampleFlow()
    for second in range(5):
        flow.update(1000 * second, float(second))
    assert flow.silent(4.0) == 0
    flow.update(4000, 9.0)
    assert flow.silent(9.0) == 5.0


def test_the_rate_is_that_of_the_window() -> None:
    flow = SampleFlow()
    for second in range(20):
        flow.update(1000 * second, float(second))
    assert flow.rate == pytest.approx(1000.0)
    for second in range(20, 40):
        flow.update(19_000 + 70_000 * (second - 19), float(second))
    assert flow.rate == pytest.approx(70_000.0)
