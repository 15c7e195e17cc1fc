"""A controller with a line of commands beside its data."""

from __future__ import annotations

import threading
from typing import Any

from loopback import Loopback

from omsm_ros.instruments.emulator import Instrument, InstrumentLink
from omsm_ros.instruments.micro_epsilon import emulator as micro_epsilon
from omsm_ros.units import MICROSECOND_S

from .faulty import faulty

RATES_KHZ = (0.1, 0.2, 0.3, 1, 2.5, 5, 10, 25, 50, 70)
SAMPLE_STEP_US = 4
SERIAL = 11_020_009


class Controller(Instrument):
    """A controller with a second line for commands."""

    def __init__(self, *arguments: Any, commands: InstrumentLink, **options: Any) -> None:
        self._commands = commands
        super().__init__(*arguments, **options)

    def reset(self) -> None:
        self._period = 1e-3
        self._typed = b""

    def rate(self) -> float:
        return 1 / self._period

    def obey(self, line: str) -> str:
        """Return the answer to a command, prompt included."""
        raise NotImplementedError

    def step(self, stop: threading.Event | None = None) -> None:
        self.work()
        super().step(stop)

    def work(self) -> None:
        """Answer the commands that arrived."""
        typed = self._typed + self._commands.read()
        *lines, self._typed = typed.replace(b"\r", b"\n").split(b"\n")
        for line in lines:
            if line:
                self._commands.write(self.obey(line.decode("latin-1").strip()).encode())


class ConfocalDtEmulator(Controller, micro_epsilon.ConfocalDtEmulator):
    """Rounds or refuses rates, with the echo and prompt of the command port."""

    def obey(self, line: str) -> str:
        words = line.split()
        if words[0] == "GETINFO":
            return f"{line}\r\nName: IFC2451\r\nSerial: {SERIAL}\r\nArticle: 2418004\r\n->"
        if words[0] == "MEASRATE" and len(words) == 2:
            if float(words[1]) not in RATES_KHZ:
                return f"{line}\r\nE06 Parameter out of range\r\n->"
            self._period = 1e-3 / float(words[1])
            return f"{line}\r\n->"
        if words[0] == "MEASRATE":
            return f"{line}\r\nMEASRATE {1e-3 / self._period:g}\r\n->"
        return f"{line}\r\nE01 Unknown command\r\n->"


class CapaNcdtEmulator(Controller, micro_epsilon.CapaNcdtEmulator):
    """Rounds sample times; other commands are unknown."""

    echoed_end = ""  # of a command; some controllers echo it before the answer

    def obey(self, line: str) -> str:
        if line == "$VER":
            return "$VERDT6230;V1.2a;8010074OK\r\n"
        if line.startswith("$STI") and line[4:].isdecimal():
            step = max(1, round(int(line[4:]) / SAMPLE_STEP_US)) * SAMPLE_STEP_US
            self._period = step * MICROSECOND_S
            return f"{line}{self.echoed_end},{step}OK\r\n"
        if line.startswith("$TRG"):
            return f"{line}OK\r\n"
        return f"{line}$UNKNOWN COMMAND\r\n"


class WithCommands:
    """A controller with both its ports, on one clock."""

    def __init__(self, emulator: Any, device: Any, wanted: Any) -> None:
        self.data = Loopback()
        self.port = Loopback(self.data.clock)
        clock = self.data.clock
        self.emulator = faulty(emulator)(self.data.line, clock=clock, commands=self.port.line)
        self.data.instrument = self.port.instrument = self.emulator
        self.device = device(self.data, wanted, clock.nanoseconds, clock, commands=self.port)
