"""Trigger counts that never came are counted, however the stream was cut."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from omsm_ros.core.streams.blocks import DistanceBlock
from omsm_ros.core.streams.pairing import StreamInput

PERIOD = 1e-3


def block(first: int, length: int, stamp: float | None = None) -> DistanceBlock:
    seconds = first * PERIOD if stamp is None else stamp
    return DistanceBlock(
        stamp_ns=round(seconds * 1e9),
        first_sample=first,
        sample_period=PERIOD,
        distance=np.zeros(length),
    )


@pytest.mark.parametrize("seed", range(5))
def test_missing_is_what_was_left_out(seed: int) -> None:
    """Against a set of the numbers that came."""
    random = np.random.default_rng(seed)
    cuts = np.unique(random.integers(0, 20_000, 200))
    pieces = [(int(a), int(b)) for a, b in itertools.pairwise(cuts)]
    kept = [piece for piece in pieces if random.random() < 0.7]
    intake = StreamInput()
    for a, b in kept:
        intake.new(block(a, b - a))
    came = {k for a, b in kept for k in range(a, b)}
    assert intake.tally.missing == max(came) + 1 - min(came) - len(came)
    assert intake.tally.received == len(came)


def test_what_comes_late_is_missing_no_longer() -> None:
    intake = StreamInput()
    for first in (0, 200, 100):
        intake.new(block(first, 100))
    assert intake.tally.missing == 0
    assert intake.tally.snapshot(0).counted["late"] == 100


def test_a_device_that_counts_anew_has_left_nothing_out() -> None:
    intake = StreamInput()
    intake.new(block(5000, 100))
    intake.new(block(0, 100, stamp=20.0))
    intake.new(block(150, 100, stamp=20.15))
    assert intake.tally.missing == 50
    assert intake.tally.snapshot(0).missing == 50
