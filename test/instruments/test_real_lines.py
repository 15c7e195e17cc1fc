"""Drivers and emulators over real lines and in real time: what simulated time cannot show."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from soaked import soaked

from omsm_ros.instruments.blocks import BlockPair
from omsm_ros.instruments.chrocodile.emulator import ChrocodileEmulator
from omsm_ros.instruments.emulator import Instrument
from omsm_ros.instruments.emulator_factory import TcpServer, emulated, line_for
from omsm_ros.instruments.factory import make_device, make_reference
from omsm_ros.instruments.parameters import REFERENCE_PARAMETERS, defaults
from omsm_ros.instruments.reader import DeviceReader, State
from omsm_ros.instruments.stream import StreamDevice

from .faulty import faulty
from .with_commands import CapaNcdtEmulator

SOON = 20.0


def wait(what: str, done: Callable[[], bool]) -> None:
    deadline = time.monotonic() + SOON
    while not done():
        assert time.monotonic() < deadline, f"waited in vain for {what}"
        time.sleep(0.02)


@contextmanager
def serving(instrument: Instrument) -> Iterator[None]:
    stop = threading.Event()
    thread = threading.Thread(target=instrument.serve, args=(stop,))
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(SOON)


@contextmanager
def reading(device: StreamDevice) -> Iterator[tuple[DeviceReader, list[BlockPair]]]:
    stop, got = threading.Event(), list[BlockPair]()
    reader = DeviceReader(device, got.extend)
    thread = threading.Thread(target=reader.run, args=(stop,))
    thread.start()
    try:
        yield reader, got
    finally:
        stop.set()
        thread.join(SOON)


def probe(path: str) -> StreamDevice:
    wired = emulated("chrocodile").driver | {"trigger": "free_run", "probe.zero": 0.0}
    return make_device(defaults() | wired | {"device": "chrocodile", "port": path})


def checked(got: list[BlockPair]) -> None:
    """No sample twice: with 10 counts a nanometre, sample k stands at x = k nm."""
    k = np.concatenate([np.rint(b.axes.x * 1e9) for b in got if b.axes is not None])
    assert np.all(np.diff(k) > 0)


@pytest.mark.parametrize(
    ("fault", "where"),
    [
        ("unplug", "pty"),
        ("power_cycle", "tcp"),
        ("stall", "pty"),
        *soaked(("unplug", "tcp"), ("power_cycle", "pty"), ("stall", "tcp")),
    ],
)
def test_the_driver_is_back_by_itself(where: str, fault: str, tmp_path: Path) -> None:
    link = str(tmp_path / "probe") if where == "pty" else "tcp://127.0.0.1:0"
    with line_for(link) as line:
        emulator = faulty(ChrocodileEmulator)(line)
        device = probe(line.path)
        with serving(emulator), reading(device) as (reader, got):
            wait("samples", lambda: device.statistics.delivered > 300)
            getattr(emulator, fault)(1.0)
            time.sleep(1.0)
            before = device.statistics.delivered
            wait("samples again", lambda: device.statistics.delivered > before + 500)
            assert reader.state is State.READING
            assert reader.trouble == ""
        found = device.statistics
        checked(got)
        assert found.restarts == (fault == "power_cycle")
        assert found.delivered == sum(len(b.distance) for b in got if b.distance is not None)


def test_a_second_client_waits_for_the_first_to_leave() -> None:
    with TcpServer() as line:
        emulator = faulty(ChrocodileEmulator)(line)
        with serving(emulator):
            first, second = probe(line.path), probe(line.path)
            with reading(first):
                wait("the first", lambda: first.statistics.delivered > 100)
                with reading(second) as (reader, _):
                    wait("its refusal", lambda: "was lost" in reader.trouble)
                    assert second.statistics.decoded == 0
            with reading(second) as (reader, got):
                wait("the second", lambda: second.statistics.delivered > 100)
            assert first.statistics.lost == 0
            checked(got)


def test_a_reference_is_read_in_addition_to_its_command_port() -> None:
    with TcpServer() as data, TcpServer() as commands:
        emulator = faulty(CapaNcdtEmulator)(data, commands=commands)
        port = int(commands.path.rpartition(":")[2])
        values: dict[str, Any] = defaults(REFERENCE_PARAMETERS)
        values |= {"port": data.path, "command_port": port, "sample_period": 2e-3}
        device = make_reference(values)
        with serving(emulator), reading(device) as (_, got):
            wait("samples", lambda: device.statistics.delivered > 500)
        assert emulator.rate() == pytest.approx(500)
        assert device.statistics.lost == 0
        assert got[0].axes is None
        assert device.identity["model"].startswith("$VERDT6230")


def test_a_cable_that_is_pulled_while_something_is_sent_ends_nothing(tmp_path: Path) -> None:
    """Another thread than the serving one unplugs it, at any time."""
    with line_for(str(tmp_path / "probe")) as line:
        emulator = faulty(ChrocodileEmulator)(line)
        sent = line.write

        def pulled(data: bytes, stop: threading.Event | None = None) -> int:
            emulator.unplug(0.2)
            return sent(data, stop)

        line.write = pulled  # type: ignore[method-assign]
        wait_until = time.monotonic() + 10.0
        while line._master is not None:
            assert time.monotonic() < wait_until
            emulator.step()
        line.write = sent  # type: ignore[method-assign]
        time.sleep(0.25)
        emulator.step()
        assert line._master is not None
