"""A written sample period against the stamps, with jitter and gaps."""

from dataclasses import replace

import numpy as np
import pytest

from omsm_ros.core.streams.blocks import AxisBlock
from omsm_ros.core.streams.stamps import StampClock, check_period
from omsm_ros.errors import DataError


def blocks(written, true, jitter=0.0, count=100, size=100, missing=()):
    random, zeros = np.random.default_rng(1), np.zeros(size)
    return [
        AxisBlock(
            stamp_ns=10**18 + round(1e9 * (k * size * true + random.normal(0, jitter))),
            first_sample=k * size,
            sample_period=written,
            x=zeros,
            y=zeros,
            z=zeros,
            b=zeros,
            c=zeros,
        )
        for k in range(count)
        if k not in missing
    ]


def test_the_period_is_the_slope_of_the_stamps():
    stamps = np.concatenate([b.stamps for b in blocks(1e-3, 1.2e-3, jitter=1e-3)])
    line = StampClock.through(stamps, 1e6)
    uncertainty = 1e-9 * line.period_uncertainty_ns
    assert 1e-9 * line.period_ns == pytest.approx(1.2e-3, abs=4 * uncertainty)
    assert uncertainty == pytest.approx(1e-3 * np.sqrt(12 / 100) / 10_000, rel=0.4)


@pytest.mark.parametrize("written", [2e-3, 0.5e-3, 1.01e-3])
def test_a_wrong_period_is_refused_with_both_values(written):
    with pytest.raises(DataError, match=r"state a sample period of .* by their stamps it is 0.001"):
        check_period("axis", blocks(written, 1e-3))


@pytest.mark.parametrize("jitter", [0.0, 5e-3])
def test_a_right_period_passes_with_jitter_gaps_and_a_clock_that_is_off(jitter):
    check_period("axis", blocks(1e-3, 1.0001e-3, jitter=jitter, missing=range(20, 60)))


def test_a_few_blocks_or_no_stamps_tell_nothing():
    check_period("axis", blocks(2e-3, 1e-3, count=4))
    check_period("axis", blocks(1e-3, 0.0))


def test_a_time_lapse_may_be_declared():
    played = blocks(1e-3, 1e-3 / 20)
    check_period("axis", played, 20.0)
    with pytest.raises(DataError, match="time_lapse"):
        check_period("axis", played)


@pytest.mark.parametrize("jump", [3.7, -2.0])
def test_a_clock_that_was_set_is_not_taken_for_a_wrong_period(jump):
    recorded = blocks(1e-3, 1e-3, jitter=1e-4)
    late = [replace(b, stamp_ns=b.stamp_ns + round(jump * 1e9)) for b in recorded[40:]]
    with pytest.raises(
        DataError, match=r"the stamps jump by .* at sample 4000 .* the clock was set"
    ):
        check_period("axis", recorded[:40] + late)
