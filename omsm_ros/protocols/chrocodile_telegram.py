"""Measured values of a Precitec CHRocodile in the dollar protocol: telegrams ↔ records.

A binary telegram is two sync bytes and the selected signals, 16-bit numbers big-endian and
32-bit ones little-endian; it has no length and no checksum. An ASCII telegram is a line:
a space, decimals separated by spaces, CR LF. Both become the same structured records, one
field a signal, named by the signal's number.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from omsm_ros.errors import ConfigurationError, ProtocolError

Records: TypeAlias = NDArray[np.void]
"""Structured array of shape (n,), dtype ``Layout.dtype``."""

SYNC = b"\xff\xff"

# Type numbers of `$DTF`: 16 bits big-endian, 32 bits little-endian.
U16, S16, U32, S32, FLOAT = 2, 3, 4, 5, 6
FORMATS = {U16: ">u2", S16: ">i2", U32: "<u4", S32: "<i4", FLOAT: "<f4"}


class Signal(NamedTuple):
    """type: as the device sends it unless `$DTF` says otherwise."""

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

# Longer telegrams than any selection of signals makes are a misread description.
MAX_TELEGRAM_BYTES = 4096


@dataclass(frozen=True, slots=True)
class Layout:
    """Where each signal stands in a telegram.

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
        """Return the layout that the table ``SIGNALS`` gives for a selection by `$SODX`.

        Raises ConfigurationError for a signal whose type only `$DTF` knows.
        """
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

        Separators, a count of signals after the length, and whether length and offsets count
        the sync are left open. Raises ProtocolError.
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
        # A length that holds the last signal and its sync is the telegram's; else the payload's.
        length = max(numbers[0] if head else 0, max(ends) + before)
        return cls(tuple(signals), tuple(types), tuple(p + before for p in places), length, sync)

    def describe(self) -> str:
        """Return what the device answers to `$DTF`."""
        triples = zip(self.signals, self.types, self.offsets, strict=True)
        return " ".join([str(self.length), *(f"{n} {t} {o}" for n, t, o in triples)])

    @property
    def dtype(self) -> np.dtype[np.void]:
        """One telegram: field ``sync``, and one a signal named by its number."""
        return np.dtype(
            {
                "names": ["sync", *map(str, self.signals)],
                "formats": [">u2", *(FORMATS[kind] for kind in self.types)],
                "offsets": [0, *self.offsets],
                "itemsize": self.length,
            }
        )

    def records(self, count: int) -> Records:
        """Return the empty telegrams (count,), their sync filled in."""
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
