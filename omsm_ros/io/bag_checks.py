"""Checks bags from any source, and reads them in bounded memory.

The index of a bag may be wrong, its definitions of messages may differ from ours, and a few bytes
may unpack to gigabytes.
"""

from __future__ import annotations

from binascii import crc32
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from functools import lru_cache
from itertools import accumulate
from os import SEEK_END, fstat
from pathlib import Path
from struct import unpack_from
from types import SimpleNamespace
from typing import IO, Any

from lz4.frame import LZ4FrameDecompressor
from rosbags.interfaces import Connection, MessageDefinition, MessageDefinitionFormat, Qos
from rosbags.rosbag2 import Reader, ReaderError, storage_mcap, storage_sqlite3
from rosbags.rosbag2 import reader as bag_folder
from rosbags.rosbag2.metadata import parse_qos
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from omsm_ros.errors import BagError
from omsm_ros.io.files import library_errors, open_regular, read_text
from omsm_ros.io.json_and_yaml import has_aliases
from omsm_ros.quantities import shown

# rosbag2 writes chunks of less than a megabyte, Foxglove of four.
MAX_CHUNK_BYTES = 128 * 1024**2
MAX_MESSAGE_BYTES = 128 * 1024**2
# The footer with its places and checksum, and the magic bytes (mcap.dev/spec, "Footer (op=0x02)").
_RECORD_HEAD_BYTES, _CHECKED_END_BYTES, _END_BYTES = 9, 25, 37
_MAX_METADATA_BYTES = 1024**2
# A profile has 400 characters; a topic of a hundred publishers has a hundred of them.
_LONGEST_QOS = 100_000
# Chunks that overlap in time are held until their messages are in order; recorders overlap by one.
_MAX_HELD_BYTES = 1024**3
# Messages of ROS 2 have 100 lines on average; 25 000 lines take a second to parse.
_MOST_DEFINITION_LINES, _LONGEST_DEFINITION = 50_000, 50_000
_ADDRESS_ERRORS = frozenset("%?#")
_NO_DEFINITION = MessageDefinition(MessageDefinitionFormat.NONE, "")
# No recording has a compression ratio of 100; a large file with more was made to fill memory.
_MOST_PACKED, _ALWAYS_UNPACKED_BYTES = 100, 16 * 1024**2


DAMAGED = "it is damaged; save what is whole with 'omsm inspect --repair', or record it again"


def bag_errors(path: Path, remedy: str) -> AbstractContextManager[None]:
    """Raise BagError for any of the many exceptions that the libraries raise on a bag's bytes."""
    return library_errors(f"bag {str(path)!r}", remedy, BagError)


_ROS_1_MAGIC = b"#ROSBAG V"
_TABLES = (".csv", ".tsv", ".txt", ".npy", ".npz", ".mat", ".h5", ".hdf5", ".tdms")


def check_kind(path: Path) -> None:
    """Raise BagError for a file that needs ``omsm import``."""
    with open_regular(path, BagError, "bag") as stream:
        of_ros_1 = stream.read(len(_ROS_1_MAGIC)) == _ROS_1_MAGIC
    if of_ros_1 or path.suffix.lower() in _TABLES:
        kind = "a bag of ROS 1" if of_ros_1 else "a table, no bag"
        raise BagError(
            f"{str(path)!r} is {kind}; make a bag of it: 'omsm import FILE --map MAP.yaml --out "
            "BAG.mcap', where the map names its columns"
        )


def check_files(path: Path) -> None:
    """Raise BagError unless ``path`` is a regular file or a rosbag2 folder of regular files."""
    if path.is_dir() and not (path / "metadata.yaml").exists():
        raise BagError(
            f"{str(path)!r} is a folder without metadata.yaml, so no rosbag2 bag; give one of its "
            ".mcap files, or save an incomplete bag with 'omsm inspect --repair'"
        )
    for part in sorted(path.iterdir()) if path.is_dir() else [path]:
        if not part.is_dir():
            open_regular(part, BagError, "bag").close()
        if part.suffix == ".db3" and set(str(part)) & _ADDRESS_ERRORS:
            # rosbags makes a URI of the path, and would read another file.
            raise BagError(f"bag {str(part)!r} has one of '%?#' in its path; rename it")
    _check_metadata(path / "metadata.yaml")


