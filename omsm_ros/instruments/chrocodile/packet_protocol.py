"""Encodes and decodes the packet protocol of Precitec CHRocodile 2 (TCP port 7891).

All numbers are little-endian. Each packet begins with a magic number and its length. Commands,
answers and updates carry arguments; a data format describes the samples of the data packets with
the same counter. Signal numbers are those of the dollar protocol.
"""

import struct
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from omsm_ros.errors import ConfigurationError, ProtocolError
from omsm_ros.instruments.chrocodile.telegram import FLOAT, S16, S32, U16, U32, Records
from omsm_ros.instruments.counting import PacketFinder, WireCounts
from omsm_ros.units import NANOSECONDS_PER_S

MAGIC = 0xAA55AA55
MAX_PACKET_BYTES = 4096
COMMAND, DATA_FORMAT, DATA = 0x00444D43, 0x00544644, 0x00544144
# Flags of a command.
QUERY, UPDATE, WARNING, ERROR = 0x0001, 0x2000, 0x4000, 0x8000
INT, REAL, STRING, CHAR, BLOB = range(5)
# The last update after connecting.
CONFIGURED = "CONF"
# No probe measures slower or faster: another rate means a damaged packet [Hz].
LEAST_RATE_HZ, GREATEST_RATE_HZ = 1e-3, 1e8
# Signal: time of a triggered sample after that of the packet [s / 2^32].
TIME_OFFSET = 91

FORMATS = {U16: "<u2", S16: "<i2", U32: "<u4", S32: "<i4", FLOAT: "<f4"}

HEADER = struct.Struct("<Ii8xI")  # magic, length, type
_COMMAND = struct.Struct("<IIIHHHH")  # id, destination, source, flags, -, ticket, arguments
_FORMAT = struct.Struct("<Iifi")  # stream, counter, rate [Hz], signals
_SIGNAL = struct.Struct("<BBHHH")  # type, -, channels, first channel, signal
DATA_BODY = struct.Struct("<IiQi")  # stream, counter, time [s / 2^32], samples
MAGIC_BYTES = struct.pack("<I", MAGIC)
NUMBER = struct.Struct("<I")
FIXED_POINT = 2**32
KINDS = (COMMAND, DATA_FORMAT, DATA)

Value: TypeAlias = int | float | str | bytes


def name_code(name: str) -> int:
    """Return the number of a command, its letters low byte first; ConfigurationError."""
    if not (name.isascii() and name.isupper() and 3 <= len(name) <= 4):
        raise ConfigurationError(f"command {name!r}, expected three or four capitals")
    return int.from_bytes(name.encode(), "little")


class PacketCommand(NamedTuple):
    """A command, an answer or an update.  ticket: of the command that is answered."""

    name: str
    values: tuple[Value, ...] = ()
    flags: int = 0
    ticket: int = 0


@dataclass(frozen=True, slots=True)
class DataFormat:
    """Describes samples.  rate: [Hz];  signals: number, type and channels of each, in order."""

    counter: int
    rate: float
    signals: tuple[tuple[int, int, int], ...]
    stream: int = 0

    @property
    def dtype(self) -> np.dtype[np.void]:
        """Return the dtype of a sample: for each signal a field of its first channel, by number."""
        sizes = [channels * np.dtype(FORMATS[kind]).itemsize for _, kind, channels in self.signals]
        offsets = np.cumsum([0, *sizes]).tolist()
        return np.dtype(
            {
                "names": [str(number) for number, _, _ in self.signals],
                "formats": [FORMATS[kind] for _, kind, _ in self.signals],
                "offsets": offsets[:-1],
                "itemsize": offsets[-1],
            }
        )


class Data(NamedTuple):
    """Samples (n,) of one format, and the device's time of each [ns]."""

    format: DataFormat
    records: Records
    times_ns: NDArray[np.int64]


Message: TypeAlias = PacketCommand | DataFormat | Data


def _packet(kind: int, body: bytes) -> bytes:
    return HEADER.pack(MAGIC, HEADER.size + len(body), kind) + body


