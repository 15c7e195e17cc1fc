"""Bytes of a CHRocodile in the dollar protocol → telegrams, in any portions.

The sync pair also occurs in the data. So the place is kept by counting, from ``ready`` on,
and searched only when a sync is missing where it is due. A telegram counts once the sync of
the next one has come: bytes lost inside it would show there. What a flipped bit does to a
value, nothing in this protocol can show.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.samples.blocks import FloatArray
from omsm_ros.protocols.chrocodile_telegram import (
    FORMATS,
    MAX_TELEGRAM_BYTES,
    SAMPLE_COUNTER,
    Layout,
    Records,
)

# Two telegrams found in garbage belong together if no more samples than this lie between.
_NEAR = 16
_NUMBER = rb"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"


@dataclass(frozen=True, slots=True)
class TelegramStatistics:
    """What became of every byte: ``received = in telegrams + discarded + pending``.

    telegrams: decoded;  losses_of_sync: how often the place in the stream was lost
    """

    bytes_received: int
    bytes_discarded: int
    bytes_pending: int
    telegrams: int
    losses_of_sync: int


class BinaryDecoder:
    """Bytes in any portions → telegrams; nothing raises, memory is two telegrams and a portion."""

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._dtype = layout.dtype
        self._due = int.from_bytes(layout.sync, "big")
        self._buffer = b""
        self._synchronised = False
        self._received = self._telegrams = self._losses = 0

    def reset(self, *, synchronised: bool) -> None:
        """Forget an unfinished telegram; ``synchronised``: the next byte begins one."""
        self._buffer = b""
        self._synchronised = synchronised

    def feed(self, data: bytes) -> Records:
        """Return telegrams that ``data`` confirms, shape (n,); n may be 0."""
        self._received += len(data)
        self._buffer += data
        parts = []
        while self._synchronised or self._search():
            parts.append(self._take())
            if self._synchronised:
                break
        found = np.frombuffer(b"".join(parts), self._dtype)
        self._telegrams += len(found)
        return found

    def settle(self) -> Records:
        """Return the last telegram, if whole and nothing came after it; shape (0,) or (1,)."""
        whole = len(self._buffer) == self._layout.length
        if not (self._synchronised and whole and self._buffer.startswith(self._layout.sync)):
            return np.empty(0, self._dtype)
        found = np.frombuffer(self._buffer, self._dtype)
        self._buffer = b""
        self._telegrams += 1
        return found

    @property
    def statistics(self) -> TelegramStatistics:
        """Return what became of every byte."""
        decoded = self._telegrams * self._layout.length
        return TelegramStatistics(
            bytes_received=self._received,
            bytes_discarded=self._received - decoded - len(self._buffer),
            bytes_pending=len(self._buffer),
            telegrams=self._telegrams,
            losses_of_sync=self._losses,
        )

    def _take(self) -> bytes:
        """Return telegrams up to the last one whose successor has begun, or to a missing sync."""
        length, buffer = self._layout.length, self._buffer
        whole = len(buffer) // length
        records = np.frombuffer(buffer, self._dtype, whole)
        bad = np.flatnonzero(records["sync"] != self._due)
        rest = buffer[whole * length :][:2]
        if not len(bad) and not self._layout.sync.startswith(rest):
            bad = np.array([whole])
        if not len(bad):
            count = whole if len(rest) == 2 else max(0, whole - 1)
            self._buffer = buffer[count * length :]
            return buffer[: count * length]
        # The telegram before a missing sync is too short or too long: it is none.
        count = max(0, int(bad[0]) - 1)
        self._buffer = buffer[count * length + (bad[0] > 0) :]
        self._synchronised = False
        self._losses += 1
        return buffer[: count * length]

    def _search(self) -> bool:
        """Go to the first two telegrams in a row; keep only what may still become that."""
        length, size = self._layout.length, len(self._buffer)
        raw = np.frombuffer(self._buffer + bytes(2 * length), np.uint8)
        first, second = self._layout.sync
        sync = (raw[:-1] == first) & (raw[1:] == second)
        starts = np.flatnonzero(sync[:size])
        starts = starts[sync[starts + length] | (starts + length + 2 > size)]
        whole = starts + 2 * length <= size
        found = np.flatnonzero(~whole | self._plausible(raw, starts))
        if not len(found):
            self._buffer = self._buffer[-1:] if self._buffer.endswith(bytes([first])) else b""
            return False
        self._buffer = self._buffer[starts[found[0]] :]
        self._synchronised = bool(whole[found[0]])
        return self._synchronised

    def _plausible(self, raw: NDArray[np.uint8], starts: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Return where the sample counter, if there is one, goes on between two telegrams."""
        if SAMPLE_COUNTER not in self._layout.signals:
            return np.ones(len(starts), np.bool_)
        index = self._layout.signals.index(SAMPLE_COUNTER)
        kind = np.dtype(FORMATS[self._layout.types[index]])
        place = starts + self._layout.offsets[index]
        here, after = (
            raw[at[:, np.newaxis] + np.arange(kind.itemsize)].copy().view(kind)[:, 0].astype(int)
            for at in (place, place + self._layout.length)
        )
        step = (after - here) % 2 ** (8 * kind.itemsize)
        return np.asarray((step >= 1) & (step <= _NEAR))


