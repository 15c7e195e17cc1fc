"""Decoders against wires that are written a second time: values, every split, noise before them."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from soaked import soaked

from omsm_ros.instruments.chrocodile.emulator import RequestParser
from omsm_ros.instruments.chrocodile.packet_protocol import (
    Data,
    DataFormat,
    PacketCommand,
    PacketDecoder,
    decode_command,
)
from omsm_ros.instruments.chrocodile.protocol import BinaryDecoder, LineDecoder, command
from omsm_ros.instruments.chrocodile.telegram import Layout
from omsm_ros.instruments.micro_epsilon.protocol import (
    BlockDecoder,
    SerialDecoder,
    channel_dtype,
    confocal_dtype,
)
from omsm_ros.instruments.six_channel.protocol import CsvDecoder, FrameDecoder

from . import plain_wires as wires

Values = list[tuple[float, ...]]
# Maker of a decoder, frames, their values, and the function that takes values of its result.
Wire = tuple[Callable[[], Any], list[bytes], Values, Callable[..., Any]]
COUNT = 9


def rows(draw: random.Random, kinds: str) -> Values:
    """Nine samples that count up: u whole without a sign, s with one, f a single; by their bits."""
    made = []
    for k in range(COUNT):
        row: list[float] = [1000 + k]
        for kind in kinds.split():
            bits = int(kind[1:])
            if kind[0] == "f":
                row.append(struct.unpack("<f", struct.pack("<f", draw.uniform(-80, 80)))[0])
            elif kind[0] == "u":
                row.append(draw.getrandbits(bits))
            else:
                row.append(draw.getrandbits(bits) - 2 ** (bits - 1))
        made.append(tuple(row))
    return made


def six_channels(draw: random.Random) -> Wire:
    drawn = rows(draw, "u64 s32 u8 s64 s64 s64 s64 s64")
    sent = [
        wires.six_channels(*(int(v) for v in row[:4]), [int(v) for v in row[4:]]) for row in drawn
    ]

    def values(found: Any) -> Iterator[tuple[float, ...]]:
        for frame in found:
            head = (frame[n].item() for n in ("sequence", "device_time", "distance", "status"))
            yield (*head, *frame["counts"].tolist())

    return FrameDecoder, sent, drawn, values


SIGNALS = (83, 64, 256, 65, 76, 16640, 33024)


def telegrams(draw: random.Random) -> Wire:
    drawn = rows(draw, "u32 f32 s32 u16 s16 s32")
    bits = (16, 32, 0, 32, 16, 16, 32)
    sent = [wires.telegram(*zip(bits, row, strict=True)) for row in drawn]
    return lambda: BinaryDecoder(Layout.of(SIGNALS)), sent, drawn, fields(SIGNALS)


def fields(signals: tuple[int, ...]) -> Callable[..., Any]:
    def values(found: Any) -> Iterator[tuple[float, ...]]:
        for record in found:
            yield tuple(record[str(number)].item() for number in signals)

    return values


def lines(draw: random.Random) -> Wire:
    drawn = rows(draw, "u32 f32 s32 u16 s16 s32")
    sent = [(" " + " ".join(f"{v:.9g}" if isinstance(v, float) else str(v) for v in row) + "\r\n")
            .encode() for row in drawn]  # fmt: skip
    return lambda: LineDecoder(Layout.of(SIGNALS)), sent, drawn, fields(SIGNALS)


def packets(draw: random.Random) -> Wire:
    """Three samples a packet; the first packet says what they hold."""
    drawn = rows(draw, "f32 s32 s16")
    form = wires.packet_format(4, 2000.0, (2, 83), (6, 256), (5, 65), (3, 16640))
    sent = [form]
    for i in range(0, COUNT, 3):
        samples = b"".join(
            wires.little(int(row[0]), 2) + wires.single(row[1])
            + wires.little(int(row[2]), 4) + wires.little(int(row[3]), 2)
            for row in drawn[i : i + 3]
        )  # fmt: skip
        sent.append(wires.packet_data(4, 100 + i, 0, 3, samples))

    def values(found: Any) -> Iterator[tuple[float, ...]]:
        for message in found:
            if isinstance(message, Data):
                yield from fields((83, 256, 65, 16640))(message.records)

    return PacketDecoder, sent, drawn, values


def three_bytes(draw: random.Random) -> Wire:
    drawn = rows(draw, "u18")
    sent = [wires.three_bytes(int(a)) + wires.three_bytes(int(b), False) for a, b in drawn]
    return lambda: SerialDecoder(2), sent, drawn, lambda found: map(tuple, found[0].tolist())


def confocal(draw: random.Random) -> Wire:
    """Encoder, counter, time, distance and its intensity: bits 8, 11, 12, 19 and 15."""
    drawn = rows(draw, "s32 u32 s31 u11")
    flags = wires.little(1 << 8 | 1 << 11 | 1 << 12 | 1 << 15 | 1 << 19, 4) + bytes(4)
    frames = [b"".join(wires.little(int(row[i]), 4) for i in (1, 0, 2, 3, 4)) for row in drawn]
    sent = [wires.block(flags, 1000 + i, frames[i : i + 3]) for i in range(0, COUNT, 3)]
    names = ("counter", "encoder 1", "time", "distance 1", "intensity 1")
    dtype = confocal_dtype((1 << 8 | 1 << 11 | 1 << 12 | 1 << 15 | 1 << 19, 0))

    def values(found: Any) -> Iterator[tuple[float, ...]]:
        for block in found:
            for frame in block.frames.reshape(-1).view(dtype):
                yield tuple(frame[name].item() for name in names)

    return lambda: BlockDecoder("confocal", confocal_dtype), sent, drawn, values


def capacitive(draw: random.Random) -> Wire:
    drawn = rows(draw, "s24")
    kind = wires.little(0b010001, 8)  # channels 1 and 3
    frames = [b"".join(wires.little(int(v), 4) for v in row) for row in drawn]
    sent = [wires.block(kind + bytes(4), i, frames[i : i + 3], b"SAEM") for i in range(0, COUNT, 3)]
    dtype = channel_dtype(0b010001)

    def values(found: Any) -> Iterator[tuple[float, ...]]:
        for block in found:
            for frame in block.frames.reshape(-1).view(dtype):
                yield (frame["channel 1"].item(), frame["channel 3"].item())

    return lambda: BlockDecoder("capacitive", lambda k: channel_dtype(k[0])), sent, drawn, values


def text(draw: random.Random) -> Wire:
    drawn = rows(draw, "u62 s32 u8 s40 s40 s40 s40 s40")
    sent = [(",".join(map(str, row)) + "\n").encode() for row in drawn]
    names = ("sequence", "device_time", "distance", "status", "x", "y", "z", "b", "c")
    return CsvDecoder, sent, drawn, lambda f: (tuple(r[n].item() for n in names) for r in f)


WIRES = (
    six_channels, telegrams, lines, packets, three_bytes, confocal, capacitive, text,
)  # fmt: skip


def synchronised(decoder: Any) -> Any:
    """A decoder that knows that the next byte begins a frame, where it can."""
    if isinstance(decoder, BinaryDecoder | LineDecoder):
        decoder.reset(synchronised=True)
    return decoder


def found_of(decoder: Any, portions: list[bytes], values: Callable[..., Any]) -> Values:
    found = [row for portion in portions for row in values(decoder.feed(portion))]
    if hasattr(decoder, "settle"):
        found += values(decoder.settle())
    return found


@pytest.mark.parametrize("wire", WIRES, ids=lambda wire: wire.__name__)
@pytest.mark.parametrize("seed", [0, *soaked(1, 2)])
def test_every_value_arrives(wire: Any, seed: int) -> None:
    make, sent, drawn, values = wire(random.Random(seed))
    decoder = synchronised(make())
    assert found_of(decoder, [b"".join(sent)], values) == drawn
    assert decoder.statistics.bytes_received == len(b"".join(sent))
    assert decoder.statistics.bytes_pending == 0
    assert getattr(decoder.statistics, "bytes_discarded", 0) == 0


@pytest.mark.parametrize("wire", WIRES, ids=lambda wire: wire.__name__)
def test_a_cut_at_any_byte_changes_nothing(wire: Any) -> None:
    make, sent, drawn, values = wire(random.Random(7))
    whole = b"".join(sent)
    for place in range(len(whole) + 1):
        decoder = synchronised(make())
        assert found_of(decoder, [whole[:place], whole[place:]], values) == drawn, place


@pytest.mark.parametrize("wire", WIRES, ids=lambda wire: wire.__name__)
@pytest.mark.parametrize("seed", [0, *soaked(*range(1, 12))])
def test_after_noise_the_place_is_found_again(wire: Any, seed: int) -> None:
    """Noise at the start costs no more than what stands next to it, and invents nothing."""
    draw = random.Random(seed)
    make, sent, drawn, values = wire(draw)
    decoder = make()
    head = sent[:1] if wire is packets else []
    noise = draw.randbytes(draw.randrange(1, 40)).replace(b"\x00", b"\x01")
    found = found_of(decoder, [*head, noise + b"".join(sent[len(head) :])], values)
    per_frame = 3 if wire in (packets, confocal, capacitive) else 1
    # Noise without an end runs into what follows; of telegrams that are in doubt one more goes.
    spared = drawn[2 * per_frame :]
    assert found[-len(spared) :] == spared
    assert [row for row in found if row in drawn] == found[-len(drawn) :]
    assert decoder.statistics.bytes_received == sum(map(len, [*sent, noise]))


@pytest.mark.parametrize("wire", WIRES, ids=lambda wire: wire.__name__)
def test_bytes_lost_in_the_middle_spoil_their_neighbours_alone(wire: Any) -> None:
    draw = random.Random(3)
    make, sent, drawn, values = wire(draw)
    per_frame = 3 if wire in (packets, confocal, capacitive) else 1
    start = sum(map(len, sent[: 1 + (wire is packets)]))
    whole = b"".join(sent)
    for place in range(start, start + len(sent[-1]) - 1):
        found = found_of(synchronised(make()), [whole[:place] + whole[place + 1 :]], values)
        kept = [row for row in drawn if row in found]
        assert len(kept) >= COUNT - 2 * per_frame, place
        if wire not in (lines, text):  # a digit lost within a number shows nowhere
            assert [row for row in found if row not in drawn] == []


def test_the_plain_wires_themselves_are_right() -> None:
    """Against figures that are published: CRC-32 of "123456789", COBS of its paper, a float."""
    assert wires.crc32(b"123456789") == 0xCBF43926
    assert wires.stuffed(b"\x45\x00\x00\x2c\x4c\x79") == b"\x02\x45\x01\x04\x2c\x4c\x79"
    assert wires.single(-118.625) == bytes.fromhex("00 40 ed c2")


@pytest.mark.parametrize("nanoseconds", [0, 1, 999_999_999, 123_456_789_012_345_678])
def test_a_packet_s_time_is_fixed_point(nanoseconds: int) -> None:
    seconds, rest = divmod(nanoseconds, 10**9)
    # The fraction that is nearest from above: what was cut off must not become a nanosecond less.
    fraction = -(-rest * 2**32 // 10**9)
    decoder = PacketDecoder()
    decoder.feed(wires.packet_format(1, 1000.0, (2, 83)))
    decoder.feed(wires.packet_data(1, seconds, fraction, 2, wires.little(0x00010000, 4)))
    (data,) = decoder.settle()
    assert isinstance(data, Data)
    assert data.times_ns.tolist() == [nanoseconds, nanoseconds + 1_000_000]
    assert data.records["83"].tolist() == [0, 1]


def test_commands_of_packets_carry_every_kind_of_argument() -> None:
    arguments = (
        wires.little(0, 4) + wires.little(-5, 4),
        wires.little(1, 4) + wires.single(12.5),
        wires.little(2, 4) + wires.little(5, 4) + b"ready" + bytes(3),
        wires.little(3, 4) + b"q" + bytes(3),
        wires.little(4, 4) + wires.little(2, 4) + b"\x00\x01" + bytes(2),
    )
    sent = wires.packet_command("CONF", 0x2000, 9, *arguments)
    (found,) = PacketDecoder().feed(sent)
    assert found == PacketCommand("CONF", (-5, 12.5, "ready", "q", b"\x00\x01"), 0x2000, 9)
    assert decode_command(sent[20:]) == found


def test_a_format_says_rate_and_types_and_a_newer_one_counts() -> None:
    decoder = PacketDecoder()
    (form,) = decoder.feed(wires.packet_format(7, 4000.0, (5, 33024), (2, 83)))
    assert form == DataFormat(7, 4000.0, ((33024, 5, 1), (83, 2, 1)))
    sample = wires.little(-70_000, 4) + wires.little(9, 2)
    decoder.feed(wires.packet_data(6, 0, 0, 1, sample))  # of a format that was before
    decoder.feed(wires.packet_data(7, 0, 0, 1, sample))
    (data,) = decoder.settle()
    assert (data.records["33024"].tolist(), data.records["83"].tolist()) == ([-70_000], [9])
    assert decoder.statistics.unformatted == 1


@pytest.mark.parametrize(
    ("sent", "arguments"),
    [
        (b"$SHZ 1000\r", ("1000",)),
        (b"$SHZ 12.5 ?\r", ("12.5", "?")),
        (b"$SODX 83 256 65 66 67\r", ("83", "256", "65", "66", "67")),
    ],
)
def test_commands_are_read_and_written_as_the_manual_has_them(
    sent: bytes, arguments: tuple[str, ...]
) -> None:
    (request,) = RequestParser().feed(b"\x00\xff" + sent)
    assert (request.wire, request.arguments) == (sent, arguments)
    assert command(request.name, *arguments) == sent


@pytest.mark.parametrize("sync", [b"\xff\xff", b"\x12\x34", b"\x00\x00"])
def test_another_pair_of_sync_bytes(sync: bytes) -> None:
    layout = Layout.of((83, 65), sync)
    sent = b"".join(wires.telegram((16, k), (32, -k), sync=sync) for k in range(5, 30))
    decoder = BinaryDecoder(layout)
    found = np.concatenate([decoder.feed(b"\x07" + sent), decoder.settle()])
    assert found["83"].tolist() == [*range(5, 30)]
    assert found["65"].tolist() == [-k for k in range(5, 30)]
