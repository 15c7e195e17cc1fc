"""Copies the valid messages of a damaged or incomplete recording into a new bag.

Each complete chunk with a valid checksum is copied message by message; messages that no command
can read are left out. The new bag has an index.
"""

import os
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from struct import unpack, unpack_from
from typing import IO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import breakup_chunk
from mcap.writer import MCAP0_MAGIC, Writer

from omsm_ros.errors import BagError
from omsm_ros.io.bag_checks import MAX_CHUNK_BYTES, check_unpacked, unpacked_chunk, unpacked_message
from omsm_ros.io.bag_writer import GrowingFile, finish, new_bag_file, new_writer
from omsm_ros.io.bags import check_message
from omsm_ros.io.files import exception_text, explained_errors, open_regular
from omsm_ros.io.message_mapping import typestore
from omsm_ros.io.topics import TOPIC_TYPES

_HEAD_BYTES = 9
# A chunk record adds two times, sizes, a checksum and a name.
_MOST_BYTES = MAX_CHUNK_BYTES + 1000
_MOST_NAMED = 20
# The beginning of a message that rosbag2 compressed; a serialised message begins with a zero.
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
# The name under which rosbag2 stores the hash of a channel's type.
_TYPE_HASH = "topic_type_hash"


@dataclass
class Repair:
    """The result of a repair.

    path: of the new bag;  messages: copied, by topic;  lost: the first twenty losses and their
    reasons;  unnamed: the number of further losses
    """

    path: Path
    messages: Counter[str] = field(default_factory=Counter)
    lost: list[str] = field(default_factory=list)
    unnamed: int = 0


def repair(path: Path) -> Repair:
    """Copy the valid messages of an MCAP bag, a file or folder, to ``<its name>.repaired.mcap``.

    Raises BagError if that exists, or if ``path`` is no MCAP bag or has no valid message, and then
    leaves no file; ``path`` itself is only read.
    """
    parts = [path]
    if path.is_dir():  # with files _0, _1, … _10
        numbers = {part: part.stem.rpartition("_")[2] for part in path.glob("*.mcap")}
        parts = sorted(numbers, key=lambda p: (int(numbers[p]) if numbers[p].isdecimal() else 0, p))
    if not parts:
        raise BagError(
            f"{str(path)!r} holds no .mcap file; only MCAP is repaired, "
            "for sqlite3 use 'ros2 bag reindex'"
        )
    whole = Path(os.path.abspath(path))
    made = Repair(whole.with_name(f"{whole.stem}.repaired.mcap"))
    with open_regular(parts[0], BagError, "bag") as stream:
        _check_magic(stream, parts[0])
    file = new_bag_file(made.path)
    try:
        _copy(parts, file, made)
    except BaseException:
        made.path.unlink()
        raise
    finally:
        file.close()
    return made


def _copy(parts: list[Path], file: GrowingFile, made: Repair) -> None:
    with explained_errors(f"cannot write {str(made.path)!r}", "make room", BagError, OSError):
        writer = new_writer(file)
        for part in parts:
            _Copy(part, writer, made).run(file.flush)
        finish(writer, file)
    if not made.messages:
        why = made.lost[0] if made.lost else "nothing was recorded"
        raise BagError(f"{str(parts[0])!r} has no whole message to save ({why}); record it again")


def _check_magic(stream: IO[bytes], path: Path) -> None:
    if stream.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
        raise BagError(f"{str(path)!r} is no MCAP file: it has another beginning; check the path")


