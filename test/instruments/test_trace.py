"""Traces: what a driver did with a device, done again without the device."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loopback import Loopback
from wire_trace import Event, ReplayTransport, read_trace

from omsm_ros.errors import ConfigurationError, DeviceError
from omsm_ros.instruments.chrocodile.device import ChrocodileSettings
from omsm_ros.instruments.chrocodile.dollar_device import ChrocodileDevice
from omsm_ros.instruments.chrocodile.emulator import ChrocodileEmulator, ChrocodilePacketEmulator
from omsm_ros.instruments.chrocodile.packet_device import ChrocodilePacketDevice
from omsm_ros.instruments.emulator import AXIS_SCALING
from omsm_ros.instruments.factory import TracedTransport
from omsm_ros.instruments.transport import TcpTransport

from .faulty import faulty

SIX = ChrocodileSettings(axes=AXIS_SCALING)


@pytest.mark.parametrize(
    ("device", "emulator"),
    [(ChrocodileDevice, ChrocodileEmulator), (ChrocodilePacketDevice, ChrocodilePacketEmulator)],
)
def test_a_replayed_trace_gives_the_same_blocks(device: Any, emulator: Any, tmp_path: Path) -> None:
    loop = Loopback()
    loop.instrument = faulty(emulator)(loop.line, clock=loop.clock)
    path = tmp_path / "wire.trace"
    driver = device(
        TracedTransport(loop, path, loop.clock), SIX, loop.clock.nanoseconds, loop.clock
    )
    driver.open()
    seen = [block for _ in range(100) for block in driver.poll(0.05)]
    seen += driver.close()

    replay = ReplayTransport(read_trace(path))
    again = device(replay, SIX, replay.now_ns, replay.now)
    again.open()
    found = []
    while not replay.finished:
        found += again.poll(0.05)
    with pytest.raises(DeviceError, match="closed here"):
        again.poll(0.05)
    found += again.close()
    assert len(found) == len(seen) > 0
    for a, b in zip(seen, found, strict=True):
        assert a.distance.first_sample == b.distance.first_sample
        np.testing.assert_array_equal(a.distance.distance, b.distance.distance)
        np.testing.assert_array_equal(a.axes.z, b.axes.z)


def test_a_driver_that_says_something_else_is_reported() -> None:
    replay = ReplayTransport([Event(0.0, "open", b""), Event(0.1, ">", b"$STO\r")])
    replay.open()
    with pytest.raises(DeviceError, match=r"sends b'\$VER\\r', the trace goes on with"):
        replay.write(b"$VER\r")


def test_a_portion_comes_at_its_time() -> None:
    replay = ReplayTransport([Event(1.0, "open", b""), Event(1.2, "<", b"ab")])
    replay.open()
    assert replay.read(0.1) == b""
    assert replay.read(0.2) == b"ab"
    assert replay.now() == pytest.approx(1.2)
    with pytest.raises(DeviceError, match="ends here"):
        replay.read(0.1)
    with pytest.raises(DeviceError, match="no further connection"):
        replay.open()


def test_every_connection_is_in_the_trace(tmp_path: Path) -> None:
    loop, path = Loopback(), tmp_path / "wire.trace"
    traced = TracedTransport(loop, path, loop.clock)
    for word in (b"first", b"second"):
        traced.open()
        traced.write(word)
        traced.close()
    signs = [(event.sign, event.data) for event in read_trace(path)]
    assert signs == [
        ("open", b""), (">", b"first"), ("close", b""),
        ("open", b""), (">", b"second"), ("close", b""),
    ]  # fmt: skip


def test_a_spare_connection_is_in_the_same_trace(tmp_path: Path) -> None:
    path = tmp_path / "wire.trace"
    with socket.create_server(("127.0.0.1", 0)) as server:
        traced = TracedTransport(TcpTransport(*server.getsockname()), path)
        for word in (b"first", b"second"):
            each = traced.spare() if word == b"second" else traced
            each.open()
            with server.accept()[0] as end:
                end.sendall(word)
                assert each.read(20.0) == word
            each.close()
    assert [event.data for event in read_trace(path) if event.sign == "<"] == [b"first", b"second"]


@pytest.mark.parametrize("place", ["/dev/full", "/dev/null/wire.trace", "/", "wire\0trace"])
def test_an_unwritable_trace_is_reported_with_the_remedy_and_the_port_is_closed(place: str) -> None:
    loop = Loopback()
    traced = TracedTransport(loop, Path(place), loop.clock)
    for _ in range(2):
        with pytest.raises(ConfigurationError, match=r"cannot write the trace .*choose another"):
            open_write_close(traced)
        traced.close()


def open_write_close(traced: TracedTransport) -> None:
    traced.open()
    traced.write(b"word")
    traced.close()


def test_what_is_no_trace_is_named(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("0.1 < zz\n")
    with pytest.raises(ConfigurationError, match=r"notes.txt', line 1: '0.1 < zz' is no event"):
        read_trace(path)
    with pytest.raises(ConfigurationError, match="cannot write the trace"):
        TracedTransport(Loopback(), tmp_path / "missing" / "x").open()
