"""Every decoder under megabytes of noise and of damaged streams: no exception, bounded memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from omsm_ros.instruments.chrocodile.packet_protocol import (
    DataFormat,
    PacketDecoder,
    encode_data,
    encode_format,
)
from omsm_ros.instruments.chrocodile.protocol import BinaryDecoder, LineDecoder
from omsm_ros.instruments.chrocodile.telegram import Layout
from omsm_ros.instruments.micro_epsilon.protocol import (
    BlockDecoder,
    MeasurementBlock,
    SerialDecoder,
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

LAYOUT = Layout.of((83, 64, 256, 257, 65))
FORM = DataFormat(1, 1e3, ((83, 2, 1), (256, 6, 1)))
FLAGS = (1 << 11 | 1 << 15 | 1 << 19, 0)


def telegrams() -> bytes:
    records = LAYOUT.records(200)
    records["83"] = np.arange(200)
    return records.tobytes()


def packets() -> bytes:
    return encode_format(FORM) + b"".join(
        encode_data(FORM, np.zeros(20, FORM.dtype), i * 10**7) for i in range(20)
    )


def blocks() -> bytes:
    frames = np.zeros((20, confocal_dtype(FLAGS).itemsize), np.uint8)
    return b"".join(
        encode_block("confocal", MeasurementBlock(1, 2, FLAGS, i * 20, frames)) for i in range(20)
    )


CASES: dict[str, tuple[Callable[[], Any], Callable[[], bytes], int]] = {
    "telegrams": (lambda: BinaryDecoder(LAYOUT), telegrams, 100),
    "lines": (
        lambda: LineDecoder(LAYOUT),
        lambda: b"".join(LAYOUT.lines(LAYOUT.records(200))),
        5000,
    ),
    "packets": (PacketDecoder, packets, 5000),
    "blocks": (lambda: BlockDecoder("confocal", confocal_dtype), blocks, 1 << 21),
    "three bytes": (
        lambda: SerialDecoder(1),
        lambda: encode_frames(np.arange(1000)[:, np.newaxis]),
        3,
    ),
    "text": (CsvDecoder, lambda: b"".join(encode_lines(np.zeros(50, row_dtype(COLUMNS)))), 1100),
    "six channels": (FrameDecoder, lambda: encode_six_channels(np.zeros(50, FRAME)), 100),
}


def damaged(random: np.random.Generator, good: bytes, size: int) -> bytes:
    """``size`` bytes of ``good``, over and over, with bytes changed, lost and put in."""
    raw = np.frombuffer((good * (size // len(good) + 1))[:size], np.uint8).copy()
    places = random.integers(0, size, size // 500)
    raw[places] = random.integers(0, 256, len(places))
    keep = np.ones(size, np.int64)
    keep[random.integers(0, size, size // 3000)] = 0
    keep[random.integers(0, size, size // 3000)] = 2
    return np.repeat(raw, keep).tobytes()


def feed(name: str, size: int) -> None:
    make, stream, most = CASES[name]
    good = stream()
    random = np.random.default_rng(7)
    decoder = make()
    fed = 0
    while fed < size:
        portion = 65_536
        for data in (random.bytes(portion), damaged(random, good, portion)):
            decoder.feed(data)
            fed += len(data)
            assert decoder.statistics.bytes_pending <= most
    before = good_ones(decoder)
    # The rest of the noise costs at most one further frame.
    for _ in range(3):
        decoder.feed(good)
    assert good_ones(decoder) > before


def good_ones(decoder: Any) -> int:
    found = decoder.statistics
    names = ("telegrams", "packets", "frames", "lines")
    return next(getattr(found, name) for name in names if hasattr(found, name))


@pytest.mark.parametrize("name", CASES)
def test_a_megabyte(name: str) -> None:
    feed(name, 10**6)


@pytest.mark.soak
@pytest.mark.parametrize("name", CASES)
def test_a_hundred_megabytes(name: str) -> None:
    feed(name, 10**8)
