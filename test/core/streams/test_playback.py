"""The time of a recording, against the arithmetic of its definition."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from omsm_ros.core.streams.monitoring import Playback

S = 1_000_000_000
BEGIN = 1_700_000_000 * S


@pytest.mark.parametrize("rate", [0.5, 1.0, 50.0])
def test_a_message_is_due_when_its_time_has_come(rate: float) -> None:
    playback = Playback(BEGIN, rate)
    playback.resume(100.0)
    stamp = BEGIN + 3 * S
    assert playback.late(stamp, 100.0 + 2.99 / rate) is None
    assert playback.late(stamp, 100.0 + 3.01 / rate) == pytest.approx(0.01 / rate, abs=1e-6)


def test_time_stands_while_it_is_paused() -> None:
    playback = Playback(BEGIN, 2.0)
    assert playback.paused
    assert playback.late(BEGIN, 5.0) is None
    playback.resume(10.0)
    playback.pause(11.0)
    assert playback.time_ns(99.0) == BEGIN + 2 * S
    assert playback.late(BEGIN, 99.0) is None
    playback.resume(100.0)
    playback.resume(101.0)  # it goes on already
    assert playback.time_ns(102.0) == BEGIN + 6 * S


def test_a_step_takes_the_time_along() -> None:
    playback = Playback(BEGIN, 1.0)
    playback.go_to(BEGIN + 7 * S, 50.0)
    assert playback.time_ns(60.0) == BEGIN + 7 * S
    playback.resume(60.0)
    assert playback.time_ns(61.0) == BEGIN + 8 * S


def test_at_rate_0_everything_is_due_and_nothing_late() -> None:
    playback = Playback(BEGIN, 0.0)
    assert playback.late(BEGIN, 0.0) is None  # paused
    playback.resume(0.0)
    assert playback.late(BEGIN + 10**6 * S, 0.0) == 0.0


@given(
    rate=st.floats(0.01, 100),
    turns=st.lists(st.tuples(st.floats(0, 100), st.floats(0, 100)), max_size=8),
)
def test_pauses_add_up(rate: float, turns: list[tuple[float, float]]) -> None:
    playback, now, played = Playback(BEGIN, rate), 0.0, 0.0
    for playing, pausing in turns:
        playback.resume(now)
        now += playing
        played += playing * rate
        playback.pause(now)
        now += pausing
    assert playback.time_ns(now) - BEGIN == pytest.approx(played * S, rel=1e-9, abs=10)
