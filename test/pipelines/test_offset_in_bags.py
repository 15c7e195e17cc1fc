"""The offset of two counters that were not started together, determined from the motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from omsm_ros.core.calibration.calibration import Calibration
from omsm_ros.core.lti.transfer_function import TransferFunction
from omsm_ros.core.streams.blocks import AxisBlock, DistanceBlock
from omsm_ros.errors import BagError, DataError
from omsm_ros.io import bags
from omsm_ros.io.bag_writer import BagWriter
from omsm_ros.pipelines.verify_calibration import established_offset

PERIOD, COUNT = 1e-3, 4000
PROMPT = Calibration(
    dynamics=TransferFunction([1.0], [1.0]), static_gain=1.0, sample_period=PERIOD,
    valid_up_to=100.0, covariance=np.zeros((2, 2)),
)  # fmt: skip


def motion(time):
    """Return a motion without a period in this record."""
    rng = np.random.default_rng(4)
    return sum(1e-6 * rng.normal() * np.sin(2 * np.pi * f * time + rng.uniform(0, 6))
               for f in rng.uniform(0.3, 30, 40))  # fmt: skip


def write(path, ahead=0, *, late=0.0, stamp_off=0.0, lost=(), start=0, size=100, count=COUNT):
    """Write axes from ``start``; the probe counts ``ahead`` more for the same instant, and lags.

    stamp_off: by which the probe's stamps are late [s];  lost: blocks of the probe that are missing
    """
    with BagWriter(path, (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)) as bag:
        noise = np.random.default_rng(5)
        for k in range(0, count, size):
            time = (start + k + np.arange(size)) * PERIOD
            stamp = round((10 + time[0]) * 1e9)
            still = dict.fromkeys("xybc", np.zeros(size))
            bag.write_block(AxisBlock(stamp_ns=stamp, first_sample=start + k, sample_period=PERIOD,
                                     z=motion(time), **still))  # fmt: skip
            if k // size in lost:
                continue
            distance = 5e-4 - motion(time - late) + noise.normal(0, 2e-9, size)
            bag.write_block(DistanceBlock(
                stamp_ns=stamp + round(stamp_off * 1e9), first_sample=start + k + ahead,
                sample_period=PERIOD, distance=distance, intensity=np.empty(0, np.float32),
                status=np.empty(0, np.uint8),
            ))  # fmt: skip
    return path


@pytest.mark.parametrize(
    ("ahead", "start", "stamp_off"),
    [(0, 0, 0.0), (1, 0, 0.0), (-1, 500, 0.0), (37, 0, 0.1), (-250, 1000, -0.15),
     (10**6, 0, 0.05), (-90_000, 10**5, 0.2)],
)  # fmt: skip
def test_the_offset_is_found_to_the_sample(tmp_path, ahead, start, stamp_off):
    """Any offset is found if stamps are off by less than a quarter second."""
    found = established_offset(
        write(tmp_path / "a.mcap", ahead, start=start, stamp_off=stamp_off), PROMPT
    )
    assert found.samples == -ahead
    assert abs(found.fraction) < 0.02
    assert found.gain == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("size", [50, 400, 2000])
def test_the_size_of_the_blocks_does_not_matter(tmp_path, size):
    found = established_offset(write(tmp_path / "a.mcap", 17, size=size), PROMPT)
    assert found.samples == -17


def test_gaps_and_a_probe_that_begins_later_are_no_hindrance(tmp_path):
    path = write(tmp_path / "a.mcap", -13, lost=(0, 1, 2, 11, 12, 30))
    assert established_offset(path, PROMPT).samples == 13


def test_what_the_calibration_knows_of_the_lag_is_no_offset(tmp_path):
    """A known lag of 0.4 samples leaves no fraction; an unknown one is reported as a fraction."""
    path = write(tmp_path / "a.mcap", 5, late=0.4 * PERIOD)
    known = replace(PROMPT, dynamics=TransferFunction([1.0], [1.0], 0.4 * PERIOD))
    found = established_offset(path, known)
    assert (found.samples, abs(found.fraction) < 0.02) == (-5, True)


def test_a_motion_that_says_nothing_is_refused(tmp_path):
    with BagWriter(tmp_path / "one.mcap", (bags.AXES_TOPIC,)):
        pass
    with pytest.raises(BagError, match="no topic"):
        established_offset(tmp_path / "one.mcap", PROMPT)
    with BagWriter(tmp_path / "empty.mcap", (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)):
        pass
    with pytest.raises(DataError, match=r"empty.mcap' lacks samples of axes or distance; record a"):
        established_offset(tmp_path / "empty.mcap", PROMPT)
    with pytest.raises(DataError, match="samples with a distance do not determine an offset"):
        established_offset(write(tmp_path / "short.mcap", size=50, count=150), PROMPT)


def test_two_recordings_in_one_are_reported(tmp_path):
    path = tmp_path / "two.mcap"
    with BagWriter(path, (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)) as bag:
        for first in (0, 10**9):
            zeros = dict.fromkeys("xyzbc", np.zeros(100))
            bag.write_block(AxisBlock(stamp_ns=first, first_sample=first, sample_period=PERIOD,
                                     **zeros))  # fmt: skip
        bag.write_block(DistanceBlock(
            stamp_ns=0, first_sample=0, sample_period=PERIOD, distance=np.zeros(100),
            intensity=np.empty(0, np.float32), status=np.empty(0, np.uint8),
        ))  # fmt: skip
    with pytest.raises(DataError, match=r"span 1000000100 samples, expected 1 to .*use one"):
        established_offset(path, PROMPT)
