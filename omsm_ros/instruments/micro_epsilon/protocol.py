"""Encodes and decodes the values of Micro-Epsilon controllers, over TCP and RS-422.

Over TCP they come in blocks, little-endian: a header with a preamble, the controller's numbers,
the content, number and length of the frames, and the counter of the first one; then the frames.
``HEADERS`` has the two forms: confocalDT 24xx states the content by flags, capaNCDT 62xx by a
field of channels.

Over RS-422 a value of a confocalDT has three bytes of six data bits, low part first. The two bits
above mark them: 00 low, 01 middle, 10 high in the first value of a frame, 11 high in the others.
So a missing byte always shows.
"""

import struct
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.streams.blocks import FloatArray, IntArray, Status
from omsm_ros.errors import ProtocolError
from omsm_ros.instruments.counting import PacketFinder, WireCounts

# Manuals give both: "MEAS" as text, and as a 32-bit number sent low byte first.
PREAMBLES = (b"MEAS", b"SAEM")
# A block fits into a TCP packet; a longer one is a header that was misread.
MAX_BLOCK_BYTES = 1 << 20

HEADERS = {
    # preamble, order, serial, flags 1, flags 2, frames, bytes a frame (or the other way round:
    # manuals and open clients differ), counter
    "confocal": struct.Struct("<4sIIIIHHI"),
    # preamble, order, serial, channels, status, frames, bytes a frame, counter
    "capacitive": struct.Struct("<4sIIQIHHI"),
}

_VIDEO_BYTES = 1024
# Bit of flags 1 → name and size [bytes] of the field in a frame, in the order of the frame.
FLAGS_1: tuple[tuple[int, str, int], ...] = (
    *((bit, f"video {bit}", _VIDEO_BYTES) for bit in (0, 2, 3, 4, 5, 6)),
    (7, "exposure", 4),
    (8, "encoder 1", 4),
    (9, "encoder 2", 4),
    (10, "encoder 3", 4),
    (11, "counter", 4),
    (12, "time", 4),
)
INTENSITY_BIT, VALUE_BIT, PEAK_BITS = 15, 18, range(19, 25)
AFTER_PEAKS: tuple[tuple[int, str, int], ...] = ((26, "error", 4), (27, "trigger difference", 4))
FLAGS_2: tuple[tuple[int, str, int], ...] = (
    (0, "thickness", 4),
    (15, "minimum", 4),
    (16, "maximum", 4),
    (17, "peak to peak", 4),
)
# Intensity 100 % is 1024, in the lowest eleven bits; above them is the height of the peak.
INTENSITY_MASK, INTENSITY_FULL = 0x7FF, 1024
_NO_INTENSITY = 0xC000F800
# Distances from this value on are error codes.
FIRST_ERROR = 0x7FFFFF00
# Codes of a peak before, and of one behind the measuring range.
BEFORE_RANGE_NM, BEHIND_RANGE_NM = 0x7FFFFF05, 0x7FFFFF06
_SIGNED = ("distance", "thickness", "minimum", "maximum", "encoder")


Frames: TypeAlias = NDArray[np.void]
"""Structured array of shape (n,), its fields as the header of a block describes them."""


class MeasurementBlock(NamedTuple):
    """One block.  kind: content of its frames, as coded in the header;  frames: (n, bytes)."""

    order: int
    serial: int
    kind: tuple[int, int]
    counter: int
    frames: NDArray[np.uint8]


def confocal_dtype(flags: tuple[int, int]) -> np.dtype[np.void]:
    """Return the fields of a frame by the flags of a confocalDT.

    Distance and intensity of a peak may be in either order: see ``intensity_leads``. Raises
    ProtocolError if the flags have no distance.
    """
    fields = [(name, size) for bit, name, size in FLAGS_1 if flags[0] >> bit & 1]
    peaks = sum(flags[0] >> bit & 1 for bit in PEAK_BITS)
    if not peaks and flags[0] >> VALUE_BIT & 1:
        peaks = 1
    if not peaks:
        raise ProtocolError(f"flags {flags[0]:#x} {flags[1]:#x} hold no distance")
    for peak in range(1, peaks + 1):
        fields.append((f"distance {peak}", 4))
        if flags[0] >> INTENSITY_BIT & 1:
            fields.append((f"intensity {peak}", 4))
    for word, table in ((flags[0], AFTER_PEAKS), (flags[1], FLAGS_2)):
        fields += [(name, size) for bit, name, size in table if word >> bit & 1]
    whole = {name: "<i4" if name.startswith(_SIGNED) else "<u4" for name, _ in fields}
    opaque = {name: f"V{size}" for name, size in fields if size == _VIDEO_BYTES}
    return np.dtype(list((whole | opaque).items()))


