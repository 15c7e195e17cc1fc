"""Samples of two counters that slipped are counted and give no points, live as offline."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.core.correction.surface_points import SurfacePoints, join_points
from omsm_ros.core.streams.blocks import Account, Block, consecutive, joined, uninterrupted
from omsm_ros.core.streams.motion_record import assemble
from omsm_ros.core.streams.trigger_slips import CommonTrigger
from omsm_ros.errors import DataError
from omsm_ros.nodes.corrector_node import CorrectionState
from omsm_ros.nodes.diagnostics import ERROR
from omsm_ros.twin.cell import Recording

from .corrected_runs import CALIBRATION, balanced, cut, part, same_points, shifted

SLIP_AT, MISSED = 2000, 3


@pytest.fixture(scope="module")
def streams(scan: Recording) -> tuple[list[Block], list[Block]]:
    """The probe missed triggers; stamps scatter by 20 us, so that joining blocks would hide it."""
    random = np.random.default_rng(5)
    axes = cut(part(scan.axes, 0, 5000), range(0, 5000, 50))
    before = cut(part(scan.distance, 0, SLIP_AT), range(0, SLIP_AT, 40))
    after = cut(part(scan.distance, SLIP_AT + MISSED, 5000), range(0, 5000, 40))
    distance = [*before, *(shifted(block, -MISSED, 0.0) for block in after)]
    scattered = [
        [replace(b, stamp_ns=b.stamp_ns + int(random.integers(-20_000, 20_000))) for b in blocks]
        for blocks in (axes, distance)
    ]
    return scattered[0], scattered[1]


def corrected(
    axes: list[Block], distance: list[Block], together: int, options: CorrectionOptions
) -> tuple[SurfacePoints, Account, Corrector]:
    """Correct; ``together`` blocks of each stream wait and are pushed at once; 0 = one by one."""
    corrector, taken = Corrector(CALIBRATION, options), []
    if not together:
        for block in axes:
            corrector.push_axes(block)  # type: ignore[arg-type]
        for block in distance:
            corrector.push_distance(block)  # type: ignore[arg-type]
    for start in range(0, max(len(axes), len(distance)), together or 10**9) if together else ():
        for blocks in consecutive(axes[start : start + together]):  # type: ignore[type-var]
            corrector.push_axes(*blocks)
        for blocks in consecutive(distance[start : start + together]):  # type: ignore[type-var]
            corrector.push_distance(*blocks)
        taken.append(corrector.take())
        assert balanced(corrector.account.axes)
        assert balanced(corrector.account.distance)
    points = join_points([*taken, corrector.finish()])
    return points, corrector.account, corrector


def test_what_slipped_is_counted_and_gives_no_points(
    streams: tuple[list[Block], list[Block]],
) -> None:
    points, account, corrector = corrected(*streams, 0, CorrectionOptions())
    slipped = account.axes.counted["slipped"]
    assert slipped == account.distance.counted["slipped"]
    assert points.sample[-1] < SLIP_AT + 1000
    assert slipped == 5000 - MISSED - 1 - points.sample[-1]
    assert balanced(account.axes)
    assert balanced(account.distance)
    assert corrector.pairing.watch.state.samples == -MISSED


@pytest.mark.parametrize("together", [1, 7, 30, 200])
def test_live_and_offline_agree_to_the_last_bit(
    streams: tuple[list[Block], list[Block]], together: int
) -> None:
    offline, expected, _ = corrected(*streams, 0, CorrectionOptions())
    live, account, _ = corrected(*streams, together, CorrectionOptions())
    assert account == expected
    # Points of blocks that waited together have the stamp of the first block.
    assert same_points(replace(live, stamp_ns=0), replace(offline, stamp_ns=0))


def as_a_bag_gives_them(blocks: list[Block]) -> list[Block]:
    """Blocks that follow on as one, which keeps the stamps of all; as of messages read at once."""
    made: list[Block] = []
    for run in uninterrupted(blocks):
        parts = np.array([(block.first_sample, block.stamp_ns) for block in run])
        made.append(replace(joined(run), parts=parts))  # type: ignore[type-var]
    return made


@pytest.mark.parametrize("drivers", ["two", "one", "one, then two"])
def test_blocks_that_a_bag_joins_are_judged_by_the_stamps_of_all(
    scan: Recording, streams: tuple[list[Block], list[Block]], drivers: str
) -> None:
    axes, distance = streams
    if drivers != "two":
        axes, distance = (
            cut(part(channel, 0, 5000), range(0, 5000, 50))
            for channel in (scan.axes, scan.distance)
        )
    if drivers == "one, then two":  # and the counters are no longer those of one trigger
        distance = [
            replace(block, stamp_ns=block.stamp_ns + (6_000_000 if i >= 60 else 0))
            for i, block in enumerate(distance)
        ]
    each, expected, _ = corrected(axes, distance, 0, CorrectionOptions())
    together = as_a_bag_gives_them(axes), as_a_bag_gives_them(distance)
    assert len(together[0]) < 3
    found, account, corrector = corrected(*together, 0, CorrectionOptions())
    assert account == expected
    assert same_points(replace(found, stamp_ns=0), replace(each, stamp_ns=0))
    assert ("slipped" in account.distance.counted) is (drivers != "one")
    assert corrector.pairing.watch.same_stamps is (drivers == "one")


def test_diagnostics_say_what_slipped_and_what_to_do(
    streams: tuple[list[Block], list[Block]],
) -> None:
    _, _, corrector = corrected(*streams, 0, CorrectionOptions())
    report = CorrectionState().report(corrector, 0.0, 0.0)
    assert report.level == ERROR
    assert f"slipped by -{MISSED} samples" in report.text
    assert "restart both drivers" in report.text
    assert report.values["slip_samples"] == -MISSED
    assert report.values["axes_slipped"] == report.values["distance_slipped"]


@pytest.mark.parametrize("begins", [0, 2000])
def test_a_counter_that_begins_anew_alone_is_reported_with_the_remedy(
    scan: Recording, begins: int
) -> None:
    """begins: trigger from which the probe has counted before, none or by a power cycle."""
    axes = cut(part(scan.axes, 0, 9000), range(0, 9000, 50))
    probe = cut(part(scan.distance, 0, 9000), range(0, 9000, 50))
    restarted = [shifted(block, -2000, 0.0) for block in probe[40:180]]
    _, _, corrector = corrected(axes, [*probe[: begins // 50], *restarted], 4, CorrectionOptions())
    report = CorrectionState().report(corrector, 0.0, 0.0)
    assert report.level == ERROR
    assert "slipped by -2000 samples" in report.text
    assert "'counter_offset' 2000" in report.text
    stated = CorrectionOptions(trigger=CommonTrigger(counter_offset=2000))
    _, account, corrector = corrected(axes, restarted, 4, stated)
    assert corrector.pairing.watch.state.samples == 0
    assert account.axes.corrected > 6900


def test_a_stated_offset_gives_the_same_surface(scan: Recording) -> None:
    axes, distance = part(scan.axes, 0, 3000), part(scan.distance, 0, 3000)
    plain, _, _ = corrected([axes], [distance], 0, CorrectionOptions())
    for offset in (1, 20, 500):
        stated = CorrectionOptions(trigger=CommonTrigger(counter_offset=offset))
        late = shifted(part(distance, offset, 3000), -offset, 0.0)
        points, account, _ = corrected([axes], [late], 0, stated)
        assert account.axes.counted.get("slipped", 0) == 0
        kept = plain.sample >= offset
        same = np.isin(points.sample, plain.sample[kept])
        assert np.all(same)
        assert np.array_equal(points.height, plain.height[kept])


def test_motion_whose_counters_slipped_is_refused(
    streams: tuple[list[Block], list[Block]], scan: Recording
) -> None:
    axes, distance = streams
    with pytest.raises(DataError, match=rf"distance: .* slipped by -{MISSED} samples"):
        assemble(axes, distance)  # type: ignore[arg-type]
    whole = cut(part(scan.distance, 0, 5000), range(0, 5000, 40))
    assert len(assemble(axes, whole)) == 5000  # type: ignore[arg-type]
    with pytest.raises(DataError, match=r"reference: .* slipped"):
        assemble(axes, whole, distance)  # type: ignore[arg-type]
    late = [shifted(block, -7, 0.0) for block in whole if block.first_sample >= 7]
    with pytest.raises(DataError, match="slipped by -7 samples"):
        assemble(axes, late)  # type: ignore[arg-type]
    stated = CommonTrigger(counter_offset=7)
    record = assemble(axes, late, trigger=stated)  # type: ignore[arg-type]
    expected = assemble(axes, whole[1:])  # type: ignore[arg-type]
    assert np.array_equal(record.distance, expected.distance, equal_nan=True)