class _Copy:
    """Copies one file into a bag; channels and definitions get the numbers of that bag."""

    def __init__(self, path: Path, writer: Writer, made: Repair) -> None:
        self._path, self._writer, self._made = path, writer, made
        self._schemas: dict[int, tuple[int, str]] = {0: (0, "")}
        self._channels: dict[int, tuple[int, str, str]] = {}
        self._unpacked = 0

    def run(self, written: Callable[[], None]) -> None:
        with open_regular(self._path, BagError, "bag") as stream:
            _check_magic(stream, self._path)
            for place, kind, body in self._records(stream):
                try:
                    for record in self._within(kind, body):
                        self._add(record)
                except Exception as err:  # the libraries raise many kinds
                    self._record_lost(f"{len(body)} bytes at {place}: {exception_text(err)}")
                written()

    def _records(self, stream: IO[bytes]) -> Iterator[tuple[int, int, bytes]]:
        while True:
            place = stream.tell()
            head = stream.read(_HEAD_BYTES)
            kind, length = unpack("<BQ", head) if len(head) == _HEAD_BYTES else (0, 0)
            if kind == Opcode.DATA_END:
                return
            body = stream.read(min(length, _MOST_BYTES))
            if not kind or len(body) < length:
                rest = len(head) + len(body)
                self._record_lost(
                    f"the last {rest} bytes, at {place}: the file was cut short there"
                )
                return
            yield place, kind, body

    def _within(self, kind: int, body: bytes) -> list[McapRecord]:
        """Return definitions, channels and messages of a record; any exception if it is damaged."""
        stream = ReadDataStream(BytesIO(body))
        if kind == Opcode.SCHEMA:
            return [Schema.read(stream)]
        if kind == Opcode.CHANNEL:
            return [Channel.read(stream)]
        if kind == Opcode.MESSAGE:
            return [Message.read(stream, len(body))]
        if kind != Opcode.CHUNK:
            return []
        chunk = Chunk.read(stream)
        self._unpacked += chunk.uncompressed_size
        check_unpacked(self._path, self._path.stat().st_size, self._unpacked)
        chunk.data = unpacked_chunk(
            chunk.data, chunk.compression, chunk.uncompressed_size, chunk.uncompressed_crc
        )
        chunk.compression = ""
        _check_records(chunk.data)
        return breakup_chunk(chunk)

    def _add(self, record: McapRecord) -> None:
        if isinstance(record, Schema) and record.id not in self._schemas:
            number = self._writer.register_schema(record.name, record.encoding, record.data)
            self._schemas[record.id] = number, record.name
        elif isinstance(record, Channel) and record.id not in self._channels:
            schema, kind = self._schemas[record.schema_id]
            ours = typestore().hash_rihs01(kind) if kind in TOPIC_TYPES.values() else None
            if record.metadata.get(_TYPE_HASH) not in (None, ours):
                kind = ""  # of another definition, so messages cannot be checked
            number = self._writer.register_channel(
                record.topic, record.message_encoding, schema, record.metadata
            )
            self._channels[record.id] = number, record.topic, kind
        elif isinstance(record, Message):
            if record.channel_id not in self._channels:
                raise ValueError(f"channel {record.channel_id} was declared in a lost part")
            self._add_message(record, *self._channels[record.channel_id])

    def _add_message(self, record: Message, number: int, topic: str, kind: str) -> None:
        try:
            data = record.data
            if data.startswith(_ZSTD_MAGIC):  # stated only in metadata.yaml, which is not copied
                data = unpacked_message(data)
            check_message(topic, kind, data)
        except Exception as err:  # the libraries raise many kinds
            self._record_lost(
                f"a message of {topic!r} at {record.log_time} ns: {exception_text(err)}"
            )
            return
        self._writer.add_message(
            number, record.log_time, data, record.publish_time, record.sequence
        )
        self._made.messages[topic] += 1

    def _record_lost(self, what: str) -> None:
        if len(self._made.lost) < _MOST_NAMED:
            self._made.lost.append(f"{self._path.name}: {what}")
        else:
            self._made.unnamed += 1


def _check_records(data: bytes) -> None:
    """Raise ValueError for a chunk with a record of kind 0: usually a run of zeros."""
    place = 0
    while place <= len(data) - _HEAD_BYTES:
        kind, length = unpack_from("<BQ", data, place)
        if not kind:
            raise ValueError(f"a record of no kind at {place} of a chunk")
        place += _HEAD_BYTES + length
