"""Bags of several cells: which topics are asked for, and what is said where that is unclear."""

from pathlib import Path

import pytest
from rosbags.rosbag2 import StoragePlugin, Writer

from omsm_ros.errors import BagError
from omsm_ros.io import bags, message_mapping
from omsm_ros.io.topics import CellBag

AXES = bags.TOPIC_TYPES[bags.AXES_TOPIC]


@pytest.fixture
def cells(tmp_path, small_scan_blocks):
    """A bag with one block of axes of each cell, whose counts tell them apart."""

    def made(*names, plugin=StoragePlugin.MCAP):
        folder = tmp_path / f"{len(names)}-{plugin.name}"
        store = message_mapping.typestore()
        with Writer(folder, version=9, storage_plugin=plugin) as writer:
            for count, name in enumerate(names):
                connection = writer.add_connection(name, AXES, typestore=store)
                message = message_mapping.block_message(
                    message_mapping.bag_messages(), small_scan_blocks[count][0]
                )
                writer.write(connection, count, store.serialize_cdr(message, AXES))
        return folder

    return made


def first_of(bag):
    with bags.BagReader(bag) as reader:
        ((topic, block),) = reader.records(bags.AXES_TOPIC)
    assert topic == bags.AXES_TOPIC  # by the contract's name, whatever the bag calls it
    return block.first_sample


@pytest.mark.parametrize("plugin", list(StoragePlugin))
def test_each_cell_is_read_by_its_namespace(cells, plugin):
    folder = cells("/omsm/axes", "/cell2/axes", "/hall/cell3/axes", plugin=plugin)
    assert first_of(folder) == 0
    assert first_of(CellBag(folder, "/cell2")) == 100
    assert first_of(CellBag(folder, "cell2/")) == 100
    assert first_of(CellBag(folder, "/hall/cell3")) == 200
    assert first_of(CellBag(folder, "", {bags.AXES_TOPIC: "/cell2/axes"})) == 100


def test_the_only_cell_is_found_and_of_two_one_must_be_named(cells):
    assert first_of(cells("/cell2/axes")) == 0
    with pytest.raises(BagError, match=r"no topic '/omsm/axes'.*/cell2/axes.*--namespace"):
        first_of(cells("/cell2/axes", "/cell3/axes"))


def test_a_topic_of_another_type_is_not_taken_for_it(cells):
    held = {"/cell2/axes": "sensor_msgs/msg/JointState", "/x/confocal": "other"}
    assert CellBag(Path("a")).names(held)[bags.AXES_TOPIC] == bags.AXES_TOPIC


def test_the_summary_tells_name_and_role(cells):
    with bags.BagReader(CellBag(cells("/omsm/axes", "/cell2/axes"), "/cell2")) as reader:
        assert [(t.topic, t.role) for t in reader.topics()] == [
            ("/cell2/axes", bags.AXES_TOPIC),
            ("/omsm/axes", ""),
        ]
        assert reader.count([bags.AXES_TOPIC]) == 1
        assert str(reader.path).endswith("2-MCAP")


def test_a_part_of_the_messages_by_their_time(cells):
    folder = cells("/cell2/axes")
    with bags.BagReader(folder) as reader:
        assert [stamp for _, stamp, _ in reader.messages([bags.AXES_TOPIC], 0, 1)] == [0]
        assert list(reader.messages([bags.AXES_TOPIC], 1, 2)) == []
