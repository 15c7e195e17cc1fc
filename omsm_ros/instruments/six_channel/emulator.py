"""The device's side of the generic six-channel stream, fed by the twin.

Imitated: quantisation to counts and whole nanometres, the probe's verdict, the device's own
sequence and clock, and, on request, the faults of ``StreamFaults``.

Not imitated: jitter, drift and resolution of the device's clock, latency of the link, baud
rate and UART overrun (a reader that is too slow is waited for), commands to the device.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.streams.blocks import BoolArray, Status
from omsm_ros.errors import ConfigurationError
from omsm_ros.instruments.emulator import AXES as SOURCES_AXES
from omsm_ros.instruments.emulator import Instrument, Measured
from omsm_ros.instruments.six_channel.protocol import (
    AXES,
    COLUMNS,
    ENCODED_SIZE,
    FRAME,
    SEGMENT_SIZE,
    TERMINATOR,
    FrameArray,
    StreamScaling,
    encode_frames,
    encode_lines,
    row_dtype,
)
from omsm_ros.twin.cell import Recording
from omsm_ros.units import NANOMETRE_M, NANOSECONDS_PER_S

# Frames are written this often; shorter costs processor time, longer bunches arrivals.
WRITE_INTERVAL_S = 0.005
# Bounds memory and the response to stop, however fast the time lapse.
MAX_CHUNK_FRAMES = 1000

_NOISE_BYTES = 20


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamFaults:
    """What goes wrong; the first five are probabilities per frame, repeatable by ``seed``.

    noise: random bytes on the line before the frame (which they spoil)
    flip: one bit of the frame, its terminator included, is inverted
    truncate: the end of the frame is missing (so it runs into the next)
    drop: the frame is never sent;  duplicate: it is sent twice
    jump_at, jump_by: at this sample of each play the sequence leaps ahead by so much
    silence_at, silence: at this sample the trigger pauses for so long [s of device time]; the
    sequence goes on where it was, the device's clock has gone on
    """

    noise: float = 0.0
    flip: float = 0.0
    truncate: float = 0.0
    drop: float = 0.0
    duplicate: float = 0.0
    jump_at: int | None = None
    jump_by: int = 0
    silence_at: int | None = None
    silence: float = 0.0
    seed: int = 1

    def __post_init__(self) -> None:
        for name in ("noise", "flip", "truncate", "drop", "duplicate"):
            if not 0 <= getattr(self, name) <= 1:
                raise ConfigurationError(f"{name} {getattr(self, name)!r}, expected 0 to 1")
        if self.silence < 0 or self.jump_by < 0:
            raise ConfigurationError(
                f"silence {self.silence!r} s, jump_by {self.jump_by!r}: expected 0 or more"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class PlayedCounts:
    """What became of the samples played.

    ``samples + duplicated = intact + spoilt + dropped + unread``, where

    intact: frames a driver can decode;  spoilt: sent, but damaged by a fault
    dropped: never sent, by a fault;  duplicated: extra copies
    unread: nobody had the port open, or the play was stopped within the frame
    """

    samples: int = 0
    intact: int = 0
    spoilt: int = 0
    dropped: int = 0
    duplicated: int = 0
    unread: int = 0

    def __add__(self, other: PlayedCounts) -> PlayedCounts:
        names = [f.name for f in fields(PlayedCounts)]
        return PlayedCounts(**{n: getattr(self, n) + getattr(other, n) for n in names})


class StreamLink(Protocol):
    """What carries the bytes away, a ``Pty`` as a rule."""

    @property
    def has_reader(self) -> bool:
        """Whether anybody listens."""

    def write(self, data: bytes, stop: threading.Event | None = None) -> int:
        """Write ``data``; return bytes taken, fewer without a reader or once ``stop`` is set."""


class GenericStreamEmulator:
    """A device that is switched on once: sequence and clock run on from play to play.

    A new emulator on the same port is the device after a restart.
    """

    def __init__(
        self,
        line: StreamLink,
        scaling: StreamScaling | None = None,
        faults: StreamFaults | None = None,
        first_sequence: int = 0,
        first_device_time_ns: int = 0,
    ) -> None:
        self._line = line
        self._scaling = scaling or StreamScaling()
        self._faults = faults or StreamFaults()
        self._faulty = FaultyLine(self._faults)
        self._sequence = first_sequence
        self._device_time = first_device_time_ns

    def play(
        self,
        recording: Recording,
        time_lapse: float = 1.0,
        stop: threading.Event | None = None,
        progress: Callable[[int], None] | None = None,
    ) -> PlayedCounts:
        """Send every sample of ``recording``, paced, and return what became of them.

        time_lapse: seconds of the device's clock per second of ours; inf does not wait
        stop: ends the play early, at any byte
        progress: called with the number of samples played so far
        """
        if not time_lapse > 0:
            raise ConfigurationError(f"time_lapse {time_lapse!r}, expected a positive number")
        stop = stop or threading.Event()
        frames = self._frames(recording)
        period = recording.axes.sample_period
        size = int(min(max(1.0, time_lapse * WRITE_INTERVAL_S / period), MAX_CHUNK_FRAMES))
        started, origin = time.monotonic(), int(frames["device_time"][0])
        total = PlayedCounts()
        for chunk in _chunks(frames, size):
            elapsed = (int(chunk["device_time"][-1]) - origin) / NANOSECONDS_PER_S
            if _wait_until(started + elapsed / time_lapse, stop):
                break
            total += self._send(chunk, stop)
            if progress is not None:
                progress(total.samples)
        self._go_on_after(frames[: total.samples], period)
        return total

    def _send(self, chunk: FrameArray, stop: threading.Event) -> PlayedCounts:
        ran_on = self._faulty.runs_on
        pieces, intact, plan = self._faulty.transmit(chunk)
        wire = b"".join(pieces)
        written = self._line.write(wire, stop)
        if written < len(wire):
            ran_on = not wire[:written].endswith(TERMINATOR) if written else ran_on
            # A driver that opens the port anew finds it empty, without the frame begun here.
            self._faulty.runs_on = ran_on and self._line.has_reader
        complete = np.cumsum([len(piece) for piece in pieces]) <= written
        return replace(
            plan,
            intact=int(np.sum(intact & complete)),
            spoilt=int(np.sum(~intact & complete)),
            unread=int(np.sum(~complete)),
        )

    def _frames(self, recording: Recording) -> FrameArray:
        axes, distance = recording.axes, recording.distance
        index = np.arange(len(axes))
        frames = np.zeros(len(axes), FRAME)
        sequence, pause = self._sequence + index, np.zeros(len(axes))
        if self._faults.jump_at is not None:
            sequence[self._faults.jump_at :] += self._faults.jump_by
        if self._faults.silence_at is not None:
            pause[self._faults.silence_at :] = self._faults.silence
        frames["sequence"] = sequence % 2**32
        seconds = index * axes.sample_period + pause
        frames["device_time"] = self._device_time + np.rint(seconds * NANOSECONDS_PER_S).astype(int)
        frames["distance"] = self._scaling.probe.counts(distance.distance)
        frames["status"] = distance.status if len(distance.status) else Status.OK
        for i, (name, axis) in enumerate(zip(AXES, self._scaling.axes, strict=True)):
            frames["counts"][:, i] = axis.counts(getattr(axes, name))
        return frames

    def _go_on_after(self, played: FrameArray, period: float) -> None:
        if len(played):
            self._sequence = (int(played["sequence"][-1]) + 1) % 2**32
            self._device_time = int(played["device_time"][-1]) + round(period * NANOSECONDS_PER_S)


class FaultyLine:
    """Frames → the bytes that reach the other end, one piece a frame, and what they suffered.

    runs_on: what was last sent lacks its terminator, so it will spoil the next frame
    """

    def __init__(self, faults: StreamFaults) -> None:
        self._faults = faults
        self._random = np.random.default_rng(faults.seed)
        self.runs_on = False

    def transmit(self, frames: FrameArray) -> tuple[list[bytes], BoolArray, PlayedCounts]:
        """Return pieces of wire, True where one decodes to its frame, and the samples' account."""
        copies = 1 - self._hit_frames(self._faults.drop, len(frames)).astype(int)
        copies += copies * self._hit_frames(self._faults.duplicate, len(frames))
        sent = int(copies.sum())
        wire = np.frombuffer(encode_frames(np.repeat(frames, copies)), np.uint8)
        wire = wire.reshape(sent, ENCODED_SIZE).copy()
        noisy, flipped, cut = (
            self._hit_frames(rate, sent)
            for rate in (self._faults.noise, self._faults.flip, self._faults.truncate)
        )
        self._flip(wire, flipped)
        pieces = [
            self._piece(row, noisy[i], cut[i]) if noisy[i] or cut[i] else row.tobytes()
            for i, row in enumerate(wire)
        ]
        runs_on = np.r_[self.runs_on, [not piece.endswith(TERMINATOR) for piece in pieces]]
        self.runs_on = bool(runs_on[-1])
        intact = ~(noisy | flipped | cut | runs_on[:-1].astype(np.bool_))
        plan = PlayedCounts(
            samples=len(frames),
            dropped=int(np.sum(copies == 0)),
            duplicated=int(np.sum(copies == 2)),
        )
        return pieces, intact, plan

    def _hit_frames(self, rate: float, count: int) -> BoolArray:
        # No draw without a fault: faultless play is then fast, and each fault repeatable.
        return self._random.random(count) < rate if rate else np.zeros(count, np.bool_)

    def _flip(self, wire: NDArray[np.uint8], struck: BoolArray) -> None:
        """Invert one bit in each struck row."""
        rows = np.flatnonzero(struck)
        places = self._random.integers(0, ENCODED_SIZE, len(rows))
        wire[rows, places] ^= (1 << self._random.integers(0, 8, len(rows))).astype(np.uint8)

    def _piece(self, row: NDArray[np.uint8], noisy: np.bool_, cut: np.bool_) -> bytes:
        noise = self._random.bytes(_NOISE_BYTES) + b"\xff" if noisy else b""
        end = self._random.integers(1, SEGMENT_SIZE) if cut else ENCODED_SIZE
        return noise + row[:end].tobytes()


