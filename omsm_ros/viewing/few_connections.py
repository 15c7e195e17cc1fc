"""How many may knock at one port: so many at a time, and the port outlives a flood of them."""

from __future__ import annotations

import contextlib
import http
import socket
import threading
import time
from collections.abc import Callable
from typing import Any

# So that closing the port is noticed; and how long to wait where the process has no file left.
_LOOK_S = 0.2
_REFUSAL = (
    f"HTTP/1.1 {http.HTTPStatus.SERVICE_UNAVAILABLE.value} Service Unavailable\r\n"
    "Content-Type: text/plain; charset=utf-8\r\nConnection: close\r\nRetry-After: 5\r\n\r\n"
    "too many connections: close other pages, and load this one again\n"
).encode()


class FewConnections(socket.socket):
    """A listening socket whose ``accept`` keeps to ``most`` connections, and refuses the others.

    A server that stops at the first error of ``accept`` ends only when this is closed: not where a
    peer has gone meanwhile, and not where the process may open no more files.
    """

    def __init__(self, host: str, port: int, most: int) -> None:
        """Listen on ``host``; OSError if the port is taken, UnicodeError if it can be no name."""
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listening = socket.create_server(address[:2], family=family)
        super().__init__(listening.family, listening.type, listening.proto, listening.detach())
        self.settimeout(_LOOK_S)
        self._places = threading.Semaphore(most)

    def accept(self) -> tuple[socket.socket, Any]:
        """Return the next connection that has a place; OSError once this is closed."""
        while True:
            try:
                connection, peer = super().accept()
            except TimeoutError:
                if self.fileno() < 0:
                    raise
            except OSError:
                if self.fileno() < 0:
                    raise
                time.sleep(_LOOK_S)
            else:
                if self._places.acquire(blocking=False):
                    return connection, peer
                _refuse(connection)

    def leaving_after(
        self, handler: Callable[[socket.socket, Any], None]
    ) -> Callable[[socket.socket, Any], None]:
        """Return ``handler`` of a connection and its peer, after which their place is free."""

        def handle(connection: socket.socket, peer: Any) -> None:
            try:
                handler(connection, peer)
            finally:
                self._places.release()

        return handle


def _refuse(connection: socket.socket) -> None:
    with contextlib.suppress(OSError), connection:
        connection.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            connection.recv(4096)  # what was asked: closing over it would take the answer back
        connection.send(_REFUSAL)
        connection.shutdown(socket.SHUT_WR)
