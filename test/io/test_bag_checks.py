"""Bags that are not what they claim to be."""

import os
import sqlite3
import struct
from binascii import crc32
from contextlib import closing
from time import process_time

import numpy as np
import pytest
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from omsm_ros.errors import BagError
from omsm_ros.io import bag_checks, bags, message_mapping
from omsm_ros.io.bag_writer import BagWriter
from omsm_ros.io.tables.binary_table import topics_of

AXES = bags.TOPIC_TYPES[bags.AXES_TOPIC]


def records(path, *topics):
    with bags.BagReader(path) as reader:
        return list(reader.records(*(topics or (bags.AXES_TOPIC,))))


@pytest.fixture
def message(small_scan_blocks):
    return message_mapping.block_message(message_mapping.bag_messages(), small_scan_blocks[0][0])


@pytest.fixture
def written(tmp_path, small_scan_blocks):
    path = tmp_path / "scan.mcap"
    with BagWriter(path, (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)) as bag:
        for axes, distance in small_scan_blocks[:40]:
            bag.write_block(axes)
            bag.write_block(distance)
    return path


def foreign_bag(folder, messages, *, plugin=StoragePlugin.MCAP, store=None, mode=None):
    """A bag as another program writes it; the path of its MCAP file or its folder."""
    store = store or message_mapping.typestore()
    writer = Writer(folder, version=9, storage_plugin=plugin)
    if mode is not None:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection(bags.AXES_TOPIC, AXES, typestore=store)
        for index, message in enumerate(messages):
            writer.write(connection, index, store.serialize_cdr(message, AXES))
    return folder / f"{folder.name}.mcap" if plugin is StoragePlugin.MCAP else folder


def swapped_store():
    """Types in which x and z of an AxisBlock have changed places."""
    store = get_typestore(Stores.ROS2_JAZZY)
    text = (message_mapping.message_folder() / "AxisBlock.msg").read_text()
    lines = text.splitlines()
    x, z = (next(i for i, line in enumerate(lines) if f"float64[] {n}" in line) for n in "xz")
    lines[x], lines[z] = lines[z], lines[x]
    store.register(get_types_from_msg("\n".join(lines), AXES))
    return store


@pytest.mark.parametrize("plugin", list(StoragePlugin))
def test_another_order_of_the_fields_is_refused(tmp_path, message, plugin):
    store = swapped_store()
    other = store.types[AXES](**{f: getattr(message, f) for f in message.__dataclass_fields__})
    path = foreign_bag(tmp_path / "bag", [other], plugin=plugin, store=store)
    with pytest.raises(BagError, match=r"another definition of 'omsm_msgs/msg/AxisBlock'"):
        records(path)


def test_comments_in_a_definition_are_no_other_definition(tmp_path, message):
    text = (message_mapping.message_folder() / "AxisBlock.msg").read_text()
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg("# another comment\n" + text, AXES))
    other = store.types[AXES](**{f: getattr(message, f) for f in message.__dataclass_fields__})
    assert len(records(foreign_bag(tmp_path / "bag", [other], store=store))) == 1


def test_all_channels_of_a_topic_are_read(tmp_path, small_scan_blocks):
    """rosbags writes one channel a topic; a second recorder's is made of it by hand."""
    blocks = [axes for axes, _ in small_scan_blocks[:10]]
    messages = [
        message_mapping.block_message(message_mapping.bag_messages(), block) for block in blocks
    ]
    folder = tmp_path / "two"
    store = message_mapping.typestore()
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        first = writer.add_connection(bags.AXES_TOPIC, AXES, typestore=store)
        second = writer.add_connection("/omsm/axez", AXES, typestore=store)
        for index, message in enumerate(messages):
            writer.write((first, second)[index % 2], index, store.serialize_cdr(message, AXES))
    path = folder / "two.mcap"
    path.write_bytes(path.read_bytes().replace(b"/omsm/axez", b"/omsm/axes"))
    assert [block.first_sample for _, block in records(path)] == [b.first_sample for b in blocks]
    with bags.BagReader(path) as reader:
        assert [(t.topic, t.messages) for t in reader.topics()] == [(bags.AXES_TOPIC, 10)]


