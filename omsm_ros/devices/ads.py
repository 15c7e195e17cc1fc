"""A TwinCAT PLC's ring buffer over Beckhoff ADS, delivered as the six-channel stream.

Reading variables one by one is neither synchronous with the trigger nor fast enough, so the PLC
writes each sample, with its trigger counter, into a ring, and the whole ring is read at once:
ADS answers between two cycles of the PLC, so what comes belongs together. In structured text,
packed to one byte::

    TYPE OmsmSample : STRUCT
        sequence : UDINT; device_time : ULINT; distance : DINT; status : USINT;
        counts : ARRAY[0..4] OF LINT;
    END_STRUCT END_TYPE
    TYPE OmsmRing : STRUCT
        written : ULINT;                       (* samples so far *)
        samples : ARRAY[0..999] OF OmsmSample; (* sample n lies at n MOD 1000 *)
    END_STRUCT END_TYPE

Tried against pyads' own test server; untried on hardware.
"""

from __future__ import annotations

import ctypes
import time
from typing import Any
from urllib.parse import parse_qs

import numpy as np

from omsm_ros.devices.addresses import parts_of
from omsm_ros.errors import ConfigurationError, DeviceError
from omsm_ros.protocols.generic_stream import BODY_SIZE, FRAME, encode_frames

DEFAULT_PORT = 851
DEFAULT_SYMBOL = "GVL.omsm"
DEFAULT_SAMPLES = 1000

_WRITTEN = np.dtype("<u8")
# At 1 kHz twenty samples at a time; a ring of a thousand lasts a second.
_POLL_S = 0.02
_MOST_SAMPLES = 200_000


class AdsRing:
    """Transport that reads ``ads://host[:port][/AMS.net.id][?symbol=GVL.omsm&samples=1000]``.

    Without a net id it is the host's address with ``.1.1``, as TwinCAT sets it. The PLC must have
    a route to this computer. Samples that were overwritten before they were read are a gap of the
    trigger counter.
    """

    def __init__(self, address: str) -> None:
        """Raise ConfigurationError for an address that is none."""
        parts = parts_of(address)
        query = parse_qs(parts.query)
        samples = query.get("samples", [str(DEFAULT_SAMPLES)])[0]
        usable = samples.isdecimal() and 0 < int(samples[:9]) <= _MOST_SAMPLES
        known = set(query) <= {"symbol", "samples"}
        if parts.scheme != "ads" or not parts.hostname or not known or not usable:
            raise ConfigurationError(
                f"address {address!r}, expected ads://host:851/1.2.3.4.1.1?symbol={DEFAULT_SYMBOL}"
                f"&samples={DEFAULT_SAMPLES}, with at most {_MOST_SAMPLES} samples"
            )
        self.name = address
        self._host = parts.hostname
        self._net_id = parts.path.strip("/") or f"{self._host}.1.1"
        try:
            self._port = parts.port or DEFAULT_PORT
        except ValueError as err:
            raise ConfigurationError(f"address {address!r}: {err}") from err
        self._symbol = query.get("symbol", [DEFAULT_SYMBOL])[0]
        self._capacity = int(samples)
        self._size = _WRITTEN.itemsize + self._capacity * BODY_SIZE
        self._plc: Any = None
        self._taken = 0

    def open(self) -> None:
        """Connect and begin with the next sample; raises DeviceError."""
        self.close()
        pyads = _pyads()
        try:
            self._plc = pyads.Connection(self._net_id, self._port, self._host)
            self._plc.open()
            self._taken = self._written(self._snapshot())
        except (pyads.ADSError, OSError, ValueError, TypeError) as err:
            self.close()
            raise DeviceError(
                f"{self.name} does not answer: {err}; check address, net id, and the PLC's route "
                "to this computer"
            ) from err
        except DeviceError:
            self.close()
            raise

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
        """Raise DeviceError: nothing is written into a PLC."""
        raise DeviceError(f"{self.name} is only read")

    def close(self) -> None:
        """Disconnect; does nothing when not connected."""
        if self._plc is not None:
            plc, self._plc = self._plc, None
            try:
                plc.close()
            except Exception:  # whatever state it was in, it is let go
                return

    def _new(self) -> bytes:
        raw = self._snapshot()
        written = self._written(raw)
        if written < self._taken:  # the PLC was restarted and counts anew
            self._taken = 0
        count = min(written - self._taken, self._capacity)
        if not count:
            return b""
        ring = np.frombuffer(raw, np.uint8, offset=_WRITTEN.itemsize).reshape(-1, BODY_SIZE)
        places = np.arange(written - count, written) % self._capacity
        self._taken = written
        frames = np.zeros((count, FRAME.itemsize), np.uint8)
        frames[:, :BODY_SIZE] = ring[places]
        return encode_frames(frames.reshape(-1).view(FRAME))

    def _snapshot(self) -> bytes:
        pyads = _pyads()
        try:
            found = self._plc.read_by_name(self._symbol, ctypes.c_ubyte * self._size)
        except (pyads.ADSError, OSError, RuntimeError) as err:
            raise DeviceError(
                f"{self.name} gives no {self._symbol!r} of {self._size} bytes: {err}; check the "
                f"PLC, the network, and that its ring has {self._capacity} samples, packed to one "
                "byte"
            ) from err
        return bytes(found)

    @staticmethod
    def _written(raw: bytes) -> int:
        return int(np.frombuffer(raw, _WRITTEN, 1)[0])


def _pyads() -> Any:
    try:
        import pyads
    except ImportError as err:
        raise DeviceError("ADS needs pyads: pip install pyads") from err
    return pyads
