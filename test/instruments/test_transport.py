"""Transports over a real pseudo-terminal and a real loopback socket."""

from __future__ import annotations

import contextlib
import os
import socket
import threading
import time
import tty
from collections.abc import Iterator
from io import FileIO

import pytest

from omsm_ros.errors import ConfigurationError, DeviceError, DeviceTimeoutError
from omsm_ros.instruments.transport import (
    Patience,
    SerialTransport,
    TcpTransport,
    Transport,
    transport_for,
)

SOON = 5.0


@pytest.fixture
def pair() -> Iterator[tuple[FileIO, str]]:
    """The device's end and the port's name of a raw pseudo-terminal."""
    master, slave = os.openpty()
    tty.setraw(slave)
    with FileIO(master, "r+") as device, FileIO(slave, "r+"):
        yield device, os.ttyname(slave)


@pytest.fixture
def server() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        listening.settimeout(SOON)
        yield listening


@pytest.fixture
def serial_transport(pair: tuple[FileIO, str]) -> Iterator[SerialTransport]:
    transport = SerialTransport(pair[1])
    yield transport
    transport.close()


@pytest.fixture
def tcp_transport(server: socket.socket) -> Iterator[TcpTransport]:
    transport = TcpTransport(*server.getsockname())
    yield transport
    transport.close()


def read_all(transport: Transport, count: int) -> bytes:
    data = b""
    while len(data) < count and (more := transport.read(SOON)):
        data += more
    return data


# Serial.


def test_every_byte_value_passes_a_serial_port(
    pair: tuple[FileIO, str], serial_transport: SerialTransport
) -> None:
    serial_transport.open()
    sent = bytes(range(256)) * 8
    pair[0].write(sent)
    assert read_all(serial_transport, len(sent)) == sent
    serial_transport.write(sent[:256])
    assert pair[0].read(256) == sent[:256]


def test_silence_on_a_serial_port_is_no_error(serial_transport: SerialTransport) -> None:
    serial_transport.open()
    assert serial_transport.read(0.01) == b""


def test_serial_port_held_by_another_is_named(
    pair: tuple[FileIO, str], serial_transport: SerialTransport
) -> None:
    serial_transport.open()
    with pytest.raises(DeviceError, match=pair[1]):
        SerialTransport(pair[1]).open()


def test_missing_serial_port_is_named() -> None:
    with pytest.raises(DeviceError, match=r"'/dev/no-such-port' at 115200 baud.*dialout"):
        SerialTransport("/dev/no-such-port", 115_200).open()


def test_a_serial_port_that_may_not_be_opened_is_named(pair: tuple[FileIO, str]) -> None:
    mode, user = os.stat(pair[1]).st_mode, os.geteuid()
    os.chmod(pair[1], 0)
    try:
        if user == 0:
            os.seteuid(65_534)  # root may open anything
        with pytest.raises(DeviceError, match=r"Permission denied.*membership of group dialout"):
            SerialTransport(pair[1]).open()
    finally:
        os.seteuid(user)
        os.chmod(pair[1], mode)


def test_lost_serial_port_raises_and_says_what_to_do(
    pair: tuple[FileIO, str], serial_transport: SerialTransport
) -> None:
    serial_transport.open()
    pair[0].close()
    with pytest.raises(DeviceError, match=r"was lost.*open again"):
        serial_transport.read(SOON)


def test_serial_port_opens_again(
    pair: tuple[FileIO, str], serial_transport: SerialTransport
) -> None:
    for word in (b"first", b"second"):
        serial_transport.open()
        pair[0].write(word)
        assert read_all(serial_transport, len(word)) == word
        serial_transport.close()


# TCP.


def test_every_byte_value_passes_tcp(server: socket.socket, tcp_transport: TcpTransport) -> None:
    tcp_transport.open()
    device, _ = server.accept()
    with device:
        sent = bytes(range(256)) * 1000
        sender = threading.Thread(target=device.sendall, args=(sent,))
        sender.start()
        assert read_all(tcp_transport, len(sent)) == sent
        sender.join(SOON)
        tcp_transport.write(b"\x00\xff")
        assert device.recv(2) == b"\x00\xff"


@pytest.mark.parametrize("timeout", [0.0, 0.01])
def test_silence_on_tcp_is_no_error(
    server: socket.socket, tcp_transport: TcpTransport, timeout: float
) -> None:
    tcp_transport.open()
    device, _ = server.accept()
    with device:
        assert tcp_transport.read(timeout) == b""


def test_tcp_closed_by_the_device_and_opened_again(
    server: socket.socket, tcp_transport: TcpTransport
) -> None:
    tcp_transport.open()
    server.accept()[0].close()
    with pytest.raises(DeviceError, match=r"closed by the device.*open again"):
        tcp_transport.read(SOON)
    tcp_transport.open()
    device, _ = server.accept()
    with device:
        device.sendall(b"back")
        assert read_all(tcp_transport, 4) == b"back"


