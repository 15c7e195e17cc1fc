"""Full turns of an encoder are added for any motion and blocks, also after invalid counts."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from omsm_ros.instruments.scaling import Turns

WRAP = 2**32
RNG = np.random.default_rng(8)


def in_blocks(turns, counts, cuts):
    return np.concatenate([turns.continued(part) for part in np.split(counts, sorted(cuts))])


@settings(max_examples=60)
@given(
    wrap=st.integers(1000, 2**33),
    start=st.integers(-(2**40), 2**40),
    changes=st.lists(st.floats(-0.015, 0.015), min_size=1, max_size=40),
    cuts=st.lists(st.integers(0, 40), max_size=4),
)
def test_any_motion_is_followed_in_any_blocks(wrap, start, changes, cuts):
    """Its step changes by little from one sample to the next, and is less than half a turn."""
    steps = np.clip(np.cumsum([0.0, *changes]), -0.48, 0.48) * wrap
    truth = start + np.cumsum(steps.astype(np.int64))
    found = in_blocks(Turns(wrap), truth % wrap, [c for c in cuts if c <= len(truth)])
    np.testing.assert_array_equal(found - found[0], truth - truth[0])
    assert found[0] == truth[0] % wrap


def motion(samples=4000):
    """An axis that crosses zero, and so the end of its counter, several times."""
    return (3e7 * np.sin(np.arange(samples) / 150)).astype(np.int64)


@pytest.mark.parametrize("share", [0.002, 0.2, 0.9])
@pytest.mark.parametrize("block", [1, 7, 100])
def test_garbled_counts_lose_no_turn_of_those_after(share, block):
    truth = motion()
    seen = truth % WRAP
    noisy = RNG.random(len(truth)) < share
    noisy[:20] = noisy[3000:] = False
    seen[noisy] = RNG.integers(0, WRAP, np.sum(noisy))
    found = in_blocks(Turns(WRAP), seen, range(block, len(seen), block))
    assert np.array_equal(found[3100:] - found[0], truth[3100:] - truth[0])
    if share < 0.01:
        assert np.mean(found - found[0] == truth - truth[0]) > 0.97
    # Spoilt counts are not repaired; they keep their value plus whole turns.
    assert np.array_equal(found % WRAP, seen)


def test_a_first_count_that_was_garbled_moves_nothing_after_it():
    truth = 3_000_000_000 + motion(400)
    found = Turns(WRAP).continued(np.concatenate([[100_000_000], truth]))
    assert np.array_equal(found[2:], truth[1:])  # which of two is wrong, the third tells


@pytest.mark.parametrize("travel", [0.3, -0.45])
def test_after_a_pause_in_which_the_axis_travelled_it_goes_on_from_where_it_is(travel):
    here = np.full(200, 5_000_000)
    there = here + int(travel * WRAP) + np.arange(200) * 1000
    turns = Turns(WRAP)
    turns.continued(here)
    assert np.array_equal(turns.continued(there % WRAP), there)
    assert np.array_equal(turns.continued((there + 200_000) % WRAP), there + 200_000)


def test_a_spindle_at_a_third_of_a_turn_a_sample_keeps_turning():
    speed = np.minimum(np.arange(300) / 100, 1.0) / 3
    truth = np.cumsum((speed * 3600).astype(np.int64))
    assert np.array_equal(in_blocks(Turns(3600), truth % 3600, [50, 180]), truth)


def test_an_encoder_that_never_wraps_is_taken_as_it_is():
    counts = RNG.integers(-(2**62), 2**62, 50)
    assert np.array_equal(Turns(0).continued(counts), counts)
    assert Turns(WRAP).continued(np.empty(0, np.int64)).shape == (0,)
