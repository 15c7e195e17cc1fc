"""Packets of a CHRocodile 2, in any portions → commands, data formats and samples."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omsm_ros.errors import ProtocolError
from omsm_ros.protocols.chrocodile_packet import (
    COMMAND,
    DATA,
    DATA_BODY,
    FIXED_POINT,
    HEADER,
    KINDS,
    MAGIC_BYTES,
    MAX_PACKET_BYTES,
    NUMBER,
    TIME_OFFSET,
    Data,
    DataFormat,
    Message,
    decode_command,
    decode_format,
)
from omsm_ros.protocols.chrocodile_telegram import Records
from omsm_ros.units import NANOSECONDS_PER_S


@dataclass(frozen=True, slots=True)
class PacketStatistics:
    """What became of every byte: ``received = in packets + discarded + pending``.

    packets: understood;  malformed: whose inside made no sense
    unformatted: samples without the format that says what they hold
    """

    bytes_received: int
    bytes_discarded: int
    bytes_pending: int
    packets: int
    malformed: int
    unformatted: int


class PacketDecoder:
    """Bytes in any portions → messages; nothing raises, memory is one packet and a portion.

    Messages are a function of the bytes alone, however they were cut. So samples wait until
    the next packet has begun, or for :meth:`settle`; commands and formats do not.
    """

    def __init__(self) -> None:
        self._buffer = b""
        self._formats: dict[int, DataFormat] = {}
        self._received = self._understood = self._packets = 0
        self._malformed = self._unformatted = 0

    def reset(self) -> None:
        """Forget an unfinished packet and all formats, as after connecting anew."""
        self._buffer = b""
        self._formats.clear()

    def feed(self, data: bytes) -> list[Message]:
        """Return messages completed by ``data``; neighbouring samples of one format in one."""
        self._received += len(data)
        self._buffer += data
        found: list[Message] = []
        waiting: list[tuple[bytes, int, int]] = []
        start = 0
        while (place := self._buffer.find(MAGIC_BYTES, start)) >= 0:
            length = self._length(place)
            if length is None:
                start = place
                break
            start = place + (self._open(place, length, found, waiting) if length else 1)
        else:
            start = max(start, len(self._buffer) - len(MAGIC_BYTES) + 1)
        self._flush(found, waiting)
        self._buffer = self._buffer[start:]
        return found

    def settle(self) -> list[Message]:
        """Return the packet that waited for what follows it, now that nothing does."""
        size = len(self._buffer)
        if not (self._buffer.startswith(MAGIC_BYTES) and self._length(0, last=True) == size):
            return []
        found: list[Message] = []
        waiting: list[tuple[bytes, int, int]] = []
        self._buffer = self._buffer[self._open(0, size, found, waiting) :]
        self._flush(found, waiting)
        return found

    @property
    def statistics(self) -> PacketStatistics:
        """Return what became of every byte."""
        return PacketStatistics(
            bytes_received=self._received,
            bytes_discarded=self._received - self._understood - len(self._buffer),
            bytes_pending=len(self._buffer),
            packets=self._packets,
            malformed=self._malformed,
            unformatted=self._unformatted,
        )

    def _length(self, place: int, *, last: bool = False) -> int | None:
        """Return the length of the packet at ``place``; 0 = it is none; None = wait for more.

        last: nothing follows it
        """
        if place + HEADER.size > len(self._buffer):
            return None
        length: int
        _, length, kind = HEADER.unpack_from(self._buffer, place)
        if not _is_head(length, kind) or self._cut_off(place, place + length, kind):
            return 0
        end = place + length
        if end > len(self._buffer):
            return None
        after = self._buffer[end : end + len(MAGIC_BYTES)]
        if kind != DATA or after == MAGIC_BYTES or (last and not after):
            return length
        # Samples have no check of their own; what follows shows whether they are too many or few.
        return None if MAGIC_BYTES.startswith(after) else 0

    def _cut_off(self, place: int, end: int, kind: int) -> bool:
        """Return whether the next packet begins inside the one up to ``end``: its end is missing.

        What cannot be told from the bytes before ``end`` is not: bytes that are not here yet
        must not change the answer. Only samples wait for what follows them; in the end of the
        others the magic alone counts.
        """
        inside = self._buffer.find(MAGIC_BYTES, place + len(MAGIC_BYTES), end)
        while 0 <= inside <= len(self._buffer) - HEADER.size and inside <= end - HEADER.size:
            _, size, other = HEADER.unpack_from(self._buffer, inside)
            if _is_head(size, other):
                return True
            inside = self._buffer.find(MAGIC_BYTES, inside + 1, end)
        return kind != DATA and inside > end - HEADER.size

    def _open(
        self, place: int, length: int, found: list[Message], waiting: list[tuple[bytes, int, int]]
    ) -> int:
        """Understand the packet at ``place``; how many bytes to go on."""
        body = self._buffer[place + HEADER.size : place + length]
        (kind,) = NUMBER.unpack_from(self._buffer, place + HEADER.size - 4)
        try:
            self._understand(kind, body, found, waiting)
        except (ProtocolError, struct.error):
            self._malformed += 1
            return 1
        self._packets += 1
        self._understood += length
        return length

    def _understand(
        self, kind: int, body: bytes, found: list[Message], waiting: list[tuple[bytes, int, int]]
    ) -> None:
        if kind == DATA:
            self._data(body, found, waiting)
            return
        self._flush(found, waiting)
        if kind == COMMAND:
            found.append(decode_command(body))
        else:
            form = decode_format(body)
            self._formats[form.stream] = form
            found.append(form)

    def _data(
        self, body: bytes, found: list[Message], waiting: list[tuple[bytes, int, int]]
    ) -> None:
        stream, counter, fixed, count = DATA_BODY.unpack_from(body)
        form = self._formats.get(stream)
        if count < 0:
            raise ProtocolError(f"data packet of {count!r} samples")
        if form is None or form.counter != counter:
            self._unformatted += count
            return
        payload = body[DATA_BODY.size :]
        if not 0 <= len(payload) - count * form.dtype.itemsize < 4:  # padded, at most
            raise ProtocolError(f"{count!r} samples in {len(payload)} bytes")
        if waiting and waiting[0][2] != stream:
            self._flush(found, waiting)
        time_ns = fixed * NANOSECONDS_PER_S // FIXED_POINT
        waiting.append((payload[: count * form.dtype.itemsize], time_ns, stream))

    def _flush(self, found: list[Message], waiting: list[tuple[bytes, int, int]]) -> None:
        """Join the samples that wait into one message."""
        if not waiting:
            return
        form = self._formats[waiting[0][2]]
        size = form.dtype.itemsize
        records = np.frombuffer(b"".join(payload for payload, _, _ in waiting), form.dtype)
        counts = np.array([len(payload) // size for payload, _, _ in waiting])
        starts = np.repeat([time_ns for _, time_ns, _ in waiting], counts).astype(np.int64)
        within = np.arange(len(records)) - np.repeat(np.cumsum(counts) - counts, counts)
        waiting.clear()
        found.append(Data(form, records, starts + _after(form, records, within)))


def _is_head(length: int, kind: int) -> bool:
    return kind in KINDS and HEADER.size < length <= MAX_PACKET_BYTES


def _after(form: DataFormat, records: Records, within: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the time after the packet's [ns] of the ``within``-th sample of a packet."""
    if str(TIME_OFFSET) in (records.dtype.names or ()):
        fraction = records[str(TIME_OFFSET)].astype(np.float64) / FIXED_POINT
        return np.rint(fraction * NANOSECONDS_PER_S).astype(np.int64)
    return np.rint(within / form.rate * NANOSECONDS_PER_S).astype(np.int64)
