"""The driver of the packet protocol against its emulator: setting up, faults, what is refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from soaked import always

from omsm_ros.errors import DeviceError, DeviceTimeoutError
from omsm_ros.instruments.chrocodile.device import ChrocodileSettings, RefusedError
from omsm_ros.instruments.chrocodile.emulator import ChrocodilePacketEmulator
from omsm_ros.instruments.chrocodile.packet_device import ChrocodilePacketDevice
from omsm_ros.instruments.emulator import AXIS_SCALING

from .faulty import Faulty

SIX = ChrocodileSettings(axes=AXIS_SCALING)


@pytest.fixture
def cell(bench: Callable[..., Any]) -> Callable[..., Any]:
    def make(wanted: ChrocodileSettings = SIX, **options: Any) -> Any:
        return bench(ChrocodilePacketEmulator, ChrocodilePacketDevice, wanted, **options)

    return make


@pytest.mark.parametrize("portion", [1 << 20, 13])
def test_every_sample_arrives_once_with_its_counter(cell: Any, portion: int) -> None:
    run = cell(portion=portion)
    run.run(1.5)
    run.end()
    run.check()
    found = run.device.statistics
    assert found.delivered > 1300
    assert (found.lost, found.duplicates, found.spoilt, found.restarts) == (0, 0, 0, 0)
    assert run.device.counts()["malformed"] == run.device.counts()["bytes_discarded"] == 0
    assert run.device.identity["SHZ"] == "1000"


def test_seventy_kilohertz(cell: Any) -> None:
    run = cell(replace(SIX, sample_period=14.3e-6, block_size=700))
    run.run(1.1)
    run.end()
    run.check()
    assert run.delivered > 65_000
    assert run.device.statistics.lost == 0


def test_stamps_follow_the_packets_own_time(cell: Any) -> None:
    run = cell()
    run.run(2.0)
    run.end()
    assert len(run.blocks) > 1
    for before, after in zip(run.blocks[:-1], run.blocks[1:], strict=True):
        step = after.distance.first_sample - before.distance.first_sample
        passed = after.distance.stamp_ns - before.distance.stamp_ns
        assert passed == pytest.approx(step * 1e6, abs=12e6)


FAULTS: dict[str, Callable[[Faulty], None]] = {
    "unplug": lambda i: i.unplug(1.0),
    "power cycle": lambda i: i.power_cycle(1.5),
    "restart with the line up": lambda i: i.restart(),
    "stall": lambda i: i.stall(1.0),
    "long stall": lambda i: i.stall(4.0),
    "counter reset": lambda i: i.reset_counter(),
    "lost packets": lambda i: setattr(i.faults, "lose", 3),
    "doubled packets": lambda i: setattr(i.faults, "duplicate", 3),
    "noise": lambda i: setattr(i.faults, "noise", 300),
    "cut": lambda i: setattr(i.faults, "cut", 101),
}


@pytest.mark.parametrize("fault", always("power cycle", "cut", of=FAULTS))
def test_it_is_back_within_five_seconds(cell: Any, fault: str) -> None:
    run = cell()
    run.is_back_within_five_seconds_of(FAULTS[fault], 6.0 if "long" in fault else 2.0)
    found = run.device.statistics
    assert (found.duplicates > 0) == (fault == "doubled packets")
    if fault in ("lost packets", "cut"):
        assert found.lost > 0
    assert bool(found.restarts) == (
        fault in ("power cycle", "restart with the line up", "counter reset")
    )


def test_a_refusal_is_named(cell: Any) -> None:
    run = cell(ChrocodileSettings(signals=(83, 256, 264)))
    with pytest.raises(DeviceError, match=r"refused SODX \(83, 256, 264\)"):
        run.device.open()


def test_a_model_without_some_commands_is_set_up_all_the_same(cell: Any) -> None:
    run = cell()
    usual = run.instrument._answer
    lacks = ("VER", "SCA", "STO", "STA", "CTN")
    run.instrument._answer = lambda r: "not valid" if r.name in lacks else usual(r)
    run.run(1.0)
    run.end()
    run.check()
    assert run.delivered > 700


def test_a_refused_trigger_is_not_taken_as_set(cell: Any) -> None:
    """Free-running, it would count exposures where the axes count triggers."""
    run = cell(ChrocodileSettings(trigger="each"))
    usual = run.instrument._answer
    run.instrument._answer = lambda r: "not valid" if r.name == "TRE" else usual(r)
    with pytest.raises(RefusedError, match="refused TRE"):
        run.device.open()


def test_another_service_on_the_port_is_named(cell: Any) -> None:
    run = cell()
    run.instrument.greet = lambda: run.instrument.say(b"SSH-2.0-OpenSSH_9.6\r\n")
    run.instrument.streaming = lambda: False
    run.instrument.receive = lambda data: None
    with pytest.raises(DeviceTimeoutError, match=r"did not answer 'CONF'; it sends .*SSH-2.0"):
        run.device.open()


def test_a_device_that_tells_nothing_by_itself_is_asked_for_its_configuration(cell: Any) -> None:
    run = cell()
    reported, usual = run.instrument.greet, run.instrument.receive
    run.instrument.greet = lambda: None

    def receive(data: bytes) -> None:
        if b"CONF" in data:
            reported()
        else:
            usual(data)

    run.instrument.receive = receive
    run.run(3.0)
    run.end()
    run.check()
    assert run.delivered > 1500
    assert run.troubles == []


def test_a_device_at_another_rate_is_withheld(cell: Any) -> None:
    run = cell()
    run.instrument.faults.rate = 0.9
    run.run(3.0)
    assert run.delivered == 0
    assert "measures at 900 Hz" in run.device.trouble
