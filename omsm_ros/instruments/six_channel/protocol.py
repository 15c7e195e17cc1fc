"""Encodes and decodes the six-channel stream: one probe, five encoders, one frame a trigger.

Each frame is the little-endian table ``FRAME``, its last four bytes the CRC-32 of all
before them, encoded by COBS and ended by 00. COBS leaves no 00 inside a frame, so a
reader that lost its place finds it again at the next 00. Empty frames (00 00) mark an idle
line.

As text, each trigger sends a line: columns by name, separated by commas or blanks, as LinuxCNC's
``halsampler -t`` writes them (the sample's number first, then the pins in their order). Axes are
counts, which may have decimals; distance is in nanometres, time in nanoseconds. Lines end with LF,
CR or both. A line with another content or number of columns is malformed.
"""

import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
from cobs import cobs
from numpy.typing import NDArray

from omsm_ros.core.streams.blocks import FloatArray, Status
from omsm_ros.errors import ConfigurationError
from omsm_ros.instruments.counting import WireCounts
from omsm_ros.instruments.scaling import AXES, AxisScaling, whole_counts
from omsm_ros.units import MICROMETRE_M, NANOMETRE_M

FRAME = np.dtype(
    [
        ("sequence", "<u4"),  # trigger counter, wraps
        ("device_time", "<u8"),  # [ns]
        ("distance", "<i4"),  # [nm]
        ("status", "u1"),  # core.streams.blocks.Status
        ("counts", "<i8", (len(AXES),)),  # encoders in the order of AXES
        ("crc", "<u4"),  # of all bytes before it
    ]
)
FrameArray: TypeAlias = NDArray[np.void]
"""Structured array of shape (n,), dtype ``FRAME``."""

BODY_SIZE = FRAME.fields["crc"][1]  # type: ignore[index]
# COBS adds exactly one byte to data shorter than 254 bytes.
SEGMENT_SIZE = FRAME.itemsize + 1
ENCODED_SIZE = SEGMENT_SIZE + 1
TERMINATOR = b"\0"
# CRC-32 over any data followed by its own CRC-32 (little-endian) is this constant.
CRC_RESIDUE = 0x2144DF1C


def encode_frames(frames: FrameArray) -> bytes:
    """Return the bytes of ``frames`` (n,), n · ENCODED_SIZE; fills in the field ``crc``."""
    raw = frames.tobytes()
    parts = []
    for start in range(0, len(raw), FRAME.itemsize):
        body = raw[start : start + BODY_SIZE]
        parts.append(cobs.encode(body + zlib.crc32(body).to_bytes(4, "little")))
    return b"".join(part + TERMINATOR for part in parts)


class FrameDecoder:
    """Decodes bytes in any portions to frames with valid length, COBS and CRC-32.

    It never raises; memory is bounded by one frame and one portion.
    """

    def __init__(self) -> None:
        self._tail = b""
        self._bytes = self._frames = 0
        self._bad = {"length": 0, "cobs": 0, "crc": 0}

    def feed(self, data: bytes) -> FrameArray:
        """Return frames completed by ``data``, shape (n,), in the order of arrival; n may be 0."""
        self._bytes += len(data)
        *segments, tail = (self._tail + data).split(TERMINATOR)
        # One byte more than a frame shows that the segment is invalid, so no more is kept.
        self._tail = tail[: SEGMENT_SIZE + 1]
        bodies = [body for segment in segments if (body := self._open(segment)) is not None]
        self._frames += len(bodies)
        return np.frombuffer(b"".join(bodies), FRAME)

    def reset(self) -> None:
        """Discard an incomplete frame, as after a lost connection."""
        self._bad["length"] += bool(self._tail)
        self._tail = b""

    @property
    def statistics(self) -> WireCounts:
        """Return the counts of bytes, frames, and segments between terminators that are none."""
        bad = {f"bad_{name}": count for name, count in self._bad.items()}
        kept = ENCODED_SIZE * self._frames
        return WireCounts(self._bytes, kept, len(self._tail), frames=self._frames, **bad)

    def _open(self, segment: bytes) -> bytes | None:
        if len(segment) != SEGMENT_SIZE:
            self._bad["length"] += bool(segment)
            return None
        try:
            body: bytes = cobs.decode(segment)
        except cobs.DecodeError:
            self._bad["cobs"] += 1
            return None
        if zlib.crc32(body) != CRC_RESIDUE:
            self._bad["crc"] += 1
            return None
        return body


@dataclass(frozen=True, slots=True)
class ProbeScaling:
    """Scaling of the probe's int32 [nm].

    full_scale: a reading with a larger absolute value is OUT_OF_RANGE [m]
    polarity: -1 for a probe whose reading grows towards the target
    invalid: the reading that means "no target" [nm]
    """

    full_scale: float = 100 * MICROMETRE_M
    polarity: int = 1
    invalid: int = -(2**31)

    def readings(
        self, raw: FloatArray, given: NDArray[np.integer[Any]]
    ) -> tuple[FloatArray, NDArray[np.uint8]]:
        """Return the distance [m], NaN where there is none, and status, each of shape (n,).

        raw: reading [nm];  given: status by the device: one other than OK is kept, one that this
            package does not know becomes LOST
        """
        nothing = raw == self.invalid
        distance = np.where(nothing, np.nan, self.polarity * NANOMETRE_M * raw)
        status = np.where(known_status(given), given, Status.LOST)
        good = status == Status.OK
        status = np.where(good & nothing, Status.NO_TARGET, status)
        beyond = good & (abs(distance) > self.full_scale)
        return distance, np.where(beyond, Status.OUT_OF_RANGE, status).astype(np.uint8)

    def counts(self, distance: FloatArray) -> NDArray[np.int32]:
        """Return what the device sends for ``distance`` [m] (n,); NaN is sent as ``invalid``."""
        scaled = np.rint(distance * (self.polarity / NANOMETRE_M))
        sent = np.where(np.isnan(distance), self.invalid, scaled)
        return whole_counts("probe distance", sent, np.int32).astype(np.int32)


