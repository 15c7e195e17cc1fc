"""Blocks that no device sends."""

from __future__ import annotations

import numpy as np
import pytest

from omsm_ros.core.streams.blocks import AxisBlock, DistanceBlock, Status
from omsm_ros.errors import DataError

FIVE = np.zeros(5)


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"sample_period": 1e-300}, "sample_period is 1e-300 s"),
        ({"sample_period": 1e300}, "sample_period"),
        ({"sample_period": np.nan}, "sample_period"),
        ({"sample_period": 0.0}, "sample_period"),
        ({"first_sample": 2**64 - 1}, "first_sample is 18446744073709551615"),
        ({"first_sample": -1}, "first_sample is -1"),
        ({"stamp_ns": 2**63}, "stamp"),
        ({"x": np.zeros(4)}, "different lengths"),
    ],
)
def test_a_block_that_no_device_sends_is_refused_by_name(
    wrong: dict[str, object], named: str
) -> None:
    good = dict.fromkeys("xyzbc", FIVE) | {"stamp_ns": 0, "first_sample": 0, "sample_period": 1e-3}
    AxisBlock(**good)  # type: ignore[arg-type]
    with pytest.raises(DataError, match=named):
        AxisBlock(**good | wrong)  # type: ignore[arg-type]


def test_a_block_of_no_samples_is_refused() -> None:
    with pytest.raises(DataError, match="0 samples"):
        DistanceBlock(stamp_ns=0, first_sample=0, sample_period=1e-3, distance=np.empty(0))


def test_a_reading_that_cannot_be_is_lost_and_costs_no_other() -> None:
    block = DistanceBlock(
        stamp_ns=0, first_sample=0, sample_period=1e-3, distance=np.array([1e-5, 1e300, -np.inf])
    )
    assert block.distance[0] == 1e-5
    assert np.isnan(block.distance[1:]).all()
    assert block.ok.tolist() == [True, False, False]


@pytest.mark.parametrize("status", [s for s in Status if s is not Status.OK] + [77])
def test_a_reading_that_is_not_ok_is_none_whatever_was_sent(status: int) -> None:
    sent = np.array([1e-6, 2e-6, 3e-6])
    block = DistanceBlock(
        stamp_ns=0,
        first_sample=0,
        sample_period=1e-3,
        distance=sent,
        status=np.array([Status.OK, status, Status.OK], np.uint8),
    )
    np.testing.assert_array_equal(block.distance, [1e-6, np.nan, 3e-6])
    np.testing.assert_array_equal(block.ok, [True, False, True])
    assert sent[1] == 2e-6  # not the sender's own array
