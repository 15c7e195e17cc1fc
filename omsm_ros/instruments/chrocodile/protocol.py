"""Encodes and decodes the dollar protocol of Precitec CHRocodile probes.

A command is ``$``, three or more capitals, arguments separated by spaces, CR. The device ends
the telegram it is sending, echoes the command, answers, sends ``ready`` CR LF and continues.

The two sync bytes of a telegram also occur in the data, in each telegram where an encoder is at -1.
So the decoder counts bytes from ``ready`` on, and searches only if a sync is missing or the sample
counter jumps. If several places could begin a telegram, the sample counter decides. A telegram is
accepted once sync and counter of the next one have arrived: bytes lost inside it show there. A bit
flipped in a counter shows by the even steps of its neighbours, one in a value cannot be detected.
"""

import math
import re
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from omsm_ros.errors import ConfigurationError
from omsm_ros.instruments.chrocodile.telegram import (
    FORMATS,
    MAX_TELEGRAM_BYTES,
    SAMPLE_COUNTER,
    Layout,
    Records,
)
from omsm_ros.instruments.counting import WireCounts

# A counter that goes on by more jumps [samples].
_NEAR = 16
# Telegrams in a row whose counters go on in even steps, which confirm each other.
_ROW = 3
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
        # Telegrams without a loss between them, of which the first ones are decided, and whether
        # the buffer goes on with the next one; where the counter jumps, that shows they are whole.
        self._row, self._decided, self._joined = b"", 0, False
        self._received = self._telegrams = self._losses = self._jumps = 0

    def reset(self, *, synchronised: bool) -> None:
        """Discard an incomplete telegram; ``synchronised``: the next byte begins one."""
        self._buffer = self._row = b""
        self._synchronised, self._joined, self._decided = synchronised, False, 0

    def feed(self, data: bytes) -> Records:
        """Return telegrams that ``data`` confirms, shape (n,); n may be 0."""
        self._received += len(data)
        self._buffer += data
        parts, found = [], False
        while self._synchronised or (found := self._search()):
            if not self._joined:
                parts.append(self._even(b"", 1))
            parts.append(self._even(self._take(b"" if found else self._row)))
            if self._synchronised:
                break
        return self._counted(b"".join(parts))

    def settle(self) -> Records:
        """Return the last telegrams if they are complete and no byte follows; shape (n,)."""
        count, rest = divmod(len(self._buffer), self._layout.length)
        placed = count == 1 and (self._synchronised or self._joined)
        whole = not rest and (placed or 1 < count <= _ROW)
        if not (whole and self._buffer.startswith(self._layout.sync)):
            return np.empty(0, self._dtype)
        before = b"" if self._joined else self._even(b"", 1)
        last = self._even(self._buffer, math.inf)
        self._buffer, self._synchronised = b"", True
        return self._counted(before + last)

    def _counted(self, wire: bytes) -> Records:
        found = np.frombuffer(wire, self._dtype)
        self._telegrams += len(found)
        return found

    def _even(self, wire: bytes, most: float = -1) -> bytes:
        """Return the telegrams whose counters are in even steps with two neighbours.

        Those that the next ones may confirm wait for them, unless none follow, as ``most`` says:
        with fewer than three, their greatest step.
        """
        last = most >= 0
        row, length = self._row + wire, self._layout.length
        even = self._counter.even(row, len(row) // length, most)
        stop = len(even) if last else max(self._decided, len(even) - 2)
        stop += int(np.argmin([*even[stop:], False]))
        if self._joined and not (self._synchronised or last):
            stop = max(min(stop, len(even) - 1), self._decided)
        new = np.frombuffer(row, self._dtype, stop)[self._decided :]
        found = new[even[self._decided : stop]].tobytes()
        kept = 0 if last else min(stop, 2)
        self._row, self._decided = row[(stop - kept) * length :] if not last else b"", kept
        return found

    @property
    def statistics(self) -> WireCounts:
        """Return the counts of bytes, telegrams, and losses of synchronisation."""
        decoded = self._telegrams * self._layout.length
        waits = len(self._buffer) + len(self._row) - self._decided * self._layout.length
        counts = {"telegrams": self._telegrams, "bad_counters": self._jumps}
        return WireCounts(self._received, decoded, waits, losses_of_sync=self._losses, **counts)

    def _take(self, row: bytes) -> bytes:
        """Return telegrams up to the last one that is followed by another, or to a missing sync.

        row: those before, with which a jump of the counter shows
        """
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
        leap = self._counter.leap(row, buffer, begun)
        if leap == begun and not len(bad):
            self._buffer, self._joined = buffer[count * length :], True
            return buffer[: count * length]
        self._joined = leap < begun
        count = leap if self._joined else count
        self._buffer = buffer[count * length + (not self._joined and bad[0] > 0) :]
        self._synchronised = False
        self._losses += 1
        return buffer[: count * length]

    def _search(self) -> bool:
        """Go to the beginning of telegrams; drop the bytes before it."""
        length, size = self._layout.length, len(self._buffer)
        raw = np.frombuffer(self._buffer + bytes(2 * length), np.uint8)
        first, second = self._layout.sync
        starts = np.flatnonzero((raw[:size] == first) & (raw[1 : size + 1] == second))
        after = starts + length
        # Two telegrams begin here, or may when all bytes have come.
        fits = (raw[after] == first) & (raw[after + 1] == second) | (after + 2 > size)
        steps = np.where(after + length > size, 1, self._counter.steps(raw, starts))
        # Where a line loses samples all the time, a longer row of small steps decides.
        for most, row in ((1, _ROW), (_NEAR, _ROW**2)):
            known = set(starts[fits & (steps >= 1) & (steps <= most)].tolist())
            rows = ((p, range(p, p + row * length, length)) for p in sorted(known))
            places = (p for p, due in rows if all(n in known or n + 2 > size for n in due))
            place = next(places, size - self._buffer.endswith(bytes([first])))
            self._synchronised = place + (row + 1) * length <= size
            if self._synchronised:
                break
        self._jumps += int(np.sum(fits & (starts < place) & (steps > _NEAR)))
        self._buffer = self._buffer[place:]
        if place and self._joined:
            self._row, self._joined = self._row[:-length], False
        return self._synchronised


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

    def steps(self, raw: NDArray[np.uint8], starts: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return the steps of counters of telegrams in ``raw`` at ``starts`` (n,) to the next."""
        if not self._has_one:
            return np.ones(len(starts), np.intp)
        here, after = (self._read(raw, places) for places in (starts, starts + self._length))
        return np.asarray((after - here) % self._modulus)

    def even(self, wire: bytes, count: int, most: float) -> NDArray[np.bool_]:
        """Return which of ``count`` telegrams in ``wire`` have even or small steps around, (n,).

        most: greatest step of fewer telegrams than a row has
        """
        if not (self._has_one and count):
            return np.ones(count, np.bool_)
        raw = np.frombuffer(wire, np.uint8)
        steps = self.steps(raw, self._length * np.arange(count - 1))
        if count < _ROW:
            return np.full(count, steps.max(initial=0) <= most)
        even = (steps[1:] == steps[:-1]) & (steps[1:] <= _NEAR)
        good = np.convolve(even, np.ones(_ROW)) > 0
        each = raw[: count * self._length].reshape(count, self._length)
        small = (steps <= _NEAR) & ((steps > 0) | (each[1:] == each[:-1]).all(axis=1))
        near = np.convolve(small, np.ones(4), "valid") == 4
        # Small steps suffice where a line loses or repeats samples, but not between two rows.
        good[2:-2] |= near[: max(0, count - 4)] & ~(good[1:-3] & good[3:-1])
        return good

    def leap(self, row: bytes, wire: bytes, begun: int) -> int:
        """Return the first of the ``begun`` telegrams in ``wire`` after a jump, or ``begun``.

        A constant counter, or the same step twice, is no jump.  row: telegrams before them
        """
        if not self._has_one or not begun:
            return begun
        known = len(row) // self._length
        raw = np.frombuffer(row + wire, np.uint8)
        steps = np.append(1, self.steps(raw, self._length * np.arange(known + begun - 1)))
        leaps = ((steps > _NEAR) & (np.diff(steps, prepend=1) != 0))[known:]
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
        self._line = re.compile(rb"(?: +%s){%d} *\r?" % (_NUMBER_BYTES, len(layout.signals)))
        kinds = [np.dtype(FORMATS[kind]) for kind in layout.types]
        self._whole = np.array([kind.kind != "f" for kind in kinds])
        ranges = [np.iinfo(kind) if kind.kind != "f" else np.finfo(kind) for kind in kinds]
        self._range = np.array([(float(each.min), float(each.max)) for each in ranges]).T
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
        good = [x for x in lines if len(x) < MAX_TELEGRAM_BYTES and self._line.fullmatch(x)]
        shape = len(good), len(self._layout.signals)
        values = np.fromstring(b" ".join(good), sep=" ").reshape(shape)
        inside = (values >= self._range[0]) & (values <= self._range[1])
        fits = (inside & (~self._whole | (values == np.rint(values)))).all(axis=1)
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
        return self._layout.records(0)

    @property
    def statistics(self) -> WireCounts:
        """Return the counts of bytes, telegrams, and damaged lines."""
        counts = {"telegrams": self._telegrams, "losses_of_sync": self._losses}
        return WireCounts(self._received, self._kept, len(self._tail), **counts)


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
