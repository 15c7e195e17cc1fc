"""The pseudo-terminal as a driver's serial port sees it."""

from __future__ import annotations

import os
import select
import threading
from collections.abc import Iterator
from io import FileIO
from pathlib import Path

import pytest

from omsm_ros.errors import ConfigurationError, DeviceError
from omsm_ros.instruments.emulator_factory import Pty
from omsm_ros.instruments.transport import SerialTransport

SOON = 5.0


@pytest.fixture
def pty(tmp_path: Path) -> Iterator[Pty]:
    with Pty(tmp_path / "probe") as opened:
        yield opened


@pytest.fixture
def driver(pty: Pty) -> Iterator[SerialTransport]:
    transport = SerialTransport(pty.path)
    yield transport
    transport.close()


def test_the_link_is_a_serial_port_while_the_pty_lives(tmp_path: Path) -> None:
    link = tmp_path / "probe"
    with Pty(link) as pty:
        assert pty.path == str(link)
        with FileIO(os.open(link, os.O_RDWR | os.O_NOCTTY)) as port:
            assert os.ttyname(port.fileno()) == os.readlink(link)
    assert not link.is_symlink()


def test_without_a_link_the_terminal_has_its_own_name() -> None:
    with Pty() as pty:
        assert Path(pty.path).is_char_device()


def test_a_stale_link_is_replaced_and_anything_else_kept(tmp_path: Path) -> None:
    link = tmp_path / "probe"
    link.symlink_to("/dev/pts/no-such")
    with Pty(link):
        assert link.is_char_device()
    link.write_text("a file of somebody")
    with pytest.raises(ConfigurationError, match="not a symbolic link"), Pty(link):
        pass
    assert link.read_text() == "a file of somebody"


def test_a_link_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match="missing"), Pty(tmp_path / "missing" / "probe"):
        pass


def test_the_link_of_a_later_pty_is_not_removed(tmp_path: Path) -> None:
    link = tmp_path / "probe"
    first = Pty(link).__enter__()
    with Pty(link):
        first.unplug()
        assert link.is_char_device()


def test_every_byte_value_passes_unchanged(pty: Pty, driver: SerialTransport) -> None:
    driver.open()
    sent = bytes(range(256)) * 4
    assert pty.write(sent) == len(sent)
    received = b""
    while len(received) < len(sent) and (more := driver.read(SOON)):
        received += more
    assert received == sent


def test_a_program_that_sets_nothing_reads_raw_bytes_too(pty: Pty) -> None:
    sent = bytes(range(256))
    with FileIO(os.open(pty.path, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)) as port:
        pty.write(sent)
        received = b""
        while len(received) < len(sent) and select.select([port], [], [], SOON)[0]:
            received += port.read(1024) or b""
    assert received == sent


def test_a_driver_is_seen_to_come_and_go(pty: Pty, driver: SerialTransport) -> None:
    assert pty.write(b"nobody") == 0
    for _ in range(2):
        driver.open()
        assert pty.write(b"x") == 1
        driver.close()
        assert pty.write(b"nobody") == 0


def test_bytes_without_a_reader_are_counted_as_lost(pty: Pty, driver: SerialTransport) -> None:
    assert pty.write(b"nobody") == 0
    driver.open()
    assert pty.write(b"heard") == 5
    assert driver.read(SOON) == b"heard"


def test_a_full_line_waits_for_the_reader(pty: Pty, driver: SerialTransport) -> None:
    """More than any kernel buffer, into a driver that starts late: nothing is lost."""
    driver.open()
    sent = os.urandom(300_000)
    written: list[int] = []
    writer = threading.Thread(target=lambda: written.append(pty.write(sent)))
    writer.start()
    received = b""
    while len(received) < len(sent) and (more := driver.read(SOON)):
        received += more
    writer.join(SOON)
    assert received == sent
    assert written == [len(sent)]


def test_a_wait_on_a_full_line_can_be_stopped(pty: Pty, driver: SerialTransport) -> None:
    driver.open()
    stop = threading.Event()
    threading.Timer(0.1, stop.set).start()
    assert 0 < pty.write(b"x" * 300_000, stop) < 300_000


def test_a_reader_that_leaves_ends_the_wait(pty: Pty, driver: SerialTransport) -> None:
    driver.open()
    timer = threading.Timer(0.1, driver.close)
    timer.start()
    assert 0 < pty.write(b"x" * 300_000) < 300_000
    timer.join(SOON)


def test_use_outside_the_with_block_is_named() -> None:
    with pytest.raises(DeviceError, match="with block"):
        Pty().write(b"x")


def test_a_driver_that_ends_together_with_the_port_does_not_lose_it(tmp_path: Path) -> None:
    left: list[bool] = []
    with Pty(tmp_path / "probe") as pty:
        line = os.open(pty.path, os.O_RDWR | os.O_NOCTTY)

        def leave() -> None:
            left.append(True)
            os.close(line)

        leaving = threading.Timer(0.3, leave)
        leaving.start()
        pty.__exit__()
        assert left
        leaving.join()
    assert not (tmp_path / "probe").exists()
