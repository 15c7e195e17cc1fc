"""A driver and an emulated instrument on simulated time, and the rules every run must keep."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from omsm_ros.devices.blocks import BlockPair
from omsm_ros.devices.stream import StreamDevice
from omsm_ros.emulators.instrument import Instrument
from omsm_ros.emulators.loopback import Loopback
from omsm_ros.errors import DeviceError

NANOMETRE = 1e-9


class Bench:
    """Reads a driver as ``DeviceReader`` does, but on simulated time."""

    def __init__(self, loop: Loopback, instrument: Instrument, device: StreamDevice) -> None:
        self.loop, self.instrument, self.device = loop, instrument, device
        loop.instrument = instrument
        instrument.keep_truth = True
        self.blocks: list[BlockPair] = []
        self.troubles: list[str] = []
        self.connections = 0
        self._connected = False

    def run(self, seconds: float) -> None:
        end = self.loop.clock.now + seconds
        while self.loop.clock.now < end:
            try:
                if not self._connected:
                    self.device.open()
                    self.connections += 1
                    self._connected = True
                self.blocks += self.device.poll(0.05)
            except DeviceError as err:
                self.troubles.append(str(err))
                self.blocks += self.device.close()
                self._connected = False
                self.loop.wait(0.25)

    def end(self) -> None:
        self.blocks += self.device.close()
        self._connected = False

    def is_back_within_five_seconds_of(
        self, strike: Callable[[Instrument], None], lasts: float
    ) -> None:
        """Let a fault ``strike`` that ``lasts`` [s], and hold that all samples come after it."""
        self.run(1.0)
        strike(self.instrument)
        self.run(lasts + 5.0)
        before = self.delivered
        self.run(1.0)
        assert self.delivered >= before + 900
        self.end()
        self.check()

    @property
    def delivered(self) -> int:
        return self.device.statistics.delivered

    def numbers(self, block: BlockPair) -> np.ndarray:
        """True numbers of a block's samples: they stand at x = k nm."""
        assert block.axes is not None
        return np.rint(block.axes.x / NANOMETRE).astype(np.int64)

    def check(self) -> None:
        """Every sample once, with its true counter and values, or counted under a reason."""
        found = self.device.statistics
        assert found.decoded == (
            found.delivered
            + found.pending
            + found.held
            + found.spoilt
            + found.duplicates
            + found.withheld
        )
        assert found.delivered == sum(len(b.distance) for b in self.blocks)
        truth = dict(self.instrument.truth)
        seen = np.concatenate([self.numbers(b) for b in self.blocks] or [np.empty(0, np.int64)])
        assert np.all(np.diff(seen) > 0), "a sample came twice, or out of order"
        lost = falls = 0
        after: int | None = None
        for block in self.blocks:
            k = self.numbers(block)
            first = block.distance.first_sample
            assert np.all(np.diff(k) == 1)
            for place in (0, -1):
                counter = first + (len(k) - 1) * (place == -1)
                assert truth[int(k[place])] == counter % self.instrument.counter_range
            self.check_values(block, k)
            if after is not None:
                lost += max(0, first - after)
                falls += first < after
            after = first + len(k)
        assert found.restarts >= falls
        if not found.restarts and not found.withheld:
            assert found.lost == lost
        stamps = [b.distance.stamp_ns for b in self.blocks]
        assert all(b > a for a, b in itertools.pairwise(stamps))

    def check_values(self, block: BlockPair, k: np.ndarray) -> None:
        axes, distance = block.axes, block.distance
        np.testing.assert_allclose(axes.y, -k * 1e-9, rtol=0, atol=1e-15)
        np.testing.assert_allclose(axes.z, k % 1000 * 1e-6, rtol=0, atol=1e-15)
        good = np.isfinite(distance.distance)
        expected = (10 + k % 80) * 1e-6
        np.testing.assert_allclose(distance.distance[good], expected[good], rtol=0, atol=2e-11)


@pytest.fixture
def bench() -> Callable[..., Any]:
    """Makes a bench of an emulator's and a device's class, and the device's settings."""

    def make(emulator: Any, device: Any, settings: Any, **options: Any) -> Bench:
        loop = Loopback(
            interval=options.pop("interval", 0.01), portion=options.pop("portion", 1 << 20)
        )
        instrument = emulator(loop.line, clock=loop.clock, **options)
        driver = device(loop, settings, loop.clock.nanoseconds, loop.clock)
        return Bench(loop, instrument, driver)

    return make
