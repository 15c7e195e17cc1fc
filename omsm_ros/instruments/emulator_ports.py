"""Ports for emulated instruments: a TCP port of this computer, and a pseudo-terminal."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import threading
import tty
from pathlib import Path

from omsm_ros.errors import ConfigurationError, DeviceError

_CHUNK_BYTES = 65_536
# Between two looks of a waiting write at its stop event [s].
_LOOK_S = 0.05


class TcpServer:
    """Serves one client at a time on a loopback port, which stays the same over ``unplug``.

    A second client is refused at once, as by a device with one connection; with ``newest_wins``
    it replaces the first one. Bytes written without a client are lost; a client that does not
    read delays the writer. ``sessions`` counts the clients that were accepted, ``turned_away`` the
    others.

    Not imitated: delay, loss and reordering of a network, keep-alive, several clients.
    """

    def __init__(self, port: int = 0, *, newest_wins: bool = False) -> None:
        """port: 0 = any free one."""
        self._port = port
        self._newest_wins = newest_wins
        self._listening: socket.socket | None = None
        self._client: socket.socket | None = None
        self.turned_away = self.sessions = 0

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
        if (client := self._client) is None:
            return b""
        try:
            data = client.recv(_CHUNK_BYTES)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self._drop()
        return data

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

    @property
    def has_reader(self) -> bool:
        """Return whether a client is connected."""
        self._accept()
        return self._client is not None

    def _accept(self) -> None:
        while self._listening is not None:
            try:
                client, _ = self._listening.accept()
            except OSError:
                return
            if not (self._gone() or self._newest_wins):
                self.turned_away += 1
                client.close()
                continue
            self._drop()
            client.setblocking(False)
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._client = client
            self.sessions += 1

    def _gone(self) -> bool:
        if (client := self._client) is None:
            return True
        try:
            return client.recv(1, socket.MSG_PEEK) == b""
        except BlockingIOError:
            return False
        except OSError:
            return True

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
        except OSError as err:
            self.close()
            raise DeviceError(
                f"cannot create link {str(self._link)!r}: {err}; choose another"
            ) from err
        except ConfigurationError:
            self.close()
            raise

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Remove the port; an open driver sees its connection lost."""
        if self._link is not None and self._points_here(self._link):
            self._link.unlink()
        if self._master is not None:
            os.close(self._master)
            self._master = None

    def unplug(self) -> None:
        """Remove the port, as a cable is pulled."""
        self.close()

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
                remaining = remaining[self._write_some(remaining) :]
        return len(data) - len(remaining)

    def _write_some(self, data: memoryview) -> int:
        try:
            return os.write(self._descriptor(), data)
        except BlockingIOError:
            return 0

    @property
    def has_reader(self) -> bool:
        """Return whether a driver has the port open."""
        return not self._events(0.0) & select.POLLHUP

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

    def _points_here(self, link: Path) -> bool:
        try:
            return link.is_symlink() and os.readlink(link) == self._slave_name
        except OSError:  # a name that no file can have
            return False
