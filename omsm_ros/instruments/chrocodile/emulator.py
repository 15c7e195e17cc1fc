"""Emulated CHRocodiles, in the dollar protocol and in the packet protocol.

In the dollar protocol it answers commands with echo, answer and ``ready``. It sends telegrams in
both formats, describes the selected signals, rounds rates, wraps its counters, and sends invalid
samples as distance and intensity zero. Encoders have 32 bits; a power cycle resets the settings.
It has the faults of ``Instrument``. In the packet protocol also: updates and ``CONF`` to
a new client, tickets, refusals, data formats with their counter, another order of signals than
selected, packets of many samples, and the time offset of triggered samples.

Not imitated: optics, exposure and averaging (only the setting is kept), the dark reference, upload
of tables, spectra, changes of the baud rate, samples during an answer, several streams, channels
and clients.
"""

import re
from functools import partial
from typing import NamedTuple

import numpy as np

from omsm_ros.core.streams.blocks import Status
from omsm_ros.instruments.chrocodile.packet_protocol import (
    CONFIGURED,
    ERROR,
    FORMATS,
    TIME_OFFSET,
    UPDATE,
    DataFormat,
    PacketCommand,
    PacketDecoder,
    Value,
    encode_command,
    encode_data,
    encode_format,
)
from omsm_ros.instruments.chrocodile.packet_protocol import QUERY as PACKET_QUERY
from omsm_ros.instruments.chrocodile.protocol import QUERY, READY
from omsm_ros.instruments.chrocodile.telegram import (
    DISTANCE,
    DISTANCE_16,
    DISTANCE_NM,
    ENCODERS_AT_END,
    ENCODERS_AT_START,
    FLAGS,
    INTENSITY,
    INTENSITY_16,
    S32,
    SAMPLE_COUNTER,
    SATURATED,
    SIGNALS,
    START_TIME,
    SYNC,
    Layout,
    unit_of,
)
from omsm_ros.instruments.emulator import Instrument, Measured
from omsm_ros.instruments.emulator_factory import OWN_ENCODERS, TWIN_READING, Emulated
from omsm_ros.instruments.scaling import AXES
from omsm_ros.units import MICROMETRE_M

# The exposure is a multiple of this, so rates are rounded [s].
_EXPOSURE_STEP_S = 1e-7
_VERSION = "CHRocodile 2 emulated"


MAX_COMMAND_BYTES = 1024
_COMMAND = re.compile(rb"\$([A-Z]{3,})([^A-Z].*)?", re.DOTALL)


class Request(NamedTuple):
    """A command as the device received it."""

    wire: bytes
    name: str
    arguments: tuple[str, ...]


class RequestParser:
    """Decodes the bytes that a device receives, in any portions, to commands."""

    def __init__(self) -> None:
        self._buffer = b""

    def feed(self, data: bytes) -> list[Request]:
        """Return the commands completed by ``data``."""
        *lines, rest = (self._buffer + data).split(b"\r")
        found = []
        for line in lines:
            wire = line[line.rfind(b"$") :][:MAX_COMMAND_BYTES]
            if match := _COMMAND.fullmatch(wire):
                words = (match[2] or b"").decode("latin-1").split()
                found.append(Request(wire + b"\r", match[1].decode(), tuple(words)))
        start = rest.rfind(b"$")
        self._buffer = rest[start:][:MAX_COMMAND_BYTES] if start >= 0 else b""
        return found


def answer_wire(wire: bytes, text: str) -> bytes:
    """Return the bytes with which a device answers ``wire``: echo, answer, ``ready``."""
    separator = b"\r\n" if text else b""
    return wire + text.encode() + separator + READY


