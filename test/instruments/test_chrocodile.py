"""The driver of the CHRocodile against its emulator: setting up, every fault, what is refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from soaked import always, soaked

from omsm_ros.core.streams.blocks import Status
from omsm_ros.errors import ConfigurationError, DeviceError, DeviceTimeoutError
from omsm_ros.instruments.chrocodile.device import ChrocodileSettings
from omsm_ros.instruments.chrocodile.dollar_device import ChrocodileDevice
from omsm_ros.instruments.chrocodile.emulator import ChrocodileEmulator
from omsm_ros.instruments.chrocodile.telegram import Layout
from omsm_ros.instruments.emulator import AXIS_SCALING
from omsm_ros.instruments.scaling import ProbeReading

from .faulty import Faulty

SIX = ChrocodileSettings(axes=AXIS_SCALING)


@pytest.fixture
def cell(bench: Callable[..., Any]) -> Callable[..., Any]:
    def make(settings: ChrocodileSettings = SIX, **options: Any) -> Any:
        return bench(ChrocodileEmulator, ChrocodileDevice, settings, **options)

    return make


# Samples.


@pytest.mark.parametrize(
    "settings",
    [
        SIX,
        replace(SIX, format="ascii"),
        replace(SIX, latch="end"),
        replace(SIX, latch="mean"),
        replace(SIX, signals=(83, 33024, 65, 66, 67, 68, 69)),
        replace(SIX, signals=(83, 64, 76, 256, 16641, 65, 66, 67, 68, 69)),
    ],
    ids=["usual", "ascii", "end", "mean", "nanometres", "intensity 16 bit"],
)
def test_every_sample_arrives_once_with_its_counter(cell: Any, settings: Any) -> None:
    run = cell(settings)
    run.run(1.5)
    run.end()
    run.check()
    found = run.device.statistics
    assert found.delivered > 1300
    assert (found.lost, found.duplicates, found.spoilt, found.restarts) == (0, 0, 0, 0)
    assert run.device.identity["SHZ"] == "1000"
    assert run.device.trouble == ""


def test_sixteen_bits_are_three_nanometres(cell: Any) -> None:
    run = cell(ChrocodileSettings(signals=(83, 16640, 16641)), probe=ProbeReading())
    run.run(0.5)
    run.end()
    distance = np.concatenate([b.distance.distance for b in run.blocks])
    assert all(b.axes is None for b in run.blocks)
    steps = distance / (100e-6 / 2**15)
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-6)
    assert abs(np.rint(distance * 1e6) * 1e-6 - distance).max() < 1.6e-9


def test_the_counter_wraps_and_the_trigger_count_does_not(cell: Any) -> None:
    run = cell()
    run.instrument._counter = 2**16 - 3000  # as after a minute
    run.run(7.0)
    run.end()
    run.check()
    first, last = run.blocks[0].distance, run.blocks[-1].distance
    assert first.first_sample < 2**16
    assert last.first_sample + len(last) > 2**16 + 3000
    assert (run.device.statistics.lost, run.device.statistics.restarts) == (0, 0)


def test_distance_is_scaled_from_its_zero_with_its_sign(cell: Any) -> None:
    probe = ProbeReading(zero=50e-6, polarity=-1, intensity_full_scale=2.0)
    settings = ChrocodileSettings(probe=probe)
    run = cell(settings)
    run.run(0.3)
    run.end()
    block = run.blocks[0].distance
    k = block.first_sample + np.arange(len(block))
    np.testing.assert_allclose(block.distance, 50e-6 - (10 + k % 80) * 1e-6, atol=2e-11)
    assert (block.intensity == 1.0).all()


@pytest.mark.parametrize("portion", [7, *soaked(1, 39)])
def test_portions_of_the_line_change_nothing(cell: Any, portion: int) -> None:
    run = cell(portion=portion)
    run.run(0.4)
    run.end()
    run.check()
    assert run.delivered > 200


# Faults, one by one.

LOSES_NOTHING = {"duplicate", "saturate", "drop_out", "merge"}
COUNTED = {"lose": 7, "duplicate": 12, "saturate": 5, "drop_out": 9, "noise": 200, "cut": 11}


@pytest.mark.parametrize("fault", always("lose", "cut", of=[*COUNTED, "merge"]))
def test_a_fault_of_the_line_costs_what_it_hits(cell: Any, fault: str) -> None:
    run = cell()
    run.run(1.0)
    setattr(run.instrument.faults, fault, COUNTED.get(fault, 0.3))
    run.run(2.0)
    run.instrument.faults.merge = 0.0
    run.run(1.0)
    run.end()
    run.check()
    found = run.device.statistics
    assert found.restarts == 0
    assert run.connections == 1
    assert found.duplicates == (12 if fault == "duplicate" else 0)
    if fault in LOSES_NOTHING:
        assert found.lost == 0
    else:
        assert 0 < found.lost <= {"lose": 7, "noise": 3, "cut": 3}[fault]


def test_saturation_and_dropouts_are_verdicts_not_losses(cell: Any) -> None:
    run = cell()
    run.run(0.5)
    run.instrument.faults.saturate, run.instrument.faults.drop_out = 5, 9
    run.run(0.5)
    run.end()
    status = np.concatenate([b.distance.status for b in run.blocks])
    distance = np.concatenate([b.distance.distance for b in run.blocks])
    assert (status == Status.SATURATED).sum() == 5
    assert (status == Status.NO_TARGET).sum() == 9
    assert np.isnan(distance[status == Status.NO_TARGET]).all()


FAULTS: dict[str, Callable[[Faulty], None]] = {
    "unplug": lambda i: i.unplug(1.0),
    "power cycle": lambda i: i.power_cycle(1.5),
    "restart with the line up": lambda i: i.restart(),
    "stall": lambda i: i.stall(1.0),
    "long stall": lambda i: i.stall(4.0),
    "counter reset": lambda i: i.reset_counter(),
    "clock step": lambda i: i.step_clock(3_000_000_000),
}


@pytest.mark.parametrize("fault", always("unplug", of=FAULTS))
def test_it_is_back_within_five_seconds(cell: Any, fault: str) -> None:
    run = cell()
    run.is_back_within_five_seconds_of(FAULTS[fault], 6.0 if "long" in fault else 2.0)
    restarted = fault in ("power cycle", "restart with the line up", "counter reset")
    assert run.device.statistics.restarts == restarted


def test_an_unplugged_cable_costs_exactly_what_was_measured_meanwhile(cell: Any) -> None:
    run = cell()
    run.run(1.0)
    run.instrument.unplug(2.0)
    run.run(4.0)
    run.end()
    run.check()
    assert 1900 < run.device.statistics.lost < 4000  # it tries again 1.75 s, then 3.75 s after
    assert run.device.statistics.gaps == 1


def test_a_cable_out_for_more_than_a_turn_of_the_counter(cell: Any) -> None:
    """65.5 s at 1 kHz: the whole turn is found from the time that passed."""
    run = cell(interval=0.1)
    run.run(1.0)
    run.instrument.unplug(100.0)
    run.run(107.0)
    run.end()
    run.check()
    assert 99_000 < run.device.statistics.lost < 106_000


@pytest.mark.parametrize(
    ("fault", "value"),
    [("slow_answers", 1.0), *soaked(("garbage_answers", 3), ("ignore_commands", 2))],
)
def test_bad_answers_delay_setting_up_and_no_more(cell: Any, fault: str, value: float) -> None:
    run = cell()
    setattr(run.instrument.faults, fault, value)
    run.run(25.0)
    before = run.delivered
    run.run(1.0)
    assert run.delivered >= before + 900
    run.end()
    run.check()


# Refusals.


def test_a_device_at_another_rate_than_it_says_is_withheld(cell: Any) -> None:
    run = cell()
    run.instrument.faults.rate = 0.9
    run.run(3.0)
    assert run.delivered == 0
    assert run.device.statistics.withheld > 2000
    assert "measures at 900 Hz, sample_period states 1000 Hz" in run.device.trouble
    run.instrument.faults.rate = 1.0
    run.run(2.0)
    assert run.delivered > 1500
    assert run.device.trouble == ""
    run.end()
    run.check()


def test_a_rate_that_is_rounded_away_is_named(cell: Any) -> None:
    run = cell(replace(SIX, sample_period=1.34e-6))
    with pytest.raises(DeviceError, match=r"746269 Hz was requested.*769231 Hz.*sample_period to"):
        run.device.open()


class Stubborn(ChrocodileEmulator):
    """Accepts everything and changes nothing."""

    def _set(self, name: str, arguments: tuple[str, ...]) -> str:
        return ""


def test_a_setting_that_is_not_taken_is_named(bench: Any) -> None:
    run = bench(Stubborn, ChrocodileDevice, replace(SIX, lamp=40.0))
    with pytest.raises(DeviceError, match=r"\$SODX was set to .* the device has \(256.0, 257.0\)"):
        run.device.open()


class OwnOrder(ChrocodileEmulator):
    """Reads its selection back, and sends it, in its own order."""

    def _answer(self, request: Any) -> str:
        text = super()._answer(request)
        if request.name == "SODX" and request.arguments != ("?",):
            numbers = sorted(map(int, request.arguments))
            self._values["SODX"] = " ".join(map(str, numbers))
            self._layout = Layout.of(numbers)
        return text


def test_the_devices_own_order_is_read(bench: Any) -> None:
    run = bench(OwnOrder, ChrocodileDevice, SIX)
    run.run(1.0)
    run.instrument.unplug(0.5)
    run.run(2.0)
    run.end()
    run.check()
    assert run.delivered > 1500
    assert run.device.statistics.restarts == 0


class Banner(ChrocodileEmulator):
    """Another service on the port."""

    def receive(self, data: bytes) -> None:
        self._line.write(b"SSH-2.0-OpenSSH_9.6\r\n")

    def streaming(self) -> bool:
        return False


def test_another_service_on_the_port_is_named(bench: Any) -> None:
    run = bench(Banner, ChrocodileDevice, SIX)
    with pytest.raises(DeviceTimeoutError, match=r"did not answer '\$STO'; it sends .*SSH-2.0"):
        run.device.open()


def test_silence_names_the_baud_rate(cell: Any) -> None:
    run = cell()
    run.instrument.stall(10.0)
    with pytest.raises(DeviceTimeoutError, match=r"check power, cable, .*baud rate, 115200"):
        run.device.open()


def test_a_device_that_became_slower_is_set_up_again(cell: Any) -> None:
    """Its answers take twice the time that is waited for one after the quick ones before."""
    run = cell()
    run.run(0.5)
    run.instrument.faults.slow_answers = 1.0
    run.instrument.unplug(0.1)
    run.run(2.0)
    assert any("did not answer" in trouble for trouble in run.troubles)
    run.is_back_within(45.0)
    run.end()


def test_a_line_too_slow_for_the_telegrams_is_named(cell: Any) -> None:
    run = cell()
    run.loop.baud_rate = 115_200
    with pytest.raises(DeviceError, match=r"38 bytes a sample need 380000 bit/s.*115200"):
        run.device.open()


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"signals": (256, 257)}, "lack 83"),
        ({"signals": (83, 256, 65, 67), "axes": AXIS_SCALING}, "lack \\[66, 68, 69\\]"),
    ],
)
def test_senseless_settings_are_refused(arguments: dict[str, Any], named: str) -> None:
    with pytest.raises(ConfigurationError, match=named):
        ChrocodileSettings(**arguments)


# Trigger.


def test_a_triggered_device_may_be_silent(cell: Any) -> None:
    run = cell(replace(SIX, trigger="each"), triggered=True)
    run.run(10.0)
    assert run.connections == 1
    assert not run.troubles
    assert float(run.device.identity["SHZ"]) > 1000


def test_a_connection_that_the_device_forgot_is_made_again_within_two_seconds(cell: Any) -> None:
    """It stays open, so nothing but the silence shows it."""
    run = cell()
    run.run(1.0)
    forgetful, before = run.instrument, run.delivered
    forgetful.receive, forgetful.streaming = lambda _: None, lambda: False

    def greeted() -> None:
        del forgetful.receive, forgetful.streaming, forgetful.greet

    forgetful.greet = greeted
    run.run(2.0)
    assert run.connections == 2
    assert run.delivered > before
    run.end()
    run.check()


def test_dark_reference_is_asked_for(cell: Any) -> None:
    run = cell()
    run.run(0.5)
    run.device.dark_reference()
    run.run(0.5)
    run.end()
    run.check()


@pytest.mark.parametrize("wanted", [{}, {"averaging": 4, "lamp": 50.0}])
def test_it_tells_what_a_calibration_belongs_to(cell: Any, wanted: dict[str, float]) -> None:
    run = cell(replace(SIX, **wanted))
    assert run.device.settings == {}
    run.device.open()
    assert run.device.settings == {
        "model": "CHRocodile 2 emulated", "head": 0, "full_scale": 100,
        "rate": 1000 * wanted.get("averaging", 1),  # of exposures
        "averaging": wanted.get("averaging", 1), "lamp": wanted.get("lamp", 100),
        "latch": "start", "trigger": "free_run",
    }  # fmt: skip
