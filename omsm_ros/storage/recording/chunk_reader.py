"""Messages of an indexed MCAP file, a chunk at a time.

rosbags makes two streams and reads five times for a message; of a long recording that took longer
than anything else that is done with its bytes. What is in a chunk is walked through here by the
lengths of its records (mcap.dev/spec, "Chunk (op=0x06)", "Message (op=0x05)").
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Collection, Iterator, Mapping
from operator import itemgetter
from os import SEEK_CUR
from struct import Struct
from typing import Any, TypeAlias

from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader, ReaderError
from rosbags.rosbag2.reader import DirectoryReader
from rosbags.rosbag2.storage_mcap import McapReader, decompress

_MESSAGE = 0x05
_RECORD = Struct("<BQ")  # kind, length of what follows
_MESSAGE_HEAD = Struct("<HIQQ")  # channel, sequence, when it was recorded, when published
_CHUNK_HEAD = Struct("<BQQQQI")  # record, first and last time, length unpacked, checksum
# Between that and what is packed: length of the compression's name, the name, and its own length.
_LENGTHS_BYTES = 4 + 8

# When it was recorded, place of its chunk, connection, message.
_Waiting: TypeAlias = "tuple[int, int, Connection, bytes]"
_TIME, _PLACE = 0, 1
_HANDED_ON = itemgetter(2, _TIME, 3)


class ChunkReader(McapReader):  # type: ignore[misc]
    """An MCAP file; one without index is read as rosbags does."""

    def messages(
        self,
        connections: Collection[Connection],
        start: int | None = None,
        stop: int | None = None,
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield ``(connection, when recorded [ns], message)`` by that time, then by their place.

        start, stop: the first instant, and the first that is left out [ns]
        """
        if not self.chunks:
            yield from super().messages(connections, start, stop)
            return
        wanted = {connection.id: connection for connection in connections}
        waiting: list[_Waiting] = []
        for chunk in sorted(
            self.chunks, key=lambda c: (c.message_start_time, c.chunk_start_offset)
        ):
            begin, end = chunk.message_start_time, chunk.message_end_time + 1
            first, last = (begin if start is None else start), (end if stop is None else stop)
            if first >= end or begin >= last or not any(map(chunk.channel_count.get, wanted)):
                continue
            before = bisect_left(waiting, begin, key=itemgetter(_TIME))
            yield from map(_HANDED_ON, waiting[:before])
            waiting[:before] = self._within(chunk, wanted, first, last)
            # Stable: those of one chunk and time stay in their order.
            waiting.sort(key=itemgetter(_TIME, _PLACE))
        yield from map(_HANDED_ON, waiting)

    def _within(
        self, chunk: Any, wanted: Mapping[int, Connection], first: int, last: int
    ) -> Iterator[_Waiting]:
        """Yield what a chunk holds on the ``wanted`` channels from ``first`` to before ``last``."""
        records, place, at = self._records(chunk), chunk.chunk_start_offset, 0
        while at < len(records):
            kind, length = _RECORD.unpack_from(records, at)
            body, at = at + _RECORD.size, at + _RECORD.size + length
            if at > len(records):
                raise ReaderError(f"a record of {length} bytes reaches beyond its chunk at {place}")
            if kind == _MESSAGE:
                if length < _MESSAGE_HEAD.size:
                    raise ReaderError(f"a message of {length} bytes has no head")
                channel, _, time, _ = _MESSAGE_HEAD.unpack_from(records, body)
                if first <= time < last and channel in wanted:
                    yield time, place, wanted[channel], records[body + _MESSAGE_HEAD.size : at]

    def _records(self, chunk: Any) -> bytes:
        assert self.bio is not None
        self.bio.seek(chunk.chunk_start_offset)
        checksum = _CHUNK_HEAD.unpack(self.bio.read(_CHUNK_HEAD.size))[-1]
        self.bio.seek(_LENGTHS_BYTES + len(chunk.compression), SEEK_CUR)
        packed = self.bio.read(chunk.compressed_size)
        if len(packed) < chunk.compressed_size:
            raise ReaderError(f"the chunk at {chunk.chunk_start_offset} was cut short")
        unpacked: bytes = decompress(packed, chunk.compression, chunk.uncompressed_size, checksum)
        return unpacked


class _FolderReader(DirectoryReader):  # type: ignore[misc]
    STORAGE_PLUGINS = DirectoryReader.STORAGE_PLUGINS | {"mcap": ChunkReader}


class MessageReader(Reader):  # type: ignore[misc]
    """rosbags' reader of files and folders, with the other reader of MCAP files."""

    STORAGE_PLUGINS = Reader.STORAGE_PLUGINS | {".mcap": ChunkReader, "dir": _FolderReader}
