"""Arrivals in step with the trigger: the age of their last sample changes by a period now and then.

That looks like a missed trigger, so they confirm samples, but give no number.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from soaked import soaked

from omsm_ros.instruments.arrivals import MissedTriggerDetector

PERIOD = 1e-3
UPTIME_S = 123_456.0  # of the host, from which its monotonic clock counts


@pytest.mark.parametrize("seed", [0, 1, *soaked(*range(2, 8))])
@pytest.mark.parametrize("missed", [0, 1])
def test_polls_in_step_with_the_trigger_are_never_renumbered(seed: int, missed: int) -> None:
    """The age of their last sample falls by a period now and then, as if a trigger was missed."""
    random, detector, period = np.random.default_rng(seed), MissedTriggerDetector(PERIOD), PERIOD
    polls = np.arange(1, 1500) * 10 * period * (1 + random.uniform(-3e-4, 3e-4))
    at, confirmed = random.uniform(0.5, 5.0), 0.0
    for poll in polls + random.uniform(0, period):
        taken = math.floor(poll / period) * period
        due = taken - missed * period * (taken > at)
        if detector.confirms(due, UPTIME_S + poll):
            confirmed = taken
        assert detector.forget_missed() == 0
    assert confirmed > 0.4
    assert confirmed < at or not missed


@pytest.mark.parametrize("seed", range(5))
def test_nor_are_polls_in_step_whose_arrivals_scatter_by_half_a_period(seed: int) -> None:
    random, period = np.random.default_rng(seed), 2e-4
    detector = MissedTriggerDetector(period)
    polls = np.arange(1, 600) * 30 * period * (1 - 1.5e-4) + random.uniform(0.9, 1.0) * period
    late = random.exponential(period / 2, len(polls))
    for poll, arrival in zip(polls, np.maximum.accumulate(polls + late), strict=True):
        detector.confirms(math.floor(poll / period) * period, UPTIME_S + float(arrival))
        assert detector.forget_missed() == 0


@pytest.mark.parametrize("scatter", ["uniform", "exponential"])
@pytest.mark.parametrize("seed", range(3))
def test_nor_are_those_whose_arrivals_scatter_by_a_whole_period(seed: int, scatter: str) -> None:
    """Their phases are random, but the polls take the same number of samples for seconds."""
    random, period = np.random.default_rng(seed), 5e-4
    detector, confirmed = MissedTriggerDetector(period), 0.0
    polls = np.arange(1, 1200) * 10 * period * (1 - random.uniform(0.7e-4, 1.3e-4))
    polls += random.uniform(0.5, 1.0) * period
    late = getattr(random, scatter)(*((0.0, period) if scatter == "uniform" else (period,)), 1199)
    for poll, arrival in zip(polls, np.maximum.accumulate(polls + late), strict=True):
        due = math.floor(poll / period) * period
        confirmed += detector.confirms(due, UPTIME_S + float(arrival))
        assert detector.forget_missed() == 0
    assert confirmed


def blocks_in_slices(seed: int, missed_at: float = math.inf) -> tuple[list[float], list[float]]:
    """Return when the blocks of 50 samples that are confirmed, and all, were complete [s].

    The device sends each block at once. The host runs for 10 ms and rests for 30 ms on average.
    """
    random, detector, blocks = np.random.default_rng(seed), MissedTriggerDetector(PERIOD), 160
    slices = np.cumsum(random.exponential((0.03, 0.01), (1000, 2)).ravel()).reshape(-1, 2)
    taken = np.arange(1, blocks + 1) * 50 * PERIOD
    taken += PERIOD * (taken > missed_at)
    sent = taken * (1 + 2e-5) + random.exponential(3e-5, blocks)
    begun = slices[np.searchsorted(slices[:, 1], sent), 0]
    arrivals = np.maximum.accumulate(np.maximum(sent, begun) + random.exponential(2e-5, blocks))
    last = np.flatnonzero(np.diff(arrivals, append=np.inf) > 1e-4)  # of those read together
    confirmed = [
        detector.confirms((int(block) + 1) * 50 * PERIOD, UPTIME_S + float(arrivals[block]))
        for block in last
    ]
    return taken[last[confirmed]].tolist(), taken[last].tolist()


def test_blocks_are_confirmed_on_a_busy_host_that_delays_most_of_them() -> None:
    """A poll would take a sample more or less now and then, so their age stays."""
    begun = [min(blocks_in_slices(seed)[0], default=math.inf) for seed in range(6)]
    assert np.median(begun) < 5.0


@pytest.mark.parametrize("seed", range(4))
def test_nor_is_a_block_after_a_missed_trigger(seed: int) -> None:
    confirmed, taken = blocks_in_slices(seed, missed_at=6.01)
    assert max(confirmed, default=0.0) < 6.01 < max(taken)


@pytest.mark.parametrize(("size", "missed"), [(2, 1), (10, 2), (50, 3)])
def test_blocks_that_are_sent_at_once_show_how_many_were_missed(size: int, missed: int) -> None:
    """They stay of equal size, where polls would take fewer samples, so no age has changed."""
    random, detector = np.random.default_rng(size), MissedTriggerDetector(PERIOD)
    counts = np.arange(1, 15_000 // size) * size
    triggers = counts + missed * (counts > 5000)
    late = random.exponential(1e-4, len(counts))
    found, resumed = 0, math.inf
    for count, trigger, delay in zip(counts, triggers, late, strict=True):
        arrival = float(trigger * PERIOD * (1 + 2e-5) + delay)
        if detector.confirms(float(count + found) * PERIOD, UPTIME_S + arrival):
            assert count + found == trigger
            resumed = min(resumed, arrival) if found else resumed
        else:
            found += detector.forget_missed()
    assert found == missed
    assert resumed < 7.0


def test_a_backlog_that_is_read_in_other_portions_does_not_make_blocks_polls() -> None:
    """The host stood still for 0.6 s; the sender looks for whole blocks every 2 ms."""
    size, period, stop, end = 20, 2e-4, 3.0, 3.6
    random, detector = np.random.default_rng(4), MissedTriggerDetector(period, 0.2, wraps=[0])
    looks = np.cumsum(2.1e-3 + random.exponential(3e-4, 2800))
    counts, first = np.unique(np.floor(looks / (size * period)) * size, return_index=True)
    sent = [*zip(looks[first].tolist(), counts.astype(int).tolist(), strict=True)]
    backlog = [(end, 15_700), (end, 16_433), (end, 17_166), (end + 5e-3, 17_993)]
    arrivals = [
        *(x for x in sent if x[0] < stop),
        *backlog,
        *(x for x in sent if x[0] > end + 0.01),
    ]
    confirmed, before = [0.0], 0
    for at, count in arrivals:
        silent = at == backlog[0][0]
        detector.motion.follow(np.arange(before, count)[:, np.newaxis] * 5000, linked=not silent)
        if detector.confirms(count * period, UPTIME_S + at, after_silence=silent):
            confirmed.append(at)
        before = count
    assert np.max(np.diff(confirmed, append=arrivals[-1][0])) < 1.0


def test_a_missed_trigger_is_seen_on_a_grid_of_half_a_period() -> None:
    """A USB frame of 1 ms becomes early enough for the age of a 500 Hz trigger when one is missed.

    Then arrivals are earlier by half a period and later by a period at once.
    """
    frame, period, drift, at = 1e-3, 2e-3, -8e-6, 4.2
    random, detector = np.random.default_rng(3), MissedTriggerDetector(2e-3)
    polls = np.cumsum(0.005 + abs(random.normal(1e-4, 5e-5, 1200)))
    first = -drift * at  # the frame at that time is just as old as the trigger
    counts = np.floor((polls - first) / (period * (1 + drift)))
    arrivals = np.ceil(polls / frame) * frame
    confirmed = np.array([
        detector.confirms(float((count - (poll > at)) * period), UPTIME_S + float(arrival))
        for count, poll, arrival in zip(counts, polls, arrivals, strict=True)
    ])  # fmt: skip
    assert np.any(confirmed & (polls < at))
    assert not np.any(confirmed & (polls > at))
