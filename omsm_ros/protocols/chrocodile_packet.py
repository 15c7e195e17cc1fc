"""The packet protocol of Precitec CHRocodile 2 (TCP port 7891), little-endian throughout.

Every packet begins with a magic number and its length. Commands, their answers and updates
carry arguments; a data format says what the samples of the data packets with the same counter
hold. Distances and encoders are those of the dollar protocol, by the same signal numbers.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from omsm_ros.errors import ConfigurationError, ProtocolError
from omsm_ros.protocols.chrocodile_telegram import FLOAT, S16, S32, U16, U32, Records
from omsm_ros.units import NANOSECONDS_PER_S

MAGIC = 0xAA55AA55
MAX_PACKET_BYTES = 4096
COMMAND, DATA_FORMAT, DATA = 0x00444D43, 0x00544644, 0x00544144
# Flags of a command.
QUERY, UPDATE, WARNING, ERROR = 0x0001, 0x2000, 0x4000, 0x8000
INT, REAL, STRING, CHAR, BLOB = range(5)
# The last update after connecting.
CONFIGURED = "CONF"
# No probe measures slower or faster; another rate is a damaged packet.
LEAST_RATE_HZ, GREATEST_RATE_HZ = 1e-3, 1e8
# Of a triggered sample: its time after the packet's [s / 2^32].
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
    """Return a command's number: its letters, low byte first; ConfigurationError if none."""
    if not (name.isascii() and name.isupper() and 3 <= len(name) <= 4):
        raise ConfigurationError(f"command {name!r}, expected three or four capitals")
    return int.from_bytes(name.encode(), "little")


class Command(NamedTuple):
    """A command, its answer, or an update.  ticket: of the command that is answered."""

    name: str
    values: tuple[Value, ...] = ()
    flags: int = 0
    ticket: int = 0


@dataclass(frozen=True, slots=True)
class DataFormat:
    """What samples hold.  rate: [Hz];  signals: number, type and channels of each, in order."""

    counter: int
    rate: float
    signals: tuple[tuple[int, int, int], ...]
    stream: int = 0

    @property
    def dtype(self) -> np.dtype[np.void]:
        """One sample: a field a signal, named by its number, of its first channel."""
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


Message: TypeAlias = Command | DataFormat | Data


# Encoding.


def _packet(kind: int, body: bytes) -> bytes:
    return HEADER.pack(MAGIC, HEADER.size + len(body), kind) + body


def _argument(value: Value) -> bytes:
    if isinstance(value, int):
        return struct.pack("<Ii", INT, value)
    if isinstance(value, float):
        return struct.pack("<If", REAL, value)
    kind, raw = (STRING, value.encode()) if isinstance(value, str) else (BLOB, value)
    return struct.pack("<II", kind, len(raw)) + raw + bytes(-len(raw) % 4)


def encode_command(command: Command) -> bytes:
    """Wire bytes of a command, an answer or an update."""
    arguments = b"".join(map(_argument, command.values))
    head = _COMMAND.pack(
        name_code(command.name), 0, 0, command.flags, 0, command.ticket, len(command.values)
    )
    return _packet(COMMAND, head + arguments)


def encode_format(form: DataFormat) -> bytes:
    """Wire bytes of a data format."""
    signals = b"".join(_SIGNAL.pack(kind, 0, n, 0, number) for number, kind, n in form.signals)
    head = _FORMAT.pack(form.stream, form.counter, form.rate, len(form.signals))
    return _packet(DATA_FORMAT, head + signals)


def encode_data(form: DataFormat, records: Records, time_ns: int) -> bytes:
    """Wire bytes of a data packet; ConfigurationError if the samples do not fit into one.

    time_ns: of the first sample
    """
    most = (MAX_PACKET_BYTES - HEADER.size - DATA_BODY.size) // form.dtype.itemsize
    if len(records) > most:
        raise ConfigurationError(f"{len(records)} samples do not fit a packet of {most}")
    fixed = time_ns * FIXED_POINT // NANOSECONDS_PER_S
    head = DATA_BODY.pack(form.stream, form.counter, fixed % 2**64, len(records))
    return _packet(DATA, head + records.tobytes())


# Decoding.


def decode_command(body: bytes) -> Command:
    """Return the command in a packet's body; ProtocolError or struct.error if it is none."""
    code, _, _, flags, _, ticket, count = _COMMAND.unpack_from(body)
    name = code.to_bytes(4, "little").rstrip(b"\0").decode("latin-1")
    values: list[Value] = []
    place = _COMMAND.size
    for _ in range(count):
        (kind,) = NUMBER.unpack_from(body, place)
        value, size = _decode_argument(kind, body, place + NUMBER.size)
        values.append(value)
        place += NUMBER.size + size
    return Command(name, tuple(values), flags, ticket)


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
    """Return the data format in a packet's body; ProtocolError or struct.error if none."""
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