def test_nobody_listening_is_named() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        port = listening.getsockname()[1]
    with pytest.raises(DeviceError, match=f"cannot connect to 'tcp://127.0.0.1:{port}'"):
        TcpTransport("127.0.0.1", port).open()


# Both.


@pytest.mark.parametrize("address", ["/dev/ttyUSB7", "tcp://device.invalid:7890"])
def test_nothing_is_touched_before_open(address: str) -> None:
    transport = transport_for(address)
    assert transport.name == address
    with pytest.raises(DeviceError, match=r"call open\(\) first"):
        transport.read(0.0)
    with pytest.raises(DeviceError, match=r"call open\(\) first"):
        transport.write(b"x")
    transport.close()
    transport.close()


def test_addresses_choose_their_transport() -> None:
    assert isinstance(transport_for("/dev/ttyS0"), SerialTransport)
    assert isinstance(transport_for("tcp://192.168.0.2:7890"), TcpTransport)
    assert isinstance(transport_for("tcp://[::1]:7890"), TcpTransport)


def test_a_serial_url_tells_its_own_baud_rate() -> None:
    named = transport_for("serial:///dev/ttyUSB0?baud=460800", 9600)
    assert isinstance(named, SerialTransport)
    assert (named.name, named.baud_rate) == ("/dev/ttyUSB0", 460_800)
    plain = transport_for("serial:///dev/ttyUSB0", 9600)
    assert isinstance(plain, SerialTransport)
    assert plain.baud_rate == 9600


def test_urls_of_pyserial_are_passed_on() -> None:
    echo = transport_for("loop://")
    echo.open()
    echo.write(b"there and back")
    assert read_all(echo, 14) == b"there and back"
    echo.close()


@pytest.mark.parametrize(
    "address", ["serial://", "serial:///dev/x?speed=9", "serial:///dev/x?baud=fast"]
)
def test_malformed_serial_url_is_named(address: str) -> None:
    with pytest.raises(ConfigurationError, match=r"expected serial:///dev/ttyUSB0"):
        transport_for(address)


@pytest.mark.parametrize("address", ["tcp://host", "tcp://host:", "tcp://:7890", "tcp://h:x"])
def test_malformed_address_is_named(address: str) -> None:
    with pytest.raises(ConfigurationError, match="expected tcp://host:port"):
        transport_for(address)


def test_senseless_numbers_are_refused() -> None:
    with pytest.raises(ConfigurationError, match="baud_rate 0"):
        SerialTransport("/dev/ttyS0", 0)
    with pytest.raises(ConfigurationError, match="70000"):
        TcpTransport("host", 70_000)


def test_a_tcp_device_that_vanishes_is_noticed(
    server: socket.socket, tcp_transport: TcpTransport
) -> None:
    """The system asks whether it is still there, and gives it up within fifteen seconds."""
    tcp_transport.open()
    connection = tcp_transport._socket
    assert connection is not None
    assert connection.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
    idle, interval, count = (
        connection.getsockopt(socket.IPPROTO_TCP, option)
        for option in (socket.TCP_KEEPIDLE, socket.TCP_KEEPINTVL, socket.TCP_KEEPCNT)
    )
    assert idle + interval * count <= 15
    assert connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) <= 15_000


# Answers.


@pytest.mark.parametrize(("slow", "failures"), [(0.4, 0), (1.2, 3), (1.95, 6)])
def test_a_device_that_became_slower_is_awaited_longer_at_each_attempt(
    slow: float, failures: int
) -> None:
    """One answer is slow, the others are quick; afterwards all are quick again."""
    patience, failed = Patience(2.0), 0
    assert patience.seconds == 2.0
    for took in (0.01, slow):
        patience.note(0.01)
        while took > patience.seconds:
            with contextlib.suppress(DeviceTimeoutError), patience:
                patience.note(0.01)
                raise DeviceTimeoutError("no answer")
            failed += 1
    assert failed == failures
    with patience:
        patience.note(0.01)
    assert patience.seconds == pytest.approx(0.52)


def test_tcp_tells_how_long_its_bytes_have_waited(
    server: socket.socket, tcp_transport: TcpTransport, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A busy host reads late; the kernel notes when the bytes came. Nothing is said of bytes that
    came before the clock was set."""
    tcp_transport.open()
    seen = 0
    connection, _ = server.accept()
    with connection:
        for step in (0, 0, 0, 10**9, -(10**9)):
            assert tcp_transport.read(0.01) == b""
            assert tcp_transport.age == 0
            before = time.monotonic()
            connection.sendall(b"12 34\n")
            sent = time.monotonic()
            time.sleep(0.1)
            clock = time.time_ns
            monkeypatch.setattr(time, "time_ns", lambda clock=clock, step=step: clock() + step)
            began = time.monotonic()
            assert tcp_transport.read(SOON) == b"12 34\n"
            ended = time.monotonic()
            if step:
                assert tcp_transport.age == 0
            elif tcp_transport.age:  # else it was interrupted between its looks at the clocks
                assert began - sent - 1e-4 <= tcp_transport.age <= ended - before + 1e-4
                seen += 1
    assert seen