class ChrocodileEmulator(Instrument):
    """The device's side of the dollar protocol."""

    counter_range = 2**16

    _sync = SYNC

    def reset(self) -> None:
        """Go back to the factory's settings: ASCII, distance and intensity, 1 kHz, free running."""
        self._requests = RequestParser()
        self._values = {"SHZ": "1000", "LAI": "100", "AVD": "1", "THR": "10", "SEN": "0"}
        self._values["SODX"] = f"{DISTANCE} {INTENSITY}"
        self._layout = Layout.of((DISTANCE, INTENSITY), self._sync)
        self._binary = False
        self._started_stream = True

    def rate(self) -> float:
        """Return samples per second as set."""
        if self._triggered:
            return super().rate()
        return float(self._values["SHZ"]) / max(1.0, float(self._values["AVD"]))

    def streaming(self) -> bool:
        """Return whether samples are to be sent."""
        return self._started_stream

    def receive(self, data: bytes) -> None:
        """Take commands, in portions of any size."""
        for request in self._requests.feed(data):
            self.say(answer_wire(request.wire, self._answer(request)))

    def _answer(self, request: Request) -> str:
        name, arguments = request.name, request.arguments
        if name in ("STA", "STO"):
            self._started_stream = name == "STA"
            return ""
        if name == "SSQ":
            self._sync = request.wire[4:6]
            self._layout = Layout.of(self._layout.signals, self._sync)
            return ""
        if name in ("BIN", "ASC"):
            self._binary = name == "BIN"
            return ""
        if name in ("TRE", "TRG"):
            self._counter = 0
            return ""
        if name in ("CTN", "TRW", "STR", "DRK", "NOP"):
            return ""
        fixed = {
            "VER": _VERSION,
            "DTF": self._layout.describe(),
            "SCA": f"{self._probe.full_scale / MICROMETRE_M:.0f}",
        }
        if name in fixed:
            return fixed[name]
        if arguments == (QUERY,):
            return self._values.get(name, "not valid")
        return self._set(name, arguments)

    def _set(self, name: str, arguments: tuple[str, ...]) -> str:
        if name not in self._values or not arguments:
            return "not valid"
        if name == "SODX":
            try:
                numbers = tuple(int(word) for word in arguments)
                self._layout = Layout.of(numbers, self._sync)
            except ValueError:
                return "not valid"
        if name == "SHZ":
            period = max(1, round(1 / float(arguments[0]) / _EXPOSURE_STEP_S)) * _EXPOSURE_STEP_S
            arguments = (f"{1 / period:.8g}",)
        self._values[name] = " ".join(arguments)
        return ""

    def pack(self, measured: Measured, counters: np.ndarray, times_ns: np.ndarray) -> list[bytes]:
        """Return the wire bytes of each sample."""
        records = self._layout.records(len(measured))
        for number in self._layout.signals:
            column = self._signal(number, measured, counters, times_ns)
            records[str(number)] = column
        if not self._binary:
            return self._layout.lines(records)
        wire, size = records.tobytes(), records.dtype.itemsize
        return [wire[i : i + size] for i in range(0, len(wire), size)]

    def _signal(
        self, number: int, measured: Measured, counters: np.ndarray, times_ns: np.ndarray
    ) -> np.ndarray:
        nothing = measured.status == Status.NO_TARGET
        if number in (DISTANCE, DISTANCE_NM, DISTANCE_16):
            raw = self._probe.raw(measured.distance) / unit_of(number, self._probe.full_scale)
            sent = np.where(nothing | np.isnan(raw), 0.0, raw)
            return sent if number == DISTANCE else np.clip(np.rint(sent), -(2**31), 2**31 - 1)
        if number in (INTENSITY, INTENSITY_16):
            light = measured.intensity * self._probe.intensity_full_scale
            return np.where(nothing, 0.0, np.rint(light) if number == INTENSITY_16 else light)
        if number in ENCODERS_AT_START or number in ENCODERS_AT_END:
            index = (number - ENCODERS_AT_START[0]) % len(AXES)
            counts = self._axes[index].counts(measured.axes[AXES[index]])
            return (counts + 2**31) % 2**32 - 2**31
        if number == START_TIME:
            return times_ns % 2**32
        if number == FLAGS:
            return np.where(measured.status == Status.SATURATED, SATURATED, 0)
        return counters if number == SAMPLE_COUNTER else np.zeros(len(measured))


# Samples in a packet.
_SAMPLES = 64
_REFUSED = "not valid"


class ChrocodilePacketEmulator(ChrocodileEmulator):
    """The device's side of the packet protocol; it sends from the moment it is switched on."""

    def reset(self) -> None:
        """Go back to the settings after switching on."""
        super().reset()
        self._packets = PacketDecoder()
        self._format_counter = 0
        self._describe()

    def greet(self) -> None:
        """Send all settings to a new client, ``CONF`` last."""
        self._packets.reset()
        for name in ("SHZ", "LAI", "AVD", "SODX"):
            values = tuple(map(_number, self._values[name].split()))
            self.say(encode_command(PacketCommand(name, values, UPDATE)))
        self.say(encode_format(self._format))
        self.say(encode_command(PacketCommand(CONFIGURED, (), UPDATE)))

    def receive(self, data: bytes) -> None:
        """Take commands, in portions of any size."""
        for message in self._packets.feed(data):
            if isinstance(message, PacketCommand):
                self._obey(message)

    def _obey(self, asked: PacketCommand) -> None:
        said = (f"{v:.9g}" if isinstance(v, int | float) else str(v) for v in asked.values)
        words = (QUERY,) if asked.flags & PACKET_QUERY else tuple(said)
        text = self._answer(Request(b"", asked.name, words))
        flags = ERROR if text == _REFUSED else 0
        if asked.name == "VER" or flags:
            values: tuple[Value, ...] = (text,)
        else:
            values = tuple(map(_number, text.split())) if text else asked.values
        self.say(encode_command(PacketCommand(asked.name, values, flags, asked.ticket)))
        if asked.name in ("SODX", "SHZ") and not asked.flags & PACKET_QUERY:
            self._describe()
            self.say(encode_format(self._format))

    def _describe(self) -> None:
        self._format_counter += 1
        numbers = sorted(self._layout.signals)
        signals = tuple((n, SIGNALS[n].type, 1) for n in numbers)
        if self._triggered:
            signals = ((TIME_OFFSET, S32, 1), *signals)
        self._format = DataFormat(self._format_counter, self.rate(), signals)

    def pack(self, measured: Measured, counters: np.ndarray, times_ns: np.ndarray) -> list[bytes]:
        """Return the packets, each in the place of its first sample."""
        records = np.zeros(len(measured), self._format.dtype)
        pieces = [b""] * len(measured)
        for number, kind, _ in self._format.signals:
            if number != TIME_OFFSET:
                column = self._signal(number, measured, counters, times_ns)
                records[str(number)] = np.asarray(column).astype(FORMATS[kind])
        for start in range(0, len(records), _SAMPLES):
            part = slice(start, start + _SAMPLES)
            if self._triggered:
                late = (times_ns[part] - times_ns[start]) * 2**32 // 10**9
                records[str(TIME_OFFSET)][part] = late
            wire = encode_data(self._format, records[part], int(times_ns[start]))
            pieces[start] = wire
        return pieces


def _number(word: str) -> Value:
    try:
        return int(word)
    except ValueError:
        return float(word)


_DRIVER = {"encoders": "XYZUV"} | OWN_ENCODERS
DOLLAR = Emulated(partial(ChrocodileEmulator, probe=TWIN_READING), _DRIVER)
PACKET = Emulated(partial(ChrocodilePacketEmulator, probe=TWIN_READING), _DRIVER, tcp=True)
