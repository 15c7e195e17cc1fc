"""Folders of rosbag2 in several files, as ``ros2 bag record --max-bag-size`` leaves them."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
import yaml
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from omsm_ros.errors import BagError
from omsm_ros.io import bags, message_mapping
from omsm_ros.io.message_mapping import bag_messages, typestore

TOPICS = (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)
PARTS, BLOCKS_A_PART = 3, 4
KINDS = [
    (StoragePlugin.SQLITE3, None),
    (StoragePlugin.SQLITE3, CompressionMode.FILE),
    (StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
    (StoragePlugin.MCAP, None),
    (StoragePlugin.MCAP, CompressionMode.FILE),
    (StoragePlugin.MCAP, CompressionMode.MESSAGE),
    (StoragePlugin.MCAP, CompressionMode.STORAGE),
]


def part(folder, pairs, plugin, mode):
    """A bag in one file; what its metadata say."""
    writer = Writer(folder, version=9, storage_plugin=plugin)
    if mode is not None:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    made, store = bag_messages(), typestore()
    with writer:
        to = [
            writer.add_connection(
                t, bags.TOPIC_TYPES[t], typestore=store, serialization_format="cdr"
            )
            for t in TOPICS
        ]
        for axes, distance in pairs:
            messages = (
                message_mapping.block_message(made, axes),
                message_mapping.block_message(made, distance),
            )
            for connection, message in zip(to, messages, strict=True):
                raw = store.serialize_cdr(message, connection.msgtype)
                writer.write(connection, axes.stamp_ns, raw)
    return yaml.safe_load((folder / "metadata.yaml").read_text())


def in_parts(folder, pairs, plugin, mode):
    """One folder with the files of several bags, and metadata that speak of all."""
    folder.mkdir()
    reported = []
    for k in range(PARTS):
        alone = folder.parent / f"part{k}"
        some = pairs[k * BLOCKS_A_PART : (k + 1) * BLOCKS_A_PART]
        reported.append(part(alone, some, plugin, mode)["rosbag2_bagfile_information"])
        (name,) = reported[k]["relative_file_paths"]
        shutil.move(alone / name, folder / name)
    whole = reported[0]
    for each in reported[1:]:
        whole["relative_file_paths"] += each["relative_file_paths"]
        whole["files"] += each["files"]
        whole["message_count"] += each["message_count"]
        whole["duration"]["nanoseconds"] += each["duration"]["nanoseconds"]
        for mine, theirs in zip(
            whole["topics_with_message_count"], each["topics_with_message_count"], strict=True
        ):
            mine["message_count"] += theirs["message_count"]
    text = yaml.safe_dump({"rosbag2_bagfile_information": whole})
    (folder / "metadata.yaml").write_text(text)
    return folder


@pytest.fixture
def pairs(small_scan_blocks):
    return small_scan_blocks[: PARTS * BLOCKS_A_PART]


def z_in(path):
    with bags.BagReader(path) as reader:
        blocks = [block for _, block in reader.records(bags.AXES_TOPIC)]
        assert reader.count(TOPICS) == 2 * len(blocks)
        return np.concatenate([block.z for block in blocks])


@pytest.mark.parametrize(("plugin", "mode"), KINDS)
def test_all_files_of_a_folder_are_read_in_order(tmp_path, pairs, plugin, mode):
    folder = in_parts(tmp_path / "bag", pairs, plugin, mode)
    np.testing.assert_array_equal(z_in(folder), np.concatenate([axes.z for axes, _ in pairs]))


@pytest.mark.parametrize(("plugin", "mode"), KINDS)
def test_a_file_that_is_not_there_is_named(tmp_path, pairs, plugin, mode):
    folder = in_parts(tmp_path / "bag", pairs, plugin, mode)
    (lost,) = folder.glob("part1*")
    lost.unlink()
    with pytest.raises(BagError, match="part1"):
        z_in(folder)


@pytest.mark.parametrize(("plugin", "mode"), KINDS)
def test_a_file_that_is_damaged_is_refused(tmp_path, pairs, plugin, mode):
    folder = in_parts(tmp_path / "bag", pairs, plugin, mode)
    (cut,) = folder.glob("part2*")
    content = cut.read_bytes()
    cut.write_bytes(content[: len(content) // 2])
    with pytest.raises(BagError, match="bag"):
        z_in(folder)