def _check_metadata(path: Path) -> None:
    """Raise BagError for a description of a folder that is too long, or not plain YAML."""
    if path.is_file() and has_aliases(
        read_text(path, _MAX_METADATA_BYTES, BagError, "description of a bag")
    ):
        raise BagError(
            f"bag {str(path.parent)!r} has aliases or anchors in its metadata.yaml, which rosbag2 "
            "never writes; make it anew with 'ros2 bag reindex'"
        )


def _plain_qos(described: Any) -> list[Qos]:
    """Return the quality of service that a bag states of a topic; ReaderError if it has aliases."""
    text = described if isinstance(described, str) else ""
    if len(text) > _LONGEST_QOS or has_aliases(text):
        raise ReaderError("a topic states its quality of service in no way that rosbag2 does")
    return list(parse_qos(described))


def check_index(path: Path, reader: Reader) -> None:
    """Raise BagError for an index whose chunks are too large, or repeated."""
    storage = reader.storage
    for part in getattr(storage, "storages", [storage]):
        chunks = getattr(part, "chunks", [])
        places = {chunk.chunk_start_offset for chunk in chunks}
        largest = max((chunk.uncompressed_size for chunk in chunks), default=0)
        if len(places) < len(chunks) or largest > MAX_CHUNK_BYTES:
            raise BagError(
                f"bag {str(path)!r} has an index of {len(chunks)} chunks at {len(places)} places, "
                f"the largest of {largest} bytes, expected each once and at most "
                f"{MAX_CHUNK_BYTES} bytes; write it again with smaller chunks"
            )
        if chunks:
            total = sum(chunk.uncompressed_size for chunk in chunks)
            check_unpacked(path, part.path.stat().st_size, total)
            if (together := _held_together(chunks)) > _MAX_HELD_BYTES:
                raise BagError(
                    f"bag {str(path)!r} has chunks of {together} bytes that cover the same time, "
                    f"at most {_MAX_HELD_BYTES} are held at once; write it again in order of time"
                )


def _held_together(chunks: Sequence[Any]) -> int:
    """Return the most bytes of chunks whose times overlap, which a reader holds at once."""
    edges = [(c.message_start_time, 0, c.uncompressed_size) for c in chunks]
    edges += [(c.message_end_time, 1, -c.uncompressed_size) for c in chunks]
    return int(max(accumulate(size for _, _, size in sorted(edges))))


def check_checksums(path: Path) -> None:
    """Raise BagError if the index of an MCAP file does not match its checksum, if any."""
    for part in path.glob("*.mcap") if path.is_dir() else [path]:
        if part.suffix == ".mcap":
            with open_regular(part, BagError, "bag") as stream:
                _check_checksum(part, stream)


def _check_checksum(path: Path, stream: IO[bytes]) -> None:
    end_at = stream.seek(-_END_BYTES, SEEK_END)
    end = stream.read(_END_BYTES)
    start, _, checksum = unpack_from("<QQI", end, _RECORD_HEAD_BYTES)
    if not start or not checksum:
        return
    stream.seek(start)
    index = stream.read(max(end_at - start, 0))
    if crc32(index + end[:_CHECKED_END_BYTES]) != checksum:
        raise BagError(f"bag {str(path)!r} has an index that does not fit its checksum: {DAMAGED}")


def check_unpacked(path: Path, packed: int, unpacked: int) -> None:
    """Raise BagError if ``packed`` bytes unpack to more than those of any recording."""
    if unpacked > _MOST_PACKED * packed + _ALWAYS_UNPACKED_BYTES:
        raise BagError(
            f"bag {str(path)!r} unpacks to {_MOST_PACKED} times its {packed} bytes and more, which "
            "no recording does; record it again without compression"
        )


def check_length_of_definitions(path: Path) -> None:
    """Raise BagError for a ROS 2 bag whose definitions of messages take long to parse."""
    with Reader(path) as reader:
        lines = sum(c.msgdef.data.count("\n") for c in reader.connections)
    if lines > _MOST_DEFINITION_LINES:
        raise BagError(
            f"bag {str(path)!r} defines its messages in {lines} lines, at most "
            f"{_MOST_DEFINITION_LINES} are read; record the topics that are needed alone"
        )


