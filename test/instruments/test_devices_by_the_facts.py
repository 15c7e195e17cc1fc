"""Drivers against devices written from the makers' manuals, not from the drivers.

Imitated: a selection of signals that belongs to the connection, refusals in words, averaging and a
mode that another program left, a trigger counter that goes on without a client, spoilt bits.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from soaked import always

from omsm_ros.core.streams.blocks import Status
from omsm_ros.errors import DeviceError, NoSamplesError
from omsm_ros.instruments.chrocodile.device import ChrocodileSettings, RefusedError
from omsm_ros.instruments.chrocodile.dollar_device import ChrocodileDevice
from omsm_ros.instruments.chrocodile.packet_device import ChrocodilePacketDevice
from omsm_ros.instruments.micro_epsilon.device import (
    ConfocalDtDevice,
    ConfocalDtEthernetDevice,
    ConfocalDtSettings,
)
from omsm_ros.instruments.scaling import AXES
from omsm_ros.instruments.six_channel.device import (
    CsvSettings,
    CsvStreamDevice,
    GenericStreamDevice,
    StreamSettings,
)
from omsm_ros.instruments.six_channel.protocol import encode_frames
from omsm_ros.instruments.stream import StreamDevice

from . import plain_wires as wires
from .scripted_stream import Script, frames_of, run

BITS = {83: 16, 64: 32, 76: 16, 256: 0, 257: 0, **dict.fromkeys(range(65, 70), 32)}
EACH = ChrocodileSettings(trigger="each")
SILENT = "silent"


class Device:
    """A CHRocodile 2 on simulated time; a client has ordered nothing until it does."""

    name = "tcp://probe:7890"
    period = 1e-3

    def __init__(self, *, empty: str = "", **settings: str) -> None:
        """empty: what ``SODX ?`` is answered while nothing is ordered; SILENT = no answer."""
        self.values = {"SHZ": "1000", "AVD": "1", "AVS": "1", "AVDS": "1", "MMD": "0", "LAI": "50"}
        self.values |= settings
        self.empty, self.now, self.sent_to = empty, 1000.0, 1000.0
        self.zero = 1000.0  # time of the trigger that was counted 0
        self.mode, self.refused = "CTN", set[str]()
        self.dark, self.up = "12.5", True

    def __call__(self) -> float:
        return self.now

    def nanoseconds(self) -> int:
        return round(self.now * 1e9)

    def open(self) -> None:
        if not self.up:
            raise DeviceError("refused")
        self.signals: list[int] = []
        self.started, self.outgoing, self.heard = True, self.greeting(), b""
        self.sent_to = self.now

    def close(self) -> None:
        self.signals = []

    def write(self, data: bytes) -> None:
        self.heard += data
        self.obey()

    def read(self, timeout: float) -> bytes:
        if not self.up:
            raise DeviceError("connection lost")
        if not self.outgoing:
            self.now += min(timeout, 0.01)
            first, last = self.count(self.sent_to), self.count(self.now)
            if self.signals and self.started and last > first:
                self.outgoing += self.samples(np.arange(first, last))
            self.sent_to = self.now
        data, self.outgoing = self.outgoing, b""
        return data

    def count(self, when: float) -> int:
        return round((when - self.zero) / self.period)

    def answer(self, name: str, words: list[str]) -> str:
        if name in self.refused:
            return "Error: unknown command"
        if name in ("VER", "DRK"):
            return "CHRocodile 2 R1.5.2" if name == "VER" else self.dark
        if name in ("STA", "STO"):
            self.started = name == "STA"
        elif name in ("TRE", "TRG", "CTN", "TRW"):
            self.mode = name
            self.zero = self.now if name in ("TRE", "TRG") else self.zero
        elif name == "SODX":
            if words == ["?"]:
                return " ".join(map(str, self.signals)) or self.empty
            self.signals = [int(word) for word in words]
        elif name not in ("BIN", "SSQ"):
            return self.setting(name, words)
        return ""

    def setting(self, name: str, words: list[str]) -> str:
        if name not in self.values:
            return "Error: unknown command"
        if words == ["?"]:
            return self.values[name]
        self.values[name] = words[0]
        return ""

    def value_of(self, signal: int, count: int) -> float:
        time = round((self.zero + count * self.period) * 1e9) % 2**32
        return {83: count % 2**16, 64: time, 76: 0, 256: 50.0 + count % 7, 257: 80.0}[signal]

    def greeting(self) -> bytes:
        return b""

    def obey(self) -> None:
        *lines, self.heard = self.heard.split(b"\r")
        for line in lines:
            name, *words = line.decode("latin-1").lstrip("$").split()
            said = self.answer(name[:3] if name.startswith("SSQ") else name, words)
            if said == SILENT:
                continue
            self.outgoing += (
                line + b"\r" + said.encode() + (b"\r\n" if said else b"") + b"ready\r\n"
            )

    def samples(self, counts: np.ndarray) -> bytes:
        return b"".join(
            wires.telegram(*((BITS[s], self.value_of(s, int(n))) for s in self.signals))
            for n in counts
        )


class PacketDevice(Device):
    """The same on port 7891; signal order is its own, ``CONF`` ends the greeting."""

    name = "tcp://probe:7891"

    def greeting(self) -> bytes:
        return wires.packet_command("CONF", 0x2000, 0)

    def obey(self) -> None:
        while len(self.heard) >= 20:
            (size,) = struct.unpack_from("<I", self.heard, 4)
            whole, self.heard = self.heard[:size], self.heard[size:]
            name = whole[20:24].rstrip(b"\0").decode()
            flags, _, ticket, count = struct.unpack_from("<HHHH", whole, 32)
            words, place = [], 40
            for _ in range(count):
                kind = struct.unpack_from("<I", whole, place)[0]
                value = struct.unpack_from("<f" if kind == 1 else "<i", whole, place + 4)[0]
                words.append(f"{value:g}")
                place += 8
            said = self.answer(name, ["?"] if flags & 1 else words)
            if said == SILENT:
                continue
            wrong = said.startswith("Error")
            values = [] if wrong else [self.argument(word) for word in said.split()]
            reply = wires.packet_command(
                name, (flags & 1) | (0x8000 if wrong else 0), ticket, *values
            )
            self.outgoing += reply
            if name == "SODX" and not flags & 1:
                kinds = {83: 2, 64: 4, 76: 2, 256: 6, 257: 6}
                self.order = sorted(self.signals)
                self.outgoing += wires.packet_format(
                    1, 1000.0, *((kinds[s], s) for s in self.order)
                )

    @staticmethod
    def argument(word: str) -> bytes:
        try:
            return struct.pack("<If", 1, float(word))
        except ValueError:
            raw = word.encode()
            return struct.pack("<II", 2, len(raw)) + raw + bytes(-len(raw) % 4)

    def samples(self, counts: np.ndarray) -> bytes:
        body = b""
        for n in counts:
            for s in self.order:
                value = self.value_of(s, int(n))
                size = 2 if BITS[s] == 16 else 4
                body += wires.single(value) if BITS[s] == 0 else wires.little(int(value), size)
        start = self.zero + counts[0] * self.period
        fraction = int(start % 1 * 2**32)
        return wires.packet_data(1, int(start), fraction, len(counts), body)


def connected(device: Device, settings: ChrocodileSettings = EACH) -> Any:
    kind = ChrocodilePacketDevice if isinstance(device, PacketDevice) else ChrocodileDevice
    driver = kind(device, settings, device.nanoseconds, device)
    driver.open()
    return driver


def blocks_for(driver: StreamDevice, device: Device, seconds: float) -> list[Any]:
    end, found = device.now + seconds, []
    while device.now < end:
        found += driver.poll(0.05)
    return found


KINDS = [Device, PacketDevice]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("empty", ["", "Error: no signals ordered", SILENT])
def test_a_dropped_connection_keeps_the_count_of_triggers(kind: type[Device], empty: str) -> None:
    device = kind(empty=empty)
    driver = connected(device)
    before = blocks_for(driver, device, 1.0)
    zero, device.up = device.zero, False
    with pytest.raises(DeviceError):
        driver.poll(0.05)
    before += driver.close()
    device.now += 0.25
    device.up = True
    begun = device.now
    driver.open()
    assert device.now - begun < 1.5
    after = blocks_for(driver, device, 1.0)
    assert device.zero == zero, "the counter of the triggers was reset"
    assert driver.statistics.restarts == 0
    count = after[-1].distance.end
    assert count == pytest.approx(device.count(device.now), abs=150)
    assert sum(len(b.distance) for b in after) > 800
    assert len(before)


@pytest.mark.parametrize("kind", KINDS)
def test_a_restarted_device_is_set_up_anew(kind: type[Device]) -> None:
    device = kind()
    driver = connected(device)
    blocks_for(driver, device, 1.0)
    driver.close()
    device.values["SHZ"], device.mode = "4000", "CTN"
    driver.open()
    assert device.mode == "TRE"
    assert len(blocks_for(driver, device, 1.0)) > 5


@pytest.mark.parametrize("kind", KINDS)
def test_words_are_no_acceptance(kind: type[Device]) -> None:
    device = kind()
    device.refused.add("LAI")
    with pytest.raises(DeviceError, match="LAI"):
        connected(device, replace(EACH, lamp=70.0))


@pytest.mark.parametrize("kind", KINDS)
def test_a_dark_reference_is_taken_or_refused(kind: type[Device]) -> None:
    device = kind()
    driver = connected(device)
    assert driver.dark_reference() == "12.5"
    assert driver.identity["stray_light"] == "12.5"
    device.dark = "lamp"
    with pytest.raises(RefusedError, match="lamp"):
        driver.dark_reference()
    device.refused.add("DRK")
    with pytest.raises(RefusedError):
        driver.dark_reference()


@pytest.mark.parametrize("kind", KINDS)
def test_averaging_that_another_program_left_is_taken_away(kind: type[Device]) -> None:
    device = kind(AVS="4", AVDS="2", MMD="1")
    driver = connected(device, ChrocodileSettings())
    assert device.values["AVS"] == device.values["AVDS"] == "1"
    assert device.values["MMD"] == "0"
    assert float(device.values["SHZ"]) == pytest.approx(1000)
    assert len(blocks_for(driver, device, 1.0)) > 5
    assert driver.trouble == ""


def test_a_thickness_is_no_distance() -> None:
    device = Device(MMD="1")
    device.refused.add("MMD")
    device.answer = keeps_its_mode(device.answer)  # type: ignore[method-assign]
    with pytest.raises(DeviceError, match="interference"):
        connected(device)


def keeps_its_mode(answer: Callable[[str, list[str]], str]) -> Callable[[str, list[str]], str]:
    return lambda name, words: "1" if (name, words) == ("MMD", ["?"]) else answer(name, words)


@pytest.mark.parametrize("bit", always(20, 40, of=[12, 20, 29, 33, 40]))
def test_a_flipped_bit_of_a_time_costs_nothing(bit: int) -> None:
    device = PacketDevice()
    driver = connected(device)
    blocks_for(driver, device, 1.0)
    whole, flips = device.samples, [device.count(device.now) + 200]

    def spoilt(counts: np.ndarray) -> bytes:
        wire = bytearray(whole(counts))
        if flips and counts[0] >= flips[0]:
            flips.pop()
            wire[28 + bit // 8] ^= 1 << bit % 8
        return bytes(wire)

    device.samples = spoilt  # type: ignore[method-assign]
    found = blocks_for(driver, device, 2.0)
    counts = driver.statistics
    assert (counts.withheld, counts.restarts, counts.lost) == (0, 0, 0)
    firsts = [block.distance.first_sample for block in found]
    stamps = np.array([block.distance.stamp_ns for block in found])
    late = stamps - np.array(firsts) * 1e6
    assert np.ptp(late) < 30e6
    assert not flips


@pytest.mark.parametrize("bit", [0, 4, 17, 31])
def test_a_flipped_bit_in_the_counter_of_a_block_renumbers_nothing(bit: int) -> None:
    flags = struct.pack("<II", 1 << 18, 0)
    script = []
    for n in range(20):
        counter = 1000 + 10 * n
        frames = [wires.little(50_000 + k, 4) for k in range(10)]
        script.append(wires.block(flags, counter ^ (1 << bit if n == 9 else 0), frames))
    now = 0.0
    driver = ConfocalDtEthernetDevice(
        Script(*script), ConfocalDtSettings(trigger="each"), lambda: round(now * 1e9), lambda: now
    )
    driver.open()
    found = []
    for _ in script:
        now += 0.01
        found += [pair.distance for pair in driver.poll(0.0)]
    found += [pair.distance for pair in driver.close()]
    assert found[0].first_sample == 1000
    assert found[-1].end == 1200
    assert sum(map(len, found)) == 200
    assert driver.statistics.lost == 0


def test_a_trigger_of_another_rate_is_not_published() -> None:
    """2 kHz where 1 kHz is stated."""
    frames = frames_of(np.arange(2000))
    frames["device_time"] = np.arange(2000) * 500_000
    portions = [encode_frames(frames[i : i + 50]) for i in range(0, 2000, 50)]
    device = GenericStreamDevice(Script(*portions), StreamSettings())
    device.open()
    found = [pair for _ in portions for pair in device.poll(0.0)]
    assert not found
    assert "2000 Hz" in device.trouble


@pytest.mark.parametrize(("period", "said"), [(1e-3, ""), (1.01e-3, "set sample_period")])
def test_axes_without_time_are_doubtful_until_arrivals_show_their_rate(
    period: float, said: str
) -> None:
    portions = [b"%d 0 0 0 0 0\n" % n for n in range(8000)]
    now, step = 5000.0, 10
    portions = [b"".join(portions[i : i + step]) for i in range(0, 8000, step)]
    device = CsvStreamDevice(
        Script(*portions), CsvSettings(columns=("sequence", *AXES)), lambda: round(now * 1e9)
    )
    device._monotonic = lambda: now
    device.open()
    cautions = []
    for _ in portions:
        now += step * period
        device.poll(0.0)
        cautions.append(device.caution)
    assert all("not verified" in caution for caution in cautions[:100])
    assert not any("not verified" in caution for caution in cautions[600:])
    assert said in cautions[-1]
    assert bool(cautions[-1]) == bool(said)


def test_a_pause_of_the_trigger_is_no_other_rate() -> None:
    frames = frames_of(np.arange(1000))
    frames["device_time"][430:] += 5_000_000_000
    found, device = run(*(encode_frames(frames[i : i + 50]) for i in range(0, 1000, 50)))
    assert sum(len(pair.axes) for pair in found) == 1000
    assert device.trouble == ""


@pytest.mark.parametrize("absolute", [True, False])
def test_encoders_that_begin_at_zero_are_not_published(absolute: bool) -> None:
    before, after = frames_of(np.arange(5000, 5300)), frames_of(np.arange(0, 300))
    before["counts"] += 1_000_000
    if absolute:
        after["counts"] += 1_000_000
    portions = [encode_frames(f[i : i + 50]) for f in (before, after) for i in range(0, 300, 50)]
    device = GenericStreamDevice(Script(*portions), StreamSettings())
    device.open()
    found = [pair for _ in portions for pair in device.poll(0.0)]
    assert (device.statistics.restarts, device.statistics.resets) == (1, 0)
    assert len(found) == (6 if absolute else 3)
    assert ("home the axes" in device.trouble) != absolute


def test_encoders_at_zero_after_a_lost_connection_are_not_published() -> None:
    """The device was switched off for a second: its counter and its encoders begin at zero."""
    now = 0.0
    before, after = frames_of(np.arange(5000, 5300)), frames_of(np.arange(0, 300))
    portions = [encode_frames(f[i : i + 50]) for f in (before, after) for i in range(0, 300, 50)]
    device = GenericStreamDevice(
        Script(*portions[:6], DeviceError("reset by peer"), *portions[6:]), StreamSettings()
    )
    device._monotonic = lambda: now
    device.open()
    found = []
    for turn in range(13):
        now += 0.05
        if turn != 6:
            found += device.poll(0.0)
            continue
        with pytest.raises(DeviceError):
            device.poll(0.0)
        found += device.close()
        now += 1.0
        device.open()
    assert [pair.axes.first_sample for pair in found] == [5000, 5100, 5200]
    assert (device.statistics.withheld, device.statistics.resets) == (300, 0)
    assert "home the axes" in device.trouble


def test_a_scan_that_begins_at_the_origin_after_a_pause_is_published() -> None:
    """The axes moved to their origin and the counter was reset on purpose meanwhile."""
    now = 0.0
    before, after = frames_of(np.arange(5000, 5300)), frames_of(np.arange(0, 300))
    before["counts"] += 1_000_000
    portions = [encode_frames(f[i : i + 50]) for f in (before, after) for i in range(0, 300, 50)]
    device = GenericStreamDevice(Script(*portions), StreamSettings())
    device._monotonic = lambda: now
    device.open()
    found = []
    for number in range(len(portions)):
        now += 5.0 if number == 6 else 0.05
        found += device.poll(0.0)
    assert sum(len(pair.axes) for pair in found) == 600
    assert (device.statistics.restarts, device.statistics.resets) == (1, 1)
    assert device.trouble == ""
    assert "home the axes" in device.caution


def test_an_intensity_taken_for_a_distance_is_refused() -> None:
    """Frames hold distance and intensity; the setting states the other order."""
    frame = wires.three_bytes(131_000) + wires.three_bytes(700, first=False)
    settings = ConfocalDtSettings(values=("intensity", "distance"))
    device = ConfocalDtDevice(Script(frame * 20), settings)
    device.open()
    with pytest.raises(NoSamplesError, match="order"):
        device.poll(0.0)


def test_peaks_before_and_behind_the_range_are_told_from_no_peak() -> None:
    """Codes 04, 05 and 06 of the last byte of a confocalDT's distance over Ethernet."""
    rows = [(0x7FFFFF04, 0), (0x7FFFFF05, 0), (0x7FFFFF06, 0), (50_000, 700)]
    frames = [wires.little(distance, 4) + wires.little(light, 4) for distance, light in rows]
    kind = wires.little(1 << 15 | 1 << 18 | 1 << 19, 4) + bytes(4)
    device = ConfocalDtEthernetDevice(Script(wires.block(kind, 0, frames)), ConfocalDtSettings())
    device.open()
    pairs = [*device.poll(0.0), *device.close()]
    (distance,) = (pair.distance for pair in pairs)
    beyond = Status.OUT_OF_RANGE
    assert distance.status.tolist() == [Status.NO_TARGET, beyond, beyond, Status.OK]
    assert np.isnan(distance.distance).tolist() == [True, True, True, False]


@pytest.mark.parametrize(("modulus", "warned"), [(4, True), (2**16, False)])
def test_a_small_counter_is_warned_of(modulus: int, warned: bool) -> None:
    """The loss of all samples of one turn of a counter shows in nothing that came."""

    numbers = np.delete(np.arange(7000), slice(3050, 3054))
    lines = [b"%d %d\n" % (n % modulus, n) for n in numbers]
    portions = [b"".join(lines[i : i + 100]) for i in range(0, len(lines), 100)]
    now = [0.0]
    settings = CsvSettings(columns=("sequence", "distance"), modulus=modulus)
    device = CsvStreamDevice(
        Script(*portions), settings, lambda: round(now[0] * 1e9), lambda: now[0]
    )
    device.open()
    for now[0] in 0.1 * np.arange(len(portions)):
        device.poll(0.0)
    assert device.statistics.lost == (0 if warned else 4)
    assert ("no loss of 4 samples or a multiple" in device.caution) == warned
