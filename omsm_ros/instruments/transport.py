"""Opens serial ports and TCP connections, and moves bytes to and from a device.

Constructors open nothing. A lost connection raises ``DeviceError``; ``open`` connects again.
"""

from __future__ import annotations

import math
import re
import socket
import struct
import sys
import termios
import time
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from typing import Any, Protocol, TypeVar
from urllib.parse import SplitResult, urlsplit

import serial
from serial.tools import list_ports

from omsm_ros.errors import ConfigurationError, DeviceError, DeviceTimeoutError
from omsm_ros.units import NANOSECOND_S, NANOSECONDS_PER_S


def parts_of(address: str) -> SplitResult:
    """Return the parts of an address such as ``daq://Dev1/ai0?range=10``; ConfigurationError."""
    try:
        parts = urlsplit(address)
        _ = parts.port  # raises as well
        return parts
    except ValueError as err:
        raise ConfigurationError(f"address {address!r} cannot be read: {err}") from err


DEFAULT_BAUD_RATE = 921_600
# A backlog is read in pieces: two seconds of it decoded at once left half a megabyte of unused
# holes in the memory of the process.
_CHUNK_BYTES = 16_384
ADS_SCHEME, PANDA_SCHEME = "ads://", "panda://"
_TCP_SCHEME = "tcp://"
# Keep-alive: a probe each second, which a device that was switched off refuses when it is back; the
# connection is lost after 10 without answer, or if sent data is not acknowledged within 10 s.
_KEEP_ALIVE = {
    socket.TCP_KEEPIDLE: 1,
    socket.TCP_KEEPINTVL: 1,
    socket.TCP_KEEPCNT: 10,
    socket.TCP_USER_TIMEOUT: 10_000,
}
# Linux notes when the last segment read arrived, by the clock of the date: socket(7).
_STAMPED = (socket.SOL_SOCKET, 35)  # SO_TIMESTAMPNS, which Python does not name
_TIMESPEC = struct.Struct("@ll")
# The clock of the date was set, or this process was interrupted between two looks at the clocks, if
# they differ by so much more than before [ns].
_SET_NS = 20_000
# Time to connect once more, while the silent connection is not read [s].
_SPARE_S = 0.5
_SERIAL_SCHEME = "serial://"


class Transport(Protocol):
    """A byte stream with a name for messages."""

    @property
    def name(self) -> str:
        """Return the name in messages: a port, or a host and its port."""
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


# An answer comes within this and the multiple of the time of the slowest one before. A device may
# become slower, so each connection without an answer adds the last [s].
_QUICK_S, _SEVERAL_TIMES, _MORE_S = 0.5, 2.0, 0.25


class Patience:
    """How long to wait for an answer: as stated, then by the slowest one so far.

    A device is set up in its context.
    """

    def __init__(self, stated: float) -> None:
        self._stated = stated
        self._slowest, self._more = math.inf, 0.0

    @property
    def seconds(self) -> float:
        """Return the longest time to wait for an answer [s]."""
        return min(self._stated, _QUICK_S + _SEVERAL_TIMES * self._slowest + self._more)

    def note(self, took: float) -> None:
        """Enter the time that an answer took [s]."""
        self._slowest = took if math.isinf(self._slowest) else max(self._slowest, took)

    def __enter__(self) -> None:
        """Begin to set the device up."""

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        """Wait longer next time if an answer did not come, as usual again if all came."""
        if error is None:
            self._more = 0.0
        elif issubclass(error, DeviceTimeoutError):
            self._more += _MORE_S


# How long a command port waits for more of an answer at a time [s].
_ANSWER_POLL_S = 0.05
# A greeting is over when nothing came for the first, and ends after the second at the latest [s].
_QUIET_S, _GREETING_S = 0.1, 1.0
# Bounds the memory of an answer without its end.
_MAX_ANSWER_BYTES = 65_536
_Connection = TypeVar("_Connection", serial.Serial, socket.socket)


def _opened(connection: _Connection | None, name: str) -> _Connection:
    if connection is None:
        raise DeviceError(f"{name!r} is not open; call open() first")
    return connection


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
        port = _opened(self._port, self.name)
        try:
            if port.timeout != timeout:
                port.timeout = timeout  # costs a system call, so only when it changes
            first: bytes = port.read(1)
            return first + port.read(min(port.in_waiting, _CHUNK_BYTES)) if first else b""
        except (OSError, termios.error) as err:
            raise self._lost(err) from err

    def write(self, data: bytes) -> None:
        port = _opened(self._port, self.name)
        try:
            port.write(data)
        except (OSError, termios.error) as err:
            raise self._lost(err) from err

    def close(self) -> None:
        if self._port is not None:
            self._port.close()
            self._port = None

    def _lost(self, err: Exception) -> DeviceError:
        return DeviceError(
            f"serial port {self.name!r} was lost: {err}; check cable and power, then open again"
        )


