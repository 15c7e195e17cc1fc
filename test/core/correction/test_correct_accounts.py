"""Every sample of both streams is corrected, or counted under its reason."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.core.correction.surface_points import join_points
from omsm_ros.core.streams.blocks import Account, Status
from omsm_ros.errors import DataError
from omsm_ros.twin.cell import Recording

from .corrected_runs import CALIBRATION, balanced, cut, part, run, same_points, shifted

# Every sample is accounted for.


def test_settling_is_counted_in_both_streams(scan: Recording) -> None:
    points, account = run([scan.axes], [scan.distance])
    settling = account.axes.counted["settling"]
    assert 12 <= settling < 40
    assert account.distance.counted == {"settling": settling}
    assert len(points) == account.axes.corrected == len(scan.axes) - settling
    assert points.sample[0] == settling


def test_a_probe_dropout_costs_its_points_and_nothing_else(scan: Recording) -> None:
    status = scan.distance.status.copy()
    status[1000:1050] = Status.NO_TARGET
    distance = scan.distance.distance.copy()
    distance[2000:2003] = np.nan, np.inf, 1e300
    whole, _ = run([scan.axes], [scan.distance])
    points, account = run([scan.axes], [replace(scan.distance, status=status, distance=distance)])
    lost = np.r_[1000:1050, 2000:2003]
    kept = ~np.isin(whole.sample, lost)
    assert np.array_equal(points.height, whole.height[kept])
    assert account.axes.counted["invalid"] == account.distance.counted["invalid"] == 53


@pytest.mark.parametrize("channel", ["x", "y", "z", "b", "c"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -1e300])
def test_an_impossible_axis_never_poisons_the_filter(
    scan: Recording, channel: str, bad: float
) -> None:
    values = getattr(scan.axes, channel).copy()
    values[3000:3005] = bad
    points, account = run([replace(scan.axes, **{channel: values})], [scan.distance])
    assert account.axes.counted["invalid"] == account.distance.counted["invalid"] == 5
    assert account.axes.counted["settling"] == 2 * points.sample[0]
    error = points.height - scan.surface_height[points.sample]
    assert np.all(np.isfinite(points.height))
    assert np.max(abs(error)) < 100e-9


def test_a_gap_restarts_the_filter_in_the_motion_it_finds(quiet_scan: Recording) -> None:
    axes = [part(quiet_scan.axes, 0, 2000), part(quiet_scan.axes, 2500, 6000)]
    points, account = run(axes, [part(quiet_scan.distance, 0, 6000)])
    error = points.height - quiet_scan.surface_height[points.sample]
    assert np.max(abs(error)) < 0.02e-9
    settling = points.sample[0]
    assert account.axes.counted == {"settling": 2 * settling}
    assert account.distance.counted == {"settling": 2 * settling, "unmatched": 500}


def test_a_run_too_short_to_start_on_is_settling(scan: Recording) -> None:
    axes = [part(scan.axes, 0, 5), part(scan.axes, 10, 14)]
    points, account = run(axes, [part(scan.distance, 0, 14)])
    assert len(points) == 0
    assert account.axes.counted == {"settling": 9}
    assert account.distance.counted == {"settling": 9, "unmatched": 5}


def test_repeated_and_overlapping_blocks_are_counted_once(scan: Recording) -> None:
    expected, account = run([part(scan.axes, 0, 1000)], [part(scan.distance, 0, 1000)])
    axes = [part(scan.axes, a, b) for a, b in [(0, 400), (0, 400), (300, 700), (700, 1000)]]
    points, doubled = run(axes, [part(scan.distance, 0, 1000)])
    assert same_points(points, expected)
    assert doubled.axes.counted == {**account.axes.counted, "duplicate": 500}


def test_a_late_block_is_counted_and_not_used(scan: Recording) -> None:
    axes = [part(scan.axes, a, b) for a, b in [(0, 1000), (1500, 2000), (1000, 1500)]]
    points, account = run(axes, [part(scan.distance, 0, 2000)])
    assert account.axes.counted["late"] == 500
    assert account.distance.counted["unmatched"] == 500
    assert not np.any((points.sample >= 1000) & (points.sample < 1500))


@pytest.mark.parametrize("seconds", [60.0, -60.0], ids=["device restarted", "bag in a loop"])
def test_a_count_that_begins_anew_is_a_new_scan(scan: Recording, seconds: float) -> None:
    axes, distance = part(scan.axes, 0, 3000), part(scan.distance, 0, 3000)
    once, account = run([axes], [distance])
    points, twice = run(
        [axes, shifted(axes, 0, seconds)], [distance, shifted(distance, 0, seconds)]
    )
    assert same_points(points, join_points([once, once]))
    assert twice.axes.corrected == 2 * account.axes.corrected
    assert twice.axes.counted == {"settling": 2 * account.axes.counted["settling"]}


def test_counts_beyond_32_bits_are_no_interruption(scan: Recording) -> None:
    axes, distance = part(scan.axes, 0, 2000), part(scan.distance, 0, 2000)
    plain, _ = run([axes], [distance])
    start = 2**32 - 700
    points, account = run(
        [replace(b, first_sample=b.first_sample + start) for b in cut(axes, range(100, 2000, 100))],
        [replace(b, first_sample=b.first_sample + start) for b in cut(distance, [70, 1400])],
    )
    assert np.array_equal(points.height, plain.height)
    assert np.array_equal(points.sample, plain.sample + start)
    assert set(account.axes.counted) == {"settling"}


def test_time_lapse_changes_nothing(scan: Recording) -> None:
    sizes = range(100, 4000, 100)
    axes, distance = cut(part(scan.axes, 0, 4000), sizes), cut(part(scan.distance, 0, 4000), sizes)
    expected = run(axes, distance)
    fast = [[replace(b, stamp_ns=b.stamp_ns // 20) for b in blocks] for blocks in (axes, distance)]
    points, account = run(*fast)
    assert same_points(points, expected[0])
    assert account == expected[1]


def test_what_waits_in_vain_is_bounded(scan: Recording) -> None:
    corrector = Corrector(CALIBRATION, CorrectionOptions(max_pending=1.0))
    for block in cut(part(scan.axes, 0, 4000), range(100, 4000, 100)):
        corrector.push_axes(block)  # type: ignore[arg-type]
        assert corrector.account.axes.pending <= 1000
        assert balanced(corrector.account.axes)
    overdue = 3000 - corrector.account.axes.counted["settling"]
    assert corrector.account.axes.counted["overdue"] == overdue
    corrector.push_distance(part(scan.distance, 0, 4000))  # type: ignore[arg-type]
    assert corrector.account.distance.counted["overdue"] == 3000
    assert corrector.account.distance.corrected == 1000


def test_stamps_that_disagree_about_a_trigger_are_reported(scan: Recording) -> None:
    corrector = Corrector(CALIBRATION)
    assert corrector.pairing.stamp_skew is None
    corrector.push_axes(scan.axes)
    corrector.push_distance(shifted(scan.distance, 0, 0.04))  # type: ignore[arg-type]
    assert corrector.pairing.stamp_skew == pytest.approx(-0.04)


def test_a_refused_block_leaves_the_account_as_it_was(scan: Recording) -> None:
    corrector = Corrector(CALIBRATION)
    with pytest.raises(DataError, match="first_sample"):
        corrector.push_axes(replace(scan.axes, first_sample=2**63))
    assert corrector.account == Account()


@settings(max_examples=25)
@given(data=st.data())
def test_whatever_the_network_does_every_sample_is_counted_and_no_point_is_wrong(
    scan: Recording, data: st.DataObject
) -> None:
    """Blocks lost, repeated, swapped and overlapping, with holes in them, in both streams."""
    corrector, taken = Corrector(CALIBRATION), []
    starts = st.lists(st.integers(0, 3900), min_size=1, max_size=25)
    for axes_start, probe_start in zip(data.draw(starts), data.draw(starts), strict=False):
        length, hole = data.draw(st.integers(1, 400)), data.draw(st.integers(0, 399))
        axes = part(scan.axes, axes_start, axes_start + length)
        distance = part(scan.distance, probe_start, probe_start + length)
        if hole < length and hole % 3 == 0:
            axes.z[hole], distance.distance[hole] = np.nan, np.inf  # type: ignore[attr-defined]
        corrector.push_axes(axes)  # type: ignore[arg-type]
        corrector.push_distance(distance)  # type: ignore[arg-type]
        taken.append(corrector.take())
        assert balanced(corrector.account.axes)
        assert balanced(corrector.account.distance)
    points = join_points([*taken, corrector.finish()])
    account = corrector.account
    assert account.axes.pending == account.distance.pending == 0
    assert account.axes.corrected == account.distance.corrected == len(points)
    assert balanced(account.axes)
    assert np.all(abs(points.height - scan.surface_height[points.sample]) < 100e-9)


def test_after_finish_a_new_scan_may_begin(scan: Recording) -> None:
    axes, distance = part(scan.axes, 0, 1000), part(scan.distance, 0, 1000)
    corrector, found = Corrector(CALIBRATION), []
    for _ in range(2):
        corrector.push_axes(axes)  # type: ignore[arg-type]
        corrector.push_distance(distance)  # type: ignore[arg-type]
        found.append(corrector.finish())
    assert same_points(join_points(found[:1]), join_points(found[1:]))


def test_nothing_to_take_is_none() -> None:
    corrector = Corrector(CALIBRATION)
    assert corrector.take() is None
    assert corrector.finish() is None
    assert corrector.account == Account()
