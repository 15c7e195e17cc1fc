"""Encodes and decodes the dollar protocol of Precitec CHRocodile probes.

A command is ``$``, three or more capitals, arguments separated by spaces, CR. The device ends
the telegram it is sending, echoes the command, answers, sends ``ready`` CR LF and continues.

The two sync bytes of a telegram also occur in the data, in each telegram where an encoder is at -1.
So the decoder counts bytes from ``ready`` on, and searches only if a sync is missing or the sample
counter jumps. If several places could begin a telegram, the sample counter decides. A telegram is
accepted once sync and counter of the next one have arrived: bytes lost inside it show there. A bit
flipped in a value cannot be detected in this protocol.
"""

import itertools
import math
import re
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from omsm_ros.core.streams.blocks import FloatArray
from omsm_ros.errors import ConfigurationError
from omsm_ros.instruments.chrocodile.telegram import (
    FORMATS,
    MAX_TELEGRAM_BYTES,
    SAMPLE_COUNTER,
    Layout,
    Records,
)
from omsm_ros.instruments.counting import WireCounts

# Two telegrams between damaged bytes belong together if at most this many samples are missing.
_NEAR = 16
# A place is accepted after this many telegrams with consecutive counters.
_DEEP = 8
# Matches a number in one way only; with more ways a long run of digits takes hours.
_NUMBER_BYTES = rb"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?"


class BinaryDecoder:
    """Decodes bytes in any portions to telegrams; it never raises."""

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._dtype = layout.dtype
        self._due = int.from_bytes(layout.sync, "big")
        self._buffer = b""
        self._synchronised = False
        self._counter = _Counter(layout)
        # A telegram before a jump of the counter; it is accepted if the next one follows it.
        self._doubtful = b""
        self._in_place = False
        self._received = self._telegrams = self._losses = 0

    def reset(self, *, synchronised: bool) -> None:
        """Discard an incomplete telegram; ``synchronised``: the next byte begins one."""
        self._buffer = self._doubtful = b""
        self._synchronised, self._in_place = synchronised, False
        self._counter.forget()

    def feed(self, data: bytes) -> Records:
        """Return telegrams that ``data`` confirms, shape (n,); n may be 0."""
        self._received += len(data)
        self._buffer += data
        parts = []
        while self._synchronised or self._search():
            parts += [self._cleared(), self._take()]
            if self._synchronised:
                break
        found = np.frombuffer(b"".join(parts), self._dtype)
        self._telegrams += len(found)
        return found

    def settle(self) -> Records:
        """Return the last telegram if it is complete and no byte follows; shape (n,), n 0 to 2."""
        whole = len(self._buffer) == self._layout.length
        placed = self._synchronised or self._in_place
        if not (placed and whole and self._buffer.startswith(self._layout.sync)):
            return np.empty(0, self._dtype)
        found = np.frombuffer(self._cleared() + self._buffer, self._dtype)
        self._buffer, self._synchronised = b"", True
        self._counter.forget()
        self._telegrams += len(found)
        return found

    @property
    def statistics(self) -> WireCounts:
        """Return the counts of bytes, telegrams, and losses of synchronisation."""
        decoded, waits = self._telegrams * self._layout.length, len(self._buffer + self._doubtful)
        counts = {"telegrams": self._telegrams, "losses_of_sync": self._losses}
        return WireCounts(self._received, decoded, waits, **counts)

    def _cleared(self) -> bytes:
        """Return the telegram before a jump, since the next one follows it."""
        cleared, self._doubtful, self._in_place = self._doubtful, b"", False
        return cleared

    def _take(self) -> bytes:
        """Return telegrams up to the last one that is followed by another, or to a missing sync."""
        length, buffer = self._layout.length, self._buffer
        whole = len(buffer) // length
        records = np.frombuffer(buffer, self._dtype, whole)
        bad = np.flatnonzero(records["sync"] != self._due)
        rest = buffer[whole * length :]
        if not len(bad) and not self._layout.sync.startswith(rest[:2]):
            bad = np.array([whole])
        # The telegram before a missing sync is too short or too long, so it is dropped.
        begun = int(bad[0]) if len(bad) else whole + (len(rest) >= self._counter.needs)
        count = max(0, begun - 1)
        leap = self._counter.leap(buffer, begun, count)
        if leap == begun and not len(bad):
            self._buffer = buffer[count * length :]
            return buffer[: count * length]
        if leap < begun:
            count, after = max(0, leap - 1), leap * length
            self._doubtful, self._in_place = buffer[count * length : after], True
        else:
            after = count * length + int(bad[0] > 0)
        self._buffer = buffer[after:]
        self._synchronised = False
        self._losses += 1
        self._counter.forget()
        return buffer[: count * length]

    def _search(self) -> bool:
        """Go to the beginning of telegrams; drop the bytes before it."""
        size = 2 * (_DEEP + 2) * self._layout.length  # enough for a decision
        while True:
            window = self._buffer[:size]
            size *= 4
            place, settled = _first_of(self._places(window), self._layout.length, len(window))
            if place is None:
                place = len(window) - window.endswith(self._layout.sync[:1])
            whole = len(self._buffer) == len(window)
            self._buffer = self._buffer[place:]
            if place:
                self._doubtful, self._in_place = b"", False
            if settled or whole:
                self._synchronised = settled
                return settled

    def _places(self, window: bytes) -> dict[int, int]:
        """Return the places where two telegrams begin, or may, and the step of their counters."""
        length, size = self._layout.length, len(window)
        raw = np.frombuffer(window + bytes(2 * length), np.uint8)
        first, second = self._layout.sync
        sync = (raw[:-1] == first) & (raw[1:] == second)
        starts = np.flatnonzero(sync[:size])
        starts = starts[sync[starts + length] | (starts + length + 2 > size)]
        steps = self._counter.steps(raw, starts)
        found = (starts + 2 * length > size) | ((steps >= 1) & (steps <= _NEAR))
        return dict(zip(starts[found].tolist(), steps[found].tolist(), strict=True))


