"""Blocks of a controller: those that wait keep their arrival time; spoilt ones give no sample."""

from __future__ import annotations

import struct
from contextlib import suppress

import numpy as np
import pytest

from omsm_ros.errors import DeviceError
from omsm_ros.instruments.arrivals import MissedTriggerDetector
from omsm_ros.instruments.micro_epsilon.capancdt_device import CapaNcdtDevice, CapaNcdtSettings
from omsm_ros.instruments.micro_epsilon.protocol import MeasurementBlock, encode_block
from omsm_ros.instruments.scaling import ProbeReading

from .scripted_stream import Script

MS = 1_000_000


def block(first: int, count: int) -> bytes:
    frames = np.zeros((count, 4), np.uint8)
    return encode_block("capacitive", MeasurementBlock(1, 2, (0b01, 0), first, frames))


def stamps(portions: list[bytes], arrivals_ms: list[float], period: float) -> dict[int, float]:
    """Stamp [ms] by trigger count of what a controller sends that keeps its own rate."""
    now = iter(arrivals_ms)
    at = [0.0]

    def now_ns() -> int:
        at[0] = next(now, at[0])
        return round(at[0] * MS)

    settings = CapaNcdtSettings(sample_period=period, block_size=10)
    device = CapaNcdtDevice(Script(*portions), settings, now_ns, lambda: at[0] / 1e3)
    device.open()
    blocks = [pair.distance for _ in portions for pair in device.poll(0.0)]
    blocks += [pair.distance for pair in device.close()]
    assert device.statistics.lost == device.statistics.restarts == 0
    return {b.first_sample: b.stamp_ns / MS for b in blocks if b is not None}


def test_stamps_are_of_the_block_not_of_its_successor() -> None:
    wire = [block(10 * k, 10) for k in range(50)]
    found = stamps(wire, [10.0 * k + 9 for k in range(50)], 1e-3)
    assert found == {10 * k: 10.0 * k for k in range(50)}


def test_blocks_seconds_apart_are_handed_over_one_by_one() -> None:
    """No longer silence than between two blocks makes a controller one that sends nothing."""
    wire = [part for k in range(6) for part in (block(k, 1), b"")]
    arrivals = [t for k in range(6) for t in (1500.0 * (k + 1), 1500.0 * k + 2250)]
    found = stamps(wire, arrivals, 1.5)
    assert found == {k: 1500.0 * (k + 1) for k in range(6)}


def test_a_flipped_bit_in_the_header_of_a_block_makes_no_wrong_sample() -> None:
    """Four frames of two channels are as long as eight of one: a channel bit may be the flipped."""
    for bit in range(8 * 12, 8 * 32):
        script = []
        for n in range(10):
            values = np.full((4, 2), 5, "<i4")
            values[:, 0] = 1000 + 4 * n + np.arange(4)
            head = struct.pack("<4sIIQIHHI", b"MEAS", 8010074, 77, 0b0101, 0, 4, 8, 4 * n)
            script.append(bytearray(head + values.tobytes()))
        script[5][bit // 8] ^= 1 << bit % 8
        driver = CapaNcdtDevice(
            Script(*map(bytes, script)),
            CapaNcdtSettings(probe=ProbeReading(full_scale=1e-4), trigger="each"),
        )
        driver.open()
        found = []
        for _ in script:
            with suppress(DeviceError):  # it has no such channel
                found += [pair.distance for pair in driver.poll(0.0)]
        found += [pair.distance for pair in driver.close()]
        numbers = np.concatenate([block.first_sample + np.arange(len(block)) for block in found])
        counts = np.concatenate([b.distance for b in found]) / 1e-4 * 0xFFFFFF
        np.testing.assert_allclose(counts, 1000.0 + numbers)
        assert len(numbers) >= 32


@pytest.mark.parametrize("missed", [0, 1])
@pytest.mark.parametrize("seed", [0, 2, 4])
def test_a_start_with_blocks_of_a_hundred_triggers_is_confirmed(seed: int, missed: int) -> None:
    """Three of ten arrivals in a second are often late in a row, but not by a whole period."""
    random, detector, period = np.random.default_rng(seed), MissedTriggerDetector(1e-3), 1e-3
    confirmed = []
    for block in range(1, 100):
        taken = block * 100 * period
        due = taken - missed * period * (taken > 7.0)
        if detector.confirms(due, 1000 + taken * (1 + 2e-5) + random.exponential(3e-4)):
            confirmed.append(taken)
        assert detector.forget_missed() == 0
    assert confirmed
    assert confirmed[0] < 7.0
    assert confirmed[-1] > 9.0 or missed
    assert confirmed[-1] < 7.1 or not missed
