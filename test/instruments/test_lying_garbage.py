"""Garbage made of what frames begin with, true or lying: the next good frame but one is decoded."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from omsm_ros.instruments.chrocodile.packet_protocol import (
    DATA,
    MAGIC_BYTES,
    Data,
    DataFormat,
    PacketDecoder,
    encode_data,
    encode_format,
)
from omsm_ros.instruments.chrocodile.protocol import BinaryDecoder
from omsm_ros.instruments.chrocodile.telegram import Layout
from omsm_ros.instruments.micro_epsilon.protocol import (
    BlockDecoder,
    MeasurementBlock,
    channel_dtype,
    encode_block,
)

LAYOUT = Layout.of((83, 65, 256))
FORM = DataFormat(1, 1e3, ((83, 2, 1), (256, 6, 1)))
CHANNELS = (0b0101, 0)
GARBAGES = 60


def telegrams(first: int, count: int) -> list[bytes]:
    records = LAYOUT.records(count)
    records["83"] = np.arange(first, first + count)
    records["65"] = 7
    wire = records.tobytes()
    return [wire[i : i + LAYOUT.length] for i in range(0, len(wire), LAYOUT.length)]


def packets(first: int, count: int) -> list[bytes]:
    made = []
    for k in range(first, first + count):
        records = np.full(3, k, FORM.dtype)
        made.append(encode_data(FORM, records, k * 10**7))
    return made


def blocks(first: int, count: int) -> list[bytes]:
    frames = np.full((3, 8), 7, np.uint8)
    return [
        encode_block("capacitive", MeasurementBlock(1, 2, CHANNELS, k, frames))
        for k in range(first, first + count)
    ]


def counters(name: str, found: Any) -> list[int]:
    if name == "telegrams":
        return [int(counter) for counter in found["83"]]
    if name == "packets":
        return [int(m.records["83"][i]) for m in found if isinstance(m, Data)
                for i in range(0, len(m.records), 3)]  # fmt: skip
    return [block.counter for block in found]


def lie(name: str, random: np.random.Generator) -> bytes:
    if name == "telegrams":
        return LAYOUT.sync + random.bytes(int(random.integers(0, 12)))
    if name == "packets":
        length = int(random.choice([21, 40, 100, 4096, 2**31 - 1, -5, 0]))
        head = MAGIC_BYTES + struct.pack("<i8xI", length, DATA)
    else:
        frames, width = int(random.choice([1, 3, 65_535])), int(random.choice([8, 8, 0]))
        head = struct.pack("<4sIIQIHHI", b"MEAS", *random.integers(0, 5, 2), 5, 0, frames, width, 5)
    return head[: int(random.choice([4, len(head), len(head)]))]


CASES: dict[str, tuple[Callable[[], Any], Callable[[int, int], list[bytes]]]] = {
    "telegrams": (lambda: BinaryDecoder(LAYOUT), telegrams),
    "packets": (PacketDecoder, packets),
    "blocks": (lambda: BlockDecoder("capacitive", lambda kind: channel_dtype(kind[0])), blocks),
}


@pytest.mark.parametrize("name", CASES)
def test_after_lying_garbage_the_next_good_frame_but_one_is_decoded(name: str) -> None:
    make, frames = CASES[name]
    random = np.random.default_rng(3)
    for _ in range(GARBAGES):
        decoder, garbage = make(), b""
        if name == "packets":
            decoder.feed(encode_format(FORM))
        for _ in range(int(random.integers(1, 8))):
            whole = frames(int(random.integers(100, 900)), 1)[0]
            part = whole[: int(random.integers(1, len(whole)))]
            garbage += bytes((random.choice(3) == 0 and part) or lie(name, random))
        found = counters(name, decoder.feed(garbage + b"".join(frames(40_000, 8))))
        assert set(range(40_001, 40_006)) <= set(found), garbage.hex()
