"""Emulated devices by name: what carries them, what plays motions on them."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

from omsm_ros.core.streams.blocks import AccelerationBlock
from omsm_ros.errors import ConfigurationError
from omsm_ros.instruments.chrocodile.emulator import (
    AXIS_SCALING,
    ChrocodileEmulator,
    ChrocodilePacketEmulator,
)
from omsm_ros.instruments.chrocodile.telegram import ProbeReading
from omsm_ros.instruments.emulator import Instrument, InstrumentLink, RecordingSource
from omsm_ros.instruments.emulator_ports import Pty, TcpServer
from omsm_ros.instruments.micro_epsilon.emulator import (
    CapaNcdtEmulator,
    ConfocalDtEmulator,
    ConfocalDtSerialEmulator,
)
from omsm_ros.instruments.six_channel.emulator import (
    CsvStreamEmulator,
    GenericStreamEmulator,
    StreamFaults,
)
from omsm_ros.instruments.six_channel.protocol import AXES, StreamScaling
from omsm_ros.quantities import TCP_PORT
from omsm_ros.twin.cell import Probe, Recording
from omsm_ros.twin.sensors import ReferenceSensor
from omsm_ros.units import MICROMETRE_M, NANOSECONDS_PER_S

_TCP = "tcp://127.0.0.1:"
_PORT_DIGITS = 10  # what int reads at once, whatever it may be
_END_S = 5.0
# The twin's probe measures about its middle, this one from the beginning of its range.
_READING = ProbeReading(full_scale=100 * MICROMETRE_M, zero=Probe().half_range)
_CAPACITIVE = ProbeReading(
    full_scale=2 * ReferenceSensor().half_range_m, zero=ReferenceSensor().half_range_m
)


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


class Player(Protocol):
    """Plays motions on an emulated device, one at a time."""

    @property
    def playing(self) -> bool:
        """Return whether a motion has samples left."""

    @property
    def played(self) -> int:
        """Return samples of the motion so far."""

    def start(self, recording: Recording, time_lapse: float) -> None:
        """Begin a motion; its trigger counts from zero."""

    def halt(self) -> None:
        """End the motion."""

    def close(self) -> None:
        """End the motion and the device."""


class StreamPlayer:
    """Our own stream: a new sender for each motion."""

    def __init__(self, line: InstrumentLink, faults: StreamFaults) -> None:
        self._line, self._faults = line, faults
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self.played = 0

    @property
    def playing(self) -> bool:
        return self._thread is not None and self._thread.is_alive()

    def start(self, recording: Recording, time_lapse: float) -> None:
        emulator = GenericStreamEmulator(self._line, faults=self._faults)
        self._stop.clear()
        self.played = 0
        arguments = (recording, time_lapse, self._stop, self._on_progress)
        self._thread = threading.Thread(target=emulator.play, args=arguments, daemon=True)
        self._thread.start()

    def _on_progress(self, samples: int) -> None:
        self.played = samples

    def halt(self) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=_END_S)

    def close(self) -> None:
        self.halt()


class InstrumentPlayer:
    """An instrument that answers all the time, and measures while a motion triggers it."""

    def __init__(self, instrument: Instrument) -> None:
        self._instrument = instrument
        self._stop = threading.Event()
        self._thread = threading.Thread(target=instrument.serve, args=(self._stop,), daemon=True)
        self._thread.start()

    @property
    def playing(self) -> bool:
        return self._instrument.playing

    @property
    def played(self) -> int:
        return self._instrument.played

    def start(self, recording: Recording, time_lapse: float) -> None:
        self._instrument.play(RecordingSource(recording), time_lapse)

    def halt(self) -> None:
        self._instrument.halt()

    def close(self) -> None:
        self.halt()
        self._stop.set()
        self._thread.join(timeout=_END_S)


class PlayerGroup:
    """Plays a motion on several devices of one trigger, on each what it measures of it."""

    def __init__(self, *players: tuple[Player, Callable[[Recording], Recording]]) -> None:
        self._players = players

    @property
    def playing(self) -> bool:
        return any(player.playing for player, _ in self._players)

    @property
    def played(self) -> int:
        return min(player.played for player, _ in self._players)

    def start(self, recording: Recording, time_lapse: float) -> None:
        parts = [(player, part(recording)) for player, part in self._players]
        for player, measured in parts:
            player.start(measured, time_lapse)

    def halt(self) -> None:
        for player, _ in self._players:
            player.halt()

    def close(self) -> None:
        for player, _ in self._players:
            player.close()


@dataclass(frozen=True, slots=True)
class CompanionDevice:
    """A second device of the same trigger.

    node: whose parameters ``driver`` are;  part: what it measures of a motion
    player, tcp: as of the first one
    """

    node: str
    player: Callable[[InstrumentLink, StreamFaults], Player]
    driver: dict[str, object]
    part: Callable[[Recording], Recording] = lambda recording: recording
    tcp: bool = False


@dataclass(frozen=True, slots=True)
class Emulated:
    """player: makes it on a line;  driver: parameters a driver needs to read it;
    tcp: it needs a TCP port, where others also work on a serial one;  companion: what else there is
    baud_rate: its line has no more, so a demonstration is slow, and small [bit/s]; 0 = any
    """

    player: Callable[[InstrumentLink, StreamFaults], Player]
    driver: dict[str, object]
    tcp: bool = False
    companion: CompanionDevice | None = None
    baud_rate: int = 0


def _chrocodile(line: InstrumentLink, faults: StreamFaults) -> Player:
    emulator = ChrocodileEmulator(line, triggered=True, seed=faults.seed, probe=_READING)
    return InstrumentPlayer(emulator)


def _chrocodile_packet(line: InstrumentLink, faults: StreamFaults) -> Player:
    emulator = ChrocodilePacketEmulator(line, triggered=True, seed=faults.seed, probe=_READING)
    return InstrumentPlayer(emulator)


def _confocaldt_ethernet(line: InstrumentLink, faults: StreamFaults) -> Player:
    emulator = ConfocalDtEmulator(
        line, triggered=True, seed=faults.seed, probe=_READING, axes=AXIS_SCALING
    )
    return InstrumentPlayer(emulator)


def _confocaldt(line: InstrumentLink, faults: StreamFaults) -> Player:
    emulator = ConfocalDtSerialEmulator(
        line, triggered=True, seed=faults.seed, probe=_READING, width=3
    )
    return InstrumentPlayer(emulator)


def _capancdt(line: InstrumentLink, faults: StreamFaults) -> Player:
    emulator = CapaNcdtEmulator(line, triggered=True, seed=faults.seed, probe=_CAPACITIVE)
    return InstrumentPlayer(emulator)


def _reference(recording: Recording) -> Recording:
    """The motion as a reference sensor measures it."""
    if recording.reference is None:
        raise ConfigurationError("this motion has no reference; add `reference` to disturbances")
    return replace(recording, distance=recording.reference)


def _csv(line: InstrumentLink, faults: StreamFaults) -> Player:
    return InstrumentPlayer(CsvStreamEmulator(line, triggered=True, seed=faults.seed))


_STREAM_SCALES: dict[str, object] = {
    f"{name}.counts_per_unit": axis.counts_per_unit
    for name, axis in zip(AXES, StreamScaling().axes, strict=True)
}
_OWN_ENCODERS: dict[str, object] = {
    "encoders": "XYZUV",
    "trigger": "each",
    "probe.zero": _READING.zero,
} | {
    f"{name}.counts_per_unit": axis.counts_per_unit
    for name, axis in zip(AXES, AXIS_SCALING, strict=True)
}

# RS-422 carries the distance alone, so the axes come from a device of their own.
_AXES_COMPANION = CompanionDevice(
    "axis_driver", StreamPlayer, {"device": "six_channel"} | _STREAM_SCALES
)
_REFERENCE_COMPANION = CompanionDevice(
    "reference_driver",
    _capancdt,
    {"device": "capancdt", "triggered": True, "probe.zero": _CAPACITIVE.zero},
    _reference,
    tcp=True,
)

EMULATED = {
    "six_channel": Emulated(StreamPlayer, _STREAM_SCALES),
    "six_channel_text": Emulated(_csv, _STREAM_SCALES),
    "chrocodile": Emulated(_chrocodile, _OWN_ENCODERS),
    "chrocodile_packet": Emulated(_chrocodile_packet, _OWN_ENCODERS, tcp=True),
    "confocaldt": Emulated(
        _confocaldt,
        {
            "signals": "distance intensity counter",
            "trigger": "each",
            "probe.zero": _READING.zero,
        },
        companion=_AXES_COMPANION,
        baud_rate=691_200,
    ),
    # The capacitive reference beside the six-channel stream.
    "capancdt": Emulated(
        StreamPlayer, {"device": "six_channel"} | _STREAM_SCALES, companion=_REFERENCE_COMPANION
    ),
    # Y and B stand still in the twin's motions: three encoders are enough.
    "confocaldt_ethernet": Emulated(
        _confocaldt_ethernet, _OWN_ENCODERS | {"encoders": "XZC"}, tcp=True
    ),
}


def emulated(device: str) -> Emulated:
    """Return the emulated device of that name; ConfigurationError if there is none."""
    if device not in EMULATED:
        raise ConfigurationError(f"device {device!r}, expected one of {sorted(EMULATED)}")
    return EMULATED[device]


def player_for(
    device: str, line: InstrumentLink, companion: InstrumentLink | None, faults: StreamFaults
) -> Player:
    """Return what plays motions on ``line``, and on the line ``companion`` it if there is one."""
    known = emulated(device)
    first = known.player(line, faults)
    if known.companion is None or companion is None:
        return first
    second = known.companion.player(companion, faults)
    return PlayerGroup((first, lambda recording: recording), (second, known.companion.part))


# The accelerometer of the emulated cell: blocks in step with the motion that is played.


class AccelerationFeed:
    """Hands out a recording's acceleration as the motion goes on; one without has none."""

    def __init__(self, recording: Recording, start_ns: int) -> None:
        """start_ns: when the motion begins [ns]."""
        self._whole, self._start_ns, self._nonempty_channels = recording.acceleration, start_ns, 0
        self._period = recording.axes.sample_period

    def due(self, played: int) -> AccelerationBlock | None:
        """Return what has been felt until the trigger ``played``, and not been handed out yet."""
        whole = self._whole
        if whole is None:
            return None
        until = min(int(played * self._period / whole.sample_period), len(whole))
        if until <= self._nonempty_channels:
            return None
        part = slice(self._nonempty_channels, until)
        stamp = self._start_ns + round(
            self._nonempty_channels * whole.sample_period * NANOSECONDS_PER_S
        )
        first, self._nonempty_channels = whole.first_sample + self._nonempty_channels, until
        return AccelerationBlock(
            stamp_ns=stamp,
            first_sample=first,
            sample_period=whole.sample_period,
            x=whole.x[part],
            y=whole.y[part],
            z=whole.z[part],
        )
