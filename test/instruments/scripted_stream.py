"""A stream of which every portion is written down."""

from __future__ import annotations

import itertools

import numpy as np

from omsm_ros.instruments.blocks import BlockPair
from omsm_ros.instruments.six_channel.device import GenericStreamDevice, StreamSettings
from omsm_ros.instruments.six_channel.protocol import FRAME, FrameArray

MS = 1_000_000
NEVER, AT_ONCE = 1e6, 1e-12  # pauses [s]


class Script:
    """A transport that plays portions; what it has not is silence, an exception is raised."""

    name, age = "script", 0.0

    def __init__(self, *portions: bytes | Exception) -> None:
        self.portions = list(portions)
        self.opened = self.closed = 0

    def open(self) -> None:
        self.opened += 1

    def close(self) -> None:
        self.closed += 1

    def spare(self) -> Script:
        return Script()

    def read(self, timeout: float) -> bytes:
        portion = self.portions.pop(0) if self.portions else b""
        if isinstance(portion, Exception):
            raise portion
        return portion

    def write(self, data: bytes) -> None:
        raise AssertionError("this device is never spoken to")


def frames_of(sequence: list[int] | np.ndarray, start_ns: int | None = None) -> FrameArray:
    """Frames 1 ms apart in device time; channel i of sample s holds 10·s + i counts."""
    numbers = np.asarray(sequence, np.int64)
    frames = np.zeros(len(numbers), FRAME)
    frames["sequence"] = numbers % 2**32
    first = numbers[0] * MS if start_ns is None else start_ns
    frames["device_time"] = first + (numbers - numbers[0]) * MS
    frames["distance"] = numbers % 1000
    frames["counts"] = (10 * numbers)[:, np.newaxis] + np.arange(5)
    return frames


def run(
    *portions: bytes | Exception, settings: StreamSettings | None = None
) -> tuple[list[BlockPair], GenericStreamDevice]:
    """All blocks of a script, the flushed rest included."""
    device = GenericStreamDevice(Script(*portions), settings or StreamSettings(pause=NEVER))
    device.open()
    blocks = [pair for _ in portions for pair in device.poll(0.0)]
    blocks += device.close()
    assert_consistent(blocks, device)
    return blocks, device


def assert_consistent(blocks: list[BlockPair], device: GenericStreamDevice) -> None:
    found = device.statistics
    assert found.decoded == device._decoder.statistics.frames
    kept_back = found.pending + found.duplicates + found.withheld
    assert found.decoded == found.delivered + kept_back
    assert found.delivered == sum(len(axes) for axes, _ in blocks)
    assert found.blocks == len(blocks)
    for axes, distance in blocks:
        assert len(axes) == len(distance)
        assert (axes.stamp_ns, axes.first_sample, axes.sample_period) == (
            distance.stamp_ns,
            distance.first_sample,
            distance.sample_period,
        )
    stamps = [axes.stamp_ns for axes, _ in blocks]
    assert all(later > earlier for earlier, later in itertools.pairwise(stamps))


def spans(blocks: list[BlockPair]) -> list[tuple[int, int]]:
    """First sample and length of each block."""
    return [(axes.first_sample, len(axes)) for axes, _ in blocks]
