"""A scan recorded by two drivers gives the same points for any block lengths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from soaked import soaked

from omsm_ros.core.correction.correct import CorrectionOptions
from omsm_ros.core.correction.surface_points import join_points
from omsm_ros.core.streams.blocks import AxisBlock, joined
from omsm_ros.core.streams.trigger_slips import CommonTrigger
from omsm_ros.io import bags, message_mapping
from omsm_ros.io.bag_writer import BagWriter
from omsm_ros.pipelines.correct import CorrectedScan
from omsm_ros.pipelines.recording import Recording

TOPICS = (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)
OFFSET = 4711
EPOCH = 1_700_000_000 * 10**9
LOST = {"axes": [(12_000, 12_100), (30_000, 30_700)], "distance": [(20_032, 20_096)]}


def pieces(block, length, gaps):
    """Yield ``block`` in blocks of ``length`` samples, without those of the gaps."""
    edges = [0, *(edge for gap in gaps for edge in gap), len(block)]
    names = "xyzbc" if isinstance(block, AxisBlock) else ("distance", "intensity", "status")
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        for a in range(start, stop, length):
            b = min(a + length, stop)
            yield replace(
                block,
                first_sample=block.first_sample + a,
                stamp_ns=block.stamp_ns + a * 1_000_000,
                **{name: getattr(block, name)[a:b] for name in names},
            )


def record(path, blocks, lengths, seed, lost):
    """Write the streams of two drivers with different counters and uneven stamps and delivery."""
    random, messages = np.random.default_rng(seed), message_mapping.bag_messages()
    sent = []
    for (topic, gaps), stream, length in zip(
        lost.items(), zip(*blocks, strict=True), lengths, strict=True
    ):
        of_axes = topic == "axes"
        for block in pieces(joined(stream), length, gaps):
            first = block.first_sample + (OFFSET if of_axes else 0)
            stamp = EPOCH + block.stamp_ns + round(random.normal(0, 2e4))
            block = replace(block, first_sample=first, stamp_ns=stamp)
            received = stamp + length * 1_000_000 + round(random.uniform(0, 2e7))
            message = message_mapping.block_message(messages, block)
            sent.append((received, TOPICS[not of_axes], message))
    with BagWriter(path, TOPICS) as bag:
        for received, topic, message in sorted(sent, key=lambda item: item[0]):
            bag.write(topic, received, message)
    return path


def corrected(path, calibration):
    options = CorrectionOptions(trigger=CommonTrigger(counter_offset=OFFSET))
    with Recording(path) as recording:
        scan = CorrectedScan(recording, calibration, options)
        points = join_points([points for _, points in scan.steps()])
    return points, scan.account


@pytest.mark.parametrize("lost", [{"axes": [], "distance": []}, LOST], ids=["whole", "lost"])
@pytest.mark.parametrize("lengths", [(250, 37), *soaked(((100, 100),), ((64, 100),))])
def test_points_and_accounts_do_not_depend_on_how_drivers_cut_their_streams(
    tmp_path, small_scan_blocks, true_calibration, lengths, lost
):
    first = record(tmp_path / "a.mcap", small_scan_blocks, (100, 64), 1, lost)
    other = record(tmp_path / "b.mcap", small_scan_blocks, lengths, 2, lost)
    points, account = corrected(first, true_calibration)
    found, counted = corrected(other, true_calibration)
    for name in ("sample", "x", "y", "height", "dynamic_error", "uncertainty", "intensity"):
        assert getattr(found, name).tobytes() == getattr(points, name).tobytes(), name
    assert counted == account
    missing = {name: sum(b - a for a, b in gaps) for name, gaps in lost.items()}
    for name, partner in (("axes", "distance"), ("distance", "axes")):
        stream = getattr(account, name)
        assert stream.received == 40_000 - missing[name]
        assert stream.missing == missing[name]
        assert stream.counted.get("unmatched", 0) == missing[partner]
        assert stream.received == stream.corrected + sum(stream.counted.values())
    assert len(points) == account.axes.corrected > 38_000
