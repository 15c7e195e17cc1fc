"""A controller with a line of commands beside its data."""

from __future__ import annotations

from typing import Any

from loopback import Loopback


class WithCommands:
    """A controller with both its ports, on one clock."""

    def __init__(self, emulator: Any, device: Any, wanted: Any, **options: Any) -> None:
        self.data = Loopback()
        self.port = Loopback(self.data.clock)
        clock = self.data.clock
        self.emulator = emulator(self.data.line, clock=clock, commands=self.port.line, **options)
        self.data.instrument = self.port.instrument = self.emulator
        self.device = device(self.data, wanted, clock.nanoseconds, clock, commands=self.port)
