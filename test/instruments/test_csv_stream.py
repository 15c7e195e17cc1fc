"""The driver of the text stream against its emulator, and the columns of LinuxCNC."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from loopback import SimulatedClock
from soaked import soaked

from omsm_ros.instruments.emulator import Instrument
from omsm_ros.instruments.scaling import AxisScaling
from omsm_ros.instruments.six_channel.device import (
    CsvSettings,
    CsvStreamDevice,
    GenericStreamDevice,
)
from omsm_ros.instruments.six_channel.emulator import CsvStreamEmulator
from omsm_ros.instruments.six_channel.protocol import StreamScaling

from .scripted_stream import Script


@pytest.mark.parametrize("portion", [1 << 20, *soaked(17)])
def test_every_sample_arrives_once_with_its_counter(bench: Any, portion: int) -> None:
    run = bench(CsvStreamEmulator, CsvStreamDevice, CsvSettings(), portion=portion)
    run.run(1.0)
    run.instrument.faults.lose = 5
    run.run(0.5)
    run.instrument.faults.duplicate = 5
    run.run(0.5)
    run.end()
    run.check()
    assert run.device.statistics.lost == 5
    assert run.device.statistics.duplicates == 5


@pytest.mark.parametrize("fault", ["power_cycle", "stall", *soaked("unplug")])
def test_it_comes_back(bench: Any, fault: str) -> None:
    run = bench(CsvStreamEmulator, CsvStreamDevice, CsvSettings())
    run.run(1.0)
    getattr(run.instrument, fault)(1.0)
    run.run(4.0)
    before = run.delivered
    run.run(1.0)
    assert run.delivered >= before + 900
    run.end()
    run.check()
    assert run.device.statistics.restarts == (fault == "power_cycle")


class Halsampler(Instrument):
    """Axes in millimetres, as LinuxCNC has them."""

    counter_range = 2**32

    def pack(self, measured: Any, counters: np.ndarray, times_ns: np.ndarray) -> list[bytes]:
        z = measured.axes["z"] * 1e3
        return [b"%d %.9f 0 \n" % (n, v) for n, v in zip(counters, z, strict=True)]


def test_axes_in_millimetres_without_a_probe(bench: Any) -> None:
    millimetres = AxisScaling(counts_per_unit=1e3)
    scaling = StreamScaling(x=AxisScaling(1.0, offset=0.25), z=millimetres)
    settings = CsvSettings(columns=("sequence", "z", "-"), scaling=scaling)
    run = bench(Halsampler, CsvStreamDevice, settings)
    run.run(0.5)
    run.end()
    assert run.blocks
    for block in run.blocks:
        assert block.distance is None
        k = block.axes.first_sample + np.arange(len(block.axes))
        np.testing.assert_allclose(block.axes.z, k % 1000 * 1e-6, atol=1e-9)
        assert (block.axes.x == 0.25).all()


class Banner(Instrument):
    """Another service on the port: it talks, but not of samples."""

    def pack(self, measured: Any, counters: np.ndarray, times_ns: np.ndarray) -> list[bytes]:
        return [b"\xff\x12login:"] * len(measured)


@pytest.mark.parametrize(
    ("device", "check"),
    [
        (CsvStreamDevice, "`columns` (the columns of a line), the baud rate and what is connected"),
        (GenericStreamDevice, "the baud rate and what is connected"),
    ],
)
def test_bytes_that_are_no_samples_are_reported(bench: Any, device: Any, check: str) -> None:
    run = bench(Banner, device, None)
    run.run(4.0)
    assert run.delivered == 0
    assert f"no samples of this device; check {check}" in run.troubles[0]


class Idle(Instrument):
    """A sender between triggers."""

    def pack(self, measured: Any, counters: np.ndarray, times_ns: np.ndarray) -> list[bytes]:
        return [b"\0\0"] * len(measured)


def test_an_idle_line_is_no_trouble(bench: Any) -> None:
    run = bench(Idle, GenericStreamDevice, None)
    run.run(6.0)
    assert run.troubles == []


@pytest.mark.parametrize("device", [CsvStreamDevice, GenericStreamDevice])
def test_a_quiet_line_is_no_trouble(bench: Any, device: Any) -> None:
    run = bench(Banner, device, None, triggered=True)
    run.run(6.0)
    assert run.troubles == []
    assert run.connections == 1


@pytest.mark.parametrize("number", [b"-1", b"4503599627370497", b"9223372036854775807"])
def test_a_number_that_no_counter_has_costs_its_line(number: bytes) -> None:
    """Half of the numbers are spoilt; the driver goes on, and the rest is where it was."""
    lines = [
        b"%s,%d,%d,0,%d,0,0,0,0\n" % (number if k % 2 else b"%d" % k, k * 10**6, k, k)
        for k in range(40)
    ]
    device = CsvStreamDevice(
        Script(*lines), CsvSettings(block_size=1), SimulatedClock().nanoseconds
    )
    device.open()
    blocks = [pair for _ in lines for pair in device.poll(0.05)] + device.close()
    found = {pair.distance.first_sample: pair.distance.distance[0] for pair in blocks}
    assert found == pytest.approx({k: k * 1e-9 for k in range(0, 40, 2)})
    assert device.counts()["malformed"] == 20
