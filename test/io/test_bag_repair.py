"""The valid messages of an incomplete or damaged bag are copied."""

import struct
from dataclasses import replace
from time import process_time

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer, storage_mcap

from omsm_ros.errors import BagError
from omsm_ros.io import bag_checks, bags, message_mapping
from omsm_ros.io.bag_repair import repair
from omsm_ros.io.bag_writer import BagWriter

TOPICS = (bags.AXES_TOPIC, bags.DISTANCE_TOPIC)
BLOCKS, CHUNK = 24, 4
FIRST_SAMPLE = 1_000_003
MAGIC = b"\x89MCAP0\r\n"


def first_samples(path, topic=bags.AXES_TOPIC):
    with bags.BagReader(path) as reader:
        return [block.first_sample for _, block in reader.records(topic)]


@pytest.fixture
def whole(tmp_path, small_scan_blocks):
    """A bag of 24 pairs of blocks in chunks of four."""
    path = tmp_path / "scan.mcap"
    with BagWriter(path, TOPICS) as bag:
        for index, (axes, distance) in enumerate(small_scan_blocks[:BLOCKS], start=1):
            bag.write_block(axes)
            bag.write_block(distance)
            if index % CHUNK == 0:
                bag.flush()
    return path


def ends_of_chunks(path):
    """Where each chunk ends in the file; read off the format (mcap.dev/spec, "Records")."""
    data, place, ends = path.read_bytes(), 8, []
    while place < len(data) - 8:
        kind, length = struct.unpack_from("<BQ", data, place)
        place += 9 + length
        if kind == 6:
            ends.append(place)
    return ends


def test_a_cut_bag_gives_all_but_the_chunk_that_was_cut(whole, small_scan_blocks):
    data, ends = whole.read_bytes(), ends_of_chunks(whole)
    expected = [axes.first_sample for axes, _ in small_scan_blocks[:BLOCKS]]
    assert len(ends) == BLOCKS // CHUNK
    for length in np.linspace(50, len(data), 40, dtype=int):
        whole.write_bytes(data[:length])
        kept = CHUNK * sum(end <= length for end in ends)
        if not kept:
            with pytest.raises(BagError, match="the file was cut short there"):
                repair(whole)
            continue
        made = repair(whole)
        assert made.messages == dict.fromkeys(TOPICS, kept)
        assert bool(made.lost) == (length < len(data) - 400)
        assert first_samples(made.path) == expected[:kept]
        assert first_samples(made.path, bags.DISTANCE_TOPIC) == expected[:kept]
        assert whole.read_bytes() == data[:length]
        made.path.unlink()


def test_a_damaged_chunk_is_left_out_and_named(whole, small_scan_blocks):
    data, ends = bytearray(whole.read_bytes()), ends_of_chunks(whole)
    place = ends[2] - 100  # samples of the third chunk
    data[place] ^= 1
    whole.write_bytes(data)
    made = repair(whole)
    (lost,) = made.lost
    assert "checksum" in lost
    assert "scan.mcap" in lost
    expected = [axes.first_sample for axes, _ in small_scan_blocks[:BLOCKS]]
    assert first_samples(made.path) == expected[: 2 * CHUNK] + expected[3 * CHUNK :]


def rewritten(path, to, change, **metadata):
    """Write the messages of a bag to another, their bytes ``change``d by (topic, place)."""
    with path.open("rb") as stream, to.open("wb") as file:
        writer = McapWriter(file)
        writer.start("ros2")
        channels = {}
        for place, (schema, channel, message) in enumerate(make_reader(stream).iter_messages()):
            if channel.topic not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(
                    channel.topic, "cdr", number, channel.metadata | metadata
                )
            data = change(channel.topic, place, message.data)
            writer.add_message(channels[channel.topic], message.log_time, data, message.log_time)
        writer.finish()


def cut(topic, place, data):
    return data[:-9]


def counter_beyond_all(topic, place, data):
    return data.replace(struct.pack("<Q", FIRST_SAMPLE), struct.pack("<Q", 2**63), 1)


