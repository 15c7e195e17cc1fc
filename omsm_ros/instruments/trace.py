"""A trace of the wire: written while a device is read, and replayed as a test.

One event a line: seconds since the trace began, a sign (``<`` from the device, ``>`` to it,
``!`` open or close), and the bytes in hexadecimal.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

from omsm_ros.errors import ConfigurationError, DeviceError
from omsm_ros.instruments.transport import Transport
from omsm_ros.units import NANOSECONDS_PER_S

READ, WRITTEN, OPENED, CLOSED = "<", ">", "open", "close"


class TracedTransport:
    """Another transport, all of whose traffic is written down; begun anew by each process."""

    def __init__(
        self,
        transport: Transport,
        path: Path,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self._transport = transport
        self._path = path
        self._monotonic = monotonic
        self._file: TextIO | None = None
        self._begun, self._began = False, 0.0

    @property
    def name(self) -> str:
        """Return the name of the transport that is traced."""
        return self._transport.name

    @property
    def baud_rate(self) -> int | None:
        """Return the baud rate of the transport that is traced; None if it has none."""
        return getattr(self._transport, "baud_rate", None)

    def open(self) -> None:
        """Connect; raises DeviceError, or ConfigurationError if the trace cannot be written."""
        self.close()
        with self._telling():
            self._file = self._path.open("a" if self._begun else "w", encoding="ascii")
        self._began = self._began if self._begun else self._monotonic()
        self._begun = True
        self._transport.open()
        self._note("!", OPENED)

    def read(self, timeout: float) -> bytes:
        """Return what has arrived within ``timeout`` [s]; raises DeviceError."""
        data = self._transport.read(timeout)
        if data:
            self._note(READ, data.hex())
        return data

    def write(self, data: bytes) -> None:
        """Send all of ``data``; raises DeviceError."""
        self._transport.write(data)
        self._note(WRITTEN, data.hex())

    def close(self) -> None:
        """Disconnect."""
        self._transport.close()
        if self._file is not None:
            file, self._file = self._file, None
            with self._telling():
                try:
                    file.write(self._line("!", CLOSED))
                finally:
                    file.close()

    def _note(self, sign: str, text: str) -> None:
        if self._file is not None:
            with self._telling():
                self._file.write(self._line(sign, text))

    def _line(self, sign: str, text: str) -> str:
        return f"{self._monotonic() - self._began:.6f} {sign} {text}\n"

    @contextmanager
    def _telling(self) -> Iterator[None]:
        """Raise ConfigurationError, with the remedy, where the trace cannot be written."""
        try:
            yield
        except (OSError, ValueError) as err:  # a full disk, no such folder; NUL in the path
            raise ConfigurationError(
                f"cannot write the trace {str(self._path)!r}: {err}; choose another place, or none"
            ) from err


@dataclass(frozen=True, slots=True)
class Event:
    """One line of a trace.  time: [s];  data: empty for open and close."""

    time: float
    sign: str
    data: bytes


def read_trace(path: Path) -> list[Event]:
    """Return the events of a trace; ConfigurationError if it is none."""
    events = []
    for number, line in enumerate(path.read_text(encoding="ascii").splitlines(), start=1):
        try:
            at, sign, text = line.split(" ")
            data = b"" if sign == "!" else bytes.fromhex(text)
            events.append(Event(float(at), sign if sign != "!" else text, data))
        except ValueError as err:
            raise ConfigurationError(f"{str(path)!r}, line {number}: {line!r} is no event") from err
    return events


class ReplayTransport:
    """Plays a trace back to a driver: the same bytes, in the same portions, at the same times.

    ``now`` is the trace's time, for the driver's clocks. A driver that sends something else
    than was sent then, or reads beyond the end, gets a DeviceError.
    """

    name = "trace"

    def __init__(self, events: list[Event]) -> None:
        self._events = list(events)
        self._time = 0.0

    def now(self) -> float:
        """Return the seconds since the trace began."""
        return self._time

    def now_ns(self) -> int:
        """Return the nanoseconds since the trace began."""
        return round(self._time * NANOSECONDS_PER_S)

    @property
    def finished(self) -> bool:
        """Return whether nothing is left of the trace but its end."""
        return all(event.sign == CLOSED for event in self._events)

    def open(self) -> None:
        """Go on to the next connection in the trace; DeviceError if there is none."""
        while self._events and self._events[0].sign != OPENED:
            self._events.pop(0)
        if not self._events:
            raise DeviceError("the trace has no further connection")
        self._time = self._events.pop(0).time

    def read(self, timeout: float) -> bytes:
        """Return the next portion, if it came within ``timeout`` [s] of the trace's time."""
        if not self._events:
            raise DeviceError("the trace ends here")
        event = self._events[0]
        if event.sign == CLOSED:
            raise DeviceError("the connection was closed here")
        if event.sign != READ or event.time > self._time + timeout:
            self._time += timeout
            return b""
        self._time = max(self._time, event.time)
        self._events.pop(0)
        return event.data

    def write(self, data: bytes) -> None:
        """Check ``data`` against what was sent then; DeviceError if it is something else."""
        if not self._events or self._events[0].sign != WRITTEN or self._events[0].data != data:
            expected = self._events[0] if self._events else None
            raise DeviceError(f"the driver sends {data!r}, the trace goes on with {expected!r}")
        self._time = max(self._time, self._events.pop(0).time)

    def close(self) -> None:
        """Disconnect."""
