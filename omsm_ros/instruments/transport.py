"""Bytes to and from a device: serial port or TCP, the only module that opens either.

Constructors touch nothing. A lost connection raises ``DeviceError``; ``open`` again connects
anew.
"""

from __future__ import annotations

import ctypes
import socket
import termios
import time
from typing import Any, Protocol
from urllib.parse import SplitResult, parse_qs, urlsplit

import numpy as np
import serial
from serial.tools import list_ports

from omsm_ros.errors import ConfigurationError, DeviceError
from omsm_ros.instruments.six_channel.protocol import BODY_SIZE, FRAME, encode_frames

# Addresses of devices as URLs: ``daq://Dev1/ai0?range=10``.


def parts_of(address: str) -> SplitResult:
    """Return scheme, host, path and query; ConfigurationError for a text that is no address."""
    try:
        return urlsplit(address)
    except ValueError as err:
        raise ConfigurationError(f"address {address!r} cannot be read: {err}") from err


# A TwinCAT PLC's ring buffer over Beckhoff ADS, delivered as the six-channel stream.
#
# Reading variables one by one is neither synchronous with the trigger nor fast enough, so the PLC
# writes each sample, with its trigger counter, into a ring, and the whole ring is read at once:
# ADS answers between two cycles of the PLC, so what comes belongs together. In structured text,
# packed to one byte::
#
#     TYPE OmsmSample : STRUCT
#         sequence : UDINT; device_time : ULINT; distance : DINT; status : USINT;
#         counts : ARRAY[0..4] OF LINT;
#     END_STRUCT END_TYPE
#     TYPE OmsmRing : STRUCT
#         written : ULINT;                       (* samples so far *)
#         samples : ARRAY[0..999] OF OmsmSample; (* sample n lies at n MOD 1000 *)
#     END_STRUCT END_TYPE
#
# Tried against pyads' own test server; untried on hardware.

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


DEFAULT_BAUD_RATE = 921_600
# What waited while this process stood still comes in pieces: decoded at once, two seconds of it
# left half a megabyte of holes in the memory of the process.
_CHUNK_BYTES = 16_384
ADS_SCHEME = "ads://"
_TCP_SCHEME = "tcp://"
# First probe after so many seconds, the next ones, and how many go unanswered before it is lost;
# and what was sent is not waited for longer [ms].
_KEEP_ALIVE = {
    socket.TCP_KEEPIDLE: 5,
    socket.TCP_KEEPINTVL: 2,
    socket.TCP_KEEPCNT: 3,
    socket.TCP_USER_TIMEOUT: 10_000,
}
_SERIAL_SCHEME = "serial://"


class Transport(Protocol):
    """A byte stream with a name to put into messages."""

    @property
    def name(self) -> str:
        """Return what the stream is called in messages: a port, or a host and its port."""
        ...

    def open(self) -> None:
        """Connect; raises DeviceError."""

    def read(self, timeout: float) -> bytes:
        """Return what has arrived, waiting up to ``timeout`` [s] for a first byte; else b"".

        Raises DeviceError when the connection is lost.
        """

    def write(self, data: bytes) -> None:
        """Send all of ``data``; raises DeviceError."""

    def close(self) -> None:
        """Disconnect; does nothing when not connected."""


class SerialTransport:
    """A serial port 8N1, real or pseudo-terminal, held exclusively, or any URL of pyserial.

    Opening discards what the port received before.
    """

    def __init__(self, port: str, baud_rate: int = DEFAULT_BAUD_RATE) -> None:
        if not baud_rate > 0:
            raise ConfigurationError(f"baud_rate {baud_rate!r}, expected a positive number")
        self.name = port
        self.baud_rate = baud_rate
        self._port: serial.Serial | None = None

    def open(self) -> None:
        self.close()
        try:
            if "://" in self.name:
                self._port = serial.serial_for_url(self.name, self.baud_rate)
            else:
                self._port = serial.Serial(self.name, self.baud_rate, exclusive=True)
        except (OSError, ValueError, termios.error) as err:
            raise DeviceError(
                f"cannot open serial port {self.name!r} at {self.baud_rate!r} baud: {err}; check "
                "the cable, the port's name, membership of group dialout, and that no other "
                "program holds it"
            ) from err

    def read(self, timeout: float) -> bytes:
        port = self._connected()
        try:
            if port.timeout != timeout:
                port.timeout = timeout  # costs a system call, so only when it changes
            first: bytes = port.read(1)
            return first + port.read(min(port.in_waiting, _CHUNK_BYTES)) if first else b""
        except (OSError, termios.error) as err:
            raise self._lost(err) from err

    def write(self, data: bytes) -> None:
        port = self._connected()
        try:
            port.write(data)
        except (OSError, termios.error) as err:
            raise self._lost(err) from err

    def close(self) -> None:
        if self._port is not None:
            self._port.close()
            self._port = None

    def _connected(self) -> serial.Serial:
        if self._port is None:
            raise DeviceError(f"serial port {self.name!r} is not open; call open() first")
        return self._port

    def _lost(self, err: Exception) -> DeviceError:
        return DeviceError(
            f"serial port {self.name!r} was lost: {err}; check cable and power, then open again"
        )


