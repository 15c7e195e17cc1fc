"""Reads the generic six-channel stream, binary or text."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from omsm_ros.instruments.blocks import BlockSettings, Channels, wrapping
from omsm_ros.instruments.counting import SAMPLE, Counting, Samples
from omsm_ros.instruments.parameters import NowNs, Values, axes_of, block_settings
from omsm_ros.instruments.scaling import AXES
from omsm_ros.instruments.six_channel.latches import PANDA_COUNTS
from omsm_ros.instruments.six_channel.protocol import (
    COLUMNS,
    MOST_COUNTS,
    CsvDecoder,
    FrameArray,
    FrameDecoder,
    ProbeScaling,
    StreamScaling,
    known_status,
)
from omsm_ros.instruments.stream import StreamDevice
from omsm_ros.instruments.transport import PANDA_SCHEME, Transport


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamSettings(BlockSettings):
    """Settings of the stream.  scaling: counts ↔ SI."""

    scaling: StreamScaling = field(default_factory=StreamScaling)


class GenericStreamDevice(StreamDevice):
    """Reads the binary stream; the sender needs no commands.

    unknown_status: samples with a status that this package does not know, delivered as LOST
    """

    def __init__(
        self, transport: Transport, settings: StreamSettings | None = None, *clocks: Any
    ) -> None:
        settings = settings or StreamSettings()
        super().__init__(
            transport, settings, Channels(axes=settings.scaling.axes), Counting(2**32), *clocks
        )
        self.unknown_status = 0
        self._scaling = settings.scaling
        self._decoder = FrameDecoder()

    def counts(self) -> dict[str, float]:
        """Return all statistics by name, those of the protocol included."""
        return super().counts() | {"unknown_status": self.unknown_status}

    def _decode(self, data: bytes) -> Samples:
        frames = self._decoder.feed(data)
        # Zeros mark an idle line.
        self._unread = 0 if len(frames) else self._unread + len(data) - data.count(0)
        self.unknown_status += int(np.sum(~known_status(frames["status"])))
        return samples_of(frames, self._scaling)


def samples_of(frames: FrameArray, scaling: StreamScaling) -> Samples:
    """Return the samples (n,) of decoded frames (n,)."""
    samples = np.zeros(len(frames), SAMPLE)
    samples["counter"] = frames["sequence"]
    samples["time"] = frames["device_time"].astype(np.int64)
    samples["distance"], samples["status"] = scaling.probe.readings(
        frames["distance"].astype(float), frames["status"]
    )
    samples["intensity"] = np.nan
    samples["counts"] = frames["counts"]
    return samples


# Text may carry decimals of a count: this many parts of a count are resolved.
PARTS = 1_000_000
_MOST_PARTS = MOST_COUNTS * PARTS


@dataclass(frozen=True, slots=True, kw_only=True)
class CsvSettings(StreamSettings):
    """Settings of the text stream.

    columns: of a line, in order;  modulus: of the sequence
    parts: of a count that are resolved;  homed: as of Channels
    An axis without a column stays at its offset.
    """

    columns: tuple[str, ...] = COLUMNS
    modulus: int = 2**32
    parts: int = PARTS
    homed: bool = False


class CsvStreamDevice(StreamDevice):
    """Reads the text stream; the sender needs no commands."""

    described_by = "`columns` (the columns of a line)"

    def __init__(
        self, transport: Transport, settings: CsvSettings | None = None, *clocks: Any
    ) -> None:
        settings = settings or CsvSettings()
        self._columns, self._probe = settings.columns, settings.scaling.probe
        self._parts = n = settings.parts
        timed = "device_time" in settings.columns
        has_axes = bool(set(AXES) & set(settings.columns))
        in_parts = (
            replace(axis, counts_per_unit=axis.counts_per_unit * n, wrap=axis.wrap * n)
            for axis in settings.scaling.axes
        )
        axes = tuple(in_parts) if has_axes else None
        channels = Channels("distance" in settings.columns, axes, timed, settings.homed)
        counting = Counting(settings.modulus, timed=timed, checked=False)
        super().__init__(transport, settings, channels, counting, *clocks)
        self._decoder = CsvDecoder(settings.columns, _MOST_PARTS // n)

    def _decode(self, data: bytes) -> Samples:
        rows = self._decoder.feed(data)
        self._unread = 0 if len(rows) else self._unread + len(data.strip())
        samples = np.zeros(len(rows), SAMPLE)
        samples["counter"] = rows["sequence"]
        samples["intensity"] = np.nan
        if self.channels.timed:
            samples["time"] = rows["device_time"]
        if "distance" in self._columns:
            given = rows["status"] if "status" in self._columns else np.zeros(len(rows), int)
            found = self._probe.readings(rows["distance"], given)
            samples["distance"], samples["status"] = found
        for index, name in enumerate(AXES):
            if name in self._columns:
                samples["counts"][:, index] = np.rint(rows[name] * self._parts).astype(np.int64)
        return samples


def _stream_settings(values: Values) -> dict[str, Any]:
    """Return the settings of a sender that cannot be asked whether it pauses or is gone.

    A serial line is never half open, so only a TCP connection is made anew.
    """
    renew = values["renew"] if values["port"].startswith("tcp://") else 0.0
    return block_settings(values) | {"renew": renew}


def _probe_scaling(values: Values) -> ProbeScaling:
    return ProbeScaling(full_scale=values["probe.full_scale"], polarity=values["probe.polarity"])


def make_binary(values: Values, transport: Transport, now_ns: NowNs) -> GenericStreamDevice:
    """Return the device that ``values`` describe."""
    axes = axes_of(values)
    if values["port"].startswith(PANDA_SCHEME):
        axes = dict(
            zip(AXES, wrapping(tuple(axes[a] for a in AXES), PANDA_COUNTS) or (), strict=True)
        )
    scaling = StreamScaling(**axes, probe=_probe_scaling(values))
    settings = StreamSettings(**_stream_settings(values), scaling=scaling)
    return GenericStreamDevice(transport, settings, now_ns)


def make_text(values: Values, transport: Transport, now_ns: NowNs, **more: Any) -> CsvStreamDevice:
    """Return the device that ``values`` describe, with ``more`` of CsvSettings."""
    columns = tuple(values["columns"].replace(",", " ").split())
    read = [axis for axis in AXES if axis in columns]
    scaling = StreamScaling(**axes_of(values, read), probe=_probe_scaling(values))
    settings = CsvSettings(**_stream_settings(values), columns=columns, scaling=scaling, **more)
    return CsvStreamDevice(transport, settings, now_ns)