def with_another_count(path, channel, count, stated):
    """Change what the index says of a channel."""
    whole = bytearray(path.read_bytes())
    place = whole.rindex(struct.pack("<HQ", channel, count))
    whole[place : place + 10] = struct.pack("<HQ", channel, stated)
    path.write_bytes(whole)


def test_fewer_messages_than_promised_are_damage(tmp_path, message):
    path = foreign_bag(tmp_path / "bag", [message] * 99)
    with_another_count(path, 1, 99, 100)
    with pytest.raises(BagError, match="1 messages fewer than its index says"):
        records(path)


def test_a_changed_index_does_not_fit_its_checksum(written):
    with_another_count(written, 1, 40, 41)
    with pytest.raises(BagError, match=r"index that does not fit its checksum.*--repair"):
        records(written)


def test_every_chunk_carries_its_checksum(written):
    whole, place, chunks = written.read_bytes(), 8, 0
    while place + 9 <= len(whole) - 8:
        kind, length = struct.unpack_from("<BQ", whole, place)
        if kind == 6:
            start = place + 9
            size, checksum, named, stored = struct.unpack_from("<QIIQ", whole, start + 16)
            assert (named, stored) == (0, size)
            assert checksum == crc32(whole[start + 40 : start + 40 + size]) != 0
            chunks += 1
        place += 9 + length
    assert chunks >= 1


def test_a_length_that_does_not_fit_its_chunk_is_damage_without_checksums_too(tmp_path, written):
    with Reader(written) as bag:
        start = bag.storage.chunks[0].chunk_start_offset
    for length in (10**6, 3):
        whole = bytearray(written.read_bytes())
        whole[start + 33 : start + 37] = whole[-12:-8] = bytes(4)  # of the chunk, of the index
        place = start + 49  # the first record within
        while whole[place] != 5:
            place += 9 + struct.unpack_from("<Q", whole, place + 1)[0]
        struct.pack_into("<Q", whole, place + 1, length)
        path = tmp_path / f"{length}.mcap"
        path.write_bytes(whole)
        with pytest.raises(BagError, match=r"damaged.*--repair"):
            records(path)


def test_a_changed_byte_gives_the_same_blocks_or_is_seen(tmp_path, written):
    whole = written.read_bytes()
    expected = records(written, bags.AXES_TOPIC, bags.DISTANCE_TOPIC)
    random, seen = np.random.default_rng(5), 0
    for place in random.integers(8, len(whole), 150):
        damaged = bytearray(whole)
        damaged[place] ^= int(random.integers(1, 256))
        path = tmp_path / "damaged.mcap"
        path.write_bytes(damaged)
        try:
            found = records(path, bags.AXES_TOPIC, bags.DISTANCE_TOPIC)
        except BagError:
            seen += 1
            continue
        for (topic, one), (other_topic, other) in zip(expected, found, strict=True):
            assert topic == other_topic
            assert one.first_sample == other.first_sample
            assert one.stamp_ns == other.stamp_ns
            name = "z" if topic == bags.AXES_TOPIC else "distance"
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert seen > 100  # nearly all of the file is samples


@pytest.mark.parametrize("content", [b"", b"8 bytes.", b"\x89MCAP0\r\n", b"\x89MCAP0\r\n" * 8])
@pytest.mark.parametrize("name", ["a.mcap", "a.db3", "a.txt"])
def test_a_few_bytes_are_no_bag(tmp_path, content, name):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(BagError, match=name):
        records(path)


def test_pipes_and_devices_are_refused_at_once(tmp_path):
    pipe = tmp_path / "pipe.mcap"
    os.mkfifo(pipe)
    with pytest.raises(BagError, match="no regular file"):
        records(pipe)
    device = tmp_path / "zero.mcap"
    device.symlink_to("/dev/zero")
    with pytest.raises(BagError, match="no regular file"):
        records(device)
    folder = tmp_path / "bag"
    folder.mkdir()
    os.mkfifo(folder / "metadata.yaml")
    with pytest.raises(BagError, match="no regular file"):
        records(folder)


