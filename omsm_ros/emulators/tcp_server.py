"""A TCP port without hardware: the device's end of a connection on this machine."""

from __future__ import annotations

import contextlib
import select
import socket
import threading
from types import TracebackType

from omsm_ros.errors import DeviceError

_CHUNK_BYTES = 65_536
# How long a write waits at a time before it looks at its stop event [s].
_LOOK_S = 0.05


class TcpServer:
    """One client at a time on a loopback port, that stays the same over ``unplug``.

    A second client is turned away at once, as by a device with one connection; with
    ``newest_wins`` it takes the first one's place, as by others. Bytes written while nobody is
    connected are lost. A client that does not read is waited for. ``sessions`` counts the
    clients that were let in, ``turned_away`` the others.

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

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.unplug()

    @property
    def path(self) -> str:
        """What a driver opens."""
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

    @property
    def has_reader(self) -> bool:
        """Whether a client is connected."""
        self._accept()
        return self._client is not None

    def read(self) -> bytes:
        """Return what the client sent; b"" if nothing."""
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
        """Return bytes of ``data`` a client can get: fewer without one, or when ``stop`` is set."""
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
        """Return whether the client has closed its end."""
        if (client := self._client) is None:
            return True
        try:
            return client.recv(1, socket.MSG_PEEK) == b""
        except BlockingIOError:
            return False
        except OSError:
            return True

    def _drop(self) -> None:
        # A fault on command comes from another thread than what serves.
        client, self._client = self._client, None
        if client is not None:
            with contextlib.suppress(OSError):
                client.shutdown(socket.SHUT_RDWR)
            client.close()
