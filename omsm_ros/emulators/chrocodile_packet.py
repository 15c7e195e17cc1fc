"""A CHRocodile 2 in the packet protocol, fed by the twin.

Imitated beside what ``ChrocodileEmulator`` does: updates and ``CONF`` upon connecting, tickets,
refusals, data formats with their counter, signals in another order than they were selected,
packets of many samples with the device's time, and the time offset of triggered samples.

Not imitated: several streams, channels and clients, spectra, transfer of tables.
"""

from __future__ import annotations

import numpy as np

from omsm_ros.emulators.chrocodile import ChrocodileEmulator
from omsm_ros.emulators.sources import Measured
from omsm_ros.protocols.chrocodile import QUERY as ASK
from omsm_ros.protocols.chrocodile import Request
from omsm_ros.protocols.chrocodile_packet import (
    CONFIGURED,
    ERROR,
    FORMATS,
    QUERY,
    TIME_OFFSET,
    UPDATE,
    Command,
    DataFormat,
    Value,
    encode_command,
    encode_data,
    encode_format,
)
from omsm_ros.protocols.chrocodile_packet_decoder import PacketDecoder
from omsm_ros.protocols.chrocodile_telegram import S32, SIGNALS

# Samples in a packet: a device that sent each alone would waste its line.
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
        """Tell a new client everything, ``CONF`` last."""
        self._packets.reset()
        for name in ("SHZ", "LAI", "AVD", "SODX"):
            values = tuple(map(_number, self._values[name].split()))
            self.say(encode_command(Command(name, values, UPDATE)))
        self.say(encode_format(self._format))
        self.say(encode_command(Command(CONFIGURED, (), UPDATE)))

    def receive(self, data: bytes) -> None:
        """Take commands, in any portions."""
        for message in self._packets.feed(data):
            if isinstance(message, Command):
                self._obey(message)

    def _obey(self, asked: Command) -> None:
        words = (ASK,) if asked.flags & QUERY else tuple(map(_text, asked.values))
        text = self._answer(Request(b"", asked.name, words))
        flags = ERROR if text == _REFUSED else 0
        if asked.name == "VER" or flags:
            values: tuple[Value, ...] = (text,)
        else:
            values = tuple(map(_number, text.split())) if text else asked.values
        self.say(encode_command(Command(asked.name, values, flags, asked.ticket)))
        if asked.name in ("SODX", "SHZ") and not asked.flags & QUERY:
            self._describe()
            self.say(encode_format(self._format))

    def _describe(self) -> None:
        """Announce a new data format; its order is the device's own."""
        self._format_counter += 1
        numbers = sorted(self._layout.signals)
        signals = tuple((n, SIGNALS[n].type, 1) for n in numbers)
        if self._triggered:
            signals = ((TIME_OFFSET, S32, 1), *signals)
        self._format = DataFormat(self._format_counter, self.rate(), signals)

    def pack(self, measured: Measured, counters: np.ndarray, times_ns: np.ndarray) -> list[bytes]:
        """Return packets in the places of their first samples."""
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


def _text(value: Value) -> str:
    return value if isinstance(value, str) else f"{value:.9g}"
