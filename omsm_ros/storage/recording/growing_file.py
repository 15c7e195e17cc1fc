"""A recording that can be read at every moment at which it is not just being written to.

MCAP readers look for the end of a file first (mcap.dev/spec, "Footer (op=0x02)"). So the end is
written behind every piece and overwritten by the next one. Whatever ends the writer between two
pieces leaves a whole file without an index, which readers scan; a full disk or a limit of size
leaves it too, for the place of the end was taken before.
"""

from __future__ import annotations

import os
from pathlib import Path

from mcap.data_stream import RecordBuilder
from mcap.records import DataEnd, Footer
from mcap.writer import MCAP0_MAGIC


def _end_without_index() -> bytes:
    builder = RecordBuilder()
    DataEnd(data_section_crc=0).write(builder)
    Footer(summary_start=0, summary_offset_start=0, summary_crc=0).write(builder)
    return builder.end() + MCAP0_MAGIC


END = _end_without_index()


class GrowingFile:
    """What an ``mcap.writer.Writer`` writes to; nothing is on the disk before :meth:`flush`.

    OSError if the file exists (as a link, too), or cannot be made.
    """

    def __init__(self, path: Path) -> None:
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
        self._descriptor = os.open(path, flags, 0o666)
        self._written = 0
        self._waiting = bytearray()

    @property
    def waiting(self) -> int:
        """Bytes that are not on the disk yet."""
        return len(self._waiting)

    def write(self, data: bytes) -> None:
        """Take the next bytes."""
        self._waiting += data

    def tell(self) -> int:
        """Return the bytes taken so far."""
        return self._written + len(self._waiting)

    def flush(self) -> None:
        """Write what waits, and an end; OSError if there is no room, and then none of it."""
        self._append(END)

    def complete(self) -> None:
        """Write what waits, which has an end of its own; OSError as :meth:`flush`."""
        self._append(b"")

    def _append(self, end: bytes) -> None:
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

    def _put(self, data: bytes) -> None:
        rest, place = memoryview(data), self._written
        while rest:
            count = os.pwrite(self._descriptor, rest, place)
            rest, place = rest[count:], place + count

    def close(self) -> None:
        """Close the file once it is on the medium itself."""
        try:
            os.fsync(self._descriptor)
        finally:
            os.close(self._descriptor)
