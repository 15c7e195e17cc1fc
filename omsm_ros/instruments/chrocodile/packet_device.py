"""Reads a CHRocodile 2 in the packet protocol, over TCP."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from omsm_ros.errors import DeviceError, DeviceTimeoutError
from omsm_ros.instruments.chrocodile.device import (
    Chrocodile,
    ChrocodileSettings,
    RefusedError,
    settings_from,
)
from omsm_ros.instruments.chrocodile.packet_protocol import (
    CONFIGURED,
    DATA_BODY,
    ERROR,
    HEADER,
    QUERY,
    UPDATE,
    Data,
    Message,
    PacketCommand,
    PacketDecoder,
    Value,
    encode_command,
)
from omsm_ros.instruments.chrocodile.protocol import Answer
from omsm_ros.instruments.counting import SAMPLE, Samples
from omsm_ros.instruments.parameters import NowNs, Values
from omsm_ros.instruments.transport import Transport

_TICKETS = 2**16


class ChrocodilePacketDevice(Chrocodile):
    """Reads packets; each has the device's time of its samples."""

    always_timed = True

    def __init__(
        self, transport: Transport, settings: ChrocodileSettings | None = None, *clocks: Any
    ) -> None:
        super().__init__(transport, settings, *clocks)
        self._decoder = PacketDecoder()
        self._ticket, self._sample_bytes = 0, 1
        self._early: list[Data] = []
        self._commands: list[PacketCommand] = []
        self._said, self._answered = b"", False  # it has answered with a value of its own

    def _begin(self) -> None:
        self._decoder.reset()
        self._early.clear()
        self._commands.clear()
        self._said, self._answered = b"", False
        # A device sends its configuration to a new client, or upon request.
        configured = partial(self._await, "CONF", lambda c: c.name == CONFIGURED)
        try:
            configured(self._answers.seconds / 2)
        except DeviceTimeoutError:
            self._transport.write(encode_command(PacketCommand(CONFIGURED, (), 0, 0)))
            configured()
        self._try("STO")

    def _finish(self) -> None:
        self._early.clear()  # measured before the device was set up
        self._try("STA")

    def _ask(self, name: str, *arguments: str | float, patience: float = 0.0) -> Answer:
        self._ticket = (self._ticket + 1) % _TICKETS
        query = arguments == ("?",)
        values: tuple[Value, ...] = () if query else arguments
        asked = PacketCommand(name, values, QUERY if query else 0, self._ticket)
        self._commands.clear()
        self._transport.write(encode_command(asked))
        answer = self._await(
            name,
            lambda c: c.name == name and c.ticket == asked.ticket and not c.flags & UPDATE,
            patience,
        )
        text = " ".join(
            value if isinstance(value, str) else f"{value:.9g}"
            for value in answer.values
            if not isinstance(value, bytes)
        )
        if query and answer.flags & QUERY and not (answer.values or self._answered):
            raise self._unanswered(name, answer.name.encode())  # the command was echoed
        self._answered |= bool(answer.values) and not values
        if answer.flags & ERROR:
            raise RefusedError(
                f"{self._transport.name} refused {name} {arguments!r}: {text!r}; choose a value "
                "that it accepts"
            )
        return Answer(encode_command(asked), text)

    def _await(
        self, what: str, wanted: Callable[[PacketCommand], bool], patience: float = 0.0
    ) -> PacketCommand:
        asked = self._monotonic()
        while True:
            data = self._read_answer(self._said, partial(self._unanswered, what))
            self._said = (self._said + data)[-64:]
            self._early += self._sorted(self._decoder.feed(data))
            commands, self._commands = self._commands, []
            for command in commands:
                if wanted(command):
                    if not patience:
                        self._answers.note(self._monotonic() - asked)
                    return command
            if self._monotonic() - asked > (patience or self._answers.seconds):
                understood = self._decoder.statistics.packets > 0
                raise self._unanswered(what, b"" if understood else self._said)

    def _sorted(self, messages: Sequence[Message]) -> list[Data]:
        """Return the samples; commands are kept for ``_await``."""
        self._commands += [each for each in messages if isinstance(each, PacketCommand)]
        return [each for each in messages if isinstance(each, Data)]

    def _decode(self, data: bytes) -> Samples:
        early, self._early = self._early, []
        return self._joined([*early, *self._sorted(self._decoder.feed(data))])

    def _ahead(self) -> float:
        """Return the samples of the next packet that have arrived."""
        waiting = int(self._decoder.statistics.bytes_pending) - HEADER.size - DATA_BODY.size
        return max(waiting, 0) / self._sample_bytes

    def _rest(self) -> Samples:
        return self._joined(self._sorted(self._decoder.settle()))

    def _joined(self, measured: Sequence[Data]) -> Samples:
        parts = [self._samples(message) for message in measured]
        self._commands.clear()  # unrequested updates
        return np.concatenate(parts) if parts else np.empty(0, SAMPLE)

    def _samples(self, message: Data) -> Samples:
        self._signals = tuple(number for number, _, _ in message.format.signals)
        if missing := set(self._selection) - set(self._signals):
            self._decoder.reset()  # the bytes that wait hold the same
            raise DeviceError(
                f"{self._transport.name}: signals {sorted(missing)!r} were selected, the device "
                f"sends {self._signals!r}; choose signals that it has"
            )
        self._sample_bytes = message.format.dtype.itemsize
        samples = self._convert(message.records)
        samples["time"] = message.times_ns
        return samples


def make(values: Values, transport: Transport, now_ns: NowNs) -> ChrocodilePacketDevice:
    """Return the device that ``values`` describe."""
    return ChrocodilePacketDevice(transport, settings_from(values), now_ns)
