"""Emulated devices by name: their ports, and how motions are played on them."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import threading
import time
import tty
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from omsm_ros.core.streams.blocks import AccelerationBlock, part_of
from omsm_ros.errors import ConfigurationError, DeviceError
from omsm_ros.instruments.emulator import (
    AXIS_SCALING,
    Instrument,
    InstrumentFaults,
    InstrumentLink,
    RecordingSource,
)
from omsm_ros.instruments.registry import PROBES, REFERENCES, loaded
from omsm_ros.instruments.scaling import AXES, ProbeReading
from omsm_ros.quantities import TCP_PORT
from omsm_ros.twin.cell import Probe, Recording
from omsm_ros.units import MICROMETRE_M

_CHUNK_BYTES = 65_536
# Between two looks of a waiting write at its stop event [s].
_LOOK_S = 0.05


class TcpServer:
    """Serves one client at a time on a loopback port, which stays the same over ``unplug``.

    A second client is refused at once, as by a device with one connection. Bytes written without a
    client are lost; a client that does not read delays the writer. ``sessions`` counts the clients
    that were accepted.

    Not imitated: delay, loss and reordering of a network, keep-alive, several clients.
    """

    def __init__(self, port: int = 0) -> None:
        """port: 0 = any free one."""
        self._port = port
        self._listening: socket.socket | None = None
        self._client: socket.socket | None = None
        self.sessions = 0

    def __enter__(self) -> TcpServer:
        self.plug()
        return self

    def __exit__(self, *_: object) -> None:
        self.unplug()

    @property
    def path(self) -> str:
        """Return the address that a driver opens."""
        return f"tcp://127.0.0.1:{self._port}"

    def plug(self) -> None:
        """Listen, on the same port as before."""
        try:
            self._listening = socket.create_server(("127.0.0.1", self._port))
        except OSError as err:
            raise DeviceError(f"cannot listen on {self.path!r}: {err}; choose another") from err
        self._listening.setblocking(False)
        self._port = self._listening.getsockname()[1]

    def unplug(self) -> None:
        """End the connection and refuse new ones."""
        self._drop()
        if self._listening is not None:
            self._listening.close()
            self._listening = None

    def read(self) -> bytes:
        """Return the bytes that the client sent; b"" if none."""
        self._accept()
        if (data := self._received(_CHUNK_BYTES)) is None:
            self._drop()
        return data or b""

    def write(self, data: bytes, stop: threading.Event | None = None) -> int:
        """Send ``data``; return the bytes taken, fewer without a client or after ``stop``."""
        self._accept()
        remaining = memoryview(data)
        while remaining and (client := self._client) is not None and not (stop and stop.is_set()):
            try:
                select.select([], [client], [], _LOOK_S)
                remaining = remaining[client.send(remaining) :]
            except BlockingIOError:
                continue
            except (OSError, ValueError):  # a ValueError if it was unplugged at this moment
                self._drop()
        return len(data) - len(remaining)

    def _accept(self) -> None:
        while self._listening is not None:
            try:
                client, _ = self._listening.accept()
            except OSError:
                return
            if self._received(1, socket.MSG_PEEK) is not None:
                client.close()
                continue
            self._drop()
            client.setblocking(False)
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._client = client
            self.sessions += 1

    def _received(self, most: int, flags: int = 0) -> bytes | None:
        """Return what the client sent, None if it is gone."""
        try:
            return (self._client and self._client.recv(most, flags)) or None
        except BlockingIOError:
            return b""
        except OSError:
            return None

    def _drop(self) -> None:
        # Faults on command come from another thread than the one that serves.
        client, self._client = self._client, None
        if client is not None:
            with contextlib.suppress(OSError):
                client.shutdown(socket.SHUT_RDWR)
            client.close()


class Pty:
    """A pseudo-terminal in raw mode, whose other end a driver opens like a serial port.

    It stays when drivers close and open it again. Bytes written while no driver has it open are
    lost, as on a real line. While a driver does not read, ``write`` waits, where a real UART would
    overrun. The system does not report that another driver opens it, so ``sessions`` stays 0.

    Not imitated: baud rate, parity, modem lines, breaks.
    """

    sessions = 0

    def __init__(self, link: str | Path | None = None) -> None:
        """link: symbolic link to create, or to replace."""
        self._link = None if link is None else Path(link)
        self._master: int | None = None
        self._slave_name = ""

    def __enter__(self) -> Pty:
        self.plug()
        return self

    def plug(self) -> None:
        """Create the port, with the same link as before."""
        self._master, slave = os.openpty()
        try:
            tty.setraw(slave)
            self._slave_name = os.ttyname(slave)
        finally:
            # Kept open here, a driver that opens or closes it would not be noticed.
            os.close(slave)
        os.set_blocking(self._master, False)
        try:
            self._make_link()
        except (OSError, ConfigurationError) as err:
            self.unplug()
            if isinstance(err, ConfigurationError):
                raise
            raise DeviceError(
                f"cannot create link {str(self._link)!r}: {err}; choose another"
            ) from err

    def __exit__(self, *_: object) -> None:
        """Remove the port once no driver has it open; one that ends with the cell has left soon."""
        until = time.monotonic() + _LEAVE_S
        while self._master is not None and time.monotonic() < until:
            if self._events(0.0) & select.POLLHUP:
                break
            time.sleep(_LOOK_S)
        self.unplug()

    def unplug(self) -> None:
        """Remove the port; an open driver sees its connection lost, as if a cable is pulled."""
        with contextlib.suppress(OSError):  # no link, or a name that no file can have
            if self._link is not None and os.readlink(self._link) == self._slave_name:
                self._link.unlink()
        if self._master is not None:
            os.close(self._master)
            self._master = None

    @property
    def path(self) -> str:
        """Return what a driver opens: the link, or the terminal's own name without one."""
        return str(self._link or self._slave_name)

    def read(self) -> bytes:
        """Return what the driver sent; b"" if nothing."""
        try:
            return os.read(self._descriptor(), _CHUNK_BYTES)
        except OSError:  # no bytes, or no driver
            return b""

    def write(self, data: bytes, stop: threading.Event | None = None) -> int:
        """Send ``data``; return the bytes taken, fewer without a driver or after ``stop``."""
        remaining = memoryview(data)
        while remaining and not (stop and stop.is_set()):
            events = self._events(_LOOK_S)
            if events & select.POLLHUP:
                break
            if events & select.POLLOUT:
                with contextlib.suppress(BlockingIOError):
                    remaining = remaining[os.write(self._descriptor(), remaining) :]
        return len(data) - len(remaining)

    def _events(self, timeout: float) -> int:
        poll = select.poll()
        poll.register(self._descriptor(), select.POLLOUT)
        found = poll.poll(timeout * 1000)
        return found[0][1] if found else 0

    def _descriptor(self) -> int:
        if self._master is None:
            raise DeviceError("the pseudo-terminal is closed; use it inside its with block")
        return self._master

    def _make_link(self) -> None:
        if self._link is None:
            return
        if self._link.is_symlink():
            self._link.unlink()
        elif self._link.exists():
            raise ConfigurationError(
                f"link {str(self._link)!r} exists and is not a symbolic link; choose another name"
            )
        self._link.symlink_to(self._slave_name)


