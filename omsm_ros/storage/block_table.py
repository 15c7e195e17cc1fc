"""How are many short messages read as a few long blocks?

Drivers send a hundred samples at a time, and taking such a message apart costs more than
correcting its samples. Messages of one size are laid out alike (plain CDR, little endian, OMG
DDSI-RTPS 2.3, 10), so that many of them are one table: a row a message, a column a field.
Rows that continue each other make one block.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from struct import error as struct_error
from struct import unpack_from
from typing import Any

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.samples.blocks import AxisBlock, DistanceBlock
from omsm_ros.units import NANOSECONDS_PER_S

CHANNELS: dict[type, tuple[tuple[str, type], ...]] = {
    AxisBlock: tuple((name, np.float64) for name in "xyzbc"),
    DistanceBlock: (("distance", np.float64), ("intensity", np.float32), ("status", np.uint8)),
}
"""The sequences of each message that makes a block, in their order on the wire."""

_LITTLE_ENDIAN = b"\x00\x01"
_ENCAPSULATION_BYTES = 4  # before the first field; alignment counts from their end
_MOST_PADDING = 3  # a writer may fill the last word


class _Layout:
    """Walks through one message and notes name, type and place of its fields."""

    def __init__(self, message: bytes) -> None:
        self._message = message
        self._place = _ENCAPSULATION_BYTES
        self.lengths: list[str] = ["encapsulation"]
        self.fields: dict[str, tuple[Any, int]] = {"encapsulation": ("S2", 0)}

    def add(self, name: str, kind: Any, shape: tuple[int, ...] = ()) -> None:
        dtype = np.dtype(kind).newbyteorder("<")
        self._place += -(self._place - _ENCAPSULATION_BYTES) % dtype.itemsize
        self.fields[name] = ((dtype, shape), self._place)
        self._place += dtype.itemsize * (shape[0] if shape else 1)

    def sequence(self, name: str, kind: Any) -> None:
        length = f"length of {name}"
        self.add(length, np.uint32)
        self.lengths.append(length)
        (count,) = unpack_from("<I", self._message, self._place - 4)
        if count:
            self.add(name, kind, (count,))

    def dtype(self) -> np.dtype[np.void]:
        size = len(self._message)
        if not 0 <= size - self._place <= _MOST_PADDING:
            raise struct_error(f"fields end at {self._place}, the message at {size}")
        formats, offsets = zip(*self.fields.values(), strict=True)
        names = list(self.fields)
        return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": size})


def long_blocks(kind: type, messages: Sequence[bytes]) -> Iterator[Any] | None:
    """Yield blocks of ``kind`` with all samples of serialised ``messages`` of one size.

    None if the messages are not laid out alike; then each is to be taken apart by itself.
    Raises DataError as the block's class does.
    """
    layout = _Layout(messages[0])
    try:
        layout.add("sec", np.int32)
        layout.add("nanosec", np.uint32)
        layout.sequence("frame", np.uint8)
        layout.add("first_sample", np.uint64)
        layout.add("sample_period", np.float64)
        for name, channel in CHANNELS[kind]:
            layout.sequence(name, channel)
        table = np.frombuffer(b"".join(messages), layout.dtype())
    except struct_error:
        return None
    alike = all((table[name] == table[name][0]).all() for name in layout.lengths)
    # What stands before the intensity, which may be empty as the status may, is always there.
    needed = [name for name, channel in CHANNELS[kind] if channel is np.float64]
    alike &= messages[0][:2] == _LITTLE_ENDIAN and all(name in layout.fields for name in needed)
    return _runs(kind, table) if alike else None


def _runs(kind: type, table: NDArray[np.void]) -> Iterator[Any]:
    """Yield a block for each run of rows that continue each other in count, period and time."""
    first, period = table["first_sample"], table["sample_period"]
    stamp = table["sec"].astype(np.int64) * NANOSECONDS_PER_S + table["nanosec"]
    present = [(name, c) for name, c in CHANNELS[kind] if name in (table.dtype.names or ())]
    samples = np.uint64(table[present[0][0]].shape[1])
    follows = (first[1:] == first[:-1] + samples) & (period[1:] == period[:-1])
    follows &= stamp[1:] >= stamp[:-1]
    edges = np.flatnonzero(~follows) + 1
    parts = np.stack([first.astype(np.int64), stamp], axis=1)
    for start, stop in zip([0, *edges], [*edges, len(table)], strict=True):
        rows = table[start:stop]
        yield kind(
            stamp_ns=int(stamp[start]),
            first_sample=int(first[start]),
            sample_period=float(period[start]),
            parts=parts[start:stop],
            **{name: np.array(rows[name], channel).ravel() for name, channel in present},
        )
