"""Micro-Epsilon controllers that differ within what is published: greetings, echo, order."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest
from soaked import always, soaked

from omsm_ros.errors import DeviceError
from omsm_ros.instruments.emulator import AXIS_SCALING
from omsm_ros.instruments.micro_epsilon.device import (
    ConfocalDtDevice,
    ConfocalDtEthernetDevice,
    ConfocalDtSettings,
)
from omsm_ros.instruments.micro_epsilon.emulator import ConfocalDtEmulator, ConfocalDtSerialEmulator
from omsm_ros.instruments.micro_epsilon.protocol import confocal_dtype

from . import plain_wires as wires
from . import with_commands
from .scripted_stream import Script
from .with_commands import WithCommands

THREE = ConfocalDtSettings(axes=AXIS_SCALING, wired=(0, 1, 2))


class Greeting(with_commands.ConfocalDtEmulator):
    """A terminal that greets with a prompt, asks for options, and answers late."""

    greeting = b"\xff\xfb\x01Welcome\r\n->"

    def work(self) -> None:
        if self._commands.sessions and self.greeting:
            self._commands.write(self.greeting)
            self.greeting = b""
        super().work()


@pytest.mark.parametrize("kept", ["", "2.5"])
def test_a_greeting_is_no_answer(kept: str) -> None:
    run = WithCommands(Greeting, ConfocalDtEthernetDevice, THREE)
    usual = run.emulator.obey
    answers = {"MEASRATE": f"MEASRATE\r\nMEASRATE {kept}\r\n->"} if kept else {}
    run.emulator.obey = lambda line: answers.get(line, usual(line))
    if kept:
        with pytest.raises(DeviceError, match=r"1 kHz was requested, .* at 2.5 kHz"):
            run.device.open()
    else:
        run.device.open()
        assert run.device.identity["name"] == "IFC2451"


@pytest.mark.parametrize(("said", "fits"), [("1.0", True), ("MEASRATE 5", False), ("", False)])
def test_the_rate_is_read_back_without_echo_too(said: str, fits: bool) -> None:
    run = WithCommands(with_commands.ConfocalDtEmulator, ConfocalDtEthernetDevice, THREE)
    usual = run.emulator.obey
    run.emulator.obey = lambda line: f"{said}\r\n->" if line == "MEASRATE" else usual(line)
    if fits:
        run.device.open()
        return
    with pytest.raises(
        DeviceError, match="at 5 kHz" if said else "did not report its measuring rate"
    ):
        run.device.open()


def test_a_controller_that_sends_the_intensity_first_is_read(bench: Any) -> None:
    class Turned(ConfocalDtEmulator):
        wired = (0, 1, 2)

        def pack(self, measured: Any, counters: Any, times_ns: Any) -> list[bytes]:
            return [
                turned(piece) if piece else piece
                for piece in super().pack(measured, counters, times_ns)
            ]

    run = bench(Turned, ConfocalDtEthernetDevice, THREE)
    run.instrument.faults.drop_out = 7
    run.run(1.0)
    run.end()
    run.check()
    assert run.delivered > 900
    np.testing.assert_allclose(run.blocks[-1].distance.intensity, 0.5)


def turned(wire: bytes) -> bytes:
    """A block whose frames have distance and intensity the other way round."""
    dtype = confocal_dtype((7 << 8 | 1 << 11 | 1 << 12 | 1 << 15 | 1 << 18 | 1 << 19, 0))
    frames = np.frombuffer(wire[28:], dtype).copy()
    light = frames["intensity 1"].copy()
    frames["intensity 1"] = frames["distance 1"]
    frames["distance 1"] = light
    return wire[:28] + frames.tobytes()


@pytest.mark.parametrize("rate", [0.85, 2.0, *soaked(0.5)])
def test_a_grossly_wrong_rate_shows_within_some_two_seconds(bench: Any, rate: float) -> None:
    """By its arrivals, for the device tells no time."""
    run = bench(ConfocalDtEmulator, ConfocalDtEthernetDevice, THREE)
    run.instrument.faults.rate = rate
    run.run(4.0)
    assert 0 < run.delivered < 1300
    assert f"measures at {1000 * rate:.0f}" in run.device.trouble


NOISE = np.random.default_rng(5)
# Bytes of a stream received at another baud rate: few different ones.
BAUD = np.array([0, 0xF8, 0xFE, 0x80, 0xE0, 0x1E, 0x66, 0x9E, 0xFF], np.uint8)


@pytest.mark.parametrize("trigger", always("each", of=["free_run", "each"]))
@pytest.mark.parametrize(
    ("values", "noise"),
    [(("distance",), BAUD), (("distance", "counter"), np.arange(256, dtype=np.uint8))],
)
def test_noise_is_no_sample(bench: Any, noise: Any, values: Any, trigger: str) -> None:
    class Noise(ConfocalDtSerialEmulator):
        def pack(self, measured: Any, counters: Any, times_ns: Any) -> list[bytes]:
            return [NOISE.choice(noise, 30).tobytes() for _ in counters]

    run = bench(Noise, ConfocalDtDevice, ConfocalDtSettings(values=values, trigger=trigger))
    run.run(5.0)
    run.end()
    assert run.device.statistics.decoded == 0
    assert run.device.counts()["unconfirmed"] > 0
    assert "baud rate" in run.troubles[0]


def test_values_of_a_frame_that_are_not_wanted_are_passed_over(bench: Any) -> None:
    wanted = ConfocalDtSettings(values=("distance", "-", "counter"))
    run = bench(ConfocalDtSerialEmulator, ConfocalDtDevice, wanted)
    run.resolution, run.modulus = 100e-6 / 2**16, 2**18
    run.run(1.0)
    run.end()
    run.check()
    assert run.delivered > 900


@pytest.mark.parametrize("twice", [5, 7])
def test_a_block_sent_twice_does_not_take_the_place_of_a_lost_one(twice: int) -> None:
    """Block 6 is lost."""
    flags, script = struct.pack("<II", 1 << 18, 0), []
    for n in sorted([*range(6), *range(7, 12), twice]):
        frames = [wires.little(50_000 + k, 4) for k in range(10 * n, 10 * n + 10)]
        script.append(wires.block(flags, 10 * n, frames))
    driver = ConfocalDtEthernetDevice(Script(*script), ConfocalDtSettings(trigger="each"))
    driver.open()
    found = [pair.distance for _ in script for pair in driver.poll(0.0)]
    found += [pair.distance for pair in driver.close()]
    for block in found:
        expected = 50e-6 + (block.first_sample + np.arange(len(block))) * 1e-9
        np.testing.assert_allclose(block.distance, expected, atol=1e-12)
    counts = driver.statistics
    assert (counts.duplicates, counts.lost, counts.delivered) == (10, 10, 110)