class TcpTransport:
    """A TCP client connection.

    age: how long before the end of the last read its last byte arrived, by the kernel [s]; 0 if the
        kernel does not say it, or the clock was set meanwhile
    """

    def __init__(self, host: str, port: int, connect_timeout: float = 5.0) -> None:
        if not 0 < port < 2**16:
            raise ConfigurationError(f"TCP port {port!r}, expected 1 to 65535")
        self.name = f"{_TCP_SCHEME}{host}:{port}"
        self._address = (host, port)
        self._connect_timeout = connect_timeout
        self._socket: socket.socket | None = None
        self.age = 0.0
        self._offset = self._steady_since = 0  # date less monotonic clock, and since when [ns]

    def spare(self) -> TcpTransport:
        """Return another connection to the same address, not yet open."""
        return TcpTransport(*self._address, _SPARE_S)

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
        # A device that loses its power does not close the connection, and the silence of a
        # triggered device is normal; only keep-alive distinguishes the two.
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in _KEEP_ALIVE.items():
            connection.setsockopt(socket.IPPROTO_TCP, option, value)
        with suppress(OSError):  # refused by other systems than Linux
            connection.setsockopt(*_STAMPED, 1)
        self._socket = connection

    def read(self, timeout: float) -> bytes:
        connection = _opened(self._socket, self.name)
        try:
            connection.settimeout(timeout)
            data, notes, *_ = connection.recvmsg(_CHUNK_BYTES, socket.CMSG_SPACE(_TIMESPEC.size))
        except (TimeoutError, BlockingIOError):
            data, notes = None, []
        except OSError as err:
            raise self._lost(str(err)) from err
        date, now = time.time_ns(), time.monotonic_ns()
        if abs(date - now - self._offset) > _SET_NS:
            self._offset, self._steady_since = date - now, now
        self.age = 0.0
        for level, kind, stamp in notes:
            if (level, kind) == _STAMPED:
                seconds, nanoseconds = _TIMESPEC.unpack(stamp)
                age = date - seconds * NANOSECONDS_PER_S - nanoseconds
                self.age = age * NANOSECOND_S if 0 < age < now - self._steady_since else 0.0
        if data == b"":
            raise self._lost("closed by the device")
        return data or b""

    def write(self, data: bytes) -> None:
        connection = _opened(self._socket, self.name)
        try:
            connection.settimeout(self._connect_timeout)
            connection.sendall(data)
        except OSError as err:
            raise self._lost(str(err)) from err

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _lost(self, reason: str) -> DeviceError:
        return DeviceError(
            f"connection to {self.name!r} was lost: {reason}; check network and power, then "
            "open again"
        )


class CommandPort:
    """Sends commands to a device that ends each answer with a prompt; connected while in use."""

    def __init__(
        self,
        transport: Transport,
        prompt: bytes,
        patience: Patience,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        """prompt: regular expression of the end of an answer."""
        self._transport = transport
        self._prompt = re.compile(prompt)
        self._patience = patience
        self._monotonic = monotonic

    def __enter__(self) -> CommandPort:
        """Connect, and read the device's greeting, which may also end with a prompt."""
        self._transport.open()
        deadline = self._monotonic() + _GREETING_S
        while self._transport.read(_QUIET_S) and self._monotonic() < deadline:
            pass
        return self

    def __exit__(self, *_: object) -> None:
        self._transport.close()

    def ask(self, text: str, end: str, sign: bytes = b"") -> str:
        """Return the answer to ``text``, its echo and prompt included; DeviceTimeoutError if none.

        sign: regular expression that each answer to this command contains; a prompt before it
            belongs to an earlier answer. If it never comes, the last prompt ends the answer.
        """
        self._transport.write((text + end).encode())
        said, asked = b"", self._monotonic()
        while not self._complete(said, sign):
            said = (said + self._transport.read(_ANSWER_POLL_S))[-_MAX_ANSWER_BYTES:]
            if self._monotonic() - asked > self._patience.seconds:
                if self._complete(said, b""):
                    break
                raise DeviceTimeoutError(
                    f"{self._transport.name} did not answer {text!r} (received {said[-32:]!r}); "
                    "check that the controller's command port is open and no other client uses it"
                )
        else:
            self._patience.note(self._monotonic() - asked)
        return said.decode("latin-1")

    def _complete(self, said: bytes, sign: bytes) -> bool:
        begun = re.search(sign, said)
        return begun is not None and self._prompt.search(said, begun.end()) is not None


def transport_for(address: str, baud_rate: int = DEFAULT_BAUD_RATE) -> Transport:
    """Return the transport that ``address`` names.

    ``tcp://host:port``; ``ads://host?symbol=GVL.omsm`` of a TwinCAT PLC;
    ``panda://host?x=INENC1.VAL`` of a PandABox;
    ``serial:///dev/ttyUSB0?baud=921600`` or the path of a serial port
    (``baud_rate`` where the address has none); any URL that pyserial knows
    (``rfc2217://host:port``). Raises ConfigurationError.
    """
    if address.startswith(_TCP_SCHEME):
        host, _, port = address[len(_TCP_SCHEME) :].rpartition(":")
        if not (host and port.isdecimal()):
            raise ConfigurationError(f"address {address!r}, expected tcp://host:port")
        return TcpTransport(host.strip("[]"), int(port))
    if address.startswith((ADS_SCHEME, PANDA_SCHEME)):
        from omsm_ros.instruments.six_channel.latches import AdsRing, PandaBox

        return AdsRing(address) if address.startswith(ADS_SCHEME) else PandaBox(address)
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


def optional_package(what: str, *modules: str) -> Any:
    """Return the package of ``modules``, which ``what`` needs; DeviceError if it is missing."""
    name = modules[0].partition(".")[0]
    try:
        for module in modules:
            import_module(module)
    except ImportError as err:
        raise DeviceError(f"{what} needs {name}: pip install {name}") from err
    return sys.modules[name]


def serial_ports() -> list[str]:
    """Return the paths of this computer's serial ports, in order."""
    return sorted(port.device for port in list_ports.comports())
