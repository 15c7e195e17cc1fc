"""Pairing of the streams of one recording."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.recorded import record_from_arrays
from omsm_ros.core.streams.blocks import AxisBlock, DistanceBlock, Status
from omsm_ros.core.streams.motion_record import MotionRecord, assemble
from omsm_ros.errors import DataError
from omsm_ros.units import NANOSECONDS_PER_S


def axis_block(z, first=0, period=1e-3, stamp_s=None):
    zero = np.zeros(len(z))
    stamp = first * period if stamp_s is None else stamp_s
    return AxisBlock(
        stamp_ns=round(stamp * NANOSECONDS_PER_S),
        first_sample=first,
        sample_period=period,
        x=zero,
        y=zero,
        z=np.asarray(z, float),
        b=zero,
        c=zero,
    )


def distance_block(values, first=0, period=1e-3, stamp_s=None, status=None):
    stamp = first * period if stamp_s is None else stamp_s
    return DistanceBlock(
        stamp_ns=round(stamp * NANOSECONDS_PER_S),
        first_sample=first,
        sample_period=period,
        distance=np.asarray(values, float),
        **({} if status is None else {"status": np.asarray(status, np.uint8)}),
    )


def blocks(samples=100, size=10):
    z = np.arange(samples, dtype=float)
    axes = [axis_block(z[k : k + size], k) for k in range(0, samples, size)]
    probe = [distance_block(-z[k : k + size], k) for k in range(0, samples, size)]
    return axes, probe


def test_blocks_in_any_order_give_the_same_record():
    axes, probe = blocks()
    record = assemble(axes[::-1], [probe[i] for i in np.random.default_rng(1).permutation(10)])
    np.testing.assert_array_equal(record.z, np.arange(100.0))
    np.testing.assert_array_equal(record.distance, -np.arange(100.0))
    assert np.all(record.ok)


def test_a_repeated_block_is_counted_and_used_once():
    axes, probe = blocks()
    record = assemble(axes, [*probe, probe[3]])
    assert len(record) == 100
    assert record.counts["duplicates"] == 10
    assert record.counts["received"] == 110


def test_lost_blocks_leave_samples_that_are_not_ok():
    axes, probe = blocks()
    del axes[5], probe[2]
    record = assemble(axes, probe)
    assert not np.any(record.ok[50:60])
    assert not np.any(record.ok[20:30])
    np.testing.assert_allclose(record.z, np.arange(100.0))
    assert record.counts["missing_axis"] == 10
    assert record.counts["unmatched"] == 10


def test_a_sample_the_probe_rejects_is_not_ok():
    axes, _ = blocks(10)
    status = [Status.OK] * 9 + [Status.NO_TARGET]
    record = assemble(axes, [distance_block(np.zeros(10), status=status)])
    assert record.counts["not_ok"] == 1
    assert not record.ok[9]


def test_every_sample_received_is_accounted_for():
    axes, probe = blocks()
    del axes[5]
    counts = assemble(axes, [*probe, probe[0]]).counts
    reported = counts["paired"] + counts["not_ok"] + counts["unmatched"] + counts["duplicates"]
    assert reported == counts["received"]


def test_streams_without_a_common_count_are_refused():
    axes, _ = blocks(10)
    with pytest.raises(DataError, match="share no trigger count"):
        assemble(axes, [distance_block(np.zeros(5), first=1000)])


def test_an_absent_stream_is_named():
    axes, probe = blocks(10)
    with pytest.raises(DataError, match="0 distance blocks"):
        assemble(axes, [])
    with pytest.raises(DataError, match="0 axis blocks"):
        assemble([], probe)


def test_two_rates_in_one_stream_are_refused():
    axes, probe = blocks(10)
    with pytest.raises(DataError, match="sample periods"):
        assemble([*axes, axis_block(np.zeros(5), 10, period=2e-3)], probe)


def test_a_counter_that_jumps_to_the_sky_is_refused():
    axes, probe = blocks(10)
    with pytest.raises(DataError, match="spans"):
        assemble([*axes, axis_block(np.zeros(5), 10**12)], probe)


@pytest.mark.parametrize(("axis_period", "probe_period"), [(1e-3, 0.25e-3), (0.25e-3, 1e-3)])
def test_streams_of_different_rates_meet_in_time(axis_period, probe_period):
    def motion(t):
        return np.sin(2 * np.pi * 3 * t)

    axis_time = np.arange(round(1 / axis_period)) * axis_period
    probe_time = np.arange(round(1 / probe_period)) * probe_period
    record = assemble(
        [axis_block(motion(axis_time), period=axis_period)],
        [distance_block(-motion(probe_time), period=probe_period)],
    )
    assert record.sample_period == pytest.approx(0.25e-3)
    np.testing.assert_allclose(record.z[record.ok], -record.distance[record.ok], atol=1e-7)


def test_streams_that_count_for_themselves_meet_in_time_where_that_is_asked_for():
    time = np.arange(1000) * 1e-3
    moved = np.sin(2 * np.pi * 3 * time)
    axes = [axis_block(moved)]
    probe = [distance_block(-moved[100:900], first=5000)]
    probe = [replace(block, stamp_ns=axes[0].stamp_ns + 100_000_000) for block in probe]
    with pytest.raises(DataError, match="by_stamps"):
        assemble(axes, probe)
    record = assemble(axes, probe, by_stamps=True)
    assert record.by_stamps
    assert np.sum(record.ok) == 800
    np.testing.assert_allclose(record.z[record.ok], -record.distance[record.ok], atol=1e-9)
    assert not assemble(axes, [distance_block(-moved)]).by_stamps


def motion(time):
    return 1e-3 * np.sin(2 * np.pi * 20 * time)


def cut_axis(rate, duration, size=50, stamp_s=0.0):
    time = np.arange(round(duration * rate)) / rate
    return [
        axis_block(motion(time[k : k + size]), k, 1 / rate, stamp_s + k / rate)
        for k in range(0, len(time), size)
    ]


def test_a_fast_axis_is_followed_between_its_samples():
    # A cubic spline would be off by 2.6 nm here.
    time = np.arange(1000) * 1e-3
    probe = [distance_block(-motion(time[k : k + 100]), k) for k in range(0, 1000, 100)]
    record = assemble(cut_axis(700.0, 1.1, stamp_s=-0.05), probe)
    assert record.sample_period == 1e-3
    readings = np.flatnonzero(record.ok)
    shifted = motion(np.arange(len(record)) * 1e-3 + 0.05)
    assert len(readings) > 900
    # The axis's own time began 50 ms before the probe's.
    assert np.max(abs(record.z[readings] - shifted[readings])) < 0.05e-9


def test_every_reading_is_accounted_for_on_a_finer_grid_too():
    axes = cut_axis(4000.0, 1.0)
    del axes[20:30]
    time = np.arange(1200) * 1e-3
    reading = -motion(time)
    reading[100] = np.nan
    probe = [distance_block(reading[k : k + 100], k) for k in range(0, 1200, 100)]
    record = assemble(axes, [*probe, probe[2]])
    counts = record.counts
    assert counts["received"] == 1300
    assert counts["duplicates"] == 100
    assert counts["paired"] == np.sum(record.ok)
    reported = counts["paired"] + counts["not_ok"] + counts["unmatched"] + counts["duplicates"]
    assert reported == counts["received"]
    # A hole of 125 ms in the axis, 200 ms after its end, and the lost reading.
    assert counts["paired"] == pytest.approx(1200 - 125 - 200 - 1, abs=3)
    assert not np.any(record.ok[4 * 100])


def test_a_reference_of_another_rate_is_carried_to_the_same_instants():
    time = np.arange(1000) * 1e-3
    probe = [distance_block(-motion(time), 0)]
    fast = np.arange(4000) / 4000.0
    reference = [distance_block(2 * motion(fast), period=1 / 4000)]
    record = assemble(cut_axis(2000.0, 1.0), probe, reference)
    seen = record.ok & np.isfinite(record.reference)
    assert np.sum(seen) > 990
    np.testing.assert_allclose(record.reference[seen], 2 * record.z[seen], rtol=0, atol=1e-9)


def test_streams_of_other_times_and_rates_are_refused():
    with pytest.raises(DataError, match="share no time"):
        assemble(cut_axis(2000.0, 1.0), [distance_block(np.zeros(100), stamp_s=60.0)])


@pytest.mark.parametrize("later_s", [30.0, 0.2])
def test_two_recordings_in_one_are_refused(later_s):
    axes, probe = blocks()
    again = [axis_block(b.z, b.first_sample, stamp_s=later_s + b.first_sample * 1e-3) for b in axes]
    with pytest.raises(DataError, match="2 runs of the trigger counter"):
        assemble([*axes, *again], probe)


def test_a_reference_comes_along_on_the_same_counts():
    axes, probe = blocks()
    record = assemble(axes, probe, [distance_block(2 * np.arange(50.0), first=20)])
    assert np.all(np.isnan(record.reference[:20]))
    np.testing.assert_array_equal(record.reference[20:70], 2 * np.arange(50.0))


def test_nan_in_an_array_is_a_lost_sample():
    z = np.arange(10.0)
    z[4] = np.nan
    record = record_from_arrays(1e-3, z, np.zeros(10))
    assert record.z[4] == 4.0
    assert record.counts["missing_axis"] == 1
    assert record.counts["paired"] == 9


def test_channels_of_different_lengths_are_refused():
    with pytest.raises(DataError, match="different lengths"):
        MotionRecord(sample_period=1e-3, z=np.zeros(5), distance=np.zeros(4), ok=np.ones(5, bool))


def test_periods_too_far_apart_are_refused_before_a_grid_is_made():
    """25 000 readings at 1 kHz beside axes at 1 MHz: a grid of 25 million took 1.4 GB."""
    axes = [axis_block(np.arange(25_000.0), period=1e-6)]
    probe = [distance_block(np.zeros(25_000))]
    with pytest.raises(DataError, match=r"axes every 1e-06 s: more than 20000000 .* check both"):
        assemble(axes, probe)