class LineDecoder:
    """ASCII telegrams in any portions → the records ``BinaryDecoder`` gives.

    A line must begin with its space and hold as many numbers as there are signals; without a
    checksum, a digit lost within a number cannot be noticed.
    """

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._dtype = layout.dtype
        self._line = re.compile(rb"(?: +%s){%d} *\r?" % (_NUMBER, len(layout.signals)))
        self._limits = _limits(layout)
        self._tail = b""
        self._synchronised = False
        self._received = self._kept = self._telegrams = self._losses = 0

    def reset(self, *, synchronised: bool) -> None:
        """Forget an unfinished line; ``synchronised``: the next byte begins one."""
        self._tail = b""
        self._synchronised = synchronised

    def feed(self, data: bytes) -> Records:
        """Return telegrams completed by ``data``, shape (n,); n may be 0."""
        self._received += len(data)
        *lines, tail = (self._tail + data).split(b"\n")
        good = [line for line in lines if self._well_formed(line)]
        shape = len(good), len(self._layout.signals)
        values = np.fromstring(b" ".join(good), sep=" ").reshape(shape)
        fits = self._fitting(values)
        values = values[fits]
        if lines:
            # Before the first line's end is known, what precedes it may be half a line.
            whole = bool(good and fits[0] and good[0] is lines[0])
            self._losses += len(lines) - len(values) - (not (self._synchronised or whole))
            self._synchronised = True
        self._kept += sum(len(line) + 1 for line, fit in zip(good, fits, strict=True) if fit)
        self._telegrams += len(values)
        self._tail = tail[:MAX_TELEGRAM_BYTES]  # so long, it is no line already
        return self._records(values)

    def settle(self) -> Records:
        """Return no telegram, shape (0,): a line says by itself where it ends."""
        return np.empty(0, self._dtype)

    @property
    def statistics(self) -> TelegramStatistics:
        return TelegramStatistics(
            bytes_received=self._received,
            bytes_discarded=self._received - self._kept - len(self._tail),
            bytes_pending=len(self._tail),
            telegrams=self._telegrams,
            losses_of_sync=self._losses,
        )

    def _well_formed(self, line: bytes) -> bool:
        return len(line) < MAX_TELEGRAM_BYTES and self._line.fullmatch(line) is not None

    def _fitting(self, values: FloatArray) -> NDArray[np.bool_]:
        """Return which rows of ``values`` (n, signals) their types can hold, shape (n,)."""
        lowest, highest, whole = self._limits
        inside = (values >= lowest) & (values <= highest)
        return np.asarray((inside & (~whole | (values == np.rint(values)))).all(axis=1))

    def _records(self, values: FloatArray) -> Records:
        made = self._layout.records(len(values))
        for number, column in zip(self._layout.signals, values.T, strict=True):
            made[str(number)] = column
        return made


def _limits(layout: Layout) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Return each signal's least and greatest value (signals,), and whether it is whole."""
    kinds = [np.dtype(FORMATS[kind]) for kind in layout.types]
    ranges = [np.finfo(kind) if kind.kind == "f" else np.iinfo(kind) for kind in kinds]
    lowest, highest = ([float(getattr(r, end)) for r in ranges] for end in ("min", "max"))
    return np.array(lowest), np.array(highest), np.array([kind.kind != "f" for kind in kinds])
