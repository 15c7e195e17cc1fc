"""Writes bags: one ``.mcap`` file, which ``ros2 bag`` and Foxglove open.

MCAP readers begin with the end of a file (mcap.dev/spec, "Footer (op=0x02)"). So an end without
index is written behind each piece, and overwritten by the next piece: whenever the writer is
stopped, the file is valid and readers scan it. Since the place of the end is taken first, a full
disk leaves a valid file too.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from mcap.data_stream import RecordBuilder
from mcap.records import ChunkIndex, DataEnd, Footer
from mcap.well_known import MessageEncoding, Profile, SchemaEncoding
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from omsm_ros.core.streams.blocks import AccelerationBlock, AxisBlock, Block, DistanceBlock
from omsm_ros.errors import BagError
from omsm_ros.io import message_mapping
from omsm_ros.io.files import exception_text, make_folder, temporary_sibling
from omsm_ros.io.message_mapping import bag_messages, typestore
from omsm_ros.io.topics import (
    ACCELERATION_TOPIC,
    AXES_TOPIC,
    DISTANCE_TOPIC,
    LATCHED_DEPTH,
    LATCHED_TOPICS,
    SAMPLES_DEPTH,
    TOPIC_TYPES,
)


def _end_without_index() -> bytes:
    builder = RecordBuilder()
    DataEnd(data_section_crc=0).write(builder)
    Footer(summary_start=0, summary_offset_start=0, summary_crc=0).write(builder)
    return bytes(builder.end() + MCAP0_MAGIC)


END = _end_without_index()


class GrowingFile:
    """The file of an ``mcap.writer.Writer``; nothing is on the disk before :meth:`flush`.

    Raises OSError if the file, or a link of its name, exists or cannot be created.
    """

    def __init__(self, path: Path) -> None:
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
        self._descriptor = os.open(path, flags, 0o666)
        self._written = 0
        self._waiting = bytearray()

    @property
    def waiting(self) -> int:
        """Return the number of bytes that are not on the disk yet."""
        return len(self._waiting)

    def write(self, data: bytes) -> None:
        """Take the next bytes."""
        self._waiting += data

    def tell(self) -> int:
        """Return the number of bytes taken so far."""
        return self._written + len(self._waiting)

    def flush(self, end: bytes = END) -> None:
        """Write the waiting bytes and an ``end``, or none of them: OSError without space.

        end: empty for bytes that have their own
        """
        if not self._waiting:
            return
        piece, self._waiting = self._waiting, bytearray()
        try:
            self._put(piece + end)
        except OSError:
            if self._written:
                self._put(END)
                os.ftruncate(self._descriptor, self._written + len(END))
            raise
        self._written += len(piece)

    def _put(self, data: bytes | bytearray) -> None:
        rest, place = memoryview(data), self._written
        while rest:
            count = os.pwrite(self._descriptor, rest, place)
            rest, place = rest[count:], place + count

    def close(self) -> None:
        """Close the file after it is on the medium."""
        try:
            os.fsync(self._descriptor)
        finally:
            os.close(self._descriptor)


_BLOCK_TOPICS = {
    AxisBlock: AXES_TOPIC, DistanceBlock: DISTANCE_TOPIC, AccelerationBlock: ACCELERATION_TOPIC,
}  # fmt: skip
# A crash loses at most one chunk; smaller chunks are slower to read.
CHUNK_BYTES = 1024 * 1024
_INDEX_PIECE_BYTES = 32 * 1024

# The form of rosbag2 9; the times mean infinity.
_FOREVER = "{{sec: 9223372036, nsec: 854775807}}"
_OFFERED_QOS = f"""\
- history: keep_last
  depth: {{depth}}
  reliability: reliable
  durability: {{durability}}
  deadline: {_FOREVER}
  lifespan: {_FOREVER}
  liveliness: automatic
  liveliness_lease_duration: {_FOREVER}
  avoid_ros_namespace_conventions: false