def _chunks(frames: FrameArray, size: int) -> Iterator[FrameArray]:
    for start in range(0, len(frames), size):
        yield frames[start : start + size]


def _wait_until(due: float, stop: threading.Event) -> bool:
    """Sleep until the monotonic instant ``due`` [s]; True if stopped."""
    return stop.wait(max(0.0, due - time.monotonic()))


# The sender of the six-channel stream as text, fed by the twin.
#
# Imitated: counts with decimals, a sequence that wraps, the sender's own time, invalid readings,
# and the faults of ``Instrument``.
#
# Not imitated: overruns as ``halsampler`` reports them, other columns than the usual.


class CsvStreamEmulator(Instrument):
    """One line a trigger."""

    counter_range = 2**32
    _scaling = StreamScaling()

    def pack(self, measured: Measured, counters: np.ndarray, times_ns: np.ndarray) -> list[bytes]:
        """Return the line of each sample."""
        rows = np.zeros(len(measured), row_dtype(COLUMNS))
        rows["sequence"], rows["device_time"] = counters, times_ns
        rows["status"] = measured.status
        nothing = np.isnan(measured.distance)
        rows["distance"] = np.where(
            nothing, self._scaling.probe.invalid, measured.distance / NANOMETRE_M
        )
        for name in SOURCES_AXES:
            axis = getattr(self._scaling, name)
            rows[name] = measured.axes[name] * axis.counts_per_unit
        return encode_lines(rows)
