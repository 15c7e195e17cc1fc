"""Serves the live page and its socket on one port, read-only."""

import contextlib
import hmac
import http
import socket
import threading
import time
from collections.abc import Callable
from importlib import resources
from typing import Any
from urllib.parse import SplitResult, parse_qs, urlsplit

from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.sync.server import Server, ServerConnection, serve

from omsm_ros.errors import ConfigurationError
from omsm_ros.io import json_and_yaml
from omsm_ros.live_page.live_view import LiveView
from omsm_ros.report import style
from omsm_ros.report.measurement.surface_map import palette, policy_of, script
from omsm_ros.report.page_parts import fill

# Time-out of ``accept``, so that closing the port is noticed, and the pause if the process may
# open no more files [s].
_LOOK_S = 0.2
_REFUSAL = (
    f"HTTP/1.1 {http.HTTPStatus.SERVICE_UNAVAILABLE.value} Service Unavailable\r\n"
    "Content-Type: text/plain; charset=utf-8\r\nConnection: close\r\nRetry-After: 5\r\n\r\n"
    "too many connections: close other pages, and load this one again\n"
).encode()


class ConnectionLimit(socket.socket):
    """A listening socket that accepts at most ``most`` connections, and refuses the others.

    Its ``accept`` raises an error only after it is closed: not if a peer has gone, and not if the
    process may open no more files. So a server that stops at the first error continues.
    """

    def __init__(self, host: str, port: int, most: int) -> None:
        """Listen on ``host``; OSError if the port is in use, UnicodeError for an invalid name."""
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listening = socket.create_server(address[:2], family=family)
        super().__init__(listening.family, listening.type, listening.proto, listening.detach())
        self.settimeout(_LOOK_S)
        self._places = threading.Semaphore(most)

    def accept(self) -> tuple[socket.socket, Any]:
        """Return the next connection within the limit; OSError once the socket is closed."""
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

    def releasing_slot(
        self, handler: Callable[[socket.socket, Any], None]
    ) -> Callable[[socket.socket, Any], None]:
        """Return ``handler`` of a connection and its peer, which frees their place at its end."""

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
            connection.recv(4096)  # the request: closing would discard the answer otherwise
        connection.send(_REFUSAL)
        connection.shutdown(socket.SHUT_WR)


LOOPBACK = ("127.0.0.1", "::1", "localhost")
_MOST_BROWSERS = 16
# Connections of browsers, pages being loaded, and others; each takes two files and a thread.
_MOST_CONNECTIONS = 64
_PERIOD_S = 0.25
_STATES_EVERY = 2
_LONGEST_TOKEN = 200
# Browsers send no messages.
_MOST_BYTES_RECEIVED = 1024


