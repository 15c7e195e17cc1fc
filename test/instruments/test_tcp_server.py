"""The emulated TCP port as a driver sees it."""

from __future__ import annotations

import os
import threading

import pytest

from omsm_ros.errors import DeviceError
from omsm_ros.instruments.emulator_factory import TcpServer
from omsm_ros.instruments.transport import Transport, transport_for

SOON = 5.0


def read(transport: Transport, count: int) -> bytes:
    data = b""
    while len(data) < count and (more := transport.read(SOON)):
        data += more
    return data


def test_every_byte_value_passes_both_ways() -> None:
    sent = bytes(range(256)) * 4
    with TcpServer() as server:
        driver = transport_for(server.path)
        driver.open()
        assert server.write(sent) == len(sent)
        assert read(driver, len(sent)) == sent
        driver.write(sent)
        back = b""
        while len(back) < len(sent):
            back += server.read()
        assert back == sent
        driver.close()


def test_bytes_without_a_client_are_counted_as_lost() -> None:
    with TcpServer() as server:
        assert server.read() == b""
        assert server.write(b"nobody") == 0


def test_a_second_client_is_turned_away_and_the_first_stays() -> None:
    with TcpServer() as server:
        first, second = transport_for(server.path), transport_for(server.path)
        first.open()
        second.open()
        assert server.write(b"still the first") == 15
        with pytest.raises(DeviceError, match=r"closed by the device|was lost"):
            second.read(SOON)
        assert read(first, 15) == b"still the first"
        assert server.sessions == 1
        first.close()
        second.close()


def test_unplugged_and_plugged_again_on_the_same_port() -> None:
    with TcpServer() as server:
        driver = transport_for(server.path)
        driver.open()
        assert server.read() == b""  # and accepts
        server.unplug()
        with pytest.raises(DeviceError):
            driver.read(SOON)
        with pytest.raises(DeviceError, match="cannot connect"):
            driver.open()
        server.plug()
        driver.open()
        server.write(b"back")
        assert read(driver, 4) == b"back"
        driver.close()
        assert server.write(b"x" * 10) <= 10


def test_a_client_that_does_not_read_is_waited_for() -> None:
    sent = os.urandom(5_000_000)
    with TcpServer() as server:
        driver = transport_for(server.path)
        driver.open()
        written: list[int] = []
        writer = threading.Thread(target=lambda: written.append(server.write(sent)))
        writer.start()
        assert read(driver, len(sent)) == sent
        writer.join(SOON)
        assert written == [len(sent)]
        driver.close()


def test_a_port_in_use_is_named() -> None:
    with TcpServer() as server:
        port = int(server.path.rpartition(":")[2])
        with pytest.raises(DeviceError, match=f"cannot listen on .*{port}"):
            TcpServer(port).plug()
