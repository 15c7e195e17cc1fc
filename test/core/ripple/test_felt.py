"""Lines measured by an accelerometer, from the blocks of a recording."""

import numpy as np
import pytest

from omsm_ros.core.ripple.accelerometer import acceleration_lines, accelerations_of
from omsm_ros.core.streams.blocks import AccelerationBlock
from omsm_ros.errors import DataError

PERIOD = 1e-3


def blocks(samples, first=0, period=PERIOD):
    time = np.arange(first, first + samples) * period
    noise = np.random.default_rng(1).normal(0.0, 1e-3, samples)
    z = 0.02 * np.sin(2 * np.pi * 120.0 * time) + noise
    still = np.zeros(samples)
    return [
        AccelerationBlock(
            stamp_ns=int((first + low) * period * 1e9), first_sample=first + low,
            sample_period=period, x=still[low:low + 100], y=still[low:low + 100],
            z=z[low:low + 100],
        )
        for low in range(0, samples, 100)
    ]  # fmt: skip


def test_the_longest_run_without_a_gap_is_taken():
    period, axes = accelerations_of([*blocks(300), *blocks(2000, first=1000)])
    assert period == PERIOD
    assert {name: len(values) for name, values in axes.items()} == dict.fromkeys("xyz", 2000)
    (line,) = acceleration_lines(period, axes).lines
    assert line.frequency == pytest.approx(120.0, abs=0.5)
    assert line.acceleration == pytest.approx(0.02, rel=0.05)


def test_a_quarter_of_a_second_tells_nothing():
    with pytest.raises(DataError, match="acceleration of 200 successive samples"):
        accelerations_of([*blocks(200), *blocks(100, first=500)])


def test_two_rates_are_refused():
    with pytest.raises(DataError, match="expected one"):
        accelerations_of([*blocks(500), *blocks(500, first=500, period=2e-3)])
