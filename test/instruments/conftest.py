"""A driver and an emulated instrument on simulated time, and the rules every run must keep."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from loopback import Loopback

from omsm_ros.core.kinematics.trajectories import Spiral
from omsm_ros.core.streams.blocks import Status
from omsm_ros.core.surface.nominal import OffAxisParaboloid
from omsm_ros.errors import DeviceError
from omsm_ros.instruments.blocks import BlockPair
from omsm_ros.instruments.reader import BACK_OFF_S
from omsm_ros.instruments.stream import StreamDevice
from omsm_ros.twin.cell import Cell, Recording, record

from .faulty import Faulty, faulty

NANOMETRE = 1e-9


class Bench:
    """Reads a driver as ``DeviceReader`` does, but on simulated time.

    resolution: of its distances [m];  modulus: of its counter
    """

    resolution = 2e-11
    modulus = 2**62

    def __init__(self, loop: Loopback, instrument: Faulty, device: StreamDevice) -> None:
        self.loop, self.instrument, self.device = loop, instrument, device
        loop.instrument = instrument
        self.blocks: list[BlockPair] = []
        self.troubles: list[str] = []
        self.connections = 0
        self._connected = False
        self._pause, self._began = BACK_OFF_S[0], 0.0
        self._after = -1  # true number of the last sample checked

    def run(self, seconds: float) -> None:
        end = self.loop.clock.now + seconds
        while self.loop.clock.now < end:
            try:
                self._began = self._began if self._connected else self.loop.clock.now
                if not self._connected:
                    self.device.open()
                    self.connections += 1
                    self._connected = True
                came = self.device.poll(0.05)
                self.blocks += came
                if came:
                    self._pause = BACK_OFF_S[0]
            except DeviceError as err:
                self.troubles.append(str(err))
                self.blocks += self.device.close()
                self._connected = False
                rest = self._began + self._pause - self.loop.clock.now
                self.loop.wait(max(rest, BACK_OFF_S[0]))
                self._pause = min(2 * self._pause, BACK_OFF_S[1])

    def end(self) -> None:
        self.blocks += self.device.close()
        self._connected = False

    def is_back_within_five_seconds_of(
        self, strike: Callable[[Faulty], None], lasts: float
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

    def is_back_within(self, seconds: float) -> None:
        """Hold that within ``seconds`` there is one in which all samples came."""
        end = self.loop.clock.now + seconds
        came = 0
        while came < 900:
            assert self.loop.clock.now < end, self.troubles
            before = self.delivered
            self.run(1.0)
            came = self.delivered - before

    @property
    def delivered(self) -> int:
        return self.device.statistics.delivered

    def numbers(self, block: BlockPair, truth: dict[int, int]) -> np.ndarray:
        """True numbers of a block's samples: they stand at x = k nm.

        Without axes, the first ones after those before that had its counter and distance.
        """
        if block.axes is not None:
            return np.rint(block.axes.x / NANOMETRE).astype(np.int64)
        count, counter = len(block.distance), block.distance.first_sample % self.modulus
        reported = block.distance.distance
        for k, sent in truth.items():
            if k <= self._after or sent % self.modulus != counter:
                continue
            last = truth.get(k + count - 1, -1)  # a restart may lie between
            if (last - sent - count + 1) % self.modulus:
                continue
            off = reported - (10 + (k + np.arange(count)) % 80) * 1e-6
            if np.nanmax(abs(off), initial=0.0) <= self.resolution:
                self._after = k + count - 1
                return np.arange(k, k + count)
        raise AssertionError(
            f"invented: {counter} with {reported[:3]} m after number {self._after}"
        )

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
        numbers = [self.numbers(block, truth) for block in self.blocks]
        seen = np.concatenate([*numbers, np.empty(0, np.int64)])
        assert np.all(np.diff(seen) > 0), "a sample came twice, or out of order"
        lost = falls = 0
        after: int | None = None
        for block, k in zip(self.blocks, numbers, strict=True):
            first = block.distance.first_sample
            assert np.all(np.diff(k) == 1)
            for place in (0, -1):
                counter = first + (len(k) - 1) * (place == -1)
                sent = truth[int(k[place])] - counter
                assert sent % min(self.modulus, self.instrument.counter_range) == 0
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
        if axes is not None:
            np.testing.assert_allclose(axes.y, -k * 1e-9, rtol=0, atol=1e-15)
            np.testing.assert_allclose(axes.z, k % 1000 * 1e-6, rtol=0, atol=1e-15)
        good = np.isfinite(distance.distance)
        expected = (10 + k % 80) * 1e-6
        np.testing.assert_allclose(
            distance.distance[good], expected[good], rtol=0, atol=self.resolution
        )


@pytest.fixture
def bench() -> Callable[..., Any]:
    """Makes a bench of an emulator's and a device's class, and the device's settings."""

    def make(emulator: Any, device: Any, settings: Any, **options: Any) -> Bench:
        loop = Loopback(
            interval=options.pop("interval", 0.01), portion=options.pop("portion", 1 << 20)
        )
        instrument = faulty(emulator)(loop.line, clock=loop.clock, **options)
        driver = device(loop, settings, loop.clock.nanoseconds, loop.clock)
        return Bench(loop, instrument, driver)

    return make


@pytest.fixture(scope="module")
def recording() -> Recording:
    """A spiral over the paper's mirror, with a stretch where the probe sees nothing."""
    mirror = OffAxisParaboloid(parent_focal_length=25.4e-3, off_axis_distance=50.8e-3)
    spiral = Spiral(surface=mirror, start_radius=2e-3, feed_per_turn=1e-3, spindle_speed=30.0)
    whole = record(Cell(), spiral, mirror, substeps=2)
    status = whole.distance.status.copy()
    status[700:730] = Status.NO_TARGET
    distance = whole.distance.distance.copy()
    distance[700:715] = np.nan
    return replace(whole, distance=replace(whole.distance, status=status, distance=distance))