class LiveServer:
    """Serves ``page`` at ``/`` and its updates at ``/live``; each browser has a thread.

    A slow browser gets fewer updates; nothing waits for it, and no queue grows.
    """

    def __init__(self, view: LiveView, page: str, host: str, port: int, token: str = "") -> None:
        """port: 0 = any free one;  token: required as ``?token=`` in the address; empty = none.

        Raises ConfigurationError for a host beyond this computer without a token.
        """
        if host not in LOOPBACK and len(token) < 16:
            raise ConfigurationError(
                f"viewer on {host!r} can be seen from other computers: give a token_file with a "
                "token of at least 16 characters, or host 127.0.0.1"
            )
        if len(token) > _LONGEST_TOKEN:
            raise ConfigurationError(
                f"token of {len(token)} characters, at most {_LONGEST_TOKEN} fit into an address; "
                "shorten it"
            )
        self._view, self._page, self._token = view, page, token
        self._host, self._wanted = host, port
        self._server: Server | None = None
        self._browsers = threading.Semaphore(_MOST_BROWSERS)

    @property
    def address(self) -> str:
        """Return the address of the page, without the token; empty while nobody listens."""
        if self._server is None:
            return ""
        port = self._server.socket.getsockname()[1]
        host = f"[{self._host}]" if ":" in self._host else self._host
        return f"http://{host}:{port}/"

    def start(self) -> None:
        """Listen; ConfigurationError if the port is in use."""
        try:
            listening = ConnectionLimit(self._host, self._wanted, _MOST_CONNECTIONS)
        except (OSError, UnicodeError) as err:
            raise ConfigurationError(
                f"viewer cannot listen on {self._host}:{self._wanted}: {err}; choose another port"
            ) from err
        self._server = serve(
            self._handle,
            sock=listening,
            process_request=self._answer,
            max_size=_MOST_BYTES_RECEIVED,
            compression=None,
            close_timeout=1,
        )
        self._server.handler = listening.releasing_slot(self._server.handler)
        threading.Thread(target=_serve, args=(self._server,), daemon=True).start()

    def stop(self) -> None:
        """Close every connection."""
        if self._server is not None:
            self._server.shutdown()
            self._server = None

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        if (place := _split(request.path)) is None:
            return _response(http.HTTPStatus.BAD_REQUEST, "the address cannot be read\n")
        # Before websockets 17 a request has no method but GET.
        if getattr(request, "method", "GET") != "GET":
            refusal = _response(http.HTTPStatus.METHOD_NOT_ALLOWED, "the page is only read: GET\n")
            refusal.headers["Allow"] = "GET"
            return refusal
        given = parse_qs(place.query).get("token", [""])[0]
        if self._token and not hmac.compare_digest(given.encode(), self._token.encode()):
            return _response(http.HTTPStatus.FORBIDDEN, "the address lacks its token\n")
        if not self._from_here(request):
            return _response(http.HTTPStatus.FORBIDDEN, "requested by another page\n")
        if place.path == "/live":
            return None
        if place.path == "/":
            return _response(http.HTTPStatus.OK, self._page, _PAGE)
        return _response(http.HTTPStatus.NOT_FOUND, "there is only /\n")

    def _from_here(self, request: Request) -> bool:
        """Return whether the request is not of a page of another origin, nor to a foreign name.

        A browser sends the page's origin with the request of a socket; a foreign name that resolves
        to this computer (DNS rebinding) is in Host.
        """
        hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
        if len(hosts) != 1 or len(origins) > 1:
            return False
        host = _split(f"//{hosts[0]}")
        if host is None or (self._host in LOOPBACK and host.hostname not in LOOPBACK):
            return False
        if not origins:
            return True
        origin = _split(origins[0])
        return origin is not None and origin.netloc == hosts[0]

    def _handle(self, connection: ServerConnection) -> None:
        if not self._browsers.acquire(blocking=False):
            connection.close(1013, "too many browsers")
            return
        try:
            self._tell(connection)
        except ConnectionClosed:
            return
        finally:
            self._browsers.release()

    def _tell(self, connection: ServerConnection) -> None:
        generation, version, turn = -1, 0, 0
        while self._server is not None:  # before websockets 17 its end closes no connection
            if turn % _STATES_EVERY == 0:
                state = json_and_yaml.unknown_as_null(self._view.state())
                connection.send(json_and_yaml.text_of(state))
            if (news := self._view.news(generation, version)) is not None:
                content, generation, version = news
                connection.send(content)
            turn += 1
            try:
                connection.recv(timeout=_PERIOD_S)  # raises ConnectionClosed on a closed line
            except TimeoutError:
                continue


def _split(address: str) -> SplitResult | None:
    """Return the parts of an address, None for an invalid one (``//[::1``)."""
    try:
        return urlsplit(address)
    except ValueError:
        return None


_PLAIN = {"Content-Type": "text/plain; charset=utf-8"}
_PAGE = {
    "Content-Type": "text/html; charset=utf-8",
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
}


def _response(status: http.HTTPStatus, text: str, headers: dict[str, str] = _PLAIN) -> Response:
    body = text.encode()
    whole = headers | {"Content-Length": str(len(body)), "Connection": "close"}
    return Response(status.value, status.phrase, Headers(whole), body)


def _serve(server: Server) -> None:
    """Serve until the server is shut down, which waits for the end of this function."""
    try:
        server.serve_forever()
    finally:
        if hasattr(server, "socket_closed"):  # since 17, which does neither before it has begun
            server.socket_closed.set()
            server.shutdown_watcher.close()


def render(title: str) -> str:
    """Return the page as HTML in one file; it opens a socket to its own origin."""
    folder = resources.files("omsm_ros.report") / "templates"
    drawing = script() + (folder / "live.js").read_text(encoding="utf-8")
    return fill(
        "live.html",
        title=title,
        script=drawing,
        script_policy=policy_of(drawing),
        palette=palette(),
        missing=style.MISSING.lstrip("#"),
    )
