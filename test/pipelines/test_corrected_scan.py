"""Correction of a bag in one pass: all samples, in bounded memory, in any order in the file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from omsm_ros.cli.recordings import inspect_bag
from omsm_ros.core.correction.correct import CorrectionOptions, Corrector
from omsm_ros.core.correction.surface_points import join_points
from omsm_ros.core.streams.blocks import AxisBlock
from omsm_ros.errors import BagError, CalibrationError
from omsm_ros.io import bags, message_mapping
from omsm_ros.io.bag_writer import BagWriter
from omsm_ros.io.results import CloudFile
from omsm_ros.pipelines import correct
from omsm_ros.pipelines.correct import Admission, CorrectedScan, correct_bag
from omsm_ros.pipelines.measure import measure
from omsm_ros.pipelines.recording import Recording

TOPICS = (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)


def write(path, blocks, ahead=0):
    """Write a bag whose axes were recorded ``ahead`` blocks before the distance."""
    with BagWriter(path, TOPICS) as bag:
        for k in range(len(blocks) + ahead):
            # Recorded at the time of writing, by which readers order messages.
            stamp = k * 100_000_000
            messages = message_mapping.bag_messages()
            if k < len(blocks):
                message = message_mapping.block_message(messages, blocks[k][0])
                bag.write(bags.AXES_TOPIC, stamp, message)
            if k >= ahead:
                message = message_mapping.block_message(messages, blocks[k - ahead][1])
                bag.write(bags.DISTANCE_TOPIC, stamp, message)
    return path


@pytest.fixture(scope="module")
def bag(tmp_path_factory, small_scan_blocks):
    return write(tmp_path_factory.mktemp("scan") / "scan.mcap", small_scan_blocks)


def points_of(path, calibration, **options):
    with Recording(path) as recording:
        scan = CorrectedScan(recording, calibration, CorrectionOptions(), **options)
        points = join_points([points for _, points in scan.steps()])
    return points, scan.account


def same(one, other):
    return all(
        getattr(one, name).tobytes() == getattr(other, name).tobytes()
        for name in ("sample", "x", "y", "height", "dynamic_error", "uncertainty", "intensity")
    )


def test_points_are_those_of_a_live_corrector_to_the_last_bit(
    bag, small_scan_blocks, true_calibration
):
    live, parts = Corrector(true_calibration), []
    for axes, distance in small_scan_blocks:
        live.push_axes(axes)
        live.push_distance(distance)
        parts.append(live.take())
    parts.append(live.finish())
    offline, account = points_of(bag, true_calibration)
    assert same(offline, join_points(parts))
    assert account == live.account


def test_a_stream_recorded_long_before_the_other_loses_nothing(
    tmp_path, small_scan_blocks, bag, true_calibration
):
    # All 40 s of the axes come first; live, a sample would have waited no more than 10 s.
    path = write(tmp_path / "ahead.mcap", small_scan_blocks, ahead=len(small_scan_blocks))
    points, account = points_of(path, true_calibration)
    expected, usual = points_of(bag, true_calibration)
    assert same(points, expected)
    assert account == usual


def test_samples_that_had_to_be_given_up_are_an_error(
    tmp_path, small_scan_blocks, true_calibration, monkeypatch
):
    monkeypatch.setattr(correct, "MAX_PENDING_SAMPLES", 5000)
    monkeypatch.setattr(bags, "_JOINED_BYTES", 1_000_000)  # splits a short bag into several blocks
    path = write(tmp_path / "ahead.mcap", small_scan_blocks, ahead=len(small_scan_blocks))
    with pytest.raises(BagError, match="were dropped before their partners came"):
        correct_bag(path, true_calibration, tmp_path / "cloud.ply")
    assert not (tmp_path / "cloud.ply").exists()


def test_axes_that_go_on_without_the_probe_are_no_error(
    tmp_path, small_scan_blocks, true_calibration, monkeypatch
):
    monkeypatch.setattr(correct, "MAX_PENDING_SAMPLES", 5000)
    monkeypatch.setattr(bags, "_JOINED_BYTES", 1_000_000)  # splits a short bag into several blocks
    path = tmp_path / "stopped.mcap"
    with BagWriter(path, TOPICS) as writer:
        for k, (axes, distance) in enumerate(small_scan_blocks):
            writer.write_block(axes)
            if k < 100:
                writer.write_block(distance)
    points, account = points_of(path, true_calibration)
    assert len(points) == 10_000 - account.distance.counted["settling"]
    waiting = account.axes.counted["overdue"] + account.axes.counted["unmatched"]
    assert waiting == 30_000


def test_every_axis_block_is_handed_on_before_its_points(bag, true_calibration):
    seen = 0
    with Recording(bag) as recording:
        scan = CorrectedScan(recording, true_calibration, CorrectionOptions())
        for block, points in scan.steps():
            if isinstance(block, AxisBlock):
                seen = block.first_sample + len(block)
            if points is not None:
                assert points.sample[-1] < seen
    assert seen == 40_000


def test_a_foreign_calibration_is_refused_before_anything_is_written(
    bag, true_calibration, tmp_path
):
    other = replace(true_calibration, sample_period=2e-3)
    with pytest.raises(CalibrationError, match="sample period"):
        correct_bag(bag, other, tmp_path / "cloud.ply")
    assert not list(tmp_path.iterdir())


def test_overridden_it_says_so_in_the_cloud(bag, true_calibration, tmp_path):
    foreign = Admission({"machine": "another"}, override=True)
    done = correct_bag(bag, true_calibration, tmp_path / "cloud.ply", admission=foreign)
    assert done.admitted["overridden"]
    assert any("another" in str(reason) for reason in done.reasons)
    assert b"OVERRIDDEN" in (tmp_path / "cloud.ply").read_bytes()[:512]


@pytest.mark.parametrize("held", ["nothing", "axes", "distance"])
def test_a_bag_without_samples_is_refused(tmp_path, small_scan_blocks, true_calibration, held):
    path = tmp_path / "empty.mcap"
    axes, distance = small_scan_blocks[0]
    with BagWriter(path, TOPICS) as writer:
        if held == "axes":
            writer.write_block(axes)
        if held == "distance":
            writer.write_block(distance)
    with pytest.raises(BagError, match="no samples on"):
        correct_bag(path, true_calibration, tmp_path / "cloud.ply")


def test_what_is_found_on_the_way_is_what_the_cloud_says(bag, true_calibration, tmp_path):
    done = correct_bag(bag, true_calibration, tmp_path / "cloud.ply")
    cloud = CloudFile(tmp_path / "cloud.ply").read()
    assert done.points.tobytes() == cloud.tobytes()
    error = done.statistics["error"]
    assert error.points == len(cloud)
    assert error.peak_to_valley == pytest.approx(np.ptp(cloud["dynamic_error"]), rel=1e-6)
    assert done.largest_uncertainty == pytest.approx(cloud["uncertainty"].max(), rel=1e-6)
    assert len(done.path.z) == 40_000
    assert done.sample_period == 1e-3


@pytest.mark.parametrize("samples", [1, 10, 100, 400])
def test_a_probe_whose_counter_is_off_gives_no_points_and_is_reported(
    tmp_path, small_scan_blocks, true_calibration, samples
):
    """The pairs are of different instants, so they give no valid height."""
    path = tmp_path / "off.mcap"
    with BagWriter(path, TOPICS) as bag:
        for axes, distance in small_scan_blocks[:20]:
            bag.write_block(axes)
            bag.write_block(replace(distance, first_sample=distance.first_sample + samples))
    summary = measure(path, true_calibration, tmp_path / "out", report=False)
    account = summary["samples"]["distance"]
    assert account["corrected"] == 0
    assert account["counted"]["slipped"] >= 2000 - samples - 21  # except for the settling samples
    said = summary["warnings"]
    assert any(f"slipped by {samples} samples" in s for s in said)
    assert any(f"slipped by {samples} samples" in s for s in inspect_bag(path)["faults"])


def test_trigger_numbers_missing_from_both_streams_take_the_green_away(
    tmp_path, small_scan_blocks, true_calibration
):
    path = tmp_path / "gap.mcap"
    with BagWriter(path, TOPICS) as bag:
        for axes, distance in small_scan_blocks[:8] + small_scan_blocks[10:20]:
            bag.write_block(axes)
            bag.write_block(distance)
    said = reasons_of(path, true_calibration, tmp_path)
    assert [s for s in said if "200 trigger numbers are missing (800 to 999)" in s]
    stream, _ = inspect_bag(path)["topics"]
    assert (stream["gaps"], stream["missing"]) == (1, 200)


def reasons_of(path, calibration, folder):
    verdict = measure(path, calibration, folder / "out", report=False)["verdict"]
    assert verdict["code"] != "verified"
    return [reason["text"] for reason in verdict["reasons"]]
