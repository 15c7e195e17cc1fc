"""CHRocodiles that differ within what is published: averaging, sync bytes, answers to VER."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from soaked import soaked

from omsm_ros.instruments.chrocodile.device import ChrocodileSettings
from omsm_ros.instruments.chrocodile.dollar_device import ChrocodileDevice
from omsm_ros.instruments.chrocodile.emulator import ChrocodileEmulator, ChrocodilePacketEmulator
from omsm_ros.instruments.chrocodile.packet_device import ChrocodilePacketDevice
from omsm_ros.instruments.emulator import AXIS_SCALING

SIX = ChrocodileSettings(axes=AXIS_SCALING)
BOTH = [(ChrocodileEmulator, ChrocodileDevice), (ChrocodilePacketEmulator, ChrocodilePacketDevice)]


@pytest.mark.parametrize(("emulator", "device"), BOTH)
def test_a_device_that_averages_still_sends_at_the_rate_that_is_set(
    emulator: Any, device: Any, bench: Any
) -> None:
    run = bench(emulator, device, replace(SIX, averaging=4))
    run.run(1.5)
    run.end()
    run.check()
    assert run.instrument.rate() == 1000
    assert run.delivered > 1300
    assert run.troubles == []


def test_averaging_that_the_device_had_before_is_known(bench: Any) -> None:
    run = bench(ChrocodileEmulator, ChrocodileDevice, SIX)
    run.instrument._values["AVD"] = "10"
    run.run(1.0)
    run.end()
    assert run.instrument.rate() == 1000
    assert run.delivered > 800


def test_a_device_that_averages_without_slowing_down_is_set_anew(bench: Any) -> None:
    run = bench(ChrocodileEmulator, ChrocodileDevice, replace(SIX, averaging=4))
    run.instrument.rate = lambda: float(run.instrument._values["SHZ"])
    run.run(3.0)
    assert run.instrument.rate() == 1000
    assert len(run.troubles) == 1
    assert "averages 4 exposures" in run.troubles[0]
    before = run.delivered
    run.run(1.0)
    assert run.delivered - before > 900


def test_a_trigger_is_below_the_rate_of_what_is_averaged(bench: Any) -> None:
    run = bench(ChrocodileEmulator, ChrocodileDevice, replace(SIX, trigger="each", averaging=4))
    run.run(0.2)
    assert float(run.instrument._values["SHZ"]) == pytest.approx(4200, rel=1e-4)


@pytest.mark.parametrize(("emulator", "device"), BOTH)
def test_averaging_that_another_client_sets_meanwhile_leads_to_a_new_setup(
    emulator: Any, device: Any, bench: Any
) -> None:
    run = bench(emulator, device, SIX)
    run.run(1.0)
    run.instrument._values["AVD"] = "4"
    run.run(3.5)
    before = run.delivered
    run.run(1.0)
    assert any("another client" in trouble for trouble in run.troubles)
    assert run.instrument.rate() == 1000
    assert run.delivered - before > 800


def test_another_sync_left_by_somebody_else_is_set_back(bench: Any) -> None:
    class OwnSync(ChrocodileEmulator):
        _sync = b"xy"

    run = bench(OwnSync, ChrocodileDevice, SIX)
    run.run(4.0)
    run.end()
    assert len(run.troubles) == 1
    assert "no readable telegram" in run.troubles[0]
    assert run.delivered > 800


@pytest.mark.parametrize("trigger", ["free_run", "each"])
def test_a_counter_in_large_steps_is_counted_and_named(trigger: str, bench: Any) -> None:
    """As with every twentieth sample sent; telegrams then cannot be told from damaged ones."""

    class EveryTwentieth(ChrocodileEmulator):
        def pack(self, measured: Any, counters: np.ndarray, times_ns: np.ndarray) -> list[bytes]:
            return super().pack(measured, counters * 20 % 2**16, times_ns)

    run = bench(EveryTwentieth, ChrocodileDevice, replace(SIX, trigger=trigger))
    run.run(5.0)
    assert run.device.counts()["bad_counters"] > 1000
    assert "counter goes on by 1" in run.troubles[0]


@pytest.mark.parametrize("form", ["binary", *soaked("ascii")])
def test_a_telegram_that_waits_for_the_next_one_is_not_stamped_late(form: str, bench: Any) -> None:
    run = bench(ChrocodileEmulator, ChrocodileDevice, replace(SIX, format=form), interval=1e-3)
    run.run(1.0)
    block = run.blocks[-1].distance
    # Sample k is due k + 1 periods after the start, and read in the next millisecond.
    due = run.instrument._started + (block.first_sample + 2) * 1e-3
    assert abs(block.stamp_ns * 1e-9 - due) < 1e-4


def test_a_refusal_is_no_version(bench: Any) -> None:
    run = bench(ChrocodileEmulator, ChrocodileDevice, SIX)
    usual = run.instrument._answer
    run.instrument._answer = lambda r: "not valid" if r.name == "VER" else usual(r)
    run.run(0.3)
    assert run.device.identity["model"] == "CHRocodile"
