"""Other services on the port, and wrong settings, are reported in one line."""

from __future__ import annotations

import numpy as np
import pytest

from omsm_ros.errors import DeviceError, NoSamplesError
from omsm_ros.instruments.chrocodile.device import Chrocodile, ChrocodileSettings
from omsm_ros.instruments.chrocodile.dollar_device import ChrocodileDevice
from omsm_ros.instruments.chrocodile.packet_device import ChrocodilePacketDevice
from omsm_ros.instruments.chrocodile.packet_protocol import PacketCommand, encode_command
from omsm_ros.instruments.micro_epsilon.device import ConfocalDtDevice, ConfocalDtSettings
from omsm_ros.instruments.micro_epsilon.protocol import encode_frames
from omsm_ros.instruments.six_channel.device import CsvSettings, CsvStreamDevice
from omsm_ros.instruments.stream import StreamDevice

from .scripted_stream import Script


class Service(Script):
    """Plays its portions, and then hangs up; an echo says what it hears."""

    def __init__(self, *portions: bytes | Exception, echo: bool = False) -> None:
        super().__init__(*portions)
        self._echo = echo

    def write(self, data: bytes) -> None:
        if self._echo:
            self.portions.append(data)


CLOSED = DeviceError("connection was lost: closed by the device")


@pytest.mark.parametrize("kind", [ChrocodileDevice, ChrocodilePacketDevice])
def test_a_web_server_that_hangs_up_is_reported(kind: type[Chrocodile]) -> None:
    device = kind(Service(b"HTTP/1.1 400 Bad Request\r\n", CLOSED), ChrocodileSettings())
    with pytest.raises(DeviceError, match=r"HTTP/1\.1 400.*no CHRocodile is there"):
        device.open()


def test_a_service_that_repeats_what_it_hears_is_no_device() -> None:
    service = Service(encode_command(PacketCommand("CONF")), echo=True)
    device = ChrocodilePacketDevice(service, ChrocodileSettings())
    with pytest.raises(DeviceError, match="no CHRocodile is there"):
        device.open()


def poll_each(device: StreamDevice, portions: int, now: list[float]) -> None:
    """Read portions of a tenth of a second."""
    for _ in range(portions):
        now[0] += 0.1
        device.poll(0.0)


def test_a_counter_that_stands_still_is_reported() -> None:
    """The frame has intensity and counter the other way round than the settings say."""
    now = [0.0]
    frames = [np.array([[98_232, 512, 100 * k + i] for i in range(100)]) for k in range(40)]
    device = ConfocalDtDevice(
        Script(*map(encode_frames, frames)),
        ConfocalDtSettings(values=("distance", "counter", "intensity")),
        lambda: round(now[0] * 1e9),
        lambda: now[0],
    )
    device.open()

    with pytest.raises(NoSamplesError, match=r"repeats its sample counter \(512\)"):
        poll_each(device, len(frames), now)
    assert now[0] < 2.5


@pytest.mark.parametrize("columns", [("sequence", "device_time", "x"), ("sequence", "x")])
def test_a_counter_that_stands_still_is_reported_although_time_goes_on(
    columns: tuple[str, ...],
) -> None:
    now = [0.0]
    row = "{} {} {}\n" if len(columns) == 3 else "{} {}\n"
    lines = [row.format(7, *(k * 10**6, k)[3 - len(columns) :]) for k in range(4000)]
    portions = ["".join(lines[i : i + 100]).encode() for i in range(0, 4000, 100)]
    device = CsvStreamDevice(
        Script(*portions), CsvSettings(columns=columns), lambda: round(now[0] * 1e9), lambda: now[0]
    )
    device.open()

    with pytest.raises(NoSamplesError, match=r"repeats its sample counter \(7\)"):
        poll_each(device, len(portions), now)
    found = device.statistics
    assert (found.restarts, found.duplicates + found.held) == (0, found.decoded - 1)
