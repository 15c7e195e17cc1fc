"""Blocks and three-byte values of Micro-Epsilon: the wire by hand, every split, every damage."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from omsm_ros.core.streams.blocks import Status
from omsm_ros.errors import ProtocolError
from omsm_ros.instruments.micro_epsilon.protocol import (
    BlockDecoder,
    MeasurementBlock,
    SerialDecoder,
    channel_dtype,
    confocal_dtype,
    distance_of,
    encode_block,
    encode_frames,
    intensity_leads,
    values_of,
)

FLAGS = (1 << 8 | 1 << 11 | 1 << 15 | 1 << 19, 0)
DTYPE = confocal_dtype(FLAGS)


def block(first: int, count: int) -> MeasurementBlock:
    frames = np.zeros(count, DTYPE)
    frames["counter"] = np.arange(first, first + count)
    frames["encoder 1"] = -frames["counter"].astype(int)
    raw = frames.view(np.uint8).reshape(count, DTYPE.itemsize)
    return MeasurementBlock(2418004, 11020009, FLAGS, first, raw)


def wire(first: int, count: int) -> bytes:
    return encode_block("confocal", block(first, count))


def decoder() -> BlockDecoder:
    return BlockDecoder("confocal", confocal_dtype)


def counters(found: list[MeasurementBlock]) -> list[int]:
    return [int(c) for b in found for c in b.frames.reshape(-1).view(DTYPE)["counter"]]


# Blocks, by hand.


def decoded(sent: bytes, made: BlockDecoder | None = None) -> list[MeasurementBlock]:
    """Return the blocks in ``sent``, the last bytes of a stream."""
    made = made or decoder()
    return made.feed(sent) + made.settle()


@pytest.mark.parametrize("preamble", [b"MEAS", b"SAEM"])
def test_a_confocal_block_by_hand(preamble: bytes) -> None:
    head = preamble + struct.pack("<IIIIHHI", 1, 2, *FLAGS, 1, 16, 77)
    (found,) = decoded(head + struct.pack("<iIiI", -5, 77, 123_456, 512))
    assert (found.order, found.serial, found.counter) == (1, 2, 77)
    frame = found.frames.reshape(-1).view(DTYPE)[0]
    assert [frame[n].item() for n in ("encoder 1", "counter", "distance 1", "intensity 1")] == [
        -5, 77, 123_456, 512,
    ]  # fmt: skip


def test_a_capacitive_block_by_hand() -> None:
    head = b"MEAS" + struct.pack("<IIQIHHI", 1, 2, 0b010001, 0, 2, 8, 9)
    made = BlockDecoder("capacitive", lambda kind: channel_dtype(kind[0]))
    (found,) = decoded(head + struct.pack("<4i", 1, 2, 3, 4), made)
    frames = found.frames.reshape(-1).view(channel_dtype(0b010001))
    assert frames.dtype.names == ("channel 1", "channel 3")
    assert frames["channel 3"].tolist() == [2, 4]


def test_numbers_of_frames_and_of_bytes_stand_in_either_order() -> None:
    head = b"SAEM" + struct.pack("<IIQIHHI", 1, 2, 0b0101, 0, 8, 3, 9)
    made = BlockDecoder("capacitive", lambda kind: channel_dtype(kind[0]))
    (found,) = decoded(head + struct.pack("<6i", *range(6)), made)
    assert found.frames.shape == (3, 8)
    assert found.counter == 9
    assert decoded(head[:-8] + struct.pack("<HHI", 7, 3, 9) + bytes(24), made) == []


NO_PEAK = 0x7FFFFF04


@pytest.mark.parametrize(
    ("words", "leads"),
    [
        ([(62_345, 512), (41_000, 9000 << 16 | 800)], False),
        ([(512, 62_345), (9000 << 16 | 800, 41_000)], True),
        ([(NO_PEAK, 0)], False),
        ([(0, NO_PEAK)], True),
        ([(66_000, 512)], None),  # the distance could be an intensity, too
        ([(66_000, 512), (-77, 3)], False),
        ([(5_000_000, 70_000)], None),  # neither
    ],
)
def test_the_words_tell_which_is_the_intensity(words: Any, leads: bool | None) -> None:
    assert intensity_leads(np.array(words, np.int64), 100_000.0) is leads


def test_flags_decide_on_the_frame() -> None:
    assert confocal_dtype((1 << 18, 0)).names == ("distance 1",)
    both = (1 << 15 | 1 << 19, 0)
    assert confocal_dtype(both).names == ("distance 1", "intensity 1")
    video = confocal_dtype((1 << 0 | 1 << 7 | 3 << 19 | 1 << 26, 1 << 15))
    assert video.names == ("video 0", "exposure", "distance 1", "distance 2", "error", "minimum")
    assert video.itemsize == 1024 + 5 * 4
    with pytest.raises(ProtocolError, match="no distance"):
        confocal_dtype((1 << 8, 0))
    with pytest.raises(ProtocolError, match="no channel"):
        channel_dtype(0)


# Blocks, split and damaged.


@given(st.lists(st.integers(1, 20), min_size=1, max_size=6), st.data())
def test_any_split_gives_the_same_blocks(sizes: list[int], data: st.DataObject) -> None:
    firsts = np.cumsum([0, *sizes]).tolist()
    sent = b"".join(wire(f, n) for f, n in zip(firsts, sizes, strict=False))
    cuts = sorted(data.draw(st.lists(st.integers(0, len(sent)))))
    made = decoder()
    found = []
    for a, b in zip([0, *cuts], [*cuts, len(sent)], strict=True):
        found += made.feed(sent[a:b])
    found += made.settle()
    assert counters(found) == list(range(firsts[-1]))
    assert made.statistics.bytes_discarded == 0


def test_byte_by_byte() -> None:
    sent = wire(0, 30) + wire(30, 30)
    made = decoder()
    found = [b for i in range(len(sent)) for b in made.feed(sent[i : i + 1])]
    assert counters(found) == list(range(30))  # what follows the others has not come
    assert counters(found + made.settle()) == list(range(60))
    assert made.settle() == []


def test_what_is_not_whole_does_not_settle() -> None:
    made, sent = decoder(), wire(0, 5)
    made.feed(sent[:-3])
    assert made.settle() == []
    assert counters(decoded(sent[-3:], made)) == list(range(5))


def test_a_block_that_bytes_were_added_to_is_none() -> None:
    sent = bytearray(wire(0, 5) + wire(5, 5) + wire(10, 5))
    sent[60:60] = b"\x07\x08"
    assert counters(decoded(bytes(sent))) == list(range(5, 15))


@given(st.binary(max_size=300))
def test_after_any_garbage_the_next_block_but_one_is_decoded(noise: bytes) -> None:
    found = counters(decoded(noise + wire(0, 5) + wire(5, 5)))
    assert found[-5:] == [5, 6, 7, 8, 9]


@given(st.integers(0, 500), st.integers(1, 107))
def test_lost_bytes_invent_nothing(place: int, lost: int) -> None:
    """Shorter than a block: one as long fits the beginning of another."""
    sent = b"".join(wire(5 * i, 5) for i in range(5))
    place = min(place, len(sent) - 1)
    found = decoded(sent[:place] + sent[place + lost :])
    whole = {b.frames.tobytes() for b in (block(5 * i, 5) for i in range(5))}
    assert len(found) >= 3  # at most two of five blocks are hurt
    assert all(b.frames.tobytes() in whole for b in found)


@given(st.lists(st.binary(max_size=200), max_size=20), st.integers(0, 200), st.integers(0, 255))
def test_noise_and_mutations_raise_nothing(portions: list[bytes], place: int, value: int) -> None:
    made = decoder()
    mutated = bytearray(wire(0, 3))
    mutated[place % len(mutated)] = value
    for portion in [bytes(mutated), *portions]:
        made.feed(portion)
    found = made.statistics
    assert found.bytes_discarded >= 0
    assert found.bytes_pending <= (1 << 20) + 300


# Three bytes a value.


def test_a_value_by_hand() -> None:
    # 0b101010_010101_110011, low six bits first
    value = 0b101010_010101_110011
    assert encode_frames(np.array([[value]])) == bytes([0b00110011, 0b01010101, 0b10101010])
    both = encode_frames(np.array([[value, value]]))
    assert both[3:] == bytes([0b00110011, 0b01010101, 0b11101010])


def test_the_scale_by_hand() -> None:
    raw = np.array([98_232, 98_232 + 65_536, 262_072, 262_073, 262_076, 262_077, 262_078])
    distance, status = distance_of(raw, 300e-6)
    np.testing.assert_allclose(distance[:2], [0.0, 300e-6])
    assert np.isnan(distance[3:]).all()
    assert status.tolist() == [
        0,
        0,
        Status.OUT_OF_RANGE,
        *[Status.NO_TARGET] * 2,
        *[Status.OUT_OF_RANGE] * 2,
    ]
    assert values_of(np.array([0.0, 300e-6, np.nan]), 300e-6).tolist() == [98_232, 163_768, 262_076]


frames = st.integers(1, 3).flatmap(
    lambda width: st.lists(
        st.lists(st.integers(0, 2**18 - 1), min_size=width, max_size=width), min_size=1, max_size=8
    )
)


@given(frames, st.data())
def test_any_split_gives_the_same_values(rows: list[list[int]], data: st.DataObject) -> None:
    sent = encode_frames(np.array(rows))
    cuts = sorted(data.draw(st.lists(st.integers(0, len(sent)))))
    made = SerialDecoder(len(rows[0]))
    edges = zip([0, *cuts], [*cuts, len(sent)], strict=True)
    found = np.concatenate([made.feed(sent[a:b])[0] for a, b in edges])
    assert found.tolist() == rows
    assert made.statistics.malformed == made.statistics.bytes_discarded == 0


@given(st.integers(0, 56), st.integers(1, 20))
def test_a_missing_byte_shows(place: int, lost: int) -> None:
    assume(lost % 3)  # three bytes may take a value's end and give it another's
    rows = np.arange(20)[:, np.newaxis] * 1000
    sent = encode_frames(rows)
    made = SerialDecoder(1)
    values, spoilt = made.feed(sent[:place] + sent[place + lost :])
    assert set(values[:, 0].tolist()) <= set(rows[:, 0].tolist())
    assert len(values) >= 20 - lost // 3 - 2
    assert place + lost > len(sent) - 3 or spoilt.sum() == 1


@given(st.lists(st.binary(max_size=100), max_size=20), st.integers(1, 3))
def test_noise_on_the_line_raises_nothing(portions: list[bytes], width: int) -> None:
    made = SerialDecoder(width)
    for portion in portions:
        made.feed(portion)
        assert made.statistics.bytes_pending < 3 * width
    good = encode_frames(np.arange(2 * width).reshape(2, width))
    assert made.feed(good)[0][-1].tolist() == list(range(width, 2 * width))