def known_status(given: NDArray[np.integer[Any]]) -> NDArray[np.bool_]:
    """Return True where the device's status ``given`` (n,) is one of ``Status``."""
    return np.asarray((given >= 0) & (given <= max(Status)))


LINEAR = AxisScaling(counts_per_unit=1e10)  # 0.1 nm a count
ROTARY = AxisScaling(counts_per_unit=1e9)  # 1 nrad a count


@dataclass(frozen=True, slots=True)
class StreamScaling:
    """Scaling of the five axes and the probe."""

    x: AxisScaling = LINEAR
    y: AxisScaling = LINEAR
    z: AxisScaling = LINEAR
    b: AxisScaling = ROTARY
    c: AxisScaling = ROTARY
    probe: ProbeScaling = field(default_factory=ProbeScaling)

    @property
    def axes(self) -> tuple[AxisScaling, ...]:
        """Return the scaling of the axes in the order of AXES."""
        return tuple(getattr(self, name) for name in AXES)


COLUMNS = ("sequence", "device_time", "distance", "status", *AXES)
SKIPPED = "-"
OVERRUN = b"overrun"
_WHOLE = ("sequence", "device_time", "status")
# Bounds the memory of a line without end.
MAX_LINE_BYTES = 1024
_SEPARATORS = b",; \t\v\f"
_INTEGER = rb"([-+]?\d{1,19})"
_NUMBER = rb"([-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?)"
_ANY = rb"[^,;\s]+"


# Numbers beyond these ranges are damage: counts that no counter reaches, times of centuries,
# positions of hundreds of metres in tenths of a nanometre.
MOST_COUNTS = 2**40
_SEQUENCE_RANGE, _OTHER_RANGE = (0, 2**52), (-(2**62), 2**62)


def row_dtype(columns: Sequence[str]) -> np.dtype[np.void]:
    """Return the dtype of a line: whole numbers int64, the others float64."""
    named = [name for name in columns if name != SKIPPED]
    return np.dtype([(name, "<i8" if name in _WHOLE else "<f8") for name in named])


def encode_lines(rows: NDArray[np.void], columns: Sequence[str] = COLUMNS) -> list[bytes]:
    """Return the bytes of each of ``rows`` (n,), which have a field for each column."""
    lists = (rows[name].tolist() for name in columns)
    texts = [[str(v) if isinstance(v, int) else f"{v:.17g}" for v in values] for values in lists]
    return [(",".join(row) + "\n").encode() for row in zip(*texts, strict=True)]


class CsvDecoder:
    """Decodes bytes in any portions to rows; it never raises, memory is a line and a portion."""

    def __init__(self, columns: Sequence[str] = COLUMNS, most_counts: int = MOST_COUNTS) -> None:
        """Raise ConfigurationError unless ``columns`` are valid.

        Each is one of COLUMNS, once, or SKIPPED; sequence, and distance or an axis, are required.
        """
        named = [name for name in columns if name != SKIPPED]
        if set(named) - set(COLUMNS) or len(set(named)) < len(named):
            raise ConfigurationError(
                f"columns {columns!r}, expected {COLUMNS!r}, each at most once"
            )
        if "sequence" not in named or not {"distance", *AXES} & set(named):
            raise ConfigurationError(f"columns {columns!r} need a sequence, and distance or axes")
        words = [_ANY if n == SKIPPED else _INTEGER if n in _WHOLE else _NUMBER for n in columns]
        self._line = re.compile(rb"[,;\s]*" + rb"[,;\s]+".join(words) + rb"[,;\s]*")
        ranges = {"sequence": _SEQUENCE_RANGE} | dict.fromkeys(AXES, (-most_counts, most_counts))
        self._read = [
            (int if name in _WHOLE else float, *ranges.get(name, _OTHER_RANGE)) for name in named
        ]
        self._dtype = row_dtype(columns)
        self._tail = b""
        self._received = self._lines = self._malformed = self._overruns = 0

    def reset(self) -> None:
        """Discard an incomplete line."""
        self._malformed += bool(self._tail)
        self._tail = b""

    def feed(self, data: bytes) -> NDArray[np.void]:
        """Return the rows completed by ``data``, shape (n,)."""
        self._received += len(data)
        *lines, tail = (self._tail + data).replace(b"\r", b"\n").split(b"\n")
        self._tail = tail[: MAX_LINE_BYTES + 1]
        rows = [row for line in lines if (row := self._row(line)) is not None]
        self._lines += len(rows)
        return np.array(rows, self._dtype)

    @property
    def statistics(self) -> WireCounts:
        """Return the counts of bytes, of lines with a sample, of malformed ones, and of overruns.

        An overrun is a malformed line by which HAL's sampler reports that it had no room.
        """
        kept = self._received - len(self._tail)
        counts = {"lines": self._lines, "malformed": self._malformed}
        counts["overruns"] = self._overruns
        return WireCounts(self._received, kept, len(self._tail), **counts)

    def _row(self, line: bytes) -> tuple[float, ...] | None:
        found = self._line.fullmatch(line) if len(line) <= MAX_LINE_BYTES else None
        if found is not None:
            words = zip(self._read, found.groups(), strict=True)
            row = tuple(
                value
                for (number, least, most), word in words
                if least <= (value := number(word)) <= most
            )
            if len(row) == len(self._read):
                return row
        text = line.strip(_SEPARATORS)
        self._overruns += text == OVERRUN
        self._malformed += bool(text)
        return None
