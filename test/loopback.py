"""A driver and its instrument on one thread and one simulated clock.

Nothing waits: reading moves the clock on until there is something to read. Minutes of
simulated time take milliseconds, and every run is the same.
"""

from __future__ import annotations

import threading
from typing import Protocol

from omsm_ros.errors import DeviceError
from omsm_ros.instruments.emulator import WRITE_INTERVAL_S
from omsm_ros.units import NANOSECONDS_PER_S


class Stepping(Protocol):
    """An instrument: what reading lets work."""

    def step(self, stop: threading.Event | None = None) -> None:
        """Do what is due now."""


class SimulatedClock:
    """Simulated time [s] and [ns]."""

    def __init__(self, start: float = 1000.0) -> None:
        self.now = start

    def __call__(self) -> float:
        """Seconds."""
        return self.now

    def nanoseconds(self) -> int:
        """Return the time [ns]."""
        return round(self.now * NANOSECONDS_PER_S)


class Loopback:
    """The instrument's line and the driver's transport in one.

    portion: bytes handed over at once at most, as an unlucky operating system would
    interval: how often the instrument works [s]
    """

    name = "loopback"

    def __init__(
        self,
        clock: SimulatedClock | None = None,
        portion: int = 1 << 20,
        interval: float = WRITE_INTERVAL_S,
    ) -> None:
        self.clock = clock or SimulatedClock()
        self.portion = portion
        self._interval = interval
        self.instrument: Stepping | None = None
        self._to_driver = self._to_device = b""
        self._plugged, self._open = True, False
        self.sessions = 0

    # The instrument's side.

    @property
    def has_reader(self) -> bool:
        """Whether the driver has it open."""
        return self._open

    def plug(self) -> None:
        """Offer the line."""
        self._plugged = True

    def unplug(self) -> None:
        """Take it away; the driver's connection is lost."""
        self._plugged = self._open = False

    def _device_read(self) -> bytes:
        data, self._to_device = self._to_device, b""
        return data

    def _device_write(self, data: bytes) -> int:
        if not self._open:
            return 0
        self._to_driver += data
        return len(data)

    @property
    def line(self) -> _DeviceEnd:
        """The end of the line that the instrument holds."""
        return _DeviceEnd(self)

    # The driver's side.

    def open(self) -> None:
        """Connect; DeviceError while unplugged."""
        self._work(0.0)
        if not self._plugged:
            raise DeviceError("cannot open 'loopback': unplugged")
        self._open = True
        self.sessions += 1
        self._to_driver = self._to_device = b""

    def read(self, timeout: float) -> bytes:
        """Return what comes within ``timeout`` [s] of simulated time."""
        deadline = self.clock.now + timeout
        while True:
            if not self._open:
                raise DeviceError("connection to 'loopback' was lost; open it again")
            if self._to_driver:
                data = self._to_driver[: self.portion]
                self._to_driver = self._to_driver[len(data) :]
                return data
            if self.clock.now >= deadline:
                return b""
            self._work(self._interval)

    def write(self, data: bytes) -> None:
        """Write to the instrument."""
        if not self._open:
            raise DeviceError("connection to 'loopback' was lost; open it again")
        self._to_device += data

    def close(self) -> None:
        """Disconnect."""
        self._open = False

    def wait(self, seconds: float) -> None:
        """Let simulated time pass without reading."""
        for _ in range(max(1, round(seconds / self._interval))):
            self._work(min(seconds, self._interval))

    def _work(self, seconds: float) -> None:
        self.clock.now += seconds
        if self.instrument is not None:
            self.instrument.step()


class _DeviceEnd:
    """``Line`` of a ``Loopback``."""

    def __init__(self, loop: Loopback) -> None:
        self._loop = loop

    @property
    def has_reader(self) -> bool:
        return self._loop.has_reader

    @property
    def sessions(self) -> int:
        return self._loop.sessions

    def plug(self) -> None:
        self._loop.plug()

    def unplug(self) -> None:
        self._loop.unplug()

    def read(self) -> bytes:
        return self._loop._device_read()

    def write(self, data: bytes, stop: threading.Event | None = None) -> int:
        return self._loop._device_write(data)
