"""Random sequences of faults: every driver lives, and every sample is published once or counted."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from omsm_ros.instruments.chrocodile.device import ChrocodileSettings
from omsm_ros.instruments.chrocodile.dollar_device import ChrocodileDevice
from omsm_ros.instruments.chrocodile.emulator import ChrocodileEmulator, ChrocodilePacketEmulator
from omsm_ros.instruments.chrocodile.packet_device import ChrocodilePacketDevice
from omsm_ros.instruments.emulator import AXIS_SCALING
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
from omsm_ros.instruments.reader import BACK_OFF_S
from omsm_ros.instruments.scaling import ProbeReading
from omsm_ros.instruments.six_channel.device import CsvSettings, CsvStreamDevice
from omsm_ros.instruments.six_channel.emulator import CsvStreamEmulator

from .faulty import Faulty

# As `docs/devices.md` states it: the fault itself, the silence that shows it and a new set-up,
# and for each command that is not answered, or with rubbish, the patience and the longest pause.
LASTS_S, NOTICED_S, UNANSWERED_S = 3.0, 5.0, 2.0 + BACK_OFF_S[1]

Fault = Callable[[Faulty], None]
Story = list[tuple[Fault, float]]


class Kind(NamedTuple):
    """A device and its emulator, and the faults that its protocol can show.

    resolution: of its distances [m];  modulus: of its counter
    """

    emulator: type
    device: type
    settings: Any
    checked: bool = False
    resolution: float = 2e-11
    modulus: int = 2**16


class XyzEmulator(ConfocalDtEmulator):
    wired = (0, 1, 2)


MICRO = ProbeReading()  # 100 µm
SIX = ChrocodileSettings(axes=AXIS_SCALING)
KINDS = {
    "dollar, binary": Kind(ChrocodileEmulator, ChrocodileDevice, SIX),
    "dollar, ascii": Kind(
        ChrocodileEmulator, ChrocodileDevice, ChrocodileSettings(axes=AXIS_SCALING, format="ascii")
    ),
    "packet": Kind(ChrocodilePacketEmulator, ChrocodilePacketDevice, SIX, checked=True),
    "confocalDT, Ethernet": Kind(
        XyzEmulator,
        ConfocalDtEthernetDevice,
        ConfocalDtSettings(axes=AXIS_SCALING, wired=(0, 1, 2)),
        checked=True,
        modulus=2**32,
    ),
    "confocalDT, RS-422": Kind(
        ConfocalDtSerialEmulator,
        ConfocalDtDevice,
        ConfocalDtSettings(values=("distance", "intensity", "counter")),
        resolution=100e-6 / 2**16,
        modulus=2**18,
    ),
    "capaNCDT": Kind(
        CapaNcdtEmulator, CapaNcdtDevice, CapaNcdtSettings(probe=MICRO), checked=True, modulus=2**32
    ),
    "text": Kind(CsvStreamEmulator, CsvStreamDevice, CsvSettings(), modulus=2**32),
}


def count(name: str, most: int) -> st.SearchStrategy[Fault]:
    return st.integers(1, most).map(lambda n: lambda i: setattr(i.faults, name, n))


def lasting(name: str) -> st.SearchStrategy[Fault]:
    return st.floats(0.05, LASTS_S).map(lambda s: lambda i: getattr(i, name)(s))


# Faults of a device that is read as a memory: no noise, cuts or commands.
MEMORY_FAULTS = (
    count("lose", 40),
    count("duplicate", 40),
    count("saturate", 40),
    count("drop_out", 40),
    lasting("unplug"),
    lasting("power_cycle"),
    lasting("stall"),
    st.just(lambda i: i.restart()),
    st.just(lambda i: i.reset_counter()),
    st.integers(0, 2**31).map(lambda ns: lambda i: i.step_clock(ns)),
)
FAULTS = (
    *MEMORY_FAULTS,
    count("noise", 500),
    count("garbage_answers", 2),
    count("ignore_commands", 2),
    st.floats(0.05, 0.5).map(lambda s: lambda i: setattr(i.faults, "merge", s)),
    st.just(lambda i: setattr(i.faults, "merge", 0.0)),
)
# Bytes cut out of a stream without length or checksum may join two samples.
CUT = count("cut", 200)


def stories(kind: Kind) -> st.SearchStrategy[Story]:
    fault = st.one_of(*FAULTS, CUT) if kind.checked else st.one_of(*FAULTS)
    return st.lists(st.tuples(fault, st.floats(0.0, 1.5)), min_size=1, max_size=6)


def play(bench: Any, kind: Kind, story: Story) -> None:
    run = bench(kind.emulator, kind.device, kind.settings, interval=0.02)
    run.resolution, run.modulus = kind.resolution, kind.modulus
    run.run(0.5)
    for fault, pause in story:
        fault(run.instrument)
        run.run(pause)
    faults = run.instrument.faults
    faults.merge = 0.0
    unanswered = faults.ignore_commands + faults.garbage_answers
    run.is_back_within(LASTS_S + NOTICED_S + UNANSWERED_S * unanswered)
    run.end()
    run.check()


def sequences(examples: int) -> Any:
    return settings(
        derandomize=True,
        phases=[Phase.generate],  # a story is not made shorter: that takes minutes
        max_examples=examples,
        suppress_health_check=[HealthCheck.function_scoped_fixture],
    )


@pytest.mark.parametrize("name", ["dollar, binary", "packet", "text"])
@sequences(4)
@given(st.data())
def test_whatever_happens_in_any_order(name: str, bench: Any, data: st.DataObject) -> None:
    play(bench, KINDS[name], data.draw(stories(KINDS[name])))


@pytest.mark.soak
@pytest.mark.timeout(0)  # minutes on a busy host
@pytest.mark.parametrize("name", KINDS)
@sequences(150)
@given(st.data())
def test_whatever_happens_many_times(name: str, bench: Any, data: st.DataObject) -> None:
    play(bench, KINDS[name], data.draw(stories(KINDS[name])))


@pytest.mark.parametrize("form", ["binary", "ascii"])
def test_a_silent_device_that_answers_nothing_for_long_is_back_in_the_stated_time(
    form: str, bench: Any
) -> None:
    """The slowest way back: a stall, then two commands ignored and two answered with rubbish."""
    wanted = ChrocodileSettings(axes=AXIS_SCALING, format=form)
    faults: Story = [
        (lambda i: setattr(i.faults, "garbage_answers", 2), 0.0),
        (lambda i: setattr(i.faults, "ignore_commands", 2), 0.0),
        (lambda i: i.stall(LASTS_S), 0.0),
    ]
    play(bench, Kind(ChrocodileEmulator, ChrocodileDevice, wanted), faults)
