"""Invariances of counter offsets."""

from __future__ import annotations

import numpy as np
import pytest
from two_counters import CALIBRATION, blocks, motion, watched

from omsm_ros.core.correction.counter_offset import CounterOffset, LiveOffset, counter_offset
from omsm_ros.core.streams.blocks import AxisBlock, DistanceBlock, FloatArray
from omsm_ros.errors import DataError

# -- the offset of two counters, from whole columns

SAMPLES, OFFSET = 4000, 7
RANDOM = np.random.default_rng(21)
PATH = np.cumsum(np.convolve(RANDOM.normal(0, 1e-7, SAMPLES + 400), np.hanning(25), "same"))
AT = 200 + np.arange(SAMPLES)
Z = PATH[AT]
DISTANCE = 50e-6 - 0.99 * PATH[AT + OFFSET] + RANDOM.normal(0, 10e-9, SAMPLES)
ALL = np.ones(SAMPLES, np.bool_)


def offset(
    z: FloatArray = Z, distance: FloatArray = DISTANCE, most: int = 40, **lag: float
) -> CounterOffset:
    return counter_offset(z, distance, ALL[: len(z)], most=most, **lag)


PLAIN = offset()


def like(found: CounterOffset, samples: int = OFFSET) -> None:
    assert found.samples == samples
    assert found.fraction == pytest.approx(PLAIN.fraction, abs=2e-3)
    assert found.uncertainty == pytest.approx(PLAIN.uncertainty, rel=0.02)


def test_the_offset_and_the_gain_are_those_of_the_truth() -> None:
    like(PLAIN)
    assert PLAIN.gain == pytest.approx(0.99, rel=1e-4)
    assert abs(PLAIN.fraction) < 3e-3


def test_stand_off_home_and_slow_drift_do_not_matter() -> None:
    like(offset(distance=DISTANCE + 3e-3))
    like(offset(z=Z - 0.2))
    like(offset(distance=DISTANCE + 1e-6 * np.linspace(0, 1, SAMPLES)))


def test_a_probe_that_counts_the_other_way_has_a_negative_gain() -> None:
    found = offset(distance=-DISTANCE)
    like(found)
    assert found.gain == pytest.approx(-PLAIN.gain, rel=1e-9)


def test_the_unit_of_both_does_not_matter() -> None:
    found = offset(z=1e3 * Z, distance=1e3 * DISTANCE)
    like(found)
    assert found.gain == pytest.approx(PLAIN.gain, rel=1e-9)


def test_backwards_in_time_the_offset_turns() -> None:
    like(offset(z=Z[::-1].copy(), distance=DISTANCE[::-1].copy()), -OFFSET)


def test_a_range_that_is_searched_wider_finds_the_same() -> None:
    for most in (8, 100, 500):
        like(offset(most=most))


@pytest.mark.parametrize("true", [-2, -1, 0, 1, 2])
def test_a_slow_recording_is_searched_over_few_samples(true: int) -> None:
    """At 10 Hz a quarter of a second is two: what else would fit lies beyond them."""
    distance = 50e-6 - 0.99 * PATH[AT + true]
    for most in (2, 3):
        assert offset(distance=distance, most=most).samples == true


def test_a_lag_that_is_stated_moves_the_fraction_by_itself() -> None:
    found = offset(lag=0.1, lag_uncertainty=0.02)
    assert found.fraction == pytest.approx(PLAIN.fraction + 0.1, abs=1e-9)
    # All but the lag's own share is the fit's; the default states a tenth of a sample.
    fit = PLAIN.uncertainty**2 - 0.1**2
    assert found.uncertainty == pytest.approx(np.sqrt(fit + 0.02**2), rel=1e-6)


def test_a_whole_sample_of_lag_is_one_of_offset() -> None:
    assert offset(lag=2.0).samples == OFFSET + 2


def test_a_lag_that_may_be_half_a_sample_tells_no_whole_number() -> None:
    with pytest.raises(DataError, match="no whole number"):
        offset(lag_uncertainty=0.2)


@pytest.mark.parametrize("used", [199, 159])
def test_too_few_samples_name_how_many_are_needed(used: int) -> None:
    with pytest.raises(DataError, match=rf"{used} samples .* up to 40 .*; record 200 or more"):
        offset(Z[:used], DISTANCE[:used])
    with pytest.raises(DataError, match=r"up to 500 samples; record 2000 or more"):
        offset(Z[:1999], DISTANCE[:1999], most=500)


# -- and from blocks as they come

CAME = blocks(motion("chirp"), 3)


def recut(sizes: list[int]) -> list[AxisBlock | DistanceBlock]:
    """The same streams in blocks of other sizes, of each device its own."""
    made: list[AxisBlock | DistanceBlock] = []
    first = CAME[0][0].first_sample
    z = np.concatenate([axes.z for axes, _ in CAME])
    d = np.concatenate([distance.distance for _, distance in CAME])
    begin, k = 0, 0
    while begin < len(z):
        size = sizes[k % len(sizes)]
        cut, still = slice(begin, begin + size), np.zeros(len(z[begin : begin + size]))
        reported = {"first_sample": first + begin, "sample_period": 1e-3, "stamp_ns": 0}
        made.append(AxisBlock(x=still, y=still, z=z[cut], b=still, c=still, **reported))
        made.append(DistanceBlock(distance=d[cut], **reported))
        begin, k = begin + size, k + 1
    return made


@pytest.mark.parametrize("sizes", [[1000], [37, 411, 5], [333]])
def test_a_motion_in_any_blocks_tells_the_same(sizes: list[int]) -> None:
    watch, reference = LiveOffset(CALIBRATION, 0), watched(CAME).established
    assert reference is not None
    for each in recut(sizes):
        watch.add(each)
        watch.judge()
    assert watch.established is not None
    assert watch.established.samples == reference.samples == 3
    assert watch.established.gain == pytest.approx(reference.gain, rel=1e-3)


def test_one_finding_is_none() -> None:
    """Twice, and with a second of new motion between them."""
    watch = LiveOffset(CALIBRATION, 0)
    half = recut([1000])
    for each in half[:8]:
        watch.add(each)
    for _ in range(5):
        watch.judge()
    assert watch.established is None
    for each in half[8:10]:
        watch.add(each)
    watch.judge()
    assert watch.established is not None


def test_before_any_block_nothing_is_reported() -> None:
    watch = LiveOffset(CALIBRATION, 0)
    watch.judge()
    assert watch.established is None
