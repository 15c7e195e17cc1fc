"""A late or damaged block does not cost the motion that the calibrator keeps."""

from __future__ import annotations

import numpy as np
import pytest

from omsm_ros.core.streams.blocks import DistanceBlock
from omsm_ros.core.streams.motion_record import BlockBuffer


def block(first: int, stamp_s: float) -> DistanceBlock:
    return DistanceBlock(
        stamp_ns=round(stamp_s * 1e9), first_sample=first, sample_period=1e-3,
        distance=np.full(100, float(first)),
    )  # fmt: skip


def kept(*blocks: DistanceBlock) -> list[int]:
    buffer: BlockBuffer[DistanceBlock] = BlockBuffer(100_000)
    for each in blocks:
        buffer.add(each)
    return [b.first_sample for b in buffer.recent()]


MOTION = [block(100 * i, 100 + 0.1 * i) for i in range(60)]


@pytest.mark.parametrize("odd", [block(200, 100.2), block(200, 107.0), block(1_000_000, 105.0)])
def test_one_odd_block_costs_nothing_else(odd: DistanceBlock) -> None:
    firsts = [b.first_sample for b in MOTION]
    assert kept(*MOTION[:50], odd, *MOTION[50:]) == firsts


def test_a_restarted_counter_begins_a_new_motion() -> None:
    after = [block(100 * i, 200 + 0.1 * i) for i in range(3)]
    assert kept(*MOTION, *after) == [0, 100, 200]
