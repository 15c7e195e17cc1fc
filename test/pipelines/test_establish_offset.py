"""The offset of two counters in a bag, at several rates, and errors if it is undetermined."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from omsm_ros.core.adjustment.resolved_calibration import unit_calibration
from omsm_ros.core.streams.blocks import AxisBlock, Block, DistanceBlock
from omsm_ros.errors import DataError
from omsm_ros.io import bags
from omsm_ros.pipelines import verify_calibration

SAMPLES, SLIP = 3000, 2
SPEED = np.convolve(np.random.default_rng(3).normal(0, 1e-7, 3100), np.hanning(25), "same")
PATH = np.cumsum(SPEED)


def streams(period: float, starts: int = 0) -> tuple[list[Block], list[Block]]:
    """Return blocks of 100; the probe's counter is ``starts`` ahead, with true stamps."""
    axes: list[Block] = []
    distance: list[Block] = []
    still = np.zeros(100)
    for first in range(0, SAMPLES, 100):
        k = 50 + first + np.arange(100)
        stamp = round(first * period * 1e9)
        reported = {"stamp_ns": stamp, "sample_period": period}
        axes.append(
            AxisBlock(first_sample=first, x=still, y=still, z=PATH[k], b=still, c=still, **reported)
        )
        seen = 50e-6 - PATH[k + SLIP]
        distance.append(DistanceBlock(first_sample=first + starts, distance=seen, **reported))
    return axes, distance


def established(
    monkeypatch: pytest.MonkeyPatch, axes: list[Block], distance: list[Block], period: float
) -> int:
    came = {bags.AXES_TOPIC: axes, bags.DISTANCE_TOPIC: distance}
    calibration = replace(unit_calibration(period), covariance=np.zeros((2, 2)))
    return verify_calibration.offset_in(Path("scan.mcap"), came, calibration).samples


@pytest.mark.parametrize("period", [1e-3, 0.1])
@pytest.mark.parametrize("starts", [0, 7000, 12])
def test_a_slip_in_addition_to_the_stamped_one_is_found(
    monkeypatch: pytest.MonkeyPatch, period: float, starts: int
) -> None:
    assert established(monkeypatch, *streams(period, starts), period) == SLIP - starts


def test_readings_that_are_lost_cost_their_own_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    axes, distance = streams(1e-3)
    del distance[19:21]
    assert established(monkeypatch, axes, distance, 1e-3) == SLIP


def test_without_a_stream_or_a_position_it_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    axes, distance = streams(1e-3)
    with pytest.raises(DataError, match="lacks samples of axes or distance"):
        established(monkeypatch, axes, [], 1e-3)
    lost = [replace(block, z=np.full(100, np.nan)) for block in axes]
    with pytest.raises(DataError, match=r"'scan\.mcap' has no position of Z"):
        established(monkeypatch, lost, distance, 1e-3)