def _argument(value: Value) -> bytes:
    if isinstance(value, int):
        return struct.pack("<Ii", INT, value)
    if isinstance(value, float):
        return struct.pack("<If", REAL, value)
    kind, raw = (STRING, value.encode()) if isinstance(value, str) else (BLOB, value)
    return struct.pack("<II", kind, len(raw)) + raw + bytes(-len(raw) % 4)


def encode_command(command: PacketCommand) -> bytes:
    """Return the bytes of a command, an answer or an update."""
    arguments = b"".join(map(_argument, command.values))
    head = _COMMAND.pack(
        name_code(command.name), 0, 0, command.flags, 0, command.ticket, len(command.values)
    )
    return _packet(COMMAND, head + arguments)


def encode_format(form: DataFormat) -> bytes:
    """Return the bytes of a data format."""
    signals = b"".join(_SIGNAL.pack(kind, 0, n, 0, number) for number, kind, n in form.signals)
    head = _FORMAT.pack(form.stream, form.counter, form.rate, len(form.signals))
    return _packet(DATA_FORMAT, head + signals)


def encode_data(form: DataFormat, records: Records, time_ns: int) -> bytes:
    """Return the bytes of a data packet; ConfigurationError if the samples do not fit into one.

    time_ns: of the first sample
    """
    most = (MAX_PACKET_BYTES - HEADER.size - DATA_BODY.size) // form.dtype.itemsize
    if len(records) > most:
        raise ConfigurationError(f"{len(records)} samples do not fit a packet of {most}")
    fixed = time_ns * FIXED_POINT // NANOSECONDS_PER_S
    head = DATA_BODY.pack(form.stream, form.counter, fixed % 2**64, len(records))
    return _packet(DATA, head + records.tobytes())


def decode_command(body: bytes) -> PacketCommand:
    """Return the command in a packet's body; ProtocolError or struct.error without one."""
    code, _, _, flags, _, ticket, count = _COMMAND.unpack_from(body)
    name = code.to_bytes(4, "little").rstrip(b"\0").decode("latin-1")
    values: list[Value] = []
    place = _COMMAND.size
    for _ in range(count):
        (kind,) = NUMBER.unpack_from(body, place)
        value, size = _decode_argument(kind, body, place + NUMBER.size)
        values.append(value)
        place += NUMBER.size + size
    return PacketCommand(name, tuple(values), flags, ticket)


def _decode_argument(kind: int, body: bytes, place: int) -> tuple[Value, int]:
    """Return the value and size [bytes] of the argument at ``place``."""
    if kind in (INT, REAL):
        (number,) = struct.unpack_from("<i" if kind == INT else "<f", body, place)
        return number, 4
    if kind == CHAR:
        return body[place : place + 1].decode("latin-1"), 4
    if kind not in (STRING, BLOB):
        raise ProtocolError(f"argument of type {kind!r}")
    (length,) = NUMBER.unpack_from(body, place)
    raw = body[place + 4 : place + 4 + length]
    if len(raw) < length:
        raise ProtocolError(f"argument of {length!r} bytes reaches beyond its packet")
    return (
        raw.rstrip(b"\0").decode("latin-1") if kind == STRING else raw
    ), 4 + length + -length % 4


def decode_format(body: bytes) -> DataFormat:
    """Return the data format in a packet's body; ProtocolError or struct.error without one."""
    stream, counter, rate, count = _FORMAT.unpack_from(body)
    rows = [_SIGNAL.unpack_from(body, _FORMAT.size + i * _SIGNAL.size) for i in range(count)]
    signals = tuple((number, kind, channels) for kind, _, channels, _, number in rows)
    numbers = [number for number, _, _ in signals]
    known = all(kind in FORMATS and channels > 0 for _, kind, channels in signals)
    offset = next((kind for number, kind, _ in signals if number == TIME_OFFSET), S32)
    sound = known and offset == S32 and LEAST_RATE_HZ <= rate <= GREATEST_RATE_HZ
    if not signals or not sound or len(set(numbers)) < count:
        raise ProtocolError(f"data format of {rate!r} Hz with signals {signals!r}")
    return DataFormat(counter, rate, signals, stream)