def _first_of(places: dict[int, int], length: int, size: int) -> tuple[int | None, bool]:
    """Return the first of ``places`` that begins a telegram, and whether that is decided.

    places: [bytes], ascending, of ``size``: where two telegrams begin, or may, and the step of
        their counters. The result is the place within one telegram with the longest
        sequence of telegrams, and of equal ones that with the smallest steps.
    """

    def rank(place: int) -> tuple[float, float]:
        """Return the least and the greatest rank that ``place`` may have."""
        steps = 0
        for here in range(place, place + _DEEP * length, length):
            if here not in places:
                return here, here if here + 2 <= size else math.inf
            if here + 2 * length > size:
                return here, math.inf
            steps += places[here]
        return size + 1 / steps, size + 1 / steps

    candidates = list(places)
    for i, place in enumerate(candidates):
        if place + 2 * length > size:
            return place, False
        least, most = rank(place)
        rivals = itertools.takewhile((place + length).__gt__, candidates[i + 1 :])
        others = [rank(rival) for rival in rivals]
        if all(high <= least for _, high in others):
            return place, True
        if not any(low > most for low, _ in others):
            return place, False
    return None, False


class _Counter:
    """Follows the sample counter of telegrams that have one."""

    def __init__(self, layout: Layout) -> None:
        self._length = layout.length
        self._has_one = SAMPLE_COUNTER in layout.signals
        self.needs = len(layout.sync)
        if self._has_one:
            index = layout.signals.index(SAMPLE_COUNTER)
            self._kind = np.dtype(FORMATS[layout.types[index]])
            self._offset = layout.offsets[index]
            self._modulus = 2 ** (8 * self._kind.itemsize)
            self.needs = self._offset + self._kind.itemsize
        self.forget()

    def forget(self) -> None:
        """Begin with the next telegram."""
        self._last: int | None = None
        self._step = 1

    def steps(self, raw: NDArray[np.uint8], starts: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return the steps from telegrams in ``raw`` at ``starts`` (n,) to the next ones."""
        if not self._has_one:
            return np.ones(len(starts), np.intp)
        here, after = (self._read(raw, places) for places in (starts, starts + self._length))
        return np.asarray((after - here) % self._modulus)

    def leap(self, wire: bytes, begun: int, count: int) -> int:
        """Return the first of the ``begun`` telegrams in ``wire`` after a jump, or ``begun``.

        A constant counter, or the same step twice, is no jump. Those before ``count`` are done.
        """
        if not self._has_one or not begun:
            return begun
        now = self._read(np.frombuffer(wire, np.uint8), self._length * np.arange(begun))
        first = now[0] - self._step if self._last is None else self._last
        steps = np.diff(now, prepend=first) % self._modulus
        leaps = (steps > _NEAR) & (np.diff(steps, prepend=self._step) != 0)
        if count:
            self._last, self._step = int(now[count - 1]), int(steps[count - 1])
        return int(np.argmax(leaps)) if leaps.any() else begun

    def _read(self, raw: NDArray[np.uint8], starts: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return the counters (n,) of telegrams in ``raw`` at ``starts`` (n,)."""
        places = (starts + self._offset)[:, np.newaxis] + np.arange(self._kind.itemsize)
        return raw[places].view(self._kind)[:, 0].astype(np.intp)


class LineDecoder:
    """Decodes ASCII telegrams in any portions to the records of ``BinaryDecoder``.

    A line begins with a space and has a number for each signal; without a checksum, a digit lost
    within a number cannot be detected.
    """

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._dtype = layout.dtype
        self._line = re.compile(rb"(?: +%s){%d} *\r?" % (_NUMBER_BYTES, len(layout.signals)))
        self._limits = _limits(layout)
        self._tail = b""
        self._synchronised = False
        self._received = self._kept = self._telegrams = self._losses = 0

    def reset(self, *, synchronised: bool) -> None:
        """Discard an incomplete line; ``synchronised``: the next byte begins one."""
        self._tail = b""
        self._synchronised = synchronised

    def feed(self, data: bytes) -> Records:
        """Return telegrams completed by ``data``, shape (n,); n may be 0."""
        self._received += len(data)
        *lines, tail = (self._tail + data).split(b"\n")
        short = (line for line in lines if len(line) < MAX_TELEGRAM_BYTES)
        good = [line for line in short if self._line.fullmatch(line) is not None]
        shape = len(good), len(self._layout.signals)
        values = np.fromstring(b" ".join(good), sep=" ").reshape(shape)
        lowest, highest, whole = self._limits
        inside = (values >= lowest) & (values <= highest)
        fits = (inside & (~whole | (values == np.rint(values)))).all(axis=1)
        values = values[fits]
        if lines:
            # The bytes before the first end of a line may be a part of a line.
            begun = self._synchronised or bool(good and fits[0] and good[0] is lines[0])
            self._losses += len(lines) - len(values) - (not begun)
            self._synchronised = True
        self._kept += sum(len(line) + 1 for line, fit in zip(good, fits, strict=True) if fit)
        self._telegrams += len(values)
        self._tail = tail[:MAX_TELEGRAM_BYTES]  # a longer line is not valid
        made = self._layout.records(len(values))
        for number, column in zip(self._layout.signals, values.T, strict=True):
            made[str(number)] = column
        return made

    def settle(self) -> Records:
        """Return no telegram, shape (0,): a line has its own end."""
        return np.empty(0, self._dtype)

    @property
    def statistics(self) -> WireCounts:
        """Return the counts of bytes, telegrams, and damaged lines."""
        counts = {"telegrams": self._telegrams, "losses_of_sync": self._losses}
        return WireCounts(self._received, self._kept, len(self._tail), **counts)


def _limits(layout: Layout) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Return each signal's least and greatest value (signals,), and whether it is whole."""
    kinds = [np.dtype(FORMATS[kind]) for kind in layout.types]
    ranges = [np.finfo(kind) if kind.kind == "f" else np.iinfo(kind) for kind in kinds]
    lowest, highest = ([float(getattr(r, end)) for r in ranges] for end in ("min", "max"))
    return np.array(lowest), np.array(highest), np.array([kind.kind != "f" for kind in kinds])


READY = b"ready\r\n"
QUERY = "?"
# Bounds the memory of an answer without ``ready``.
MAX_ANSWER_BYTES = 65_536

_NAME = re.compile(r"[A-Z]{3,}")
# The end of its line may be missing if a telegram follows at once.
_READY = re.compile(
    rb"ready(?: *(?:\r\n|\r(?!\n)(?=.)|\n)|(?=[\x80-\xff])|(?= +[-+.\d]))",
    re.DOTALL | re.IGNORECASE,
)
_NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?")


def command(name: str, *arguments: str | float) -> bytes:
    """Return the bytes of a command; ConfigurationError if it is not valid."""
    if not _NAME.fullmatch(name):
        raise ConfigurationError(f"command {name!r}, expected three or more capitals")
    words = [a if isinstance(a, str) else f"{a:.10g}" for a in arguments]
    for word in words:
        if not word or not word.isascii() or not word.isprintable() or set(word) & set(" $,"):
            raise ConfigurationError(f"argument {word!r} of command {name!r} cannot be sent")
    return ("$" + " ".join([name, *words]) + "\r").encode()


class Answer(NamedTuple):
    """The text of a device between the echo of ``command`` and ``ready``."""

    command: bytes
    text: str

    @property
    def numbers(self) -> tuple[float, ...]:
        """Return all numbers in the text; the name of the command may precede them."""
        return tuple(float(word) for word in _NUMBER.findall(self.text))


class DollarStream:
    """Separates the bytes of the device, in any portions, into telegrams and answers.

    Without a decoder, and after ``start``, all bytes but those of answers are dropped.
    """

    def __init__(self) -> None:
        self.decoder: BinaryDecoder | LineDecoder | None = None
        self.last_outside = b""
        self._pending = b""  # a command without echo so far
        self._held = b""
        self._answering = b""  # a command whose answer is being received
        self._answers: list[Answer] = []

    def start(self) -> None:
        """Discard everything, as after a new connection."""
        self.decoder = None
        self._pending = self._held = self._answering = b""
        self._answers.clear()

    def expect(self, wire: bytes) -> None:
        """Expect the answer to the command ``wire``, which is about to be sent."""
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
        """End an answer if ``ready`` is followed by a silence."""
        if self._answering and self._held.rstrip().lower().endswith(b"ready"):
            self._held = self._held.rstrip() + b"\r\n"
            self._receive()

    def settle(self) -> list[Records]:
        """Return the last telegram before a silence, if it is complete."""
        if self._answering or self.decoder is None:
            return []
        found = self._decode(self._held) if not self._pending else []
        self._held = b"" if not self._pending else self._held
        return [records for records in [*found, self.decoder.settle()] if len(records)]

    def _listen(self, found: list[Records]) -> bool:
        """Add the telegrams up to the echo to ``found``; return whether it has come."""
        # Some models echo neither the CR nor the case.
        echo, held = self._pending.rstrip(b"\r").lower(), self._held.lower()
        place = held.find(echo)
        if place < 0:
            # Keep a possible beginning of the echo.
            keep = max(n for n in range(len(echo)) if held.endswith(echo[:n]))
            found += self._decode(self._held[: len(self._held) - keep])
            self._held = self._held[len(self._held) - keep :]
            return False
        found += self._decode(self._held[:place])
        if self.decoder is not None:
            found.append(self.decoder.settle())  # an echo follows a complete telegram
        self._held = self._held[place + len(echo) :]
        self._answering, self._pending = self._pending, b""
        return True

    def _receive(self) -> bool:
        """Take the answer up to ``ready``; return whether it is complete."""
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
        self.last_outside = (self.last_outside + data)[-64:]
        return []
