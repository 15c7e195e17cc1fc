"""Reads the generic six-channel stream, binary or text, from a line or a TwinCAT PLC."""

import ctypes
import socket
import time
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any
from urllib.parse import parse_qs

import numpy as np
from numpy.typing import NDArray

from omsm_ros.errors import ConfigurationError, DeviceError
from omsm_ros.instruments.blocks import BlockSettings, Channels
from omsm_ros.instruments.counting import SAMPLE, Counting, Samples
from omsm_ros.instruments.parameters import NowNs, Values, axes_of, block_settings
from omsm_ros.instruments.scaling import AXES
from omsm_ros.instruments.six_channel.protocol import (
    BODY_SIZE,
    COLUMNS,
    FRAME,
    MOST_COUNTS,
    CsvDecoder,
    FrameArray,
    FrameDecoder,
    ProbeScaling,
    StreamScaling,
    encode_frames,
    known_status,
)
from omsm_ros.instruments.stream import StreamDevice
from omsm_ros.instruments.transport import Transport, parts_of


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
class CsvSettings(BlockSettings):
    """Settings of the text stream.

    columns: of a line, in order;  scaling: counts ↔ SI;  modulus: of the sequence
    parts: of a count that are resolved;  homed: as of Channels
    An axis without a column stays at its offset.
    """

    columns: tuple[str, ...] = COLUMNS
    scaling: StreamScaling = field(default_factory=StreamScaling)
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
        self._parts = settings.parts
        timed = "device_time" in settings.columns
        has_axes = bool(set(AXES) & set(settings.columns))
        n = settings.parts
        in_parts = (
            replace(axis, counts_per_unit=axis.counts_per_unit * n, wrap=axis.wrap * n)
            for axis in settings.scaling.axes
        )
        axes = tuple(in_parts) if has_axes else None
        channels = Channels("distance" in settings.columns, axes, timed, settings.homed)
        counting = Counting(settings.modulus, timed=timed, checked=False)
        super().__init__(transport, settings, channels, counting, *clocks)
        self._decoder = CsvDecoder(settings.columns, _MOST_PARTS // settings.parts)

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
    scaling = StreamScaling(**axes_of(values), probe=_probe_scaling(values))
    settings = StreamSettings(**_stream_settings(values), scaling=scaling)
    return GenericStreamDevice(transport, settings, now_ns)


def make_text(values: Values, transport: Transport, now_ns: NowNs, **more: Any) -> CsvStreamDevice:
    """Return the device that ``values`` describe, with ``more`` of CsvSettings."""
    columns = tuple(values["columns"].replace(",", " ").split())
    read = [axis for axis in AXES if axis in columns]
    scaling = StreamScaling(**axes_of(values, read), probe=_probe_scaling(values))
    settings = CsvSettings(**_stream_settings(values), columns=columns, scaling=scaling, **more)
    return CsvStreamDevice(transport, settings, now_ns)


# Variables read one by one over Beckhoff ADS are neither synchronous with the trigger nor fast
# enough. So the PLC writes each sample, with its trigger counter, into a ring buffer, and the whole
# ring is read at once: ADS answers between two cycles of the PLC, so the samples are consistent.
# In structured text, packed to one byte::
#
#     TYPE OmsmSample : STRUCT
#         sequence : UDINT; device_time : ULINT; distance : DINT; status : USINT;
#         counts : ARRAY[0..4] OF LINT;
#     END_STRUCT END_TYPE
#     TYPE OmsmRing : STRUCT
#         written : ULINT;                       (* samples so far *)
#         samples : ARRAY[0..999] OF OmsmSample; (* sample n is at n MOD 1000 *)
#     END_STRUCT END_TYPE
#
# Tested against the test server of pyads, not on hardware.

_WRITTEN_SIZE = 8
# At 1 kHz this gives twenty samples at a time, and a ring of a thousand holds a second [s].
_POLL_S = 0.02
# An answer that takes longer than this counts as lost, so that the driver connects again [s].
_ANSWER_S = 0.5
_MOST_SAMPLES = 200_000


class AdsRing:
    """Reads ``ads://host[:port][/AMS.net.id][?symbol=GVL.omsm&samples=1000]``.

    The ring is delivered as the six-channel stream. Without a net id it is the host's address with
    ``.1.1``, as TwinCAT sets it. The PLC must have a route to this computer. Samples that were
    overwritten before they were read are a gap of the trigger counter; those that the ring still
    holds after a lost connection are not lost.
    """

    def __init__(self, address: str) -> None:
        """Raise ConfigurationError for an address that is not valid."""
        parts = parts_of(address)
        query = {"symbol": ["GVL.omsm"], "samples": ["1000"]} | parse_qs(parts.query)
        samples = query["samples"][0]
        usable = samples.isdecimal() and 0 < int(samples[:9]) <= _MOST_SAMPLES
        if parts.scheme != "ads" or not parts.hostname or len(query) != 2 or not usable:
            raise ConfigurationError(
                f"address {address!r}, expected ads://host:851/1.2.3.4.1.1?symbol=GVL.omsm"
                f"&samples=1000, with at most {_MOST_SAMPLES} samples"
            )
        self.name = address
        self._host = parts.hostname
        self._net_id = parts.path.strip("/") or f"{self._host}.1.1"
        self._port = parts.port or 851
        self._symbol = query["symbol"][0]
        self._capacity = int(samples)
        self._size = _WRITTEN_SIZE + self._capacity * BODY_SIZE
        self._plc: Any = None
        self._taken = -1

    def open(self) -> None:
        """Connect, the first time to begin with the next sample; raises DeviceError."""
        self.close()
        pyads = _pyads()
        try:
            # pyads itself would wait for two minutes for a host that is switched off.
            socket.create_connection((self._host, 48898), _ANSWER_S).close()
            self._plc = pyads.Connection(self._net_id, self._port, self._host)
            self._plc.open()
        except (pyads.ADSError, OSError, ValueError, TypeError) as err:
            self.close()
            raise DeviceError(
                f"{self.name} does not answer: {err}; check address, net id, and the PLC's route "
                "to this computer"
            ) from err
        self._plc.set_timeout(round(_ANSWER_S * 1000))
        written, _ = self._snapshot()
        self._taken = written if self._taken < 0 else self._taken
        with suppress(pyads.ADSError, RuntimeError):  # refused if there is no byte more
            self._plc.read_by_name(self._symbol, ctypes.c_ubyte * (self._size + 1))
            raise DeviceError(f"{self.name}: the ring has more samples than that; state how many")

    def read(self, timeout: float) -> bytes:
        """Return new samples as frames of the six-channel stream, b"" if none came in time."""
        if self._plc is None:
            raise DeviceError(f"{self.name} is not open")
        deadline = time.monotonic() + timeout
        while not (data := self._new()):
            left = deadline - time.monotonic()
            if left <= 0:
                return b""
            time.sleep(min(_POLL_S, left))
        return data

    def write(self, data: bytes) -> None:
        """Raise DeviceError: nothing is written to a PLC."""
        raise DeviceError(f"{self.name} is only read")

    def close(self) -> None:
        """Disconnect; does nothing when not connected."""
        if self._plc is not None:
            plc, self._plc = self._plc, None
            with suppress(Exception):  # it is closed in any state
                plc.close()

    def _new(self) -> bytes:
        written, ring = self._snapshot()
        if written < self._taken:  # the PLC was restarted
            self._taken = 0
        count = min(written - self._taken, self._capacity)
        if not count:
            return b""
        places = ((written - count) % self._capacity + np.arange(count)) % self._capacity
        self._taken = written
        frames = np.zeros((count, FRAME.itemsize), np.uint8)
        frames[:, :BODY_SIZE] = ring[places]
        return encode_frames(frames.reshape(-1).view(FRAME))

    def _snapshot(self) -> tuple[int, NDArray[np.uint8]]:
        """Return how many samples were written so far, and the ring (capacity, bytes)."""
        pyads = _pyads()
        try:
            kind = ctypes.c_ubyte * self._size
            raw = bytes(self._plc.read_by_name(self._symbol, kind, return_ctypes=True))
        except (pyads.ADSError, OSError, RuntimeError) as err:
            raise DeviceError(
                f"{self.name} returns no {self._symbol!r} of {self._size} bytes: {err}; check the "
                f"PLC, the network, and that its ring has {self._capacity} samples, packed to one "
                "byte"
            ) from err
        ring = np.frombuffer(raw, np.uint8, offset=_WRITTEN_SIZE).reshape(-1, BODY_SIZE)
        return int.from_bytes(raw[:_WRITTEN_SIZE], "little"), ring


def _pyads() -> Any:
    try:
        import pyads
    except ImportError as err:
        raise DeviceError("ADS needs pyads: pip install pyads") from err
    return pyads
