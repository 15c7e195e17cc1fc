"""The server: the page and the socket on one port, for this computer, or with a token."""

import contextlib
import html
import json
import re
import resource
import socket as sockets
import threading
import time
import urllib.error
import urllib.request
from contextlib import ExitStack
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pytest

pytest.importorskip("websockets", reason="websockets is an optional package")
import websockets
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect
from websockets.sync.server import Server

from omsm_ros.core.correction.surface_points import POINT_DTYPE
from omsm_ros.errors import ConfigurationError
from omsm_ros.live_page.live_view import LiveView
from omsm_ros.live_page.server import LiveServer, render

TOKEN = "a-token-of-some-length"


@pytest.fixture
def view():
    return LiveView()


@pytest.fixture
def serve(view):
    """Starts servers of ``view``; all end with the test."""
    started = []

    def start(**options):
        given = {"page": render("Cell <1>"), "host": "127.0.0.1", "port": 0} | options
        server = LiveServer(view, **given)
        server.start()
        started.append(server)
        return server

    yield start
    for server in started:
        server.stop()


def points(count):
    made = np.zeros(count, POINT_DTYPE)
    made["x"] = np.linspace(-1e-3, 1e-3, count)
    made["height"] = 1e-9
    return made


def socket_of(server, **options):
    return connect(server.address.replace("http", "ws", 1) + "live", **options)


def until_closed(socket):
    """Read until the other side closes."""
    for _ in range(100):
        socket.recv(timeout=5)


def test_the_page_is_one_file_that_runs_no_foreign_script(serve):
    with urllib.request.urlopen(serve().address) as answer:
        page = answer.read().decode()
        assert answer.headers["X-Frame-Options"] == "DENY"
    assert "Cell &lt;1&gt;" in page
    policy = html.unescape(re.search(r'Content-Security-Policy" content="([^"]+)"', page)[1])
    assert "default-src 'none'" in policy
    assert "script-src 'sha256-" in policy
    assert not re.search(r"(src|href)=[\"']?(https?:)?//", page)


def test_a_browser_gets_the_full_state_once_and_then_changes_only(serve, view):
    view.add_points(points(500))
    with socket_of(serve()) as socket:
        state = json.loads(socket.recv(timeout=5))
        assert state["points"] == 500
        first = socket.recv(timeout=5)
        assert isinstance(first, bytes)
        view.add_points(points(3))
        while isinstance(news := socket.recv(timeout=5), str):
            pass
        assert len(news) < len(first)


def test_two_browsers_do_not_share_what_is_new(serve, view):
    server = serve()
    view.add_points(points(50))
    sizes = []
    for _ in range(2):
        with socket_of(server) as socket:
            while isinstance(news := socket.recv(timeout=5), str):
                pass
            sizes.append(len(news))
    assert sizes[0] == sizes[1]


def test_a_browser_that_talks_too_much_is_shown_the_door(serve):
    with socket_of(serve()) as socket:
        socket.send("x" * 2000)
        with pytest.raises(ConnectionClosed):
            until_closed(socket)


def test_nothing_but_the_page_is_there(serve):
    with pytest.raises(urllib.error.HTTPError, match="404"):
        urllib.request.urlopen(serve().address + "etc/passwd")


def test_a_foreign_page_gets_nothing(serve):
    server = serve()
    with (
        pytest.raises(InvalidStatus, match="403"),
        socket_of(server, additional_headers={"Origin": "http://evil.example"}),
    ):
        pass


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "", "127.0.0.1.evil.example"])
def test_a_foreign_name_that_points_here_gets_nothing(serve, host):
    request = urllib.request.Request(serve().address, headers={"Host": host})
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(request)


def test_beyond_this_computer_only_with_a_token(serve, view):
    with pytest.raises(ConfigurationError, match="token of at least 16"):
        LiveServer(view, "", "0.0.0.0", 0)
    server = serve(host="0.0.0.0", token=TOKEN)
    port = re.search(r":(\d+)/", server.address)[1]
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/?token={TOKEN}") as answer:
        assert answer.status == 200
    for wrong in ("", "?token=", "?token=wrong"):
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(f"http://127.0.0.1:{port}/{wrong}")
        with (
            pytest.raises(InvalidStatus, match="403"),
            connect(f"ws://127.0.0.1:{port}/live{wrong}"),
        ):
            pass


