"""Describes the telegrams of a Precitec CHRocodile, and converts their signals.

A binary telegram is two sync bytes and the selected signals, 16-bit numbers big-endian and
32-bit ones little-endian; it has no length and no checksum. An ASCII telegram is a line:
a space, decimals separated by spaces, CR LF. Both become the same structured records, with a
field for each signal, named by its number.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.streams.blocks import FloatArray, IntArray, Status
from omsm_ros.errors import ConfigurationError, ProtocolError
from omsm_ros.instruments.scaling import ProbeReading
from omsm_ros.units import MICROMETRE_M, NANOMETRE_M

Records: TypeAlias = NDArray[np.void]
"""Structured array of shape (n,), dtype ``Layout.dtype``."""

SYNC = b"\xff\xff"

# Type numbers of `$DTF`: 16 bits big-endian, 32 bits little-endian.
U16, S16, U32, S32, FLOAT = 2, 3, 4, 5, 6
FORMATS = {U16: ">u2", S16: ">i2", U32: "<u4", S32: "<i4", FLOAT: "<f4"}


class Signal(NamedTuple):
    """A signal.  type: unless `$DTF` states another."""

    meaning: str
    type: int


DISTANCE, INTENSITY = 256, 257
DISTANCE_16, INTENSITY_16 = 16640, 16641
DISTANCE_NM = 33024
START_TIME, FLAGS, LOST_TRIGGERS, SAMPLE_COUNTER = 64, 76, 79, 83
# Axes X, Y, Z, U, V of the device, latched at the start and at the end of the exposure.
ENCODERS_AT_START = (65, 66, 67, 68, 69)
ENCODERS_AT_END = (70, 71, 72, 73, 74)

SIGNALS = {
    DISTANCE: Signal("distance 1 [µm]", FLOAT),
    INTENSITY: Signal("intensity 1", FLOAT),
    DISTANCE_16: Signal("distance 1 [full scale / 2^15]", S16),
    INTENSITY_16: Signal("intensity 1", U16),
    DISTANCE_NM: Signal("distance 1 [nm]", S32),
    START_TIME: Signal("start of the exposure [ns], wraps", U32),
    **{n: Signal(f"encoder {n - 64} at the start", S32) for n in ENCODERS_AT_START},
    **{n: Signal(f"encoder {n - 69} at the end", S32) for n in ENCODERS_AT_END},
    FLAGS: Signal("bit 0 saturated, 1 trigger lost, 2 trigger delayed", U16),
    LOST_TRIGGERS: Signal("triggers lost", U16),
    SAMPLE_COUNTER: Signal("samples, wraps", U16),
}

# No selection of signals makes longer telegrams; a longer one is a misread description.
MAX_TELEGRAM_BYTES = 4096


@dataclass(frozen=True, slots=True)
class Layout:
    """The places of the signals in a telegram.

    signals, types, offsets: number, type and place [bytes from the first sync byte] of each
    length: of a telegram with its sync [bytes]
    """

    signals: tuple[int, ...]
    types: tuple[int, ...]
    offsets: tuple[int, ...]
    length: int
    sync: bytes = SYNC

    def __post_init__(self) -> None:
        if len(self.sync) != 2:
            raise ConfigurationError(f"sync {self.sync!r}, expected two bytes")
        if not self.signals or len(set(self.signals)) < len(self.signals):
            raise ProtocolError(f"signals {self.signals!r}, expected one or more, each once")
        if unknown := set(self.types) - set(FORMATS):
            raise ProtocolError(f"signal types {sorted(unknown)!r}, expected {sorted(FORMATS)}")
        spans = sorted(
            (offset, offset + np.dtype(FORMATS[kind]).itemsize)
            for offset, kind in zip(self.offsets, self.types, strict=True)
        )
        ends = [len(self.sync), *(end for _, end in spans)]
        starts = [*(start for start, _ in spans), self.length]
        if self.length > MAX_TELEGRAM_BYTES or any(
            a > b for a, b in zip(ends, starts, strict=True)
        ):
            raise ProtocolError(
                f"telegram of {self.length!r} bytes with signals at {self.offsets!r}: they "
                "overlap or reach beyond its end"
            )

    @classmethod
    def of(cls, signals: Sequence[int], sync: bytes = SYNC) -> Layout:
        """Return the layout of a selection by `$SODX`; ConfigurationError for an unknown signal."""
        if unknown := [number for number in signals if number not in SIGNALS]:
            raise ConfigurationError(
                f"signals {unknown!r} are not in the table; the device must describe them ($DTF)"
            )
        types = tuple(SIGNALS[number].type for number in signals)
        sizes = [np.dtype(FORMATS[kind]).itemsize for kind in types]
        offsets = np.cumsum([len(sync), *sizes]).tolist()
        return cls(tuple(signals), types, tuple(offsets[:-1]), offsets[-1], sync)

    @classmethod
    def described(cls, text: str, sync: bytes = SYNC) -> Layout:
        """Return the layout in an answer to `$DTF`: length; number, type, offset of each signal.

        Any separators, an optional count of signals after the length, and lengths and offsets with
        or without the sync are accepted. Raises ProtocolError.
        """
        numbers = [int(word) for word in re.findall(r"\d+", text)]
        head = len(numbers) % 3
        if len(numbers) < 3 or (head == 2 and numbers[1] != len(numbers) // 3):
            raise ProtocolError(
                f"description {text!r}: expected a length and three numbers for each signal"
            )
        body = numbers[head:]
        signals, types, places = body[0::3], body[1::3], body[2::3]
        if unknown := set(types) - set(FORMATS):
            raise ProtocolError(f"description {text!r}: unknown types {sorted(unknown)!r}")
        ends = [p + np.dtype(FORMATS[t]).itemsize for p, t in zip(places, types, strict=True)]
        before = 0 if min(places) >= len(sync) else len(sync)
        # A length without the sync is that of the payload.
        length = max(numbers[0] if head else 0, max(ends) + before)
        return cls(tuple(signals), tuple(types), tuple(p + before for p in places), length, sync)

    def describe(self) -> str:
        """Return the answer to `$DTF`."""
        triples = zip(self.signals, self.types, self.offsets, strict=True)
        return " ".join([str(self.length), *(f"{n} {t} {o}" for n, t, o in triples)])

    @property
    def dtype(self) -> np.dtype[np.void]:
        """Return the dtype of a telegram: field ``sync``, and one for each signal by its number."""
        return np.dtype(
            {
                "names": ["sync", *map(str, self.signals)],
                "formats": [">u2", *(FORMATS[kind] for kind in self.types)],
                "offsets": [0, *self.offsets],
                "itemsize": self.length,
            }
        )

    def records(self, count: int) -> Records:
        """Return telegrams (count,) of zeros with their sync."""
        made = np.zeros(count, self.dtype)
        made["sync"] = int.from_bytes(self.sync, "big")
        return made

    def lines(self, records: Records) -> list[bytes]:
        """Return the same records (n,) as ASCII telegrams."""
        columns = []
        for number, kind in zip(self.signals, self.types, strict=True):
            form = "%.4f" if kind == FLOAT else "%d"
            columns.append([form % value for value in records[str(number)].tolist()])
        return [(" " + " ".join(row) + "\r\n").encode() for row in zip(*columns, strict=True)]


# In the order of resolution, finest first: 16 bits over 100 µm are steps of 3 nm.
DISTANCES = (DISTANCE_NM, DISTANCE, DISTANCE_16)
INTENSITIES = (INTENSITY, INTENSITY_16)
SATURATED, TRIGGER_LOST, TRIGGER_DELAYED = 1, 2, 4
LATCHES = {
    "start": (ENCODERS_AT_START,),
    "end": (ENCODERS_AT_END,),
    "mean": (ENCODERS_AT_START, ENCODERS_AT_END),
}
# The device's encoders are 32 bits wide.
ENCODER_RANGE = 2**32


def check_selection(signals: Sequence[int], encoders: Sequence[int]) -> None:
    """Raise ConfigurationError unless ``signals`` have the counter and all of ``encoders``."""
    if SAMPLE_COUNTER not in signals:
        raise ConfigurationError(
            f"signals {signals!r} lack {SAMPLE_COUNTER}, the sample counter: without it lost "
            "samples are not detected"
        )
    if missing := sorted({*encoders} - {*signals}):
        raise ConfigurationError(
            f"signals {signals!r} lack {missing!r}, the encoders of the axes: add them, or "
            "leave `encoders` empty"
        )


def unit_of(signal: int, full_scale: float) -> float:
    """Return the step of a distance signal [m] of a probe with the range ``full_scale`` [m]."""
    sixteen = full_scale / 2**15
    return {DISTANCE: MICROMETRE_M, DISTANCE_NM: NANOMETRE_M, DISTANCE_16: sixteen}[signal]


def first_of(choice: Sequence[int], signals: Sequence[int]) -> int | None:
    """Return the first of ``choice`` that is among ``signals``."""
    return next((number for number in choice if number in signals), None)


def distance_of(
    records: Records, signals: Sequence[int], probe: ProbeReading
) -> tuple[FloatArray, NDArray[np.float32], NDArray[np.uint8]]:
    """Return distance [m], intensity (0-1; NaN where not selected) and status of ``records`` (n,).

    Distance zero with intensity zero, or without a selected intensity, means no target. Raises
    ConfigurationError if no distance is selected.
    """
    number = first_of(DISTANCES, signals)
    if number is None:
        raise ConfigurationError(f"signals {signals!r} hold no distance of {DISTANCES!r}")
    raw = records[str(number)].astype(np.float64) * unit_of(number, probe.full_scale)
    intensity = np.full(len(records), np.nan, np.float32)
    nothing = raw == 0
    light = first_of(INTENSITIES, signals)
    if light is not None:
        reported = records[str(light)].astype(np.float32)
        intensity = np.clip(reported / probe.intensity_full_scale, 0, 1).astype(np.float32)
        nothing &= reported == 0
    nothing |= ~np.isfinite(raw)
    status = np.full(len(records), Status.OK, np.uint8)
    status[(raw < 0) | (raw > probe.full_scale)] = Status.OUT_OF_RANGE
    if FLAGS in signals:
        status[(records[str(FLAGS)].astype(np.int64) & SATURATED) > 0] = Status.SATURATED
    status[nothing] = Status.NO_TARGET
    return np.where(nothing, np.nan, probe.distance(raw)), intensity, status


def counts_of(records: Records, latch: str, order: Sequence[int]) -> IntArray:
    """Return the encoder counts (n, 5) of X, Y, Z, B, C at ``latch``, of LATCHES.

    order: encoder X Y Z U V (0 to 4) of the device on each axis. The mean of start and end is
    rounded to a whole count.
    """
    at = [
        np.stack([records[str(numbers[i])].astype(np.int64) for i in order], axis=1)
        for numbers in LATCHES[latch]
    ]
    if len(at) == 1:
        return at[0]
    half = ENCODER_RANGE // 2
    travel = (at[1] - at[0] + half) % ENCODER_RANGE - half  # the counter may wrap in between
    return at[0] + travel // 2