class TcpTransport:
    """A TCP client connection."""

    def __init__(self, host: str, port: int, connect_timeout: float = 5.0) -> None:
        if not 0 < port < 2**16:
            raise ConfigurationError(f"TCP port {port!r}, expected 1 to 65535")
        self.name = f"{_TCP_SCHEME}{host}:{port}"
        self._address = (host, port)
        self._connect_timeout = connect_timeout
        self._socket: socket.socket | None = None

    def open(self) -> None:
        self.close()
        try:
            connection = socket.create_connection(self._address, self._connect_timeout)
        except OSError as err:
            raise DeviceError(
                f"cannot connect to {self.name!r} within {self._connect_timeout!r} s: {err}; "
                "check address, network and power"
            ) from err
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        # A device that lost its power says no farewell; its silence alone could be that of a
        # triggered device at rest.
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in _KEEP_ALIVE.items():
            connection.setsockopt(socket.IPPROTO_TCP, option, value)
        self._socket = connection

    def read(self, timeout: float) -> bytes:
        connection = self._connected()
        try:
            connection.settimeout(timeout)
            data = connection.recv(_CHUNK_BYTES)
        except (TimeoutError, BlockingIOError):
            return b""
        except OSError as err:
            raise self._lost(str(err)) from err
        if not data:
            raise self._lost("closed by the device")
        return data

    def write(self, data: bytes) -> None:
        connection = self._connected()
        try:
            connection.settimeout(self._connect_timeout)
            connection.sendall(data)
        except OSError as err:
            raise self._lost(str(err)) from err

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _connected(self) -> socket.socket:
        if self._socket is None:
            raise DeviceError(f"{self.name!r} is not open; call open() first")
        return self._socket

    def _lost(self, reason: str) -> DeviceError:
        return DeviceError(
            f"connection to {self.name!r} was lost: {reason}; check network and power, then "
            "open again"
        )


def transport_for(address: str, baud_rate: int = DEFAULT_BAUD_RATE) -> Transport:
    """Return the transport that ``address`` names.

    ``tcp://host:port``; ``ads://host?symbol=GVL.omsm`` of a TwinCAT PLC;
    ``serial:///dev/ttyUSB0?baud=921600`` or the path of a serial port
    (``baud_rate`` where the address has none); any URL that pyserial knows
    (``rfc2217://host:port``). Raises ConfigurationError.
    """
    if address.startswith(_TCP_SCHEME):
        host, _, port = address[len(_TCP_SCHEME) :].rpartition(":")
        if not (host and port.isdecimal()):
            raise ConfigurationError(f"address {address!r}, expected tcp://host:port")
        return TcpTransport(host.strip("[]"), int(port))
    if address.startswith(ADS_SCHEME):
        # few have a PLC to read

        return AdsRing(address)
    if address.startswith(_SERIAL_SCHEME):
        path, _, query = address[len(_SERIAL_SCHEME) :].partition("?")
        name, _, value = query.partition("=")
        if not path or (query and (name != "baud" or not value.isdecimal())):
            raise ConfigurationError(
                f"address {address!r}, expected serial:///dev/ttyUSB0 or "
                "serial:///dev/ttyUSB0?baud=921600"
            )
        return SerialTransport(path, int(value) if value else baud_rate)
    return SerialTransport(address, baud_rate)


def serial_ports() -> list[str]:
    """Return the paths of this computer's serial ports, in order."""
    return sorted(port.device for port in list_ports.comports())