def intensity_leads(words: NDArray[np.int64], furthest: float) -> bool | None:
    """Return whether the first of a peak's ``words`` (n, 2) is the intensity; None if unknown.

    One manual has the distance first, others the intensity. The values show the order: in an
    intensity bits 11 to 15, 30 and 31 are zero; a distance is at most ``furthest`` [nm], or an
    error code.
    """
    distance = (np.abs(words) <= furthest) | (words >= FIRST_ERROR)
    light = (words & _NO_INTENSITY == 0) & (words & INTENSITY_MASK <= INTENSITY_FULL)
    leads, follows = light[:, 0] & distance[:, 1], distance[:, 0] & light[:, 1]
    votes = int(np.sum(leads & ~follows)) - int(np.sum(follows & ~leads))
    return votes > 0 if votes else None


def intensity_of(light: IntArray | None) -> FloatArray | float:
    """Return the intensity (n,), 0 to 1, of values of a peak; NaN where there are none."""
    return np.nan if light is None else np.minimum((light & INTENSITY_MASK) / INTENSITY_FULL, 1.0)


def channel_dtype(field: int) -> np.dtype[np.void]:
    """Return the fields of a frame by the channel field of a capaNCDT; ProtocolError if none."""
    present = [f"channel {i + 1}" for i in range(32) if field >> 2 * i & 0b11]
    if not present:
        raise ProtocolError(f"channel field {field:#x} names no channel")
    return np.dtype([(name, "<i4") for name in present])


def encode_block(form: str, block: MeasurementBlock, preamble: bytes = PREAMBLES[0]) -> bytes:
    """Return the bytes of a block; form: of HEADERS."""
    head = HEADERS[form].pack(
        preamble, block.order, block.serial, *block.kind, *block.frames.shape, block.counter
    )
    return head + block.frames.tobytes()


class BlockDecoder(PacketFinder):
    """Decodes bytes in any portions to blocks, each of which waits for the next one."""

    magics, longest = PREAMBLES, MAX_BLOCK_BYTES

    def __init__(self, form: str, dtype_of: Callable[[tuple[int, int]], np.dtype[np.void]]) -> None:
        """form: of HEADERS;  dtype_of: fields of frames by their kind; may raise ProtocolError."""
        super().__init__()
        self.head = HEADERS[form]
        self._dtype_of = dtype_of
        self._width_at: int | None = None  # which of the two is the length of a frame

    def _measure(self, place: int) -> tuple[int, bool]:
        count, width = self._shape(self.head.unpack_from(self._buffer, place))
        return self.head.size + count * width if count else 0, True

    def _shape(self, fields: tuple[int, ...]) -> tuple[int, int]:
        """Return number and length of the frames; (0, 0) if they do not fit.

        They may have either order, but all blocks have the same.
        """
        try:
            width = self._dtype_of((fields[3], fields[4])).itemsize
        except ProtocolError:
            return 0, 0
        for at in (-2, -3) if self._width_at is None else (self._width_at,):
            if fields[at] == width and fields[-5 - at]:
                return fields[-5 - at], width
        return 0, 0

    def _take(self, place: int, size: int, found: list[MeasurementBlock]) -> int:
        if not size:
            self._malformed += 1
            return 1
        fields = self.head.unpack_from(self._buffer, place)
        count, width = self._shape(fields)
        if count != width:
            self._width_at = -2 if fields[-2] == width else -3
        raw = np.frombuffer(self._buffer, np.uint8, count * width, place + self.head.size)
        self._packets += 1
        self._understood += size
        kind, frames = (fields[3], fields[4]), raw.reshape(count, width)
        found.append(MeasurementBlock(fields[1], fields[2], kind, fields[-1], frames))
        return size


LOW, MIDDLE, HIGH_FIRST, HIGH_OTHER = 0b00, 0b01, 0b10, 0b11
# distance = (value - ZERO) · range / SPAN
ZERO, SPAN = 98_232, 65_536
# Larger values are error codes.
LAST_VALUE = 262_072
NO_PEAK, BEFORE_RANGE, BEHIND_RANGE, NO_VALUE = 262_076, 262_077, 262_078, 262_079
VALUE_BITS = 18
_VALUE_BYTES = 3
# Five values in a row have valid marks by chance once in 64⁵ places, 10⁹ bytes.
_PLAUSIBLE_VALUES = 5


def encode_frames(values: IntArray) -> bytes:
    """Return the bytes of frames (n, m) of 18-bit values."""
    parts = np.zeros((*values.shape, _VALUE_BYTES), np.uint8)
    parts[..., 0] = values & 0x3F
    parts[..., 1] = values >> 6 & 0x3F | MIDDLE << 6
    parts[..., 2] = values >> 12 & 0x3F | HIGH_OTHER << 6
    parts[:, 0, 2] ^= (HIGH_OTHER ^ HIGH_FIRST) << 6
    return parts.tobytes()


