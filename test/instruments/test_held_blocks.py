"""Samples that wait for the next block keep their arrival time, and wait for a limited time."""

from __future__ import annotations

import numpy as np

from omsm_ros.instruments.micro_epsilon.capancdt_device import CapaNcdtDevice, CapaNcdtSettings
from omsm_ros.instruments.micro_epsilon.protocol import MeasurementBlock, encode_block

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