def test_a_token_of_any_signs_opens_the_page_and_the_address_does_not_show_it(serve, view):
    token = "a b&c=d#e%f/g+h?ä" * 2
    server = serve(token=token)
    assert "token" not in server.address
    with urllib.request.urlopen(f"{server.address}?token={quote(token, '')}") as answer:
        assert answer.status == 200
    with pytest.raises(ConfigurationError, match="at most 200 fit into an address"):
        LiveServer(view, "", "127.0.0.1", 0, "x" * 201)


def test_a_port_that_is_taken_is_named(serve, view):
    server = serve()
    port = int(re.search(r":(\d+)/", server.address)[1])
    with pytest.raises(ConfigurationError, match=f"{port}: .*choose another port"):
        LiveServer(view, "", "127.0.0.1", port).start()


def test_seventeen_browsers_are_one_too_many(serve):
    server = serve()
    with ExitStack() as browsers:
        for _ in range(16):
            browsers.enter_context(socket_of(server)).recv(timeout=5)
        with socket_of(server) as late, pytest.raises(ConnectionClosed):
            late.recv(timeout=5)


def test_a_server_that_ends_lets_go_of_its_port(serve, view):
    server = serve()
    port = int(re.search(r":(\d+)/", server.address)[1])
    with socket_of(server) as socket:
        socket.recv(timeout=5)
        server.stop()
        with pytest.raises(ConnectionClosed):
            until_closed(socket)
    time.sleep(0.1)
    assert serve(port=port).address == f"http://127.0.0.1:{port}/"


GOOD = b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"


def port_of(server):
    return int(re.search(r":(\d+)/", server.address)[1])


def answer_to(server, request):
    """Return what comes back for the bytes of a request."""
    with sockets.create_connection(("127.0.0.1", port_of(server)), timeout=5) as line:
        line.sendall(request)
        return b"".join(iter(lambda: line.recv(65536), b"")).decode()


@pytest.mark.parametrize(
    ("request_line", "more", "status"),
    [
        ("GET /", "Host: [::1", 403),
        ("GET /live", "Host: 127.0.0.1\r\nOrigin: http://[::1", 403),
        ("GET //[", "Host: 127.0.0.1", 400),
        ("POST /", "Host: 127.0.0.1", 405),
        ("HEAD /", "Host: 127.0.0.1", 405),
        ("DELETE /live", "Host: 127.0.0.1", 405),
    ],
)
def test_a_foolish_request_is_refused_without_a_traceback(
    serve, caplog, request_line, more, status
):
    if status == 405 and websockets.__version__ < "17":
        pytest.skip("websockets answers no other method before 17")
    reported = answer_to(serve(), f"{request_line} HTTP/1.1\r\n{more}\r\n\r\n".encode())
    assert reported.startswith(f"HTTP/1.1 {status} ")
    assert not caplog.records


def test_idle_connections_leave_room_for_a_browser_and_excess_ones_are_refused(serve):
    server = serve()
    with ExitStack() as idle:
        for _ in range(64):
            idle.enter_context(sockets.create_connection(("127.0.0.1", port_of(server)), 5))
        time.sleep(0.3)
        with pytest.raises(urllib.error.HTTPError, match="503"):
            urllib.request.urlopen(server.address)
    reported = ""
    for _ in range(50):
        time.sleep(0.05)
        reported = answer_to(server, GOOD)
        if not reported.startswith("HTTP/1.1 503 "):
            break
    assert reported.startswith("HTTP/1.1 200 ")


def test_the_page_is_there_again_after_the_process_ran_out_of_files(serve):
    """A server that stopped at the first failure of accept was silent for good."""
    server = serve()
    urllib.request.urlopen(server.address, timeout=5).close()  # it has begun
    least = len(list(Path("/proc/self/fd").iterdir()))
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    with ExitStack() as files:
        line = files.enter_context(sockets.socket())
        resource.setrlimit(resource.RLIMIT_NOFILE, (least + 20, limits[1]))
        files.callback(resource.setrlimit, resource.RLIMIT_NOFILE, limits)
        for _ in range(20):
            with contextlib.suppress(OSError):
                files.enter_context(Path("/dev/null").open())
        line.connect(("127.0.0.1", port_of(server)))
        time.sleep(0.5)
    with urllib.request.urlopen(server.address, timeout=5) as answer:
        assert answer.status == 200


def test_a_server_that_never_began_is_stopped_all_the_same(serve, monkeypatch):
    """Its thread ends before it serves: whoever stops it would wait for ever."""

    def fail(self):
        raise OSError(24, "too many open files")

    monkeypatch.setattr(Server, "serve_forever", fail)
    monkeypatch.setattr(threading, "excepthook", lambda _: None)
    serve()
    for thread in threading.enumerate():
        if thread.name.endswith("(_serve)"):
            thread.join(10.0)