_TCP = "tcp://127.0.0.1:"
# Most digits of a port, since ``int`` refuses thousands of them.
_PORT_DIGITS = 10
_END_S, _LEAVE_S = 5.0, 1.0
# The twin's probe measures about its middle, an emulated one from the beginning of its range.
TWIN_READING = ProbeReading(full_scale=100 * MICROMETRE_M, zero=Probe().half_range)
OWN_ENCODERS: dict[str, object] = {"trigger": "each", "probe.zero": TWIN_READING.zero} | {
    f"{name}.counts_per_unit": axis.counts_per_unit
    for name, axis in zip(AXES, AXIS_SCALING, strict=True)
}
"""Parameters with which a driver reads an emulated probe that counts the axes itself."""


@dataclass(frozen=True, slots=True)
class Emulated:
    """An emulated device, or the second one of the same trigger.

    make: returns the device on a line;  driver: parameters a driver needs to read it
    tcp: it needs a TCP port, where others also work on a serial one;  second: another device
    baud_rate: its line has no more, so a demonstration is slow, and small [bit/s]; 0 = any
    node: whose parameters ``driver`` are
    part: returns the recording of a motion as this device measures it
    """

    make: Callable[..., Instrument]
    driver: dict[str, object]
    tcp: bool = False
    second: Emulated | None = None
    baud_rate: int = 0
    node: str = "confocal_driver"
    part: Callable[[Recording], Recording] = lambda recording: recording


