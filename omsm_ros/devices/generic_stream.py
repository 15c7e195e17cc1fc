"""The generic six-channel stream from a transport to blocks."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field

import numpy as np

from omsm_ros.devices.blocks import BlockSettings, Channels
from omsm_ros.devices.counting import SAMPLE, Counting, Samples
from omsm_ros.devices.stream import StreamDevice
from omsm_ros.devices.transport import Transport
from omsm_ros.protocols.generic_stream import (
    DecoderStatistics,
    FrameArray,
    FrameDecoder,
    StreamScaling,
    known_status,
)

_SEQUENCE_RANGE = 2**32


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamSettings(BlockSettings):
    """How the stream is read.  scaling: counts ↔ SI."""

    scaling: StreamScaling = field(default_factory=StreamScaling)


class GenericStreamDevice(StreamDevice):
    """Reads the stream; the sender needs no setting up.

    unknown_status: samples whose verdict this package does not know, delivered as LOST
    """

    def __init__(
        self,
        transport: Transport,
        settings: StreamSettings | None = None,
        now_ns: Callable[[], int] = time.time_ns,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        settings = settings or StreamSettings()
        super().__init__(
            transport,
            settings,
            Channels(axes=settings.scaling.axes),
            Counting(_SEQUENCE_RANGE),
            now_ns,
            monotonic,
        )
        self.unknown_status = 0
        self._scaling = settings.scaling
        self._decoder = FrameDecoder()
        self._unread = 0

    @property
    def wire(self) -> DecoderStatistics:
        """What became of every byte."""
        return self._decoder.statistics

    def counts(self) -> dict[str, float]:
        """Return all statistics by name, those of the protocol included."""
        return super().counts() | asdict(self.wire) | {"unknown_status": self.unknown_status}

    def _prepare(self) -> None:
        self._decoder.reset()
        self._unread = 0

    def _decode(self, data: bytes) -> Samples:
        frames = self._decoder.feed(data)
        # Zeros are an idle line.
        self._unread = 0 if len(frames) else self._unread + len(data) - data.count(0)
        self.unknown_status += int(np.sum(~known_status(frames)))
        return samples_of(frames, self._scaling)

    def _listen_in(self, silent: float) -> None:
        self._check_understood(silent, self._unread)


def samples_of(frames: FrameArray, scaling: StreamScaling) -> Samples:
    """Return the samples (n,) of decoded frames (n,)."""
    samples = np.zeros(len(frames), SAMPLE)
    samples["counter"] = frames["sequence"]
    samples["time"] = frames["device_time"].astype(np.int64)
    samples["distance"], samples["status"] = scaling.probe.readings(frames)
    samples["intensity"] = np.nan
    samples["counts"] = frames["counts"]
    return samples
