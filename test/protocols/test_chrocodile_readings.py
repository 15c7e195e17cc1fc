"""Encoder counts that belong to an exposure."""

import numpy as np
import pytest

from omsm_ros.protocols.chrocodile_readings import ENCODER_RANGE, LATCHES, counts_of

STARTS = np.array([[0, 100, -7, 5_000, 2**31 - 10], [50, 90, -7, 5_001, 2**31 + 30]])
TRAVEL = np.array([[8, -8, 0, 3, 40], [20, -6, 0, 1, -60]])


def records(starts, travel):
    """What the device says of its encoders: 32 bits, with a sign."""

    def signed(counts):
        return ((counts + 2**31) % ENCODER_RANGE - 2**31).astype(np.int32)

    first, last = LATCHES["mean"]
    return {
        str(number): signed(counts[:, i])
        for numbers, counts in ((first, starts), (last, starts + travel))
        for i, number in enumerate(numbers)
    }


@pytest.mark.parametrize(("latch", "share"), [("start", 0.0), ("mean", 0.5), ("end", 1.0)])
def test_counts_are_those_of_the_instant_that_was_asked_for(latch, share):
    """Axes that go either way, and one whose counter wraps during the exposure."""
    found = counts_of(records(STARTS, TRAVEL), latch, range(5))
    expected = STARTS + share * TRAVEL
    off = (found - expected + 2**31) % ENCODER_RANGE - 2**31
    assert np.max(abs(off)) <= 0.5


def test_each_axis_has_the_encoder_it_is_on():
    found = counts_of(records(STARTS, TRAVEL), "start", (3, 2, 1, 0, 4))
    np.testing.assert_array_equal(found[:, :4], STARTS[:, [3, 2, 1, 0]])