def test_a_name_longer_than_names_are_is_refused(tmp_path):
    with pytest.raises(BagError, match="name too long"):
        records(tmp_path / ("n" * 300 + ".mcap"))
    with pytest.raises(BagError, match="cannot write"), BagWriter(tmp_path / ("n" * 300), ()):
        pass


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_a_bad_frame_is_damage(compression):
    with pytest.raises(Exception, match=r".") as caught, bag_checks.bag_errors("x", "remedy"):
        bag_checks.storage_mcap.decompress(b"no frame at all", compression, 100, 0)
    assert caught.type is BagError
    assert str(caught.value).startswith("bag 'x' cannot be read: ")
    assert "Error" not in str(caught.value)


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_a_frame_that_unpacks_to_gigabytes_stops_at_what_it_claims(compression):
    import tracemalloc

    from lz4.frame import compress as lz4_compress

    zeros = bytes(64 * 1024**2)
    packed = {"zstd": bag_checks.storage_mcap.zstd.compress, "lz4": lz4_compress}[compression]
    bomb = packed(zeros)
    del zeros
    tracemalloc.start()
    with pytest.raises(Exception, match="claims 1000 bytes"):
        bag_checks.storage_mcap.decompress(bomb, compression, 1000, 0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4e6
    with pytest.raises(Exception, match="at most"):
        bag_checks.storage_mcap.decompress(bomb, compression, 2**40, 0)


NESTED_ALIASES = "&a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{name}: &{name} [{', '.join([f'*{before}'] * 9)}]\n"
    for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)


def test_a_folder_that_is_no_bag_is_named(tmp_path, written):
    for read in (records, topics_of):
        with pytest.raises(BagError, match=r"without metadata\.yaml.*give one of its \.mcap files"):
            read(tmp_path)


def test_metadata_with_aliases_is_refused_at_once(tmp_path, message):
    """A few hundred bytes that unfold to gigabytes as soon as an error shows them."""
    folder = foreign_bag(tmp_path / "bag", [message], plugin=StoragePlugin.SQLITE3)
    metadata = folder / "metadata.yaml"
    text = metadata.read_text()
    assert "compression_format: ''" in text
    bomb = text.replace("compression_format: ''", "compression_format: *i")
    metadata.write_text(f"a: {NESTED_ALIASES}{bomb}")
    start = process_time()
    for read in (records, topics_of):
        with pytest.raises(BagError, match="aliases or anchors"):
            read(folder)
    assert process_time() - start < 1.0


@pytest.mark.parametrize("stated", [f"a: {NESTED_ALIASES}", "- history: 1\n" * 20_000])
def test_a_quality_of_service_with_aliases_or_without_end_is_refused(stated):
    start = process_time()
    with pytest.raises(Exception, match="quality of service") as refused:
        bag_checks.storage_mcap.parse_qos(stated)
    assert refused.type is bag_checks.ReaderError
    assert process_time() - start < 1.0
    assert bag_checks.storage_mcap.parse_qos("[]") == []


def packed_chunks(path, chunks, size, compression):
    """An MCAP file with an index, its chunks full of zeros that all cover the same time."""
    with path.open("wb") as stream:
        writer = McapWriter(stream, chunk_size=size, compression=compression)
        writer.start("ros2")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        channel = writer.register_channel("/text", "cdr", schema)
        for number in range(chunks):
            writer.add_message(channel, 1 + number % 2, bytes(size), 1)
        writer.finish()


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
def test_chunks_that_unpack_to_gigabytes_are_refused_before_they_are_unpacked(
    tmp_path, compression
):
    """Nothing is unpacked: 30 chunks of 128 MB would be held together."""
    import tracemalloc

    path = tmp_path / "bomb.mcap"
    packed_chunks(path, 8, 8 * 1024**2, compression)
    tracemalloc.start()
    with pytest.raises(BagError, match="unpacks to 100 times its"):
        records(path)
    assert tracemalloc.get_traced_memory()[1] < 8e6
    tracemalloc.stop()


