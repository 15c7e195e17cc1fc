import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer

from omsm_ros.core.calibration.calibration_set import CalibrationSet, calibration_set
from omsm_ros.core.streams.blocks import AxisBlock, DistanceBlock
from omsm_ros.errors import BagError
from omsm_ros.io import bags, message_mapping
from omsm_ros.io.bag_writer import BagWriter

TOPICS = (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)


@pytest.fixture(scope="module")
def bag(tmp_path_factory, small_scan_blocks):
    path = tmp_path_factory.mktemp("bags") / "scan.mcap"
    with BagWriter(path, TOPICS) as writer:
        for axes, distance in small_scan_blocks[:20]:
            writer.write_block(axes)
            writer.write_block(distance)
    return path


def test_blocks_come_back_to_the_last_bit(bag, small_scan_blocks):
    with bags.BagReader(bag) as reader:
        records = [record for _, record in reader.records(*TOPICS)]
    axes = [r for r in records if isinstance(r, AxisBlock)]
    distance = [r for r in records if isinstance(r, DistanceBlock)]
    for read, (written, _) in zip(axes, small_scan_blocks[:20], strict=True):
        assert (read.stamp_ns, read.first_sample) == (written.stamp_ns, written.first_sample)
        for name in ("x", "y", "z", "b", "c"):
            np.testing.assert_array_equal(getattr(read, name), getattr(written, name))
    for read, (_, written) in zip(distance, small_scan_blocks[:20], strict=True):
        for name in ("distance", "intensity", "status"):
            np.testing.assert_array_equal(getattr(read, name), getattr(written, name))


@pytest.mark.parametrize("plugin", list(StoragePlugin))
def test_folders_of_rosbag2_are_read(tmp_path, small_scan_blocks, plugin):
    folder = tmp_path / "recorded"
    with Writer(folder, version=9, storage_plugin=plugin) as writer:
        connection = writer.add_connection(
            bags.AXES_TOPIC,
            bags.TOPIC_TYPES[bags.AXES_TOPIC],
            typestore=message_mapping.typestore(),
        )
        message = message_mapping.block_message(
            message_mapping.bag_messages(), small_scan_blocks[0][0]
        )
        raw = message_mapping.typestore().serialize_cdr(message, bags.TOPIC_TYPES[bags.AXES_TOPIC])
        writer.write(connection, 5, raw)
    with bags.BagReader(folder) as reader:
        ((_, block),) = reader.records(bags.AXES_TOPIC)
    np.testing.assert_array_equal(block.z, small_scan_blocks[0][0].z)


def _open(path, *topics):
    with bags.BagReader(path) as reader:
        return list(reader.records(*topics))


def test_missing_topic_names_what_is_there(bag):
    with pytest.raises(BagError, match=r"reference.*holds /omsm/axes, /omsm/confocal"):
        _open(bag, bags.REFERENCE_TOPIC)


def test_missing_cut_and_foreign_files_are_refused(tmp_path, bag):
    with pytest.raises(BagError, match="no bag at"):
        _open(tmp_path / "none", *TOPICS)
    with pytest.raises(BagError, match="no rosbag2 bag"):
        _open(tmp_path, *TOPICS)
    whole = bag.read_bytes()
    for length in (0, 7, 1000, len(whole) // 2, len(whole) - 3):
        cut = tmp_path / f"cut{length}.mcap"
        cut.write_bytes(whole[:length])
        with pytest.raises(BagError):
            _open(cut, *TOPICS)


def test_damaged_bytes_are_refused_or_harmless(tmp_path, bag):
    whole = bytearray(bag.read_bytes())
    random = np.random.default_rng(3)
    refused = 0
    for trial in range(60):
        damaged = whole.copy()
        for place in random.integers(8, len(whole), 20):
            damaged[place] ^= int(random.integers(1, 256))
        path = tmp_path / f"damaged{trial}.mcap"
        path.write_bytes(damaged)
        try:
            _open(path, *TOPICS)
        except BagError as err:
            assert str(path) in str(err)  # noqa: PT017 - any other error fails the test
            refused += 1
    assert refused > 0


def test_a_topic_of_another_type_is_refused(tmp_path):
    path = tmp_path / "text"
    with Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        writer.add_connection(
            bags.AXES_TOPIC, "std_msgs/msg/Header", typestore=message_mapping.typestore()
        )
    with pytest.raises(BagError, match="std_msgs/msg/Header"):
        _open(path, bags.AXES_TOPIC)


def test_a_block_that_contradicts_itself_is_refused(tmp_path, small_scan_blocks):
    path = tmp_path / "odd.mcap"
    message = message_mapping.block_message(message_mapping.bag_messages(), small_scan_blocks[0][0])
    message.x = message.x[:3]
    with BagWriter(path, TOPICS) as writer:
        writer.write(bags.AXES_TOPIC, 0, message)
    with pytest.raises(BagError, match="different lengths"):
        _open(path, bags.AXES_TOPIC)


def test_a_set_of_calibrations_is_unchanged_by_the_message(true_calibration):
    made = calibration_set("x", [(0.0, true_calibration), (0.01, true_calibration)])
    message = message_mapping.calibration_message(message_mapping.bag_messages(), made, 7)
    heard = message_mapping.calibration(message)
    assert isinstance(heard, CalibrationSet)
    assert (heard.id, heard.positions) == (made.id, (0.0, 0.01))
    # Readers that do not know sets see the middle member.
    assert np.array_equal(message.numerator, made.dynamics.numerator)
    message.certificate = message.certificate.replace('"along": "x"', '"along": "z"')
    with pytest.raises(message_mapping.CalibrationError, match="altered"):
        message_mapping.calibration(message)
    message.certificate = '{"calibration_set": {"schema": "omsm-calibration-set/1"}}'
    with pytest.raises(message_mapping.CalibrationError, match="calibration message"):
        message_mapping.calibration(message)


def test_a_calibration_is_unchanged_by_the_message(true_calibration):
    message = message_mapping.calibration_message(
        message_mapping.bag_messages(), true_calibration, 7
    )
    assert message_mapping.calibration(message).id == true_calibration.id
    message.static_gain = 1.0
    with pytest.raises(message_mapping.CalibrationError, match="altered"):
        message_mapping.calibration(message)