def check_definition(path: Path, connection: Connection, ours: Typestore) -> None:
    """Raise BagError if the bag's definition of a message is not ours."""
    expected = ours.hash_rihs01(connection.msgtype)
    if len(connection.msgdef.data) > _LONGEST_DEFINITION:  # too long to parse; ours are short
        connection = connection._replace(msgdef=_NO_DEFINITION, digest="too long to be one")
    found = {connection.digest, _hash_of(connection.msgdef, connection.msgtype)} - {"", expected}
    if found:
        raise BagError(
            f"{connection.topic!r} in {str(path)!r} was recorded with another definition of "
            f"{connection.msgtype!r} ({found.pop()!r}, expected {expected!r}); record it again, or "
            "convert it"
        )


@lru_cache(maxsize=64)
def _hash_of(definition: MessageDefinition, name: str) -> str:
    """Return the hash RIHS01 of a definition in a bag; empty without one."""
    if definition.format is MessageDefinitionFormat.NONE:
        return ""
    store = get_typestore(Stores.EMPTY)
    if definition.format is MessageDefinitionFormat.MSG:
        store.register(get_types_from_msg(definition.data, name))
    else:
        store.register(get_types_from_idl(definition.data))
    return str(store.hash_rihs01(name))


def unpacked_message(data: bytes) -> bytes:
    """Return an unpacked message; ReaderError if it is too long."""
    return _zstd(data, MAX_MESSAGE_BYTES, exactly=False)


def unpacked_chunk(data: bytes, compression: str, size: int, checksum: int) -> bytes:
    """Return the records of a chunk; ReaderError if size or checksum do not match."""
    return bytes(storage_mcap.decompress(data, compression, size, checksum))


def _zstd(data: bytes, size: int, exactly: bool = True) -> bytes:
    return _bounded(storage_mcap.zstd.ZstdDecompressor().decompress, data, size, exactly)


def _bounded(decompress: Callable[..., bytes], data: bytes, size: int, exactly: bool) -> bytes:
    most = min(MAX_CHUNK_BYTES, _MOST_PACKED * len(data) + _ALWAYS_UNPACKED_BYTES)
    if exactly and size > most:
        raise ReaderError(
            f"a chunk of {len(data)} bytes claims {size} when unpacked, at most {most} are accepted"
        )
    raw = decompress(data, max_length=size + 1)
    if len(raw) > size or (exactly and len(raw) < size):
        raise ReaderError(f"a chunk claims {size} bytes and does not unpack to that many")
    return raw


@contextmanager
def _open_unpacked(packed: IO[bytes], mode: str) -> Iterator[Any]:
    """Open a compressed file; its ``read`` raises BagError where there are too many bytes."""
    size, total = fstat(packed.fileno()).st_size, 0

    def read(wanted: int) -> bytes:
        nonlocal total
        part: bytes = stream.read(wanted)
        total += len(part)
        check_unpacked(Path(packed.name), size, total)
        return part

    with storage_mcap.zstd.open(packed, mode) as stream:
        yield SimpleNamespace(read=read)


def _check_tables(base: Any) -> None:
    """Raise BagError for a database with computed columns, which can be of any size."""
    base.limit(storage_sqlite3.apsw.SQLITE_LIMIT_LENGTH, MAX_CHUNK_BYTES)
    computed = "SELECT m.name FROM sqlite_master m, pragma_table_xinfo(m.name) c WHERE c.hidden > 0"
    for (name,) in base.execute(computed):
        raise BagError(f"table {shown(name)} of the bag computes its columns; record it again")


storage_sqlite3.apsw.connection_hooks.append(_check_tables)
# rosbags checks sizes only after unpacking.
storage_mcap.DECOMPRESSORS |= {
    "zstd": _zstd,
    "lz4": lambda data, size: _bounded(LZ4FrameDecompressor().decompress, data, size, True),
}
bag_folder.zstd = SimpleNamespace(open=_open_unpacked, decompress=unpacked_message)
# A few bytes of nested aliases become gigabytes when an error message shows them.
for _module in (bag_folder, storage_mcap, storage_sqlite3):
    _module.parse_qos = _plain_qos