class PacketDecoder(PacketFinder):
    """Decodes bytes in any portions to messages; consecutive samples of a format are joined.

    Samples have no checksum, so they wait for the next packet; commands and formats do not.
    """

    magics, head, longest = (MAGIC_BYTES,), HEADER, MAX_PACKET_BYTES

    def __init__(self) -> None:
        super().__init__()
        self._formats: dict[int, DataFormat] = {}
        self._waiting: list[tuple[bytes, int, int]] = []  # samples, time [ns], stream
        self._unformatted = 0

    def reset(self) -> None:
        """Discard an incomplete packet and all formats, as after a new connection."""
        super().reset()
        self._formats.clear()

    @property
    def statistics(self) -> WireCounts:
        """Return the counts of bytes, packets, malformed ones, and samples without their format."""
        counts = super().statistics
        counts.unformatted = self._unformatted
        return counts

    def _measure(self, place: int) -> tuple[int, bool]:
        _, length, kind = HEADER.unpack_from(self._buffer, place)
        known = kind in KINDS and HEADER.size < length <= MAX_PACKET_BYTES
        return length if known else 0, kind == DATA

    def _take(self, place: int, size: int, found: list[Message]) -> int:
        if not size:
            return 1
        body = self._buffer[place + HEADER.size : place + size]
        (kind,) = NUMBER.unpack_from(self._buffer, place + HEADER.size - 4)
        try:
            self._understand(kind, body, found)
        except (ProtocolError, struct.error):
            self._malformed += 1
            return 1
        self._packets += 1
        self._understood += size
        return size

    def _understand(self, kind: int, body: bytes, found: list[Message]) -> None:
        if kind == DATA:
            self._data(body, found)
            return
        self._flush(found)
        if kind == COMMAND:
            found.append(decode_command(body))
        else:
            form = decode_format(body)
            self._formats[form.stream] = form
            found.append(form)

    def _data(self, body: bytes, found: list[Message]) -> None:
        stream, counter, fixed, count = DATA_BODY.unpack_from(body)
        form = self._formats.get(stream)
        if count < 0:
            raise ProtocolError(f"data packet of {count!r} samples")
        if form is None or form.counter != counter:
            self._unformatted += count
            return
        payload = body[DATA_BODY.size :]
        if not 0 <= len(payload) - count * form.dtype.itemsize < 4:  # padding
            raise ProtocolError(f"{count!r} samples in {len(payload)} bytes")
        if self._waiting and self._waiting[0][2] != stream:
            self._flush(found)
        time_ns = fixed * NANOSECONDS_PER_S // FIXED_POINT
        self._waiting.append((payload[: count * form.dtype.itemsize], time_ns, stream))

    def _flush(self, found: list[Message]) -> None:
        waiting, self._waiting = self._waiting, []
        if not waiting:
            return
        form = self._formats[waiting[0][2]]
        size = form.dtype.itemsize
        records = np.frombuffer(b"".join(payload for payload, _, _ in waiting), form.dtype)
        counts = np.array([len(payload) // size for payload, _, _ in waiting])
        starts = np.repeat([time_ns for _, time_ns, _ in waiting], counts).astype(np.int64)
        within = np.arange(len(records)) - np.repeat(np.cumsum(counts) - counts, counts)
        found.append(Data(form, records, starts + _after(form, records, within)))


def _after(form: DataFormat, records: Records, within: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the time of the ``within``-th sample of a packet, after that of the packet [ns]."""
    if str(TIME_OFFSET) in (records.dtype.names or ()):
        fraction = records[str(TIME_OFFSET)].astype(np.float64) / FIXED_POINT
        return np.rint(fraction * NANOSECONDS_PER_S).astype(np.int64)
    return np.rint(within / form.rate * NANOSECONDS_PER_S).astype(np.int64)