"""


class BagWriter:
    """Writes one ``.mcap`` file; all messages that were flushed stay readable.

    It is a context manager; after any exit the bag is readable.

    path: a file that does not exist yet; BagError if it does, or cannot be created
    topics: of the contract;  names: in the bag, if they differ from the contract
    """

    def __init__(
        self, path: Path | str, topics: Sequence[str], names: Mapping[str, str] | None = None
    ) -> None:
        self.path = Path(path)
        self._names = {topic: (names or {}).get(topic, topic) for topic in topics}
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._taken = self._kept = 0
        self._failed = False

    def __enter__(self) -> BagWriter:
        self._file = new_bag_file(self.path)
        self._writer = new_writer(self._file)
        try:
            with self._room():
                self._file.flush()
        except BagError:
            self.path.unlink()
            raise
        for topic, name in self._names.items():
            self._channels[topic] = self._channel(name, topic)
        return self

    def _channel(self, name: str, topic: str) -> int:
        kind, latched = TOPIC_TYPES[topic], topic in LATCHED_TOPICS
        if kind not in self._schemas:
            text, _ = typestore().generate_msgdef(kind, ros_version=2)
            self._schemas[kind] = self._writer.register_schema(
                kind, SchemaEncoding.ROS2, text.encode()
            )
        qos = _OFFERED_QOS.format(
            depth=LATCHED_DEPTH if latched else SAMPLES_DEPTH,
            durability="transient_local" if latched else "volatile",
        )
        metadata = {"offered_qos_profiles": qos, "topic_type_hash": typestore().hash_rihs01(kind)}
        return self._writer.register_channel(
            name, MessageEncoding.CDR, self._schemas[kind], metadata
        )

    def write_raw(
        self, topic: str, stamp_ns: int, cdr: bytes | memoryview, published_ns: int | None = None
    ) -> None:
        """Append one serialised message that was received at ``stamp_ns``.

        Raises BagError without space on the disk, or for a stamp before 1970, which a bag cannot
        hold; messages written before stay readable.
        """
        if self._failed:
            return
        published = stamp_ns if published_ns is None else published_ns
        if (earliest := min(stamp_ns, published)) < 0:
            raise BagError(
                f"{topic!r}: the stamp {earliest} ns is before 1970, which no bag can hold; give "
                "times since 1970, or a later start"
            )
        self._writer.add_message(self._channels[topic], stamp_ns, bytes(cdr), published)
        self._taken += 1
        if self._file.waiting:  # a chunk is full
            self.flush()

    def flush(self) -> None:
        """Write all messages so far to the disk; BagError without space."""
        if self._failed:
            return
        with self._room():
            self._writer.flush()
        self._kept = self._taken

    @contextmanager
    def _room(self) -> Iterator[None]:
        try:
            yield
        except OSError as err:
            self._failed = True
            raise BagError(
                f"recording ended, {str(self.path)!r} takes no more: {exception_text(err)}; it is "
                f"readable and holds the first {self._kept} messages, the last "
                f"{self._taken - self._kept} are lost; make room and record again"
            ) from err

    def write(self, topic: str, stamp_ns: int, message: object) -> None:
        """Append one message of a class of :func:`bag_messages`."""
        self.write_raw(topic, stamp_ns, typestore().serialize_cdr(message, TOPIC_TYPES[topic]))

    def write_block(self, block: Block, topic: str = "") -> None:
        """Append a block at its own stamp, on the topic of its kind or of another sensor."""
        message = message_mapping.block_message(bag_messages(), block)
        self.write(topic or _BLOCK_TOPICS[type(block)], block.stamp_ns, message)

    def __exit__(self, *_: object) -> None:
        try:
            self.flush()
            if not self._failed:
                with self._room():
                    finish(self._writer, self._file)
        finally:
            with self._room():
                self._file.close()


@contextmanager
def atomic_bag(path: Path, topics: Sequence[str]) -> Iterator[BagWriter]:
    """Yield the writer of a bag that appears only if no exception is raised.

    Raises BagError if the file exists, or without space on the disk.
    """
    if os.path.lexists(path):
        raise _exists(path)
    part = temporary_sibling(path)
    try:
        with BagWriter(part, topics) as bag:
            yield bag
        part.rename(path)
    except (BagError, OSError) as err:
        cause = err.__cause__ if isinstance(err, BagError) else err
        if not isinstance(cause, OSError):
            raise
        raise _not_writable(path, cause) from err
    finally:
        part.unlink(missing_ok=True)


def new_bag_file(path: Path) -> GrowingFile:
    """Create the file of a bag; BagError if it exists or cannot be created."""
    try:
        make_folder(path.parent)
        return GrowingFile(path)
    except FileExistsError as err:
        raise _exists(path) from err
    except (OSError, ValueError) as err:
        raise _not_writable(path, err) from err


def next_free(path: Path) -> Path:
    """Return the first of ``path``, path.2, path.3, … (before the suffix) that does not exist."""
    tried, number = path, 1
    while os.path.lexists(tried):
        number += 1
        tried = path.with_name(f"{path.stem}.{number}{path.suffix}")
    return tried


def _exists(path: Path) -> BagError:
    return BagError(
        f"{str(path)!r} exists and is not overwritten; give another name, or move it away"
    )


def _not_writable(path: Path, err: Exception) -> BagError:
    return BagError(
        f"cannot write {str(path)!r}: {exception_text(err)}; check the folder, its rights and its "
        "room"
    )


def new_writer(file: GrowingFile) -> Writer:
    """Begin an MCAP file of ROS 2, with checksums and uncompressed: samples are noise."""
    writer = Writer(file, chunk_size=CHUNK_BYTES, compression=CompressionType.NONE)  # type: ignore[arg-type]
    # Its list keeps a kilobyte for each chunk: at two chunks a second, 200 MB a day.
    writer._Writer__chunk_indices = _PackedIndex()  # type: ignore[attr-defined]
    writer.start(Profile.ROS2, "omsm_ros")
    return writer


class _PackedIndex:
    """The index of the chunks as compressed bytes: a quarter of a megabyte an hour."""

    def __init__(self) -> None:
        self._builder, self._recent = RecordBuilder(), bytearray()
        self._packed: list[bytes] = []

    def append(self, index: ChunkIndex) -> None:
        """Add the record of a chunk."""
        index.write(self._builder)
        self._recent += self._builder.end()
        if len(self._recent) >= _INDEX_PIECE_BYTES:
            self._packed.append(zlib.compress(self._recent))
            self._recent = bytearray()

    def __iter__(self) -> Iterator[_PackedIndex]:
        yield self

    def write(self, stream: RecordBuilder) -> None:
        """Write all records."""
        for piece in self._packed:
            stream.write(zlib.decompress(piece))
        stream.write(bytes(self._recent))


def finish(writer: Writer, file: GrowingFile) -> None:
    """Write the index; OSError without space, and then the bag is readable without index."""
    writer.finish()
    file.flush(b"")