@pytest.mark.parametrize("spoil", [cut, counter_beyond_all])
def test_a_message_that_no_command_reads_is_left_out_and_named(tmp_path, small_scan_blocks, spoil):
    """The checksum of its chunk fits, for it was recorded so: a driver that went wrong once."""
    path, spoilt = tmp_path / "scan.mcap", tmp_path / "spoilt.mcap"
    blocks = [
        tuple(replace(b, first_sample=FIRST_SAMPLE + b.first_sample) for b in pair)
        for pair in small_scan_blocks[:5]
    ]
    with BagWriter(path, TOPICS) as bag:
        for axes, distance in blocks:
            bag.write_block(axes)
            bag.write_block(distance)
    rewritten(path, spoilt, lambda *m: spoil(*m) if m[1] == 0 else m[2])
    with pytest.raises(BagError, match="omsm inspect --repair"):
        first_samples(spoilt)
    made = repair(spoilt)
    (lost,) = made.lost
    assert "a message of '/omsm/axes' at " in lost
    assert made.messages == {bags.AXES_TOPIC: 4, bags.DISTANCE_TOPIC: 5}
    assert first_samples(made.path) == [axes.first_sample for axes, _ in blocks[1:]]


def test_messages_of_another_definition_are_saved_as_they_are(whole, tmp_path):
    other = tmp_path / "other.mcap"
    rewritten(whole, other, cut, topic_type_hash="RIHS01_of_another_release")
    made = repair(other)
    assert (made.messages, made.lost) == (dict.fromkeys(TOPICS, BLOCKS), [])


def write_axes(writer, pairs):
    """Write axes with the writer of rosbags."""
    store, kind = message_mapping.typestore(), bags.TOPIC_TYPES[bags.AXES_TOPIC]
    with writer:
        connection = writer.add_connection(bags.AXES_TOPIC, kind, typestore=store)
        for axes, _ in pairs:
            message = message_mapping.block_message(message_mapping.bag_messages(), axes)
            writer.write(connection, axes.stamp_ns, store.serialize_cdr(message, kind))


def test_messages_that_were_compressed_one_by_one_can_be_read(tmp_path, small_scan_blocks):
    """That they are is said by metadata.yaml alone, and the copy is one file."""
    folder = tmp_path / "night"
    writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    write_axes(writer, small_scan_blocks[:5])
    made = repair(folder)
    assert made.lost == []
    assert first_samples(made.path) == [axes.first_sample for axes, _ in small_scan_blocks[:5]]


def test_the_original_and_an_earlier_repair_are_never_overwritten(whole):
    before = whole.read_bytes()
    made = repair(whole)
    assert made.path.name == "scan.repaired.mcap"
    kept = made.path.read_bytes()
    with pytest.raises(BagError, match=r"scan\.repaired\.mcap' exists"):
        repair(whole)
    assert (whole.read_bytes(), made.path.read_bytes()) == (before, kept)


def test_a_bag_without_index_gets_one(tmp_path, small_scan_blocks):
    path = tmp_path / "scan.mcap"
    bag = BagWriter(path, TOPICS).__enter__()
    for axes, _ in small_scan_blocks[:3]:
        bag.write_block(axes)
    bag.flush()
    made = repair(path)
    assert made.lost == []
    assert first_samples(made.path) == first_samples(path)
    assert made.path.stat().st_size > path.stat().st_size
    bag.__exit__(None, None, None)


@pytest.mark.parametrize("packed", [False, True])
def test_a_folder_of_rosbag2_without_its_metadata(tmp_path, small_scan_blocks, packed):
    """As rosbag2 leaves it when it is killed: no metadata.yaml, no end."""
    folder = tmp_path / "night"
    writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
    if packed:
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    write_axes(writer, small_scan_blocks[:5])
    (folder / "metadata.yaml").unlink()
    part = folder / "night.mcap"
    part.write_bytes(part.read_bytes()[: ends_of_chunks(part)[-1]])
    made = repair(folder)
    assert made.path == tmp_path / "night.repaired.mcap"
    assert first_samples(made.path) == [axes.first_sample for axes, _ in small_scan_blocks[:5]]


def test_what_is_no_mcap_is_refused_and_nothing_is_made(tmp_path):
    text = tmp_path / "notes.mcap"
    text.write_text("the mirror looks fine")
    with pytest.raises(BagError, match="no MCAP file"):
        repair(text)
    with pytest.raises(BagError, match="no bag at"):
        repair(tmp_path / "none.mcap")
    empty = tmp_path / "folder"
    empty.mkdir()
    with pytest.raises(BagError, match="ros2 bag reindex"):
        repair(empty)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["folder", "notes.mcap"]


