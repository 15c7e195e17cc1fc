"""Messages of an MCAP file come as rosbags would hand them on, in less time."""

from __future__ import annotations

import numpy as np
import pytest
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.rosbag2 import Reader, ReaderError

from omsm_ros.io.bag_checks import MessageReader

COMPRESSIONS = [CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD]


def write(path, times, compression=CompressionType.NONE, **options):
    """Messages on two topics, recorded at ``times`` in that order."""
    random = np.random.default_rng(2)
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=2000, compression=compression, **options)
        writer.start("ros2")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        channels = [writer.register_channel(f"/{name}", "cdr", schema) for name in "ab"]
        for time in times:
            data = bytes(random.integers(0, 256, random.integers(0, 90), np.uint8))
            writer.add_message(channels[random.integers(2)], int(time), data, int(time))
        writer.finish()
    return path


def read(reader, path, topics, *span):
    with reader(path) as bag:
        wanted = [c for c in bag.connections if c.topic in topics]
        return [(c.topic, time, bytes(raw)) for c, time, raw in bag.messages(wanted, *span)]


TIMES = {
    "in order": np.arange(1000) * 10,
    "of one time": np.arange(1000) // 50,
    "late by some": np.arange(1000) * 10 + np.random.default_rng(1).integers(0, 900, 1000),
    "backwards": np.arange(1000)[::-1] * 10,
}


@pytest.mark.parametrize("name", TIMES)
@pytest.mark.parametrize("compression", COMPRESSIONS)
@pytest.mark.parametrize("span", [(), (2000, 5000), (None, 4), (9990, None)])
def test_messages_are_those_of_rosbags_in_their_order(tmp_path, name, compression, span):
    path = write(tmp_path / "a.mcap", TIMES[name], compression)
    for topics in ("/a", ["/a", "/b"]):
        assert read(MessageReader, path, topics, *span) == read(Reader, path, topics, *span)
    assert len(read(MessageReader, path, ["/a", "/b"])) == 1000


def test_a_file_without_index_is_read_too(tmp_path):
    options = dict.fromkeys(("use_summary_offsets", "repeat_channels", "repeat_schemas"), False)
    path = write(tmp_path / "a.mcap", TIMES["in order"], index_types=IndexType.NONE, **options)
    with MessageReader(path) as bag:
        assert not bag.storage.chunks
    assert len(read(MessageReader, path, ["/a", "/b"])) == 1000


@pytest.mark.parametrize("damage", ["length", "short message"])
def test_a_record_that_does_not_fit_its_chunk_is_an_error(tmp_path, damage):
    path = write(tmp_path / "a.mcap", TIMES["in order"], enable_crcs=False)
    with Reader(path) as bag:
        chunk = bag.storage.chunks[3]
    whole = bytearray(path.read_bytes())
    first = chunk.chunk_start_offset + 9 + 40
    length = first + 1
    whole[length : length + 8] = (10**6 if damage == "length" else 3).to_bytes(8, "little")
    path.write_bytes(whole)
    with pytest.raises(ReaderError, match=r"beyond its chunk|has no head"):
        read(MessageReader, path, ["/a", "/b"])
