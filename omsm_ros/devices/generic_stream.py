"""The generic six-channel stream from a transport to blocks.

Every frame received is accounted for: ``frames = delivered + pending + duplicates``; what
never came is ``lost``, what came broken is counted by the decoder.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.samples.blocks import MAX_BLOCK_SAMPLES, AxisBlock, DistanceBlock, IntArray
from omsm_ros.devices.clock import DeviceClock
from omsm_ros.devices.transport import Transport
from omsm_ros.errors import ConfigurationError
from omsm_ros.protocols.generic_stream import (
    AXES,
    FRAME,
    DecoderStatistics,
    FrameArray,
    FrameDecoder,
    StreamScaling,
    known_status,
)
from omsm_ros.units import NANOSECOND_S, PPM

BlockPair: TypeAlias = tuple[AxisBlock, DistanceBlock]

# More than crystals differ by: beyond it the nominal period is wrong.
PERIOD_TOLERANCE = 100 * PPM

_SEQUENCE_RANGE = 2**32


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamSettings:
    """sample_period: nominal [s];  block_size: samples;  pause: a partial block is handed over
    when nothing came for so long [s];  scaling: counts ↔ SI.
    """

    sample_period: float = 1e-3
    block_size: int = 100
    pause: float = 0.2
    scaling: StreamScaling = field(default_factory=StreamScaling)

    def __post_init__(self) -> None:
        for name in ("sample_period", "pause"):
            value = getattr(self, name)
            if not 0 < value < np.inf:
                raise ConfigurationError(f"{name} {value!r} s, expected a positive number")
        if not 0 < self.block_size <= MAX_BLOCK_SAMPLES:
            raise ConfigurationError(
                f"block_size {self.block_size!r}, expected 1 to {MAX_BLOCK_SAMPLES}"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamStatistics(DecoderStatistics):
    """Everything counted since construction, exact between two calls of ``poll``.

    delivered, pending: samples in blocks handed over, and waiting for their block to fill
    duplicates: frames received twice in a row
    lost, gaps: trigger counts that never arrived, and in how many places
    restarts: the device's counter or clock fell back
    unknown_status: samples whose verdict this package does not know, delivered as LOST
    period_deviation: of the last full block's device time from nominal, relative
    period_warnings: full blocks beyond PERIOD_TOLERANCE
    """

    delivered: int = 0
    pending: int = 0
    duplicates: int = 0
    lost: int = 0
    gaps: int = 0
    restarts: int = 0
    unknown_status: int = 0
    blocks: int = 0
    period_deviation: float = 0.0
    period_warnings: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """Frames (n,) with consecutive trigger counts from ``first_sample``.

    restarted: the device started anew just before
    """

    frames: FrameArray
    first_sample: int
    restarted: bool


class SequenceTracker:
    """Frames with a wrapping u32 sequence → runs of an unwrapped trigger counter.

    The same sequence and device time again is a duplicate. Where either of them falls back,
    the device was restarted and its own number counts from there. Anything else that is not
    the next number is a gap.
    """

    def __init__(self) -> None:
        self.duplicates = self.lost = self.gaps = self.restarts = 0
        self._last: FrameArray = np.empty(0, FRAME)
        self._counter = 0

    def split(self, frames: FrameArray) -> Iterator[Run]:
        """Runs of ``frames`` (n,), in order; duplicates left out."""
        chain = np.concatenate([self._last, frames])
        steps = _steps(chain["sequence"]) % _SEQUENCE_RANGE
        advances = _steps(chain["device_time"])
        fresh = (steps != 0) | (advances != 0)
        if len(fresh) < len(frames):  # the very first frame has no predecessor
            first = int(frames["sequence"][0])
            self._counter = first - 1
            steps, advances = np.r_[1, steps], np.r_[1, advances]
            fresh = np.r_[True, fresh]
        self.duplicates += int(np.sum(~fresh))
        self._last = chain[-1:]
        yield from self._runs(frames[fresh], steps[fresh], advances[fresh])

    def _runs(self, frames: FrameArray, steps: IntArray, advances: IntArray) -> Iterator[Run]:
        fallen = (steps == 0) | (steps >= _SEQUENCE_RANGE // 2) | (advances < 0)
        breaks = np.flatnonzero(fallen | (steps != 1))
        edges = np.unique(np.r_[0, breaks, len(frames)])
        for start, end in itertools.pairwise(edges.tolist()):
            restarted = bool(fallen[start])
            if restarted:
                self.restarts += 1
                first = int(frames["sequence"][start])
            else:
                missing = int(steps[start]) - 1
                self.gaps += missing > 0
                self.lost += missing
                first = self._counter + int(steps[start])
            self._counter = first + end - start - 1
            yield Run(frames[start:end], first, restarted)


def _steps(numbers: NDArray[Any]) -> IntArray:
    whole: IntArray = numbers.astype(np.int64)
    return whole[1:] - whole[:-1]


class BlockCutter:
    """Runs → pairs of blocks of ``block_size`` samples; a gap or a restart closes one early."""

    def __init__(self, settings: StreamSettings) -> None:
        self._settings = settings
        self._clock = DeviceClock()
        self._pending: FrameArray = np.empty(0, FRAME)
        self._first = self._stamp = 0
        self._turned: list[int] | None = None
        self.delivered = self.blocks = self.unknown_status = self.period_warnings = 0
        self.period_deviation = 0.0

    @property
    def pending(self) -> int:
        """Samples that wait for their block to fill."""
        return len(self._pending)

    def add(self, run: Run, arrival_ns: int) -> Iterator[BlockPair]:
        """Blocks completed by ``run``, of which the last frame arrived at ``arrival_ns``."""
        if run.restarted or run.first_sample != self._first + self.pending:
            yield from self.flush()
            self._first = run.first_sample
        if run.restarted:
            self._clock.restart()
        self._clock.observe(int(run.frames["device_time"][-1]), arrival_ns)
        if not self.pending:
            self._stamp = self._clock.to_host(int(run.frames["device_time"][0]))
        self._pending = np.concatenate([self._pending, run.frames])
        while self.pending >= self._settings.block_size:
            yield self._take(self._settings.block_size)

    def flush(self) -> Iterator[BlockPair]:
        """The partial block, if any."""
        if self.pending:
            yield self._take(self.pending)

    def _take(self, count: int) -> BlockPair:
        frames, self._pending = self._pending[:count], self._pending[count:]
        first, self._first = self._first, self._first + count
        stamp = self._stamp
        if self.pending:
            self._stamp = self._clock.to_host(int(self._pending["device_time"][0]))
        self.delivered += count
        self.blocks += 1
        self._check_period(frames["device_time"])
        return self._blocks(frames, first, stamp)

    def _check_period(self, device_time: NDArray[np.uint64]) -> None:
        periods = len(device_time) - 1
        if periods < max(1, self._settings.block_size - 1):
            return  # too short to tell a wrong period from jitter
        nominal = periods * self._settings.sample_period
        elapsed = (int(device_time[-1]) - int(device_time[0])) * NANOSECOND_S
        self.period_deviation = elapsed / nominal - 1
        self.period_warnings += abs(self.period_deviation) > PERIOD_TOLERANCE

    def _blocks(self, frames: FrameArray, first: int, stamp: int) -> BlockPair:
        scaling = self._settings.scaling
        period = self._settings.sample_period
        counts = frames["counts"]
        previous = self._turned or counts[0].tolist()
        turned = [axis.unwrap(counts[:, i], previous[i]) for i, axis in enumerate(scaling.axes)]
        self._turned = [int(column[-1]) for column in turned]
        positions = {
            name: axis.values(column)
            for name, axis, column in zip(AXES, scaling.axes, turned, strict=True)
        }
        distance, status = scaling.probe.readings(frames)
        self.unknown_status += int(np.sum(~known_status(frames)))
        return (
            AxisBlock(stamp_ns=stamp, first_sample=first, sample_period=period, **positions),
            DistanceBlock(
                stamp_ns=stamp,
                first_sample=first,
                sample_period=period,
                distance=distance,
                status=status,
            ),
        )


class GenericStreamDevice:
    """Reads the stream and hands over blocks.

    Counters and trigger count live on over ``close`` and ``open``, so what a lost connection
    cost shows up as a gap.
    """

    def __init__(
        self,
        transport: Transport,
        settings: StreamSettings | None = None,
        now_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        """now_ns: the host clock that stamps refer to [ns]."""
        self._transport = transport
        self._settings = settings or StreamSettings()
        self._now_ns = now_ns
        self._decoder = FrameDecoder()
        self._tracker = SequenceTracker()
        self._cutter = BlockCutter(self._settings)
        self._heard = time.monotonic()

    def open(self) -> None:
        """Connect, or connect again; raises DeviceError."""
        self._decoder.reset()
        self._transport.open()

    def poll(self, timeout: float) -> list[BlockPair]:
        """Blocks completed by what arrives within ``timeout`` [s]; may be none.

        Raises DeviceError when the connection is lost; ``close`` then still hands over the
        partial block.
        """
        data = self._transport.read(timeout)
        arrival_ns, now = self._now_ns(), time.monotonic()
        frames = self._decoder.feed(data)
        if not len(frames):
            silent = now - self._heard > self._settings.pause
            return list(self._cutter.flush()) if silent else []
        self._heard = now
        return [
            pair
            for run in self._tracker.split(frames)
            for pair in self._cutter.add(run, arrival_ns)
        ]

    def close(self) -> list[BlockPair]:
        """Disconnect and hand over the partial block, if any."""
        self._transport.close()
        return list(self._cutter.flush())

    @property
    def statistics(self) -> StreamStatistics:
        """Return all counts since the device was made."""
        tracker, cutter = self._tracker, self._cutter
        return StreamStatistics(
            **asdict(self._decoder.statistics),
            delivered=cutter.delivered,
            pending=cutter.pending,
            duplicates=tracker.duplicates,
            lost=tracker.lost,
            gaps=tracker.gaps,
            restarts=tracker.restarts,
            unknown_status=cutter.unknown_status,
            blocks=cutter.blocks,
            period_deviation=cutter.period_deviation,
            period_warnings=cutter.period_warnings,
        )
