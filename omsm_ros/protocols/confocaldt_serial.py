"""Measured values of a Micro-Epsilon confocalDT over RS-422: three bytes a value.

Six data bits each, low part first. The two bits above mark them: 00 low, 01 middle, 10 high
in the first value of a frame, 11 high in the others. So a byte that is missing always shows.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.samples.blocks import FloatArray, IntArray, Status

LOW, MIDDLE, HIGH_FIRST, HIGH_OTHER = 0b00, 0b01, 0b10, 0b11
# distance = (value - ZERO) · range / SPAN
ZERO, SPAN = 98_232, 65_536
# Above it: error values.
LAST_VALUE = 262_072
NO_PEAK, BEFORE_RANGE, BEHIND_RANGE, NO_VALUE = 262_076, 262_077, 262_078, 262_079
VALUE_BITS = 18
_VALUE_BYTES = 3
# So many values in a row have their marks by chance once in 64⁵ places, 10⁹ bytes.
_VALUES_BELIEVED = 5


def encode_frames(values: IntArray) -> bytes:
    """Wire bytes of frames (n, m) of 18-bit values."""
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
    status[values > LAST_VALUE] = Status.NO_TARGET
    status[(values == BEFORE_RANGE) | (values == BEHIND_RANGE)] = Status.OUT_OF_RANGE
    return np.where(values > LAST_VALUE, np.nan, distance), status


def values_of(distance: FloatArray, measuring_range: float) -> IntArray:
    """Return 18-bit values of ``distance`` [m] (n,); NaN becomes "no peak"."""
    scaled = np.rint(np.nan_to_num(distance) * (SPAN / measuring_range)) + ZERO
    inside = np.clip(scaled, 0, LAST_VALUE).astype(np.int64)
    return np.where(np.isnan(distance), NO_PEAK, inside)


@dataclass(frozen=True, slots=True)
class SerialStatistics:
    """What became of every byte: ``received = in frames + discarded + pending``.

    frames: decoded;  malformed: places where something was missing or too much
    """

    bytes_received: int
    bytes_discarded: int
    bytes_pending: int
    frames: int
    malformed: int


class SerialDecoder:
    """Bytes in any portions → frames of ``width`` values; nothing raises."""

    def __init__(self, width: int) -> None:
        """width: values in a frame."""
        self._width = width
        self._size = width * _VALUE_BYTES
        marks = np.tile([LOW, MIDDLE, HIGH_OTHER], width)
        marks[_VALUE_BYTES - 1] = HIGH_FIRST
        self._marks = marks.astype(np.uint8)
        self._buffer = b""
        self._passed_over = False  # bytes since the last frame that begin none
        self._received = self._frames = self._malformed = 0

    def reset(self) -> None:
        """Forget an unfinished frame, as after connecting anew."""
        self._buffer = b""
        self._passed_over = False

    def feed(self, data: bytes) -> tuple[IntArray, IntArray]:
        """Return values (n, width) of the frames completed by ``data``, and how many were spoilt.

        The second, (n,), says for each frame in how many places since the frame before it
        something was wrong.
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
        if len(tail) >= self._size:  # no frame in it: only its end may still become one
            tail = tail[len(tail) - self._size + 1 :]
            self._passed_over = True
        self._buffer = tail.tobytes()
        self._frames += len(starts)
        self._malformed += int(spoilt.sum())
        index = starts[:, np.newaxis] + np.arange(self._size)
        parts = raw[index].reshape(len(starts), self._width, _VALUE_BYTES).astype(np.int64) & 0x3F
        return parts[..., 0] | parts[..., 1] << 6 | parts[..., 2] << 12, spoilt

    @property
    def statistics(self) -> SerialStatistics:
        """Return what became of every byte."""
        decoded = self._frames * self._size
        return SerialStatistics(
            bytes_received=self._received,
            bytes_discarded=self._received - decoded - len(self._buffer),
            bytes_pending=len(self._buffer),
            frames=self._frames,
            malformed=self._malformed,
        )

    def _starts(self, raw: NDArray[np.uint8]) -> NDArray[np.intp]:
        """Return where whole frames begin; frames never overlap, since their marks do not."""
        if len(raw) < self._size:
            return np.empty(0, np.intp)
        windows = np.lib.stride_tricks.sliding_window_view(raw >> 6, self._size)
        return np.flatnonzero((windows == self._marks).all(axis=1))


class Believed:
    """Frames that are more than chance: enough of them came one after the other at once.

    Nothing but the marks vouches for a value, and in noise, or at another baud rate, every 64th
    place has them. So after every place where something was wrong frames wait for the next ones.

    unconfirmed: frames that waited in vain
    """

    def __init__(self, width: int) -> None:
        """width: values in a frame."""
        self._width = width
        self._needed = -(-_VALUES_BELIEVED // width)
        self.unconfirmed = 0
        self.reset()

    def reset(self) -> None:
        """Believe nothing, as after connecting anew."""
        self._waiting: list[tuple[IntArray, IntArray]] = []
        self._confirmed = False

    def feed(self, values: IntArray, spoilt: IntArray) -> tuple[IntArray, IntArray]:
        """Return what to believe of what :meth:`SerialDecoder.feed` returned and of what waited."""
        found: list[tuple[IntArray, IntArray]] = []
        breaks = np.flatnonzero(spoilt)
        edges = np.unique(np.concatenate([[0], breaks, [len(values)]]))
        for start, end in itertools.pairwise(edges):
            if spoilt[start]:
                self.unconfirmed += self._held()
                self.reset()
            self._waiting.append((values[start:end], spoilt[start:end]))
            if self._confirmed or self._held() >= self._needed:
                self._confirmed = True
                found += self._waiting
                self._waiting = []
        if not found:
            return np.empty((0, self._width), np.int64), np.empty(0, np.int64)
        return np.concatenate([f for f, _ in found]), np.concatenate([s for _, s in found])

    def _held(self) -> int:
        return sum(len(values) for values, _ in self._waiting)
