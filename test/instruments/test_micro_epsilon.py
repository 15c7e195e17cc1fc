"""The drivers of confocalDT and capaNCDT against their emulators."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from soaked import always, soaked

from omsm_ros.errors import ConfigurationError, DeviceError, DeviceTimeoutError
from omsm_ros.instruments.emulator import AXIS_SCALING, Instrument
from omsm_ros.instruments.micro_epsilon.capancdt_device import CapaNcdtDevice, CapaNcdtSettings
from omsm_ros.instruments.micro_epsilon.device import (
    ConfocalDtDevice,
    ConfocalDtEthernetDevice,
    ConfocalDtSettings,
)
from omsm_ros.instruments.micro_epsilon.emulator import (
    CapaNcdtEmulator,
    ConfocalDtEmulator,
    ConfocalDtSerialEmulator,
)

from . import with_commands
from .conftest import Bench
from .faulty import Faulty
from .with_commands import WithCommands


class XyzEmulator(ConfocalDtEmulator):
    wired = (0, 1, 2)


class DistanceEmulator(ConfocalDtSerialEmulator):
    width = 1


THREE = ConfocalDtSettings(axes=AXIS_SCALING, wired=(0, 1, 2))
FAULTS: dict[str, Callable[[Faulty], None]] = {
    "unplug": lambda i: i.unplug(1.0),
    "power cycle": lambda i: i.power_cycle(1.5),
    "stall": lambda i: i.stall(1.0),
    "long stall": lambda i: i.stall(4.0),
    "lost": lambda i: setattr(i.faults, "lose", 3),
    "doubled": lambda i: setattr(i.faults, "duplicate", 3),
    "noise": lambda i: setattr(i.faults, "noise", 300),
    "cut": lambda i: setattr(i.faults, "cut", 101),
    "counter reset": lambda i: i.reset_counter(),
}


def ethernet(bench: Any, wanted: ConfocalDtSettings = THREE, **options: Any) -> Any:
    return bench(XyzEmulator, ConfocalDtEthernetDevice, wanted, **options)


# ConfocalDT, Ethernet.


@pytest.mark.parametrize("portion", [1 << 20, 11])
def test_every_sample_arrives_once_with_its_counter(bench: Any, portion: int) -> None:
    run = ethernet(bench, portion=portion)
    run.run(1.5)
    run.end()
    run.check()
    assert run.delivered > 1400
    assert run.device.statistics.lost == run.device.counts()["bytes_discarded"] == 0
    assert run.device.identity["serial"] == "11020009"
    intensity = run.blocks[0].distance.intensity
    np.testing.assert_allclose(intensity, 0.5)


@pytest.mark.parametrize("fault", always("counter reset", "lost", of=FAULTS))
def test_it_is_back_within_five_seconds(bench: Any, fault: str) -> None:
    run = ethernet(bench)
    run.is_back_within_five_seconds_of(FAULTS[fault], 6.0 if "long" in fault else 2.0)
    found = run.device.statistics
    assert (found.duplicates > 0) == (fault == "doubled")
    if fault in ("lost", "cut", "unplug", "stall", "long stall"):
        assert found.lost > 0
    assert bool(found.restarts) == (fault in ("power cycle", "counter reset"))


def test_dropouts_are_no_target(bench: Any) -> None:
    run = ethernet(bench)
    run.run(0.3)
    run.instrument.faults.drop_out = 7
    run.run(0.3)
    run.end()
    distance = np.concatenate([b.distance.distance for b in run.blocks])
    assert np.isnan(distance).sum() == 7


def test_an_encoder_that_is_not_sent_is_named(bench: Any) -> None:
    run = ethernet(bench, replace(THREE, wired=(0, 1, 2, 4)))
    run.run(0.5)
    assert "sends no encoder 4" in run.troubles[0]


def test_the_rate_is_set_and_read_back() -> None:
    wanted = ConfocalDtSettings(sample_period=2e-4)
    run = WithCommands(with_commands.ConfocalDtEmulator, ConfocalDtEthernetDevice, wanted)
    run.device.open()
    assert run.emulator.rate() == 5000
    assert run.device.identity["name"] == "IFC2451"


def test_a_rate_it_does_not_have_is_named() -> None:
    wanted = ConfocalDtSettings(sample_period=1 / 3000)
    run = WithCommands(with_commands.ConfocalDtEmulator, ConfocalDtEthernetDevice, wanted)
    with pytest.raises(DeviceError, match=r"refused 3 kHz: 'E06"):
        run.device.open()


def test_a_silent_command_port_is_named() -> None:
    wanted = ConfocalDtSettings()
    run = WithCommands(with_commands.ConfocalDtEmulator, ConfocalDtEthernetDevice, wanted)
    run.emulator.stall(10.0)
    with pytest.raises(DeviceTimeoutError, match=r"did not answer 'GETINFO'.*no other client"):
        run.device.open()


@pytest.mark.parametrize("lasts", always(2.9, 5.0, of=[2.2, 2.9, 3.6, 4.3, 5.0, 5.7]))
def test_it_returns_within_two_seconds_after_a_silence_of_both_ports(lasts: float) -> None:
    wanted = ConfocalDtSettings()
    ports = WithCommands(with_commands.ConfocalDtEmulator, ConfocalDtEthernetDevice, wanted)
    run = Bench(ports.data, ports.emulator, ports.device)
    run.run(1.0)
    ports.emulator.stall(lasts)
    run.run(lasts)
    before = run.delivered
    run.run(2.0)
    assert run.delivered > before
    run.end()


# ConfocalDT, RS-422.


@pytest.mark.parametrize("values", [["distance"], *soaked(["distance", "intensity", "counter"])])
def test_serial_values_arrive_in_order(bench: Any, values: list[str]) -> None:
    wanted = ConfocalDtSettings(values=tuple(values))
    emulator = ConfocalDtSerialEmulator if "counter" in values else DistanceEmulator
    run = bench(emulator, ConfocalDtDevice, wanted, portion=5)
    run.run(0.5)
    run.instrument.faults.lose = 4
    run.run(0.5)
    run.end()
    distance = np.concatenate([b.distance.distance for b in run.blocks])
    k = np.concatenate([b.distance.first_sample + np.arange(len(b.distance)) for b in run.blocks])
    if "counter" in values:
        assert run.device.statistics.lost == 4
        expected = (10 + k % 80) * 1e-6
        np.testing.assert_allclose(distance, expected, atol=100e-6 / 65_536 / 2 * 1.001)
    else:  # without a counter a sample never sent cannot be missed
        assert run.device.statistics.lost == 0
        assert np.all(np.diff(k) == 1)


def test_a_damaged_value_counts_as_one_lost_sample(bench: Any) -> None:
    run = bench(DistanceEmulator, ConfocalDtDevice, ConfocalDtSettings())
    run.run(0.5)
    run.instrument.faults.cut = 2
    run.run(0.5)
    run.end()
    assert run.device.statistics.lost == 1
    assert run.device.counts()["malformed"] == 1


def test_without_a_counter_a_silence_begins_anew(bench: Any) -> None:
    run = bench(DistanceEmulator, ConfocalDtDevice, ConfocalDtSettings())
    run.run(0.5)
    run.instrument.stall(1.0)
    run.run(2.0)
    run.end()
    assert run.device.statistics.restarts == 1


def test_a_wrong_baud_rate_is_no_sample_and_is_reported(bench: Any) -> None:
    class Garbled(ConfocalDtSerialEmulator):
        def pack(self, measured: Any, counters: Any, times_ns: Any) -> list[bytes]:
            return [b"\xff\x80\x3f"] * len(measured)

    run = bench(Garbled, ConfocalDtDevice, ConfocalDtSettings())
    run.run(5.0)
    assert run.delivered == 0
    assert "`signals` (the values of a frame), the baud rate" in run.troubles[0]


# CapaNCDT.


def test_a_reference_is_read_to_its_24_bits(bench: Any) -> None:
    run = bench(CapaNcdtEmulator, CapaNcdtDevice, CapaNcdtSettings(probe=replace(
        CapaNcdtSettings().probe, full_scale=100e-6
    )))  # fmt: skip
    run.run(1.0)
    run.end()
    for block in run.blocks:
        assert block.axes is None
        k = block.distance.first_sample + np.arange(len(block.distance))
        np.testing.assert_allclose(
            block.distance.distance, (10 + k % 80) * 1e-6, atol=100e-6 / 2**24
        )
    assert run.device.statistics.lost == 0


def test_a_power_cycle_that_leaves_the_connection_open_is_noticed(bench: Any) -> None:
    """As users report: the socket stays, but nothing ever comes again."""
    run = bench(CapaNcdtEmulator, CapaNcdtDevice, CapaNcdtSettings())
    run.run(1.0)
    session = run.loop.sessions
    alive = run.instrument.streaming
    run.instrument.streaming = lambda: run.loop.sessions > session and alive()
    run.instrument.restart()
    run.run(6.0)
    assert run.loop.sessions == session + 1
    assert "sent no readable data for" in run.troubles[0]
    before = run.delivered
    run.run(1.0)
    assert run.delivered >= before + 900
    assert run.device.statistics.restarts == 1


@pytest.mark.parametrize("end", ["", "\r", "\r\n"])
def test_the_sample_time_is_set_and_what_it_becomes_is_checked(
    end: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    emulator = with_commands.CapaNcdtEmulator
    monkeypatch.setattr(emulator, "echoed_end", end)
    run = WithCommands(emulator, CapaNcdtDevice, CapaNcdtSettings(sample_period=500e-6))
    run.device.open()
    assert run.emulator.rate() == pytest.approx(2000)
    assert run.device.identity["model"].startswith("$VERDT6230")
    wrong = WithCommands(emulator, CapaNcdtDevice, CapaNcdtSettings(sample_period=250e-6))
    with pytest.raises(DeviceError, match=r"250 µs were requested, .* every 248 µs"):
        wrong.device.open()


def test_a_channel_it_does_not_have_is_named(bench: Any) -> None:
    run = bench(CapaNcdtEmulator, CapaNcdtDevice, CapaNcdtSettings(channel=4))
    run.run(0.5)
    assert "has no channel 4, only ('channel 1', 'channel 2')" in run.troubles[0]


@pytest.mark.parametrize(
    "make",
    [
        lambda: ConfocalDtSettings(values=("counter",)),
        lambda: ConfocalDtSettings(values=("distance", "exposure")),
        lambda: ConfocalDtSettings(values=("distance", "distance")),
    ],
)
def test_senseless_settings_are_refused(make: Callable[[], object]) -> None:
    with pytest.raises(ConfigurationError):
        make()


@pytest.mark.parametrize(
    ("device", "wanted"),
    [
        (ConfocalDtEthernetDevice, ConfocalDtSettings(trigger="each")),
        (CapaNcdtDevice, CapaNcdtSettings(trigger="each")),
    ],
)
def test_another_service_on_the_port_is_reported_even_while_waiting_for_a_trigger(
    bench: Any, device: Any, wanted: Any
) -> None:
    class Banner(Instrument):
        def pack(self, measured: Any, counters: Any, times_ns: Any) -> list[bytes]:
            return [b"SSH-2.0-OpenSSH_9.6\r\n"] * len(measured)

    run = bench(Banner, device, wanted)
    run.run(4.0)
    assert "no samples of this device" in run.troubles[0]
    blocks = bench(Banner, device, wanted)
    blocks.instrument.pack = lambda measured, *_: [b"DATA" + bytes(184)] * len(measured)
    blocks.run(4.0)
    assert "read this controller over RS-422" in blocks.troubles[0]
    quiet = bench(Banner, device, wanted, triggered=True)
    quiet.run(4.0)
    assert quiet.troubles == []
