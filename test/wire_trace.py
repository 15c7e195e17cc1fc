"""A trace of the wire read and played back to a driver."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from omsm_ros.errors import ConfigurationError, DeviceError
from omsm_ros.instruments.factory import CLOSED, OPENED, READ, WRITTEN
from omsm_ros.units import NANOSECONDS_PER_S


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