def test_chunks_that_cover_the_same_time_are_held_up_to_a_bound(tmp_path, monkeypatch):
    path = tmp_path / "overlap.mcap"
    packed_chunks(path, 5, 1_000_000, CompressionType.NONE)
    monkeypatch.setattr(bag_checks, "_MAX_HELD_BYTES", 2_500_000)
    with pytest.raises(BagError, match="cover the same time"):
        records(path)
    monkeypatch.undo()
    with pytest.raises(BagError, match="has no topic"):
        records(path)


@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE])
def test_compressed_folders_are_read(tmp_path, message, mode):
    folder = foreign_bag(tmp_path / "bag", [message], plugin=StoragePlugin.SQLITE3, mode=mode)
    ((_, block),) = records(folder)
    np.testing.assert_array_equal(block.z, message.z)


def test_a_message_that_unpacks_to_gigabytes_is_refused(tmp_path, message, monkeypatch):
    monkeypatch.setattr(bag_checks, "MAX_MESSAGE_BYTES", 1000)
    mode = CompressionMode.MESSAGE
    folder = foreign_bag(tmp_path / "bag", [message], plugin=StoragePlugin.SQLITE3, mode=mode)
    with pytest.raises(BagError, match="1000 bytes"):
        records(folder)


def test_a_file_of_a_folder_that_unpacks_to_gigabytes_is_refused(tmp_path, message):
    """It would go to the disk, all of it, before anybody looks."""
    mode = CompressionMode.FILE
    folder = foreign_bag(tmp_path / "bag", [message], plugin=StoragePlugin.SQLITE3, mode=mode)
    (packed,) = folder.glob("*.zstd")
    packed.write_bytes(bag_checks.storage_mcap.zstd.compress(bytes(64 * 1024**2)))
    with pytest.raises(BagError, match="unpacks to 100 times its"):
        records(folder)
    with pytest.raises(BagError, match="unpacks to 100 times its"):
        topics_of(folder)


def defined_in(folder, lines):
    """Return a bag whose message is defined in ``lines`` lines, most of them remarks."""
    text = "# a remark\n" * (lines - 1) + "float64 data\n"
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        ours = writer.add_connection(bags.AXES_TOPIC, AXES, msgdef=text, rihs01="RIHS01_")
        writer.write(ours, 0, bytes(12))
    return folder / f"{folder.name}.mcap"


def test_definitions_that_take_minutes_to_take_apart_are_not(tmp_path):
    path = defined_in(tmp_path / "long", 300_000)
    start = process_time()
    with pytest.raises(BagError, match="defines its messages in 300000 lines"):
        topics_of(path)
    with pytest.raises(BagError, match="another definition of"):
        records(path)
    assert process_time() - start < 1.0


@pytest.mark.parametrize(
    "change",
    [
        "ALTER TABLE topics ADD COLUMN a BLOB GENERATED ALWAYS AS (zeroblob(900000000)) VIRTUAL",
        "CREATE VIRTUAL TABLE v USING fts5(a)",
    ],
)
def test_a_database_that_computes_what_it_holds_is_refused(tmp_path, message, change):
    """A few bytes of it would be read as 900 MB, once a row."""
    folder = foreign_bag(tmp_path / "bag", [message], plugin=StoragePlugin.SQLITE3)
    (base,) = folder.glob("*.db3")
    with closing(sqlite3.connect(base)) as connection, connection:
        connection.execute(change)
    for path in (folder, base):
        with pytest.raises(BagError, match="of the bag computes its columns"):
            records(path)


def test_a_path_that_would_be_read_as_an_address_is_refused(tmp_path, message):
    """SQLite decodes "%41" to "A": another file would be read."""
    folder = foreign_bag(tmp_path / "A", [message], plugin=StoragePlugin.SQLITE3)
    other = folder.rename(tmp_path / "%41")
    foreign_bag(tmp_path / "A", [message] * 2, plugin=StoragePlugin.SQLITE3)
    assert len(records(tmp_path / "A")) == 2
    with pytest.raises(BagError, match="rename it"):
        records(other)
