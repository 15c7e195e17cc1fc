"""Pairs of two drivers wait until stamps have shown that they are pairs; one driver's never do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from soaked import soaked

from omsm_ros.core.streams.trigger_slips import CommonTrigger

from .test_slips import ALL, EPOCH, Device, join, without

LONG = np.arange(20_000)


def test_what_one_driver_stamped_waits_for_nothing() -> None:
    blocks = Device(ALL, jitter=1e-3, seed=4).blocks()
    done = join(blocks, blocks)
    assert len(done.axes) == 6000
    assert set(done.held) == {0}
    lost = [block for i, block in enumerate(blocks) if i % 7]
    done = join(lost, blocks)
    assert len(done.axes) == 50 * len(lost)
    assert set(done.held) == {0}


@pytest.mark.parametrize("seed", [0, *soaked(1, 2)])
def test_what_two_drivers_stamped_waits_two_seconds_then_for_the_next_block(seed: int) -> None:
    axes = Device(LONG, jitter=2e-4, drift=50e-6, seed=seed).blocks()
    probe = Device(LONG, 80, jitter=2e-4, seed=seed + 50).blocks()
    done = join(axes, probe)
    assert done.axes == done.distance == list(LONG)
    assert max(done.held) <= 2100
    # 250 blocks of 80 and 400 of 50: from the fifth second on.
    assert max(done.held[170:]) <= 50 + 80


@pytest.mark.parametrize("missed", [10, *soaked(1)])
@pytest.mark.parametrize("seed", [0, *soaked(1, 2)])
def test_no_pair_of_a_slip_comes_out(missed: int, seed: int) -> None:
    """Whichever missed the triggers, and wherever in its block, once the clocks have settled."""
    for at in (12_000, 12_037):
        axes = Device(LONG, jitter=2e-4, seed=seed).blocks()
        probe = Device(without(LONG, at, missed), 80, jitter=2e-4, seed=seed + 50).blocks()
        for done in (join(axes, probe), join(probe, axes)):
            assert len(done.wrong) == 0
            assert at - 130 <= len(done.axes) <= at
            assert len(done.axes) + done.slipped == 20_000 - missed


@pytest.mark.parametrize("last", [3, *soaked(2, 8)])
def test_a_slip_just_before_the_end_is_kept_back_too(last: int) -> None:
    axes = Device(LONG, jitter=2e-5, seed=1).blocks()
    probe = Device(without(LONG, 12_010, 10), jitter=2e-5, seed=2).blocks()
    done = join(axes[: 240 + last], probe[: 240 + last])
    assert len(done.wrong) == 0
    assert len(done.axes) == 12_000


@pytest.mark.parametrize("missed", [0, 10])
def test_a_pause_settles_what_came_before_it_as_the_end_does(missed: int) -> None:
    """Pairs that a live node settles in a pause are settled alike offline, by their stamps."""
    before = LONG[:12_100]
    after = Device(np.arange(20_000, 26_000), first=12_100, jitter=2e-5, seed=3).blocks()
    axes = Device(before, jitter=2e-5, seed=1).blocks()
    probe = Device(without(before, 12_010, missed), jitter=2e-5, seed=2).blocks()
    ended = join(axes, probe)
    resumed = join([*axes, *after], probe)
    assert len(resumed.wrong) == len(ended.wrong) == 0
    assert (
        resumed.axes[: len(ended.axes)] == ended.axes == list(range(12_000 if missed else 12_100))
    )


@pytest.mark.parametrize("offset", [0, 4])
def test_a_short_motion_is_judged_as_a_whole(offset: int) -> None:
    axes = Device(ALL[:900], jitter=2e-5, seed=1).blocks()
    probe = Device(ALL[offset:900], jitter=2e-5, seed=2).blocks()
    done = join(axes, probe)
    assert set(done.slips) == {0}  # while it comes
    assert (len(done.axes), done.slipped) == ((900, 0) if not offset else (0, 896))


def test_stamps_that_tell_nothing_hold_nothing_for_ever() -> None:
    long = Device(LONG, 4000, jitter=1e-4, seed=1).blocks()
    done = join(long, Device(LONG, 4000, jitter=1e-4, seed=2).blocks())
    assert done.axes == list(LONG)
    assert max(done.held) <= 16_000
    lapse = [
        [(replace(b, stamp_ns=EPOCH + (b.stamp_ns - EPOCH) // 20), n) for b, n in blocks]
        for blocks in (Device(LONG, 70).blocks(), Device(LONG, 100).blocks())
    ]
    done = join(*lapse)
    assert done.axes == list(LONG)
    assert max(done.held) <= 2500


def test_an_offset_that_is_stated_is_watched_too() -> None:
    stated = CommonTrigger(counter_offset=300)
    axes = Device(LONG, jitter=1e-4, seed=1).blocks()
    done = join(axes, Device(LONG[300:], jitter=1e-4, seed=2).blocks(), stated)
    assert done.axes == done.distance == list(LONG[300:])
    wrong = join(axes, Device(LONG[301:], jitter=1e-4, seed=2).blocks(), stated)
    assert wrong.axes == []
