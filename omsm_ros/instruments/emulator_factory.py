"""Emulated devices by name: their ports, and how motions are played on them."""

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace

from omsm_ros.core.streams.blocks import AccelerationBlock, part_of
from omsm_ros.errors import ConfigurationError
from omsm_ros.instruments.emulator import (
    AXIS_SCALING,
    Instrument,
    InstrumentFaults,
    InstrumentLink,
    RecordingSource,
)
from omsm_ros.instruments.emulator_ports import Pty, TcpServer
from omsm_ros.instruments.registry import PROBES, REFERENCES, loaded
from omsm_ros.instruments.scaling import AXES, ProbeReading
from omsm_ros.quantities import TCP_PORT
from omsm_ros.twin.cell import Probe, Recording
from omsm_ros.units import MICROMETRE_M

_TCP = "tcp://127.0.0.1:"
# Most digits of a port, since ``int`` refuses thousands of them.
_PORT_DIGITS = 10
_END_S = 5.0
# The twin's probe measures about its middle, an emulated one from the beginning of its range.
TWIN_READING = ProbeReading(full_scale=100 * MICROMETRE_M, zero=Probe().half_range)
OWN_ENCODERS: dict[str, object] = {"trigger": "each", "probe.zero": TWIN_READING.zero} | {
    f"{name}.counts_per_unit": axis.counts_per_unit
    for name, axis in zip(AXES, AXIS_SCALING, strict=True)
}
"""Parameters with which a driver reads an emulated probe that counts the axes itself."""


@dataclass(frozen=True, slots=True)
class SecondDevice:
    """A second device of the same trigger.

    node: whose parameters ``driver`` are
    make: as of ``Emulated``
    part: returns the recording of a motion as this device measures it
    tcp: it needs a TCP port
    """

    node: str
    make: Callable[..., Instrument]
    driver: dict[str, object]
    part: Callable[[Recording], Recording] = lambda recording: recording
    tcp: bool = False


@dataclass(frozen=True, slots=True)
class Emulated:
    """make: returns the device on a line;  driver: parameters a driver needs to read it;
    tcp: it needs a TCP port, where others also work on a serial one;  second: another device
    baud_rate: its line has no more, so a demonstration is slow, and small [bit/s]; 0 = any
    """

    make: Callable[..., Instrument]
    driver: dict[str, object]
    tcp: bool = False
    second: SecondDevice | None = None
    baud_rate: int = 0


EMULATED = tuple(name for name, model in (PROBES | REFERENCES).items() if model.emulator)
"""Names of the devices that have an emulator."""


def emulated(device: str) -> Emulated:
    """Return the emulated device of that name; ConfigurationError if there is none."""
    if device not in EMULATED:
        raise ConfigurationError(f"device {device!r}, expected one of {sorted(EMULATED)}")
    found: Emulated = loaded((PROBES | REFERENCES)[device].emulator)
    return found


def reference_in(recording: Recording) -> Recording:
    """Return the motion as a reference sensor measures it; ConfigurationError without one."""
    if recording.reference is None:
        raise ConfigurationError("this motion has no reference; add `reference` to disturbances")
    return replace(recording, distance=recording.reference)


def line_for(link: str) -> Pty | TcpServer:
    """Return the emulated port: ``tcp://127.0.0.1:port`` or a pseudo-terminal's path."""
    if not link.startswith("tcp://"):
        return Pty(link)
    port = link.removeprefix(_TCP)
    if not (link.startswith(_TCP) and port.isdecimal() and len(port) <= _PORT_DIGITS):
        raise ConfigurationError(
            f"link {link!r}, expected a path or {_TCP}PORT: an emulator stays on this machine"
        )
    return TcpServer(TCP_PORT.checked(int(port), ConfigurationError, f"port of link {link!r}"))


class Player:
    """Plays motions on emulated devices of one trigger, on each its own part.

    Each instrument runs in a thread: it always answers, and measures while a motion is played.
    """

    def __init__(self, *devices: tuple[Instrument, Callable[[Recording], Recording]]) -> None:
        self._devices, self._stop = devices, threading.Event()
        self._threads = [
            threading.Thread(target=one.serve, args=(self._stop,), daemon=True)
            for one, _ in devices
        ]
        for thread in self._threads:
            thread.start()

    @property
    def playing(self) -> bool:
        """Return whether a motion has samples left."""
        return any(one.playing for one, _ in self._devices)

    @property
    def played(self) -> int:
        """Return the number of samples of the motion so far."""
        return min(one.played for one, _ in self._devices)

    def start(self, recording: Recording, time_lapse: float) -> None:
        """Begin a motion; its trigger counts from zero."""
        parts = [(one, part(recording)) for one, part in self._devices]
        for one, measured in parts:
            one.play(RecordingSource(measured), time_lapse)

    def halt(self) -> None:
        """End the motion."""
        for one, _ in self._devices:
            one.halt()

    def close(self) -> None:
        """End the motion and the devices."""
        self.halt()
        self._stop.set()
        for thread in self._threads:
            thread.join(timeout=_END_S)


def player_for(
    device: str,
    line: InstrumentLink,
    second: InstrumentLink | None = None,
    faults: InstrumentFaults | None = None,
    seed: int = 1,
) -> Player:
    """Return what plays motions on ``line``, and on the line of the ``second`` device, if any."""
    known, faults = emulated(device), faults or InstrumentFaults()
    devices = [(known.make(line, triggered=True, seed=seed), lambda recording: recording)]
    if known.second is not None and second is not None:
        devices.append((known.second.make(second, triggered=True), known.second.part))
    for one, _ in devices:
        one.faults = replace(faults)  # their counts are used up
    return Player(*devices)


class AccelerationFeed:
    """Supplies the acceleration of a recording, if it has some, while its motion is played."""

    def __init__(self, recording: Recording, start_ns: int) -> None:
        """start_ns: begin of the motion [ns]."""
        self._whole, self._start_ns, self._taken = recording.acceleration, start_ns, 0
        self._period = recording.axes.sample_period

    def due(self, played: int) -> AccelerationBlock | None:
        """Return the samples up to the trigger ``played`` that were not returned before."""
        whole = self._whole
        if whole is None:
            return None
        until = min(int(played * self._period / whole.sample_period), len(whole))
        if until <= self._taken:
            return None
        begin, self._taken = self._taken, until
        return part_of(replace(whole, stamp_ns=self._start_ns), begin, until)