def distance_of(values: IntArray, measuring_range: float) -> tuple[FloatArray, NDArray[np.uint8]]:
    """Return the distance [m], NaN where there is none, and status of 18-bit ``values`` (n,).

    measuring_range: [m]
    """
    distance = (values - ZERO) * (measuring_range / SPAN)
    status = np.full(values.shape, Status.OK, np.uint8)
    status[np.abs(distance) > measuring_range] = Status.OUT_OF_RANGE
    status[values > LAST_VALUE] = Status.NO_TARGET
    status[(values == BEFORE_RANGE) | (values == BEHIND_RANGE)] = Status.OUT_OF_RANGE
    return np.where(values > LAST_VALUE, np.nan, distance), status


def values_of(distance: FloatArray, measuring_range: float) -> IntArray:
    """Return 18-bit values of ``distance`` [m] (n,); NaN becomes "no peak"."""
    scaled = np.rint(np.nan_to_num(distance) * (SPAN / measuring_range)) + ZERO
    inside = np.clip(scaled, 0, LAST_VALUE).astype(np.int64)
    return np.where(np.isnan(distance), NO_PEAK, inside)


class SerialDecoder:
    """Decodes bytes in any portions to frames of ``width`` values; it never raises."""

    def __init__(self, width: int) -> None:
        """width: values in a frame."""
        self._width = width
        self._size = width * _VALUE_BYTES
        marks = np.tile([LOW, MIDDLE, HIGH_OTHER], width)
        marks[_VALUE_BYTES - 1] = HIGH_FIRST
        self._marks = marks.astype(np.uint8)
        self._buffer = b""
        self._passed_over = False  # whether bytes since the last frame were skipped
        self._received = self._frames = self._malformed = 0

    def reset(self) -> None:
        """Discard an incomplete frame, as after a new connection."""
        self._buffer = b""
        self._passed_over = False

    def feed(self, data: bytes) -> tuple[IntArray, IntArray]:
        """Return values (n, width) of the frames completed by ``data``, and how many were spoilt.

        The second, (n,), is for each frame the number of damaged places since the frame before.
        """
        self._received += len(data)
        raw = np.frombuffer(self._buffer + data, np.uint8)
        starts = self._starts(raw)
        spoilt = np.zeros(len(starts), np.int64)
        spoilt[:] = np.diff(starts, prepend=-self._size) != self._size
        rest = 0
        if len(starts):
            spoilt[0] |= self._passed_over
            rest, self._passed_over = int(starts[-1]) + self._size, False
        tail = raw[rest:]
        if len(tail) >= self._size:  # it has no frame: only its end may still become one
            tail = tail[len(tail) - self._size + 1 :]
            self._passed_over = True
        self._buffer = tail.tobytes()
        self._frames += len(starts)
        self._malformed += int(spoilt.sum())
        index = starts[:, np.newaxis] + np.arange(self._size)
        parts = raw[index].reshape(len(starts), self._width, _VALUE_BYTES).astype(np.int64) & 0x3F
        return parts[..., 0] | parts[..., 1] << 6 | parts[..., 2] << 12, spoilt

    @property
    def statistics(self) -> WireCounts:
        """Return the counts of bytes, frames, and places with missing or additional bytes."""
        counts = {"frames": self._frames, "malformed": self._malformed}
        decoded = self._frames * self._size
        return WireCounts(self._received, decoded, len(self._buffer), **counts)

    def _starts(self, raw: NDArray[np.uint8]) -> NDArray[np.intp]:
        """Return where complete frames begin; their marks prevent an overlap."""
        if len(raw) < self._size:
            return np.empty(0, np.intp)
        windows = np.lib.stride_tricks.sliding_window_view(raw >> 6, self._size)
        return np.flatnonzero((windows == self._marks).all(axis=1))


class PlausibleValueFilter:
    """Passes frames on once enough of them followed each other without a gap.

    A value has no check but its marks, and in noise, or at another baud rate, every 64th place has
    valid ones. So after each damaged place frames wait for the next ones.

    unconfirmed: frames that were dropped because the next ones did not follow
    """

    def __init__(self, width: int) -> None:
        """width: values in a frame."""
        self._width, self._needed = width, -(-_PLAUSIBLE_VALUES // width)
        self.unconfirmed = 0
        self.reset()

    def reset(self) -> None:
        """Drop the frames that wait, as after a new connection."""
        self._values = np.empty((0, self._width), np.int64)
        self._spoilt = np.empty(0, np.int64)
        self._confirmed = False

    def feed(self, values: IntArray, spoilt: IntArray) -> tuple[IntArray, IntArray]:
        """Return the frames that are confirmed, of those from :meth:`SerialDecoder.feed`."""
        values, spoilt = np.append(self._values, values, 0), np.append(self._spoilt, spoilt)
        row = np.cumsum(spoilt > 0)  # in row 0 frames go on with those before
        lengths = np.bincount(row, minlength=1)
        lengths[0] += self._needed * self._confirmed
        good = lengths[row] >= self._needed
        waits = ~good & (row == len(lengths) - 1)
        self.unconfirmed += int(np.sum(~good & ~waits))
        self._values, self._spoilt = values[waits], spoilt[waits]
        self._confirmed = bool(lengths[-1] >= self._needed)
        return values[good], spoilt[good]
