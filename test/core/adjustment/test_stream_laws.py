"""Invariances of counter offsets, of the agreement of scans, and of the reader of scans."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from two_counters import CALIBRATION, blocks, motion, watched

from omsm_ros.core.adjustment.scan_reader import ScanReader, read_scan
from omsm_ros.core.adjustment.self_calibration import ScanConsistency, ScanConsistencySums
from omsm_ros.core.correction.counter_offset import CounterOffset, LiveOffset, counter_offset
from omsm_ros.core.correction.surface_points import SurfacePoints, join_points
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


# -- agreement of scans

TURNS = 24
ANGLE = np.linspace(0.0, 2 * np.pi * TURNS, 24_000, endpoint=False)
RADIUS = np.linspace(1e-3, 10e-3, len(ANGLE))
LEFT = [RANDOM.normal(0, 2e-9, len(ANGLE)) + s * 20e-9 * np.cos(3 * ANGLE) for s in (1, -1)]


def agreement(
    left: list[FloatArray], turn: float = 0.0, every: int = len(ANGLE)
) -> ScanConsistency:
    sums = ScanConsistencySums(len(left), 1e-3, 10e-3)
    for scan, residual in enumerate(left):
        for begin in range(0, len(ANGLE), every):
            part = slice(begin, begin + every)
            sums.add(scan, RADIUS[part], ANGLE[part] + turn, residual[part])
    return sums.result()


def alike(
    found: ScanConsistency, expected: ScanConsistency, unit: float = 1.0, rel: float = 1e-9
) -> None:
    assert found.ratio == pytest.approx(expected.ratio, rel=rel)
    assert found.disagreement == pytest.approx(unit * expected.disagreement, rel=rel)
    assert found.noise == pytest.approx(unit * expected.noise, rel=rel)


def test_agreement_knows_no_unit_order_sign_or_beginning_of_the_angle() -> None:
    plain = agreement(LEFT)
    alike(agreement([1e9 * one for one in LEFT]), plain, unit=1e9)
    alike(agreement(LEFT[::-1]), plain)
    alike(agreement([-one for one in LEFT]), plain)
    alike(agreement(LEFT, turn=0.4), plain)


def test_portions_cost_the_agreement_one_difference_each() -> None:
    alike(agreement(LEFT, every=1000), agreement(LEFT), rel=1e-3)
    # Both cover whole turns of the wave of three, so the result is the same.
    assert agreement(LEFT, every=1000).disagreement == pytest.approx(
        agreement(LEFT).disagreement, rel=1e-4
    )


def test_a_ring_or_a_scan_that_nobody_saw_says_nothing() -> None:
    sums = ScanConsistencySums(3, 1e-3, 20e-3)  # the outer rings, and the third scan, are empty
    for scan, residual in enumerate(LEFT):
        sums.add(scan, RADIUS, ANGLE, residual)
    found = sums.result()
    assert found.disagreement == pytest.approx(20e-9 / np.sqrt(2), rel=0.02)
    assert found.noise == agreement(LEFT).noise


def test_scans_without_noise_agree() -> None:
    found = agreement([np.zeros(len(ANGLE))] * 2)
    assert (found.ratio, found.disagreement, found.noise) == (0.0, 0.0, 0.0)
    assert found.holds


@pytest.mark.parametrize(
    ("ratio", "disagreement", "holds"),
    [(1.0, 1e-6, True), (50.0, 0.1e-9, True), (50.0, 1e-6, False)],
)
def test_only_what_is_beyond_noise_and_visible_is_a_contradiction(
    ratio: float, disagreement: float, holds: bool
) -> None:
    assert ScanConsistency(ratio, disagreement, 1e-9).holds is holds


# -- a scan as it is read

PERIOD = 1e-3
COUNT = 3000


def axes(z: FloatArray, radius: float = 5e-3) -> AxisBlock:
    """A circle of one turn a second at ``radius`` [m], with any motion of Z."""
    zero, time = np.zeros(len(z)), PERIOD * np.arange(len(z))
    return AxisBlock(
        stamp_ns=0, first_sample=400, sample_period=PERIOD,
        x=np.full(len(z), radius), y=zero, z=z, b=zero, c=2 * np.pi * time,
    )  # fmt: skip


def points(block: AxisBlock, height: FloatArray, error: FloatArray) -> SurfacePoints:
    zero = np.zeros(len(block))
    parts = dict.fromkeys(SurfacePoints.__dataclass_fields__, zero)
    sample = block.first_sample + np.arange(len(block))
    made = {"sample": sample, "height": height, "dynamic_error": error}
    return SurfacePoints(**(parts | made))  # type: ignore[arg-type]


TIME = PERIOD * np.arange(COUNT)
Z4 = 1e-6 * (3.0 + 2.0 * TIME - 4.0 * TIME**2 + 0.7 * TIME**3 - 0.2 * TIME**4)


def test_a_motion_of_the_fourth_degree_has_exact_derivatives() -> None:
    block, height = axes(Z4), 1e-6 * np.cos(TIME)
    found = read_scan(block, points(block, height, np.full(COUNT, 2e-9)))
    t = found.time
    assert t[0] == pytest.approx(12e-3)
    assert len(found) == COUNT - 24
    rate = 1e-6 * (2.0 - 8.0 * t + 2.1 * t**2 - 0.8 * t**3)
    np.testing.assert_allclose(found.motion_rate, rate, atol=1e-14)
    bend = 1e-6 * (-8.0 + 4.2 * t - 2.4 * t**2)
    np.testing.assert_allclose(found.motion_acceleration, bend, atol=1e-11)
    np.testing.assert_allclose(found.height, 1e-6 * np.cos(t), atol=1e-15)
    np.testing.assert_allclose(found.motion, np.interp(t, TIME, Z4) - 2e-9, atol=1e-15)
    np.testing.assert_allclose(found.radius, 5e-3, rtol=1e-12)
    np.testing.assert_allclose(np.abs(found.angular_rate), 2 * np.pi, rtol=1e-9)
    np.testing.assert_allclose(found.radial_rate, 0.0, atol=1e-12)


@settings(max_examples=10)
@given(cuts=st.lists(st.integers(1, COUNT - 1), max_size=6, unique=True))
def test_a_scan_read_in_any_blocks_is_the_same_scan(cuts: list[int]) -> None:
    block = axes(Z4)
    every = points(block, 1e-6 * np.cos(TIME), np.zeros(COUNT))
    reader, edges = ScanReader(PERIOD), [0, *sorted(cuts), COUNT]
    for begin, end in pairwise(edges):
        part = {n: getattr(block, n)[begin:end] for n in "xyzbc"}
        reader.add_axes(replace(block, first_sample=400 + begin, **part))
        reader.add(every.part(slice(begin, end)))
    whole, cut = read_scan(block, every), reader.columns()
    for name in whole.__dataclass_fields__:
        assert np.array_equal(getattr(cut, name), getattr(whole, name)), name
    assert (reader.points, reader.used) == (COUNT, COUNT - 24)


def test_a_scan_that_is_too_short_says_how_many_it_needs() -> None:
    block = axes(Z4[:1023])
    short = points(block, np.zeros(1023), np.zeros(1023))
    with pytest.raises(DataError, match=r"scan of 1023 points, 999 of them .* expected 1000"):
        read_scan(block, join_points([short]))
