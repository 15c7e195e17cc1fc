"""One port for the page and its socket: shows, and takes no orders."""

from __future__ import annotations

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

import matplotlib
import numpy as np
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.sync.server import Server, ServerConnection, serve

from omsm_ros.errors import ConfigurationError
from omsm_ros.io import json_and_yaml
from omsm_ros.live_page.live_view import LiveView
from omsm_ros.report import style
from omsm_ros.report.measurement.surface_map import policy_of, script
from omsm_ros.report.page_parts import fill

# How many may knock at one port: so many at a time, and the port outlives a flood of them.

# So that closing the port is noticed; and how long to wait where the process has no file left.
_LOOK_S = 0.2
_REFUSAL = (
    f"HTTP/1.1 {http.HTTPStatus.SERVICE_UNAVAILABLE.value} Service Unavailable\r\n"
    "Content-Type: text/plain; charset=utf-8\r\nConnection: close\r\nRetry-After: 5\r\n\r\n"
    "too many connections: close other pages, and load this one again\n"
).encode()


class ConnectionLimit(socket.socket):
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

    def releasing_slot(
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


LOOPBACK = ("127.0.0.1", "::1", "localhost")
_MOST_BROWSERS = 16
# Those of the browsers, pages on their way, and some that only knock: each is two files, a thread.
_MOST_CONNECTIONS = 64
_PERIOD_S = 0.25
_STATES_EVERY = 2
_LONGEST_TOKEN = 200
# A browser has nothing to say.
_MOST_BYTES_RECEIVED = 1024


class LiveServer:
    """Serves ``page`` at ``/`` and what is new at ``/live``; each browser has a thread.

    A slow browser is updated less often; nothing waits for it, and nothing queues up.
    """

    def __init__(self, view: LiveView, page: str, host: str, port: int, token: str = "") -> None:
        """port: 0 takes any that is free;  token: must stand behind ``?token=`` in the address.

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
        """Listen; ConfigurationError if the port is taken."""
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
        """Return the page, a refusal, or None where the socket may be opened."""
        if (place := _split(request.path)) is None:
            return _text(http.HTTPStatus.BAD_REQUEST, "the address cannot be read\n")
        # Before websockets 17 a request has no method but GET.
        if getattr(request, "method", "GET") != "GET":
            refusal = _text(http.HTTPStatus.METHOD_NOT_ALLOWED, "the page is only read: GET\n")
            refusal.headers["Allow"] = "GET"
            return refusal
        given = parse_qs(place.query).get("token", [""])[0]
        if self._token and not hmac.compare_digest(given.encode(), self._token.encode()):
            return _text(http.HTTPStatus.FORBIDDEN, "the address lacks its token\n")
        if not self._from_here(request):
            return _text(http.HTTPStatus.FORBIDDEN, "asked for by another page\n")
        if place.path == "/live":
            return None
        if place.path == "/":
            return _html(self._page)
        return _text(http.HTTPStatus.NOT_FOUND, "there is only /\n")

    def _from_here(self, request: Request) -> bool:
        """Return whether no page of another origin asks, and the name is one of this computer's.

        A browser sends the page's origin with a socket's request; a foreign name that points here
        (DNS rebinding) stands in Host.
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
        while True:
            if turn % _STATES_EVERY == 0:
                state = json_and_yaml.unknown_as_null(self._view.state())
                connection.send(json_and_yaml.text_of(state))
            if (news := self._view.news(generation, version)) is not None:
                content, generation, version = news
                connection.send(content)
            turn += 1
            try:
                connection.recv(timeout=_PERIOD_S)  # says nothing of use, but tells a closed line
            except TimeoutError:
                continue


def _split(address: str) -> SplitResult | None:
    """Return the parts of an address, None where it is none (``//[::1``)."""
    try:
        return urlsplit(address)
    except ValueError:
        return None


def _html(text: str) -> Response:
    headers = Headers(
        {
            "Content-Type": "text/html; charset=utf-8",
            "Cache-Control": "no-store",
            "X-Content-Type-Options": "nosniff",
            "X-Frame-Options": "DENY",
            "Referrer-Policy": "no-referrer",
        }
    )
    return _response(http.HTTPStatus.OK, headers, text)


def _text(status: http.HTTPStatus, text: str) -> Response:
    return _response(status, Headers({"Content-Type": "text/plain; charset=utf-8"}), text)


def _response(status: http.HTTPStatus, headers: Headers, text: str) -> Response:
    body = text.encode()
    headers["Content-Length"] = str(len(body))
    headers["Connection"] = "close"
    return Response(status.value, status.phrase, headers, body)


def _serve(server: Server) -> None:
    """Serve until the server is shut down, which waits for the end, however this ends."""
    try:
        server.serve_forever()
    finally:
        # Where it ends before it has begun, websockets does neither.
        server.socket_closed.set()
        server.shutdown_watcher.close()


# The page of a running scan: one file, nothing fetched, drawn by the script of the maps.

_COLOURS = 128


def render(title: str) -> str:
    """Return the page as HTML; it opens a socket to where it came from."""
    colours = matplotlib.colormaps[style.MAP_COLOURS](np.linspace(0, 1, _COLOURS))[:, :3]
    palette = "".join(f"{round(255 * part):02x}" for row in colours for part in row)
    folder = resources.files("omsm_ros.report") / "templates"
    drawing = script() + (folder / "live.js").read_text(encoding="utf-8")
    return fill(
        "live.html",
        title=title,
        script=drawing,
        script_policy=policy_of(drawing),
        palette=palette,
        missing=style.MISSING.lstrip("#"),
    )
