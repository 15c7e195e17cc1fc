"""The result of a decoder does not depend on the portions in which bytes arrive."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from omsm_ros.instruments.chrocodile.packet_protocol import (
    Data,
    DataFormat,
    PacketDecoder,
    encode_data,
    encode_format,
)
from omsm_ros.instruments.chrocodile.protocol import BinaryDecoder, LineDecoder
from omsm_ros.instruments.chrocodile.telegram import MAX_TELEGRAM_BYTES, Layout
from omsm_ros.instruments.micro_epsilon.protocol import (
    BlockDecoder,
    MeasurementBlock,
    PlausibleValueFilter,
    SerialDecoder,
    channel_dtype,
    confocal_dtype,
    encode_block,
    encode_frames,
)
from omsm_ros.instruments.six_channel.protocol import (
    COLUMNS,
    FRAME,
    CsvDecoder,
    FrameDecoder,
    encode_lines,
    row_dtype,
)
from omsm_ros.instruments.six_channel.protocol import encode_frames as encode_six_channels

LAYOUT = Layout.of((83, 64, 256, 65))
FORM = DataFormat(1, 1e3, ((83, 2, 1), (256, 6, 1)))
FLAGS = (1 << 11 | 1 << 15 | 1 << 19, 0)
CHANNELS = (0b0101, 0)

Found = list[bytes]


def counted(dtype: np.dtype[np.void], name: str) -> np.ndarray:
    records = np.zeros(12, dtype)
    records[name] = np.arange(12)
    return records


def each(found: Any) -> Found:
    return [record.tobytes() for record in found]


def telegrams() -> list[bytes]:
    records = LAYOUT.records(12)
    records["83"] = np.arange(12)
    return each(records)


def packets() -> list[bytes]:
    return [encode_data(FORM, counted(FORM.dtype, "83")[i : i + 3], i * 10**7) for i in range(9)]


def of_packets(found: Any) -> Found:
    return [
        record.tobytes() + time.tobytes()
        for message in found
        if isinstance(message, Data)
        for record, time in zip(message.records, message.times_ns, strict=True)
    ]


def blocks(form: str, kind: tuple[int, int], width: int) -> list[bytes]:
    return [
        encode_block(form, MeasurementBlock(1, 2, kind, 3 * i, np.full((3, width), i, np.uint8)))
        for i in range(6)
    ]


def of_blocks(found: Any) -> Found:
    return [bytes([block.counter % 256]) + block.frames.tobytes() for block in found]


class Three:
    """Decoder of values of three bytes, and filter of confirmed ones."""

    def __init__(self) -> None:
        self._decoder, self._believed = SerialDecoder(2), PlausibleValueFilter(2)

    def feed(self, data: bytes) -> Found:
        values, spoilt = self._believed.feed(*self._decoder.feed(data))
        return [v.tobytes() + s.tobytes() for v, s in zip(values, spoilt, strict=True)]


# Name → decoder, its good frames, what it found as bytes a sample, what begins its frames.
CASES: dict[str, tuple[Callable[[], Any], list[bytes], Callable[[Any], Found], bytes]] = {
    "telegrams": (lambda: BinaryDecoder(LAYOUT), telegrams(), each, LAYOUT.sync),
    "lines": (
        lambda: LineDecoder(LAYOUT),
        LAYOUT.lines(np.frombuffer(b"".join(telegrams()), LAYOUT.dtype)),
        each,
        b" " * (MAX_TELEGRAM_BYTES - 5),
    ),
    "packets": (PacketDecoder, [encode_format(FORM), *packets()], of_packets, b"\x55\xaa\x55\xaa"),
    "confocal blocks": (
        lambda: BlockDecoder("confocal", confocal_dtype),
        blocks("confocal", FLAGS, 12),
        of_blocks,
        b"MEAS",
    ),
    "capacitive blocks": (
        lambda: BlockDecoder("capacitive", lambda kind: channel_dtype(kind[0])),
        blocks("capacitive", CHANNELS, 8),
        of_blocks,
        b"SAEM",
    ),
    "three bytes": (
        Three,
        [encode_frames(np.array([[i, 7]])) for i in range(12)],
        list,
        b"\x00\x40",
    ),
    "text": (CsvDecoder, encode_lines(counted(row_dtype(COLUMNS), "sequence")), each, b" " * 1020),
    "six channels": (
        FrameDecoder,
        [encode_six_channels(frame[np.newaxis]) for frame in counted(FRAME, "sequence")],
        each,
        b"\x00",
    ),
}


def garbage_among(name: str) -> st.SearchStrategy[bytes]:
    """Good frames, parts of them, what begins them, and noise, in any order."""
    _, good, _, begins = CASES[name]
    whole = st.integers(0, len(good) - 1)
    part = st.builds(lambda i, a, b: good[i][a:b], whole, st.integers(0, 9), st.integers(1, 60))
    pieces = st.one_of(
        st.builds(lambda i, n: b"".join(good[i : i + n]), whole, st.integers(1, 9)),
        part,
        st.just(begins),
        st.binary(max_size=8),
    )
    return st.lists(pieces, max_size=12).map(lambda drawn: good[0] + b"".join(drawn))


@pytest.mark.parametrize("name", CASES)
@given(st.data())
def test_pieces_give_the_same_samples_as_one(name: str, draw: st.DataObject) -> None:
    make, _, samples, _ = CASES[name]
    wire = draw.draw(garbage_among(name))
    cuts = sorted(draw.draw(st.lists(st.integers(0, len(wire)), max_size=6)))
    at_once, in_pieces, by_bytes = make(), make(), make()
    whole = samples(at_once.feed(wire))
    pieces = [wire[a:b] for a, b in zip([0, *cuts], [*cuts, len(wire)], strict=True)]
    assert [s for piece in pieces for s in samples(in_pieces.feed(piece))] == whole
    if len(wire) < 1000:
        found = (by_bytes.feed(wire[i : i + 1]) for i in range(len(wire)))
        assert [s for some in found for s in samples(some)] == whole
