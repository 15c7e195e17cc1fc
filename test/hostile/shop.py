"""What shops make of good files: tables written by other programs, recordings gone wrong whole."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
from hostile.bag_inputs import messages_of
from hypothesis import strategies as st
from rosbags.rosbag2 import StoragePlugin

Rows = list[list[str]]
Text = Callable[[Rows], bytes]
"""Makes a text of rows of cells, the names first."""


def written(rows: Rows, mark: str = ",", end: str = "\n") -> bytes:
    """The text of ``rows``."""
    return (end.join(mark.join(row) for row in rows) + end).encode()


def _comma(rows: Rows) -> Rows:
    return [rows[0], *([cell.replace(".", ",") for cell in row] for row in rows[1:])]


def _with_line(rows: Rows, line: list[str]) -> Rows:
    middle = (len(rows) + 1) // 2
    return [*rows[:middle], line, *rows[middle:]]


def _with_column(rows: Rows, name: str, place: int) -> Rows:
    body = enumerate(rows[1:])
    columns = [(rows[0], name), *((row, str(number)) for number, row in body)]
    return [[*row[:place], cell, *row[place:]] for row, cell in columns]


HARMLESS: dict[str, Text] = {
    "as Windows ends lines": lambda rows: written(rows, end="\r\n"),
    "as old Macs did": lambda rows: written(rows, end="\r"),
    "with a mark": lambda rows: b"\xef\xbb\xbf" + written(rows),
    "blanks between cells": lambda rows: written(rows, " , "),
    "blank lines": lambda rows: written(rows[:20]) + b"\n  \n" + written(rows[20:]) + b"\n\t\n",
    "a delimiter at each end": lambda rows: written([[*row, ""] for row in rows]),
    "a column more": lambda rows: written(_with_column(rows, "remark", len(rows[0]))),
    "numbered lines": lambda rows: written(_with_column(rows, "", 0)),
    "turned about": lambda rows: written([row[::-1] for row in rows]),
    "no end": lambda rows: written(rows).rstrip(),
    "a remark": lambda rows: written(rows[:9]) + b"# dry, 20 degrees\n" + written(rows[9:]),
}
"""What changes nothing, if the file is read at all."""

HARMFUL: dict[str, Text] = {
    "decimal commas": lambda rows: written(_comma(rows)),
    "decimal commas, quoted": lambda rows: written([[f'"{c}"' for c in r] for r in _comma(rows)]),
    "semicolons and decimal commas": lambda rows: written(_comma(rows), ";"),
    "no names": lambda rows: written(rows[1:]),
    "a name twice": lambda rows: written([[*row, row[0]] for row in rows]),
    "a column less": lambda rows: written([row[1:] for row in rows]),
    "a line short": lambda rows: written(_with_line(rows, rows[-1][:-1])),
    "a line long": lambda rows: written(_with_line(rows, [*rows[-1], "1"])),
    "names of another unit": lambda rows: written([[f"{n}_furlong" for n in rows[0]], *rows[1:]]),
    "a line of marks": lambda rows: written(_with_line(rows, ["---"] * len(rows[0]))),
    "averages at the end": lambda rows: written([*rows, ["mean", *rows[-1][1:]]]),
    "names once more": lambda rows: written([*rows, *rows]),
    "cut short": lambda rows: written([*rows[:-1], [""] * len(rows[0])]).rstrip() + b"-",
    "zeros behind it": lambda rows: written(rows) + bytes(512),
    "a page of the web": lambda rows: b"<html><body>404</body></html>\n",
}
"""What makes it another file, or none; a right answer is none."""

_ODD = ("", "nan", "inf", "1e400", "1,5", "1_000", "0x1p3", "#N/A", "---", "5e-324", "-1e308",
        "\x00", "1 2", "'1'", "1d-3", "1%", "9" * 400)  # fmt: skip
_SCALES = (0.0, -1.0, 1e-3, 1e3, 1e6, 1e-300, 1e200)
_OFFSETS = (1.0, 1e6, 1e9)


def rows_of(text: bytes, mark: str | None = ",") -> Rows:
    """The cells of a good text."""
    return [line.split(mark) for line in text.decode().lstrip("# ").splitlines()]


@st.composite
def texts(draw: st.DrawFn, good: bytes, mark: str | None = ",") -> bytes:
    """A good table as another program, another unit or a careless hand would have it."""
    rows = rows_of(good, mark)
    match draw(st.sampled_from(["as it is", "few", "column", "cell", "order"])):
        case "few":
            rows = rows[: draw(st.integers(1, 70))]
        case "column":
            scale, offset = draw(st.sampled_from(_SCALES)), draw(st.sampled_from((0.0, *_OFFSETS)))
            at = draw(st.integers(0, len(rows[0]) - 1))
            for row in rows[1:]:
                row[at] = repr(float(row[at]) * scale + offset)
        case "cell":
            row = rows[draw(st.integers(1, len(rows) - 1))]
            row[draw(st.integers(0, len(row) - 1))] = draw(st.sampled_from(_ODD))
        case "order":
            how = draw(st.sampled_from((slice(None, 0, -1), slice(1, None, 2), slice(7, 0, -1))))
            rows = [rows[0], *rows[how]]
    ways = {**HARMLESS, **HARMFUL}
    return ways[draw(st.sampled_from(sorted(ways)))](rows)


Change = Callable[[Any], None]
_CHANNELS = ("x", "y", "z", "b", "c", "distance")
_PERIODS = (1e-7, 1e-6, 1e-4, 1e-2, 0.5, 10.0, 1.01, 2.0)


def _channel(name: str, of: Callable[[Any], Any]) -> Change:
    def change(message: Any) -> None:
        if hasattr(message, name):
            setattr(message, name, np.asarray(of(np.asarray(getattr(message, name)))))

    return change


def _status(value: int) -> Change:
    def change(message: Any) -> None:
        if hasattr(message, "distance"):
            message.status = np.full(len(message.distance), value, np.uint8)

    return change


def _paced(factor: float, axes_alone: bool) -> Change:
    """In step with its stamps, as a clock of that pace would have it."""

    def change(message: Any) -> None:
        if axes_alone and hasattr(message, "distance"):
            return
        stamp = message.header.stamp
        whole = int((stamp.sec * 10**9 + stamp.nanosec) * factor)
        stamp.sec, stamp.nanosec = min(whole // 10**9, 2**31 - 1), whole % 10**9
        message.sample_period *= factor

    return change


def _counted(of: Callable[[int], int], axes_alone: bool) -> Change:
    def change(message: Any) -> None:
        if not (axes_alone and hasattr(message, "distance")):
            message.first_sample = of(int(message.first_sample)) % 2**64

    return change


_CHANGES: st.SearchStrategy[Change] = st.one_of(
    st.builds(
        lambda name, scale: _channel(name, lambda v: scale * v),
        st.sampled_from(_CHANNELS), st.sampled_from((0.0, -1.0, 1e-3, 1e3, 1e-310, np.nan)),
    ),
    st.builds(
        lambda name, offset: _channel(name, lambda v: v + offset),
        st.sampled_from(_CHANNELS), st.sampled_from((1.0, 90.0, 1e3, 1e9)),
    ),
    st.builds(
        lambda name, digits: _channel(name, lambda v: np.round(v, digits)),
        st.sampled_from(_CHANNELS), st.integers(3, 8),
    ),
    st.just(_channel("c", lambda v: v % (2 * np.pi))),
    st.builds(_status, st.sampled_from((1, 2, 3, 4, 5, 255))),
    st.builds(_paced, st.sampled_from(_PERIODS), st.booleans()),
    st.builds(
        lambda jump, alone: _counted(lambda n: n + jump, alone),
        st.sampled_from((1, -1, 3, 100, 2**31, 2**32 - 300, 2**53, 2**63)), st.booleans(),
    ),
    st.builds(
        lambda bits, alone: _counted(lambda n: n % 2**bits, alone),
        st.sampled_from((0, 8, 9, 16)), st.booleans(),
    ),
)  # fmt: skip


@st.composite
def streams(draw: st.DrawFn, blocks: list[tuple[Any, Any]]) -> tuple[Any, ...]:
    """How to write a bag that is wrong from end to end, as a wrong setting has it."""
    messages = messages_of(blocks)
    for change in draw(st.lists(_CHANGES, min_size=1, max_size=2)):
        for _, message in messages:
            change(message)
    match draw(st.sampled_from(["whole"] * 3 + ["one", "half", "late", "twice", "alone", "few"])):
        case "one":
            messages = messages[:2]
        case "half":
            messages = messages[len(messages) // 2 :]
        case "late":
            messages = [m for k, m in enumerate(messages) if k % 5]
        case "twice":
            messages = messages + copy.deepcopy(messages)
        case "alone":
            messages = messages[draw(st.integers(0, 1)) :: 2]
        case "few":
            messages = messages[:2]
            _shorten(messages, draw(st.integers(1, 5)))
    return messages, draw(st.sampled_from([StoragePlugin.MCAP, StoragePlugin.SQLITE3])), None


def _shorten(messages: list[tuple[str, Any]], samples: int) -> None:
    for _, message in messages:
        for name in (*_CHANNELS, "intensity", "status"):
            if hasattr(message, name):
                setattr(message, name, getattr(message, name)[:samples])
