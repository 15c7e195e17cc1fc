"""The path that is judged has no gap and one sample period."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from omsm_ros.core.kinematics.scan_path import ScanPathReader
from omsm_ros.core.streams.blocks import AxisBlock, DistanceBlock

TIME = np.arange(1000) * 1e-3
Z = 1e-4 * np.sin(2 * np.pi * 2.0 * TIME)


def axes(first: int, stop: int) -> AxisBlock:
    zeros = np.zeros(stop - first)
    channels = {"x": zeros, "y": zeros, "z": Z[first:stop], "b": zeros, "c": zeros}
    return AxisBlock(stamp_ns=first * 10**6, first_sample=first, sample_period=1e-3, **channels)


def distance(first: int, stop: int) -> DistanceBlock:
    return DistanceBlock(
        stamp_ns=first * 10**6, first_sample=first, sample_period=1e-3, distance=-Z[first:stop]
    )


def path_of(*blocks: AxisBlock | DistanceBlock, most: int = 10_000):
    start = ScanPathReader(most)
    for block in blocks:
        start.add(block)
    return start.path()


def test_blocks_that_continue_each_other_are_one_path() -> None:
    found = path_of(axes(0, 100), distance(0, 100), axes(100, 250), distance(100, 250))
    np.testing.assert_array_equal(found.z, Z[:250])
    np.testing.assert_array_equal(found.distance, -Z[:250])
    assert found.left_out is None


def test_the_longest_run_is_taken_where_there_is_a_gap() -> None:
    """Joined over the gap, z would jump by the motion of the samples that are missing."""
    found = path_of(axes(0, 100), distance(0, 100), axes(220, 900), distance(220, 900))
    np.testing.assert_array_equal(found.z, Z[220:900])
    np.testing.assert_array_equal(found.distance, -Z[220:900])
    assert str(found.left_out) == (
        "only 680 of 780 samples are judged, triggers 220 to 899, the longest run without a gap: "
        "120 are missing (100 to 219)"
    )


def test_the_longest_run_is_taken_where_z_was_lost() -> None:
    """As where the encoder failed, or the probe began before axes that are joined by stamps."""
    z = Z[100:900].copy()
    z[[0, 1, 200]] = np.nan
    found = path_of(
        axes(0, 100), distance(0, 100), replace(axes(100, 900), z=z), distance(100, 900)
    )
    np.testing.assert_array_equal(found.z, Z[301:900])
    np.testing.assert_array_equal(found.distance, -Z[301:900])
    assert str(found.left_out) == (
        "only 599 of 900 samples are judged, triggers 301 to 899, the longest run without a gap: "
        "2 are missing (100 to 101), 1 are missing (300 to 300)"
    )
    assert path_of(replace(axes(0, 100), z=np.full(100, np.nan))) is None


def test_each_kind_of_break_is_named_and_of_many_three() -> None:
    found = path_of(axes(0, 300), replace(axes(300, 350), sample_period=2e-3), axes(0, 100))
    assert (
        "from 300 on the sample period is 0.002 s, after 349 the counter continues from 0"
        in str(found.left_out)
    )
    found = path_of(*(axes(k, k + 50) for k in range(0, 600, 100)))
    assert str(found.left_out).endswith("50 are missing (250 to 299), 2 more gaps")


def test_another_period_is_another_path() -> None:
    last = replace(axes(600, 700), sample_period=2e-3)
    found = path_of(axes(0, 600), last)
    assert found.sample_period == 1e-3
    np.testing.assert_array_equal(found.z, Z[:600])


def test_no_more_is_kept_than_asked_for() -> None:
    found = path_of(axes(0, 100), axes(100, 200), axes(200, 900), most=150)
    np.testing.assert_array_equal(found.z, Z[:150])
    assert str(found.left_out) == (
        "only 150 of 900 samples are judged, triggers 0 to 149; at most the first 150 are used"
    )
    assert path_of(distance(0, 10)) is None