EMULATED = tuple(name for name, model in (PROBES | REFERENCES).items() if model.emulator)
"""Names of the devices that have an emulator."""


def emulated(device: str) -> Emulated:
    """Return the emulated device of that name; ConfigurationError if there is none."""
    if device not in EMULATED:
        raise ConfigurationError(f"device {device!r}, expected one of {sorted(EMULATED)}")
    found: Emulated = loaded((PROBES | REFERENCES)[device].emulator)
    return found


def reference_in(recording: Recording) -> Recording:
    """Return the motion as a reference sensor measures it; ConfigurationError without one."""
    if recording.reference is None:
        raise ConfigurationError("this motion has no reference; add `reference` to disturbances")
    return replace(recording, distance=recording.reference)


def line_for(link: str) -> Pty | TcpServer:
    """Return the emulated port: ``tcp://127.0.0.1:port`` or a pseudo-terminal's path."""
    if not link.startswith("tcp://"):
        return Pty(link)
    port = link.removeprefix(_TCP)
    if not (link.startswith(_TCP) and port.isdecimal() and len(port) <= _PORT_DIGITS):
        raise ConfigurationError(
            f"link {link!r}, expected a path or {_TCP}PORT: an emulator stays on this machine"
        )
    return TcpServer(TCP_PORT.checked(int(port), ConfigurationError, f"port of link {link!r}"))


class Player:
    """Plays motions on emulated devices of one trigger, on each its own part.

    Each instrument runs in a thread: it always answers, and measures while a motion is played.
    """

    def __init__(self, *devices: tuple[Instrument, Callable[[Recording], Recording]]) -> None:
        self._devices, self._stop = devices, threading.Event()
        self._threads = [
            threading.Thread(target=one.serve, args=(self._stop,), daemon=True)
            for one, _ in devices
        ]
        for thread in self._threads:
            thread.start()

    @property
    def playing(self) -> bool:
        """Return whether a motion has samples left."""
        return any(one.playing for one, _ in self._devices)

    @property
    def played(self) -> int:
        """Return the number of samples of the motion so far."""
        return min(one.played for one, _ in self._devices)

    def start(self, recording: Recording, time_lapse: float) -> None:
        """Begin a motion; its trigger counts from zero."""
        parts = [(one, part(recording)) for one, part in self._devices]
        for one, measured in parts:
            one.play(RecordingSource(measured), time_lapse)

    def halt(self) -> None:
        """End the motion."""
        for one, _ in self._devices:
            one.halt()

    def close(self) -> None:
        """End the motion and the devices."""
        self.halt()
        self._stop.set()
        for thread in self._threads:
            thread.join(timeout=_END_S)


def player_for(
    device: str,
    line: InstrumentLink,
    second: InstrumentLink | None = None,
    faults: InstrumentFaults | None = None,
    seed: int = 1,
) -> Player:
    """Return what plays motions on ``line``, and on the line of the ``second`` device, if any."""
    known, faults = emulated(device), faults or InstrumentFaults()
    devices = [(known.make(line, triggered=True, seed=seed), known.part)]
    if known.second is not None and second is not None:
        devices.append((known.second.make(second, triggered=True), known.second.part))
    for one, _ in devices:
        one.faults = faults
    return Player(*devices)


class AccelerationFeed:
    """Supplies the acceleration of a recording, if it has some, while its motion is played."""

    def __init__(self, recording: Recording, start_ns: int) -> None:
        """start_ns: begin of the motion [ns]."""
        self._whole, self._start_ns, self._taken = recording.acceleration, start_ns, 0
        self._period = recording.axes.sample_period

    def due(self, played: int) -> AccelerationBlock | None:
        """Return the samples up to the trigger ``played`` that were not returned before."""
        whole = self._whole
        if whole is None:
            return None
        until = min(int(played * self._period / whole.sample_period), len(whole))
        if until <= self._taken:
            return None
        begin, self._taken = self._taken, until
        return part_of(replace(whole, stamp_ns=self._start_ns), begin, until)
