"""The dollar protocol of Precitec CHRocodile probes: commands, answers, and the stream between.

A command is ``$``, three or more capitals, arguments separated by spaces, CR. The device ends
the telegram it is sending, echoes the command, answers, says ``ready`` CR LF and goes on.
"""

from __future__ import annotations

import re
from typing import NamedTuple

from omsm_ros.errors import ConfigurationError
from omsm_ros.protocols.chrocodile_decoder import BinaryDecoder, LineDecoder
from omsm_ros.protocols.chrocodile_telegram import Records

READY = b"ready\r\n"
QUERY = "?"
# An answer longer than this is none; it bounds what is kept while waiting for ``ready``.
MAX_ANSWER_BYTES = 65_536
MAX_COMMAND_BYTES = 1024

_NAME = re.compile(r"[A-Z]{3,}")
_COMMAND = re.compile(rb"\$([A-Z]{3,})([^A-Z].*)?", re.DOTALL)
# With what ends its line, or without where a telegram follows at once.
_READY = re.compile(
    rb"ready(?: *(?:\r\n|\r(?!\n)(?=.)|\n)|(?=[\x80-\xff])|(?= +[-+.\d]))",
    re.DOTALL | re.IGNORECASE,
)
_NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?")


def command(name: str, *arguments: str | float) -> bytes:
    """Wire bytes of a command; ConfigurationError if it cannot be one."""
    if not _NAME.fullmatch(name):
        raise ConfigurationError(f"command {name!r}, expected three or more capitals")
    words = [a if isinstance(a, str) else f"{a:.10g}" for a in arguments]
    for word in words:
        if not word or not word.isascii() or not word.isprintable() or set(word) & set(" $,"):
            raise ConfigurationError(f"argument {word!r} of command {name!r} cannot be sent")
    return ("$" + " ".join([name, *words]) + "\r").encode()


class Request(NamedTuple):
    """A command as the device received it."""

    wire: bytes
    name: str
    arguments: tuple[str, ...]


class RequestParser:
    """The device's side: bytes in any portions → commands; anything else is passed over."""

    def __init__(self) -> None:
        self._buffer = b""

    def feed(self, data: bytes) -> list[Request]:
        """Return the commands completed by ``data``."""
        *lines, rest = (self._buffer + data).split(b"\r")
        found = [request for line in lines if (request := _request(line)) is not None]
        start = rest.rfind(b"$")
        self._buffer = rest[start:][:MAX_COMMAND_BYTES] if start >= 0 else b""
        return found


def _request(line: bytes) -> Request | None:
    """Return the command that ends ``line``, which a CR followed."""
    match = _COMMAND.fullmatch(line[line.rfind(b"$") :][:MAX_COMMAND_BYTES])
    if match is None:
        return None
    words = (match[2] or b"").decode("latin-1").split()
    return Request(match[0] + b"\r", match[1].decode(), tuple(words))


class Answer(NamedTuple):
    """What the device said between the echo of ``command`` and ``ready``."""

    command: bytes
    text: str

    @property
    def numbers(self) -> tuple[float, ...]:
        """All numbers in the text, in order; the name of the command may stand before them."""
        return tuple(float(word) for word in _NUMBER.findall(self.text))


def answer_wire(wire: bytes, text: str) -> bytes:
    """Return what the device sends upon the command ``wire``: echo, answer, ``ready``."""
    separator = b"\r\n" if text else b""
    return wire + text.encode() + separator + READY


class DollarStream:
    """Everything the device sends, in any portions → telegrams and answers.

    Until a decoder is set, and after ``start``, what is no answer is discarded and counted.
    """

    def __init__(self) -> None:
        self.decoder: BinaryDecoder | LineDecoder | None = None
        self.bytes_outside = 0
        self.last_outside = b""
        self._pending = b""  # a command whose echo has not come yet
        self._held = b""
        self._answering = b""  # a command whose answer is being received
        self._answers: list[Answer] = []

    def start(self) -> None:
        """Forget everything, as after connecting anew."""
        self.decoder = None
        self._pending = self._held = self._answering = b""
        self._answers.clear()

    def expect(self, wire: bytes) -> None:
        """Await the answer to the command ``wire``, which is about to be sent."""
        self._pending = wire
        self._answers.clear()

    def take_answer(self) -> Answer | None:
        """Return the answer to the last command, once."""
        return self._answers.pop() if self._answers else None

    def feed(self, data: bytes) -> list[Records]:
        """Return telegrams that ``data`` completes, in order."""
        self._held += data
        found: list[Records] = []
        while self._held:
            if self._answering:
                if not self._receive():
                    break
            elif self._pending:
                if not self._listen(found):
                    break
            else:
                found += self._decode(self._held)
                self._held = b""
        return [records for records in found if len(records)]

    def settle_answer(self) -> None:
        """End an answer whose ``ready`` nothing follows: the line is silent."""
        if self._answering and self._held.rstrip().lower().endswith(b"ready"):
            self._held = self._held.rstrip() + b"\r\n"
            self._receive()

    def settle(self) -> list[Records]:
        """Return the last telegram before a silence, if it is whole."""
        if self._answering or self.decoder is None:
            return []
        found = self._decode(self._held) if not self._pending else []
        self._held = b"" if not self._pending else self._held
        return [records for records in [*found, self.decoder.settle()] if len(records)]

    def _listen(self, found: list[Records]) -> bool:
        """Return telegrams up to the echo; whether it has come."""
        # Some echo neither the CR nor the case.
        echo, held = self._pending.rstrip(b"\r").lower(), self._held.lower()
        place = held.find(echo)
        if place < 0:
            # Keep what may be the beginning of the echo.
            keep = _overlap(held, echo)
            found += self._decode(self._held[: len(self._held) - keep])
            self._held = self._held[len(self._held) - keep :]
            return False
        found += self._decode(self._held[:place])
        if self.decoder is not None:
            found.append(self.decoder.settle())  # commands begin where a telegram ended
        self._held = self._held[place + len(echo) :]
        self._answering, self._pending = self._pending, b""
        return True

    def _receive(self) -> bool:
        """Return the answer up to ``ready``; whether it is complete."""
        match = _READY.search(self._held)
        if match is None:
            self._held = self._held[-MAX_ANSWER_BYTES:]
            return False
        text = self._held[: match.start()].decode("latin-1").strip()
        self._answers.append(Answer(self._answering, text))
        self._answering, self._held = b"", self._held[match.end() :]
        if self.decoder is not None:
            self.decoder.reset(synchronised=True)
        return True

    def _decode(self, data: bytes) -> list[Records]:
        if self.decoder is not None:
            return [self.decoder.feed(data)]
        self.bytes_outside += len(data)
        self.last_outside = (self.last_outside + data)[-64:]
        return []


def _overlap(data: bytes, word: bytes) -> int:
    """Return the length of the longest end of ``data`` that begins ``word``."""
    for length in range(min(len(data), len(word) - 1), 0, -1):
        if data.endswith(word[:length]):
            return length
    return 0
