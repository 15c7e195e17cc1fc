"""The generic six-channel stream from a transport to blocks."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace

import numpy as np

from omsm_ros.core.streams.blocks import Status
from omsm_ros.instruments.blocks import BlockSettings, Channels
from omsm_ros.instruments.counting import SAMPLE, Counting, Samples
from omsm_ros.instruments.six_channel.protocol import (
    AXIS_COLUMNS,
    COLUMNS,
    AxisScaling,
    CsvDecoder,
    DecoderStatistics,
    FrameArray,
    FrameDecoder,
    StreamScaling,
    known_status,
)
from omsm_ros.instruments.stream import StreamDevice
from omsm_ros.instruments.transport import Transport
from omsm_ros.units import NANOMETRE_M

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


# The six-channel stream as text, from a transport to blocks.

# Text may carry decimals of a count: so many parts of it are kept.
_PARTS = 1_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class CsvSettings(BlockSettings):
    """columns: of a line, in order;  scaling: counts ↔ SI;  modulus: where the sequence wraps.

    An axis without a column stands at its offset.
    """

    columns: tuple[str, ...] = COLUMNS
    scaling: StreamScaling = field(default_factory=StreamScaling)
    modulus: int = 2**32


class CsvStreamDevice(StreamDevice):
    """Reads lines; the sender needs no setting up."""

    described_by = "`columns` (what a line holds)"

    def __init__(
        self,
        transport: Transport,
        settings: CsvSettings | None = None,
        now_ns: Callable[[], int] = time.time_ns,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        settings = settings or CsvSettings()
        self._decoder = CsvDecoder(settings.columns)
        self._unread = 0
        self._columns, self._probe = settings.columns, settings.scaling.probe
        timed = "device_time" in settings.columns
        has_axes = bool(set(AXIS_COLUMNS) & set(settings.columns))
        axes = tuple(map(_in_parts, settings.scaling.axes)) if has_axes else None
        channels = Channels("distance" in settings.columns, axes, timed)
        counting = Counting(settings.modulus, timed=timed, checked=False)
        super().__init__(transport, settings, channels, counting, now_ns, monotonic)

    def counts(self) -> dict[str, float]:
        """Return all statistics by name, those of the protocol included."""
        return super().counts() | asdict(self._decoder.statistics)

    def _prepare(self) -> None:
        self._decoder.reset()
        self._unread = 0

    def _decode(self, data: bytes) -> Samples:
        rows = self._decoder.feed(data)
        self._unread = 0 if len(rows) else self._unread + len(data.strip())
        samples = np.zeros(len(rows), SAMPLE)
        samples["counter"] = rows["sequence"]
        samples["intensity"] = np.nan
        if self.channels.timed:
            samples["time"] = rows["device_time"]
        if "distance" in self._columns:
            measured = rows["distance"] != self._probe.invalid
            raw = np.where(measured, rows["distance"], np.nan)
            samples["distance"] = self._probe.polarity * NANOMETRE_M * raw
            given = rows["status"] if "status" in self._columns else Status.OK
            known = np.where((given >= 0) & (given <= max(Status)), given, Status.LOST)
            good = known == Status.OK
            beyond = good & (abs(samples["distance"]) > self._probe.full_scale)
            known = np.where(beyond, Status.OUT_OF_RANGE, known)
            samples["status"] = np.where(good & ~measured, Status.NO_TARGET, known)
        for index, name in enumerate(AXIS_COLUMNS):
            if name in self._columns:
                samples["counts"][:, index] = np.rint(rows[name] * _PARTS).astype(np.int64)
        return samples

    def _listen_in(self, silent: float) -> None:
        self._check_understood(silent, self._unread)


def _in_parts(axis: AxisScaling) -> AxisScaling:
    """Return the same axis, counted in parts of a count."""
    return replace(axis, counts_per_unit=axis.counts_per_unit * _PARTS, wrap=axis.wrap * _PARTS)