def test_any_damage_is_survived_and_what_is_saved_is_true(whole, small_scan_blocks):
    data = whole.read_bytes()
    truth = {axes.first_sample: axes.z for axes, _ in small_scan_blocks[:BLOCKS]}
    random = np.random.default_rng(8)
    saved = 0
    for _ in range(60):
        damaged = bytearray(data)
        for place in random.integers(8, len(data), 3):
            damaged[place] ^= int(random.integers(1, 256))
        whole.write_bytes(damaged)
        try:
            made = repair(whole)
        except BagError:  # where the definitions were hit nothing is whole
            continue
        saved += 1
        if made.messages[bags.AXES_TOPIC]:
            with bags.BagReader(made.path) as reader:
                for _, block in reader.records(bags.AXES_TOPIC):
                    np.testing.assert_array_equal(block.z, truth[block.first_sample])
        made.path.unlink()
    assert saved > 40


def chunk_of(data, compress):
    """An MCAP file of one chunk (mcap.dev/spec, "Chunk (op=0x06)"), many times."""
    packed = compress(data)
    body = struct.pack("<QQQII4sQ", 0, 1, len(data), 0, 4, b"zstd", len(packed)) + packed
    return struct.pack("<BQ", 6, len(body)) + body


def test_chunks_of_zeros_are_lost_at_once(tmp_path):
    """Each nine of them are a record of no kind: a kilobyte would be a million of them."""
    path, compress = tmp_path / "zeros.mcap", storage_mcap.zstd.compress
    path.write_bytes(MAGIC + chunk_of(bytes(10**6), compress) * 400)
    start = process_time()
    with pytest.raises(BagError, match="a record of no kind at 0 of a chunk"):
        repair(path)
    assert process_time() - start < 1.0


def test_every_place_that_is_lost_is_counted(whole, small_scan_blocks):
    """Twenty are named, and the others are a number."""
    data = whole.read_bytes()
    damage = chunk_of(bytes(90), storage_mcap.zstd.compress) * 33
    whole.write_bytes(MAGIC + damage + data[len(MAGIC) :])
    made = repair(whole)
    assert (len(made.lost), made.unnamed) == (20, 13)
    assert [axes.first_sample for axes, _ in small_scan_blocks[:BLOCKS]] == first_samples(made.path)


@pytest.mark.parametrize("data", [MAGIC, MAGIC + bytes(9), MAGIC + b"\x05"], ids=repr)
def test_what_holds_no_whole_message_is_refused_and_no_empty_bag_is_left(tmp_path, data):
    path = tmp_path / "cut.mcap"
    path.write_bytes(data)
    with pytest.raises(BagError, match="has no whole message to save"):
        repair(path)
    assert list(tmp_path.iterdir()) == [path]


def test_chunks_that_unpack_to_more_than_a_recording_are_lost(tmp_path, monkeypatch):
    """Tiny messages in small files: what is taken apart does not grow beyond a bound."""
    monkeypatch.setattr(bag_checks, "_ALWAYS_UNPACKED_BYTES", 10**6)
    path, compress = tmp_path / "tiny.mcap", storage_mcap.zstd.compress
    schema, channel = struct.pack("<HIII", 1, 0, 0, 0), struct.pack("<HHIII", 1, 1, 0, 0, 0)
    known = struct.pack("<BQ", 3, 14) + schema + struct.pack("<BQ", 4, 16) + channel
    tiny = struct.pack("<BQ", 5, 22) + struct.pack("<HIQQ", 1, 0, 0, 0)
    chunks = (known + tiny * 10, *[tiny * 15_000] * 4)
    path.write_bytes(MAGIC + b"".join(chunk_of(c, compress) for c in chunks))
    within = (10**6 + 100 * path.stat().st_size - len(chunks[0])) // len(chunks[1])
    assert within < 4
    made = repair(path)
    assert made.messages[""] == 10 + 15_000 * within
    assert sum("unpacks to 100 times its" in what for what in made.lost) == 4 - within
